#!/bin/sh
# usd-core 25.11: a mesh's own accessors do not see the primvars that it inherits.
#
# A primvar of constant interpolation is inherited by everything below a prim (UsdGeomPrimvar,
# namespace inheritance), and imaging draws meshes with it. GetDisplayColorAttr and
# GetDisplayColorPrimvar of the mesh are empty all the same; FindPrimvarWithInheritance finds it.
#
# Installs usd-core==25.11 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check usd-core==25.11
cd "$folder"
"$folder/venv/bin/python" - <<'END'
from importlib.metadata import version
from pxr import Usd, UsdGeom
text = ("""#usda 1.0
def Xform "x" {
    color3f[] primvars:displayColor = [(0.1, 0.2, 0.3)] (interpolation = "constant")
    def Mesh "m" {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    }
}
""")
with open("a.usda", "w") as file:
    file.write(text)
stage = Usd.Stage.Open("a.usda")
mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/x/m"))
own, of_primvar = mesh.GetDisplayColorAttr().Get(), mesh.GetDisplayColorPrimvar().Get()
found = UsdGeom.PrimvarsAPI(mesh).FindPrimvarWithInheritance("displayColor").Get()
print("usd-core", version("usd-core"), "gives", own, "and", of_primvar, "by the mesh, and", found, "with inheritance")
assert own is None and of_primvar is None and len(found) == 1, "no longer so"
END
