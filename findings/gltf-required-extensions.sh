#!/bin/sh
# trimesh 5.2.0 and assimp-py 1.1.0 read a glTF that requires an extension which they do not know.
#
# glTF 2.0, 3.12: a loader must fail to load an asset that requires an extension which it does not
# support. Both give the triangle of the file, without a warning; whatever the extension would have
# changed is wrong, as with EXT_mesh_gpu_instancing, of whose two instances one is drawn.
#
# Installs trimesh==5.2.0, numpy==2.3.5, assimp-py==1.1.0 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check trimesh==5.2.0 numpy==2.3.5 assimp-py==1.1.0
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

import warnings
import assimp_py, trimesh
from importlib.metadata import version
warnings.simplefilter("error")
write_gltf(TRIANGLE, {"attributes": {"POSITION": 0}, "indices": 1}, extensionsUsed=["VENDOR_unknown"],
           extensionsRequired=["VENDOR_unknown"])
(mesh,) = trimesh.load_scene("a.gltf", process=False).geometry.values()
other = assimp_py.import_file("a.gltf", assimp_py.Process_Triangulate).meshes
print("trimesh", trimesh.__version__, "reads", len(mesh.faces), "face, assimp-py", version("assimp-py"), "reads", len(other), "mesh")
assert len(mesh.faces) == 1 and len(other) == 1, "no longer read by both"
END
