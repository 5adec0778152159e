#!/bin/sh
# trimesh 5.2.0 divides concave polygons of an OBJ into fans that reach beyond them.
#
# The arrow head (0,0) (2,1) (0,2) (1,1) has the area 1. Cut into a fan from its first corner, its
# triangles are (0,0) (2,1) (0,2) and (0,0) (0,2) (1,1): they cover each other, and three times the
# area.
#
# Installs trimesh==5.2.0, numpy==2.3.5 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check trimesh==5.2.0 numpy==2.3.5
cd "$folder"
"$folder/venv/bin/python" - <<'END'
import trimesh
with open("a.obj", "w") as file:
    file.write("v 0 0 0\nv 2 1 0\nv 0 2 0\nv 1 1 0\nf 1 2 3 4\n")
mesh = trimesh.load_mesh("a.obj", process=False)
print("trimesh", trimesh.__version__, "gives the area", mesh.area, "for 1.0")
assert abs(mesh.area - 3.0) < 1e-9, "the area is no longer 3"
END
