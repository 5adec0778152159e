"""Small glTF files, written whole: each array is an accessor of its own."""

import base64
import io
import json

import numpy as np
from PIL import Image

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4")
FACE = np.array([0, 1, 2], "u2")
QUAD = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], "f4")
FACES = np.array([0, 1, 2, 0, 2, 3], "u2")
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "f4")
_COMPONENTS = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125, "i1": 5120, "i2": 5122}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


def data_uri(data, kind="application/octet-stream"):
    """Return bytes as a URI."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def write_gltf(folder, arrays, primitive, *, normalized=(), edit=None, **document):
    """Write a glTF of one mesh whose accessor i holds arrays[i]; `edit` changes the document last."""
    whole = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "buffers": [{"byteLength": array.nbytes, "uri": data_uri(array.tobytes())} for array in arrays],
        "bufferViews": [{"buffer": index, "byteLength": array.nbytes} for index, array in enumerate(arrays)],
        "accessors": [
            {
                "bufferView": index,
                "componentType": _COMPONENTS[array.dtype.str[1:]],
                "count": len(array),
                "normalized": index in normalized,
                "type": _TYPES[1 if array.ndim == 1 else array.shape[1]],
            }
            for index, array in enumerate(arrays)
        ],
        **document,
    }
    if edit is not None:
        edit(whole)
    path = folder / "a.gltf"
    path.write_text(json.dumps(whole))
    return path


def write_textured(folder, pixels, *, info=None, uv=UV, material=None, attributes=None, arrays=(), **document):
    """Write a square with an image."""
    stream = io.BytesIO()
    Image.fromarray(np.asarray(pixels, "u1")).save(stream, "PNG")
    texture = {"baseColorTexture": {"index": 0, **(info or {})}}
    whole = {
        "images": [{"uri": data_uri(stream.getvalue(), "image/png")}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": texture, **(material or {})}],
        **document,
    }
    places = {"POSITION": 0, "TEXCOORD_0": 2, **(attributes or {})}
    primitive = {"attributes": places, "indices": 1, "material": 0}
    return write_gltf(folder, [QUAD, FACES, uv, *arrays], primitive, **whole)


def looked_up(mesh, points):
    """Return straight RGBA of the image of a square from (−1, −1) to (1, 1) at points of it, as captures look it up."""
    # Along the two triangles coordinates are affine: three corners give them all.
    corners = {tuple(np.sign(vertex[:2]).astype(int)): uv for vertex, uv in zip(mesh.vertices, mesh.uv, strict=True)}
    origin, right, up = corners[-1, -1], corners[1, -1], corners[1, 1]
    image = mesh.textures[0]
    result = []
    for x, y in points:
        u, v = origin + (x + 1) / 2 * (right - origin) + (y + 1) / 2 * (up - right)
        column, row = u * image.shape[1] - 0.5, (1.0 - v) * image.shape[0] - 0.5
        left, top = int(np.floor(column)), int(np.floor(row))
        texel = [
            [image[(top + i) % image.shape[0], (left + j) % image.shape[1]].astype(float) for j in (0, 1)]
            for i in (0, 1)
        ]
        across = [first + (column - left) * (second - first) for first, second in texel]
        result.append(across[0] + (row - top) * (across[1] - across[0]))
    return np.array(result)
