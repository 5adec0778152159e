#!/bin/sh
# trimesh 5.2.0 reads 16-bit vertex colours of a glTF without a material modulo 256.
#
# COLOR_0 may be normalised unsigned shorts (glTF 2.0, 3.7.2.1): 13107 of 65535 is 0.2. Where the
# primitive names no material, trimesh keeps the low byte of each number: 13107 becomes 51, which
# happens to be right, and 6554 becomes 154, 0.60 for 0.10. With a material the numbers are right.
#
# Installs trimesh==5.2.0, numpy==2.3.5 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check trimesh==5.2.0 numpy==2.3.5
cd "$folder"
"$folder/venv/bin/python" - <<'END'
import base64, json
import numpy as np

def write_gltf(arrays, primitive, **more):
    """Write a.gltf, whose accessor i holds arrays[i] (kind, values, normalised)."""
    uri = "data:application/octet-stream;base64,"
    kinds = {"f4": 5126, "u2": 5123}
    arrays = [(np.array(values, kind), normalised) for kind, values, normalised in arrays]
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": a.nbytes, "uri": uri + base64.b64encode(a.tobytes()).decode()} for a, _ in arrays],
        "bufferViews": [{"buffer": i, "byteLength": a.nbytes} for i, (a, _) in enumerate(arrays)],
        "accessors": [{"bufferView": i, "componentType": kinds[a.dtype.str[1:]], "count": len(a), "normalized": n,
                       "type": "SCALAR" if a.ndim == 1 else f"VEC{a.shape[1]}",
                       **({"min": [0, 0, 0], "max": [1, 1, 0]} if i == 0 else {})}
                      for i, (a, n) in enumerate(arrays)],
        **more,
    }
    with open("a.gltf", "w") as file:
        json.dump(document, file)

TRIANGLE = ("f4", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], False), ("u2", [0, 1, 2], False)

import trimesh
colours = ("u2", [[6554, 13107, 19661, 65535]] * 3, True)
write_gltf([*TRIANGLE, colours], {"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1})
(mesh,) = trimesh.load_scene("a.gltf", process=False).geometry.values()
seen = (mesh.visual.vertex_colors[0] / 255.0).round(2).tolist()
print("trimesh", trimesh.__version__, "gives", seen, "for 0.10, 0.20, 0.30, 1.00")
assert seen[0] == 0.6, "the first of them is no longer 0.60"
END
