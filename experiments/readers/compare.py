"""Which reader of mesh files gets what right: writes the table of docs/readers.md.

Each case is a small valid file written here, with the value that its format's specification gives. Readers that are not
installed are left out:

    uv run --with trimesh --with assimp-py --with plyfile --with pygltflib python experiments/readers/compare.py
"""

import base64
import json
import re
import struct
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
BEGIN, END = "<!-- begin of the table -->", "<!-- end of the table -->"
TARGET = ROOT / "docs" / "readers.md"
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4")
QUAD = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], "f4")
FACE = np.array([0, 1, 2], "u2")
XYZ = "property float x\nproperty float y\nproperty float z\n"
LIST = "property list uchar int vertex_indices\n"
ARROW = [(0, 0), (2, 1), (0, 2), (1, 1)]


@dataclass(frozen=True)
class Found:
    """What a reader makes of a file: vertices (V, 3), faces (N, 3), colours of vertices or faces as in the file."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    linear: bool = False

    def area(self) -> float:
        """Return the sum of the areas of all triangles."""
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def gltf(folder: Path, arrays: list[np.ndarray], primitive: dict, edit: Callable[[dict], object] | None = None) -> Path:
    """Write a glTF whose accessor i holds arrays[i]."""
    uri = "data:application/octet-stream;base64,"
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
        "buffers": [{"byteLength": a.nbytes, "uri": uri + base64.b64encode(a.tobytes()).decode()} for a in arrays],
        "bufferViews": [{"buffer": i, "byteLength": a.nbytes} for i, a in enumerate(arrays)],
        "accessors": [
            {
                "bufferView": i,
                "componentType": {"f4": 5126, "u1": 5121, "u2": 5123, "i2": 5122}[a.dtype.str[1:]],
                "count": len(a),
                "type": "SCALAR" if a.ndim == 1 else f"VEC{a.shape[1]}",
            }
            for i, a in enumerate(arrays)
        ],
    }
    document["accessors"][0].update(min=[-1e3] * 3, max=[1e3] * 3)
    if edit is not None:
        edit(document)
    path = folder / "a.gltf"
    path.write_text(json.dumps(document))
    return path


def ply(folder: Path, vertex: str, faces: str, body: str | bytes, count: tuple[int, int], form: str = "ascii") -> Path:
    """Write a PLY file."""
    head = f"ply\nformat {form} 1.0\nelement vertex {count[0]}\n{vertex}{faces.format(count[1])}end_header\n"
    path = folder / "a.ply"
    path.write_bytes(head.encode() + (body.encode() if isinstance(body, str) else body))
    return path


def text(folder: Path, name: str, content: str, **others: str) -> Path:
    """Write a text file and others beside it."""
    for other, lines in others.items():
        (folder / other.replace("_", ".")).write_text(lines)
    (folder / name).write_text(content)
    return folder / name


PLAIN = {"attributes": {"POSITION": 0}, "indices": 1}
FIVE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0)]
LINES = "".join(f"{x} {y} {z}\n" for x, y, z in FIVE)
ELEMENT = "element face {}\n" + LIST
EAST, NORTH = 448262.3, 5411932.7


def mixed(folder: Path) -> Path:
    """A quadrilateral and a triangle in binary."""
    body = b"".join(struct.pack("<3f", *point) for point in FIVE)
    body += b"".join(struct.pack(f"<B{len(f)}i", len(f), *f) for f in ((0, 1, 2, 3), (3, 2, 4)))
    return ply(folder, XYZ, ELEMENT, body, (5, 2), "binary_little_endian")


def strips(folder: Path) -> Path:
    """Two strips of one list."""
    return ply(folder, XYZ, "element tristrips {}\n" + LIST, LINES + "8 0 1 3 2 -1 3 2 4\n", (5, 1))


def far(folder: Path) -> Path:
    """Doubles of a map."""
    points = [(EAST, NORTH, 0), (EAST + 1, NORTH, 0), (EAST, NORTH + 1, 0)]
    body = "".join(f"{x} {y} {z}\n" for x, y, z in points) + "3 0 1 2\n"
    return ply(folder, XYZ.replace("float", "double"), ELEMENT, body, (3, 1))


def deep_colors(folder: Path) -> Path:
    """Colours of 16 bits."""
    colors = "".join(f"property ushort {name}\n" for name in ("red", "green", "blue"))
    body = "".join(f"{x} {y} {z} 6554 13107 52428\n" for x, y, z in FIVE[:3]) + "3 0 1 2\n"
    return ply(folder, XYZ + colors, ELEMENT, body, (3, 1))


def face_colors(folder: Path) -> Path:
    """Colours of polygons of mixed size."""
    colors = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    return ply(folder, XYZ, ELEMENT + colors, LINES + "4 0 1 2 3 255 0 0\n3 3 2 4 0 0 255\n", (5, 2))


def sparse(folder: Path) -> Path:
    """One vertex displaced by a sparse value."""
    given = {"count": 1, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}}
    arrays = [TRIANGLE, FACE, np.array([1], "u2"), np.array([[5, 0, 0]], "f4")]
    return gltf(folder, arrays, PLAIN, lambda d: d["accessors"][0].update(sparse=given))


def quantised(folder: Path) -> Path:
    """Positions of normalised 16-bit numbers."""
    positions = np.array([[0, 0, 0, 0], [32767, 0, 0, 0], [0, 32767, 0, 0]], "i2")

    def edit(document: dict) -> None:
        document["accessors"][0].update(type="VEC3", normalized=True)
        document["bufferViews"][0]["byteStride"] = 8
        document.update(extensionsUsed=["KHR_mesh_quantization"], extensionsRequired=["KHR_mesh_quantization"])

    return gltf(folder, [positions, FACE], PLAIN, edit)


def morphed(folder: Path) -> Path:
    """A morph target of weight a half."""
    primitive = {**PLAIN, "targets": [{"POSITION": 2}]}
    arrays = [TRIANGLE, FACE, np.array([[0, 0, 2]] * 3, "f4")]
    return gltf(folder, arrays, primitive, lambda d: d["meshes"][0].update(weights=[0.5]))


def instanced(folder: Path) -> Path:
    """Two instances of a triangle."""
    name = "EXT_mesh_gpu_instancing"

    def edit(document: dict) -> None:
        document["nodes"][0]["extensions"] = {name: {"attributes": {"TRANSLATION": 2}}}
        document.update(extensionsUsed=[name], extensionsRequired=[name])

    return gltf(folder, [TRIANGLE, FACE, np.array([[10, 0, 0], [20, 0, 0]], "f4")], PLAIN, edit)


def linear_colors(folder: Path) -> Path:
    """Colours of 16 bits of a glTF."""
    colors = np.array([[6554, 13107, 19661, 65535]] * 3, "u2")
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1}
    return gltf(folder, [TRIANGLE, FACE, colors], primitive, lambda d: d["accessors"][2].update(normalized=True))


def unknown(folder: Path) -> Path:
    """An extension that is required and that nobody knows."""
    return gltf(folder, [TRIANGLE, FACE], PLAIN, lambda d: d.update(extensionsRequired=["VENDOR_unknown"]))


def mirrored(folder: Path) -> Path:
    """A triangle that faces +z, mirrored along x: it still does."""
    return gltf(folder, [TRIANGLE, FACE], PLAIN, lambda d: d["nodes"][0].update(scale=[-1, 1, 1]))


def viscam(folder: Path) -> Path:
    """Colours of triangles in a binary STL."""
    data = bytes(80) + struct.pack("<I", 2)
    for points, color in ((TRIANGLE, 0x8000 | 31 << 10), (TRIANGLE + 1, 0x8000 | 31)):
        data += struct.pack("<3f", 0, 0, 1) + points.astype("f4").tobytes() + struct.pack("<H", color)
    (folder / "a.stl").write_bytes(data)
    return folder / "a.stl"


def arrow(folder: Path) -> Path:
    """A concave quadrilateral."""
    return text(folder, "a.obj", "".join(f"v {x} {y} 0\n" for x, y in ARROW) + "f 1 2 3 4\n")


def tinted(folder: Path) -> Path:
    """Colours of vertices beside a material."""
    content = "mtllib a.mtl\nv 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nusemtl a\nf 1 2 3\n"
    return text(folder, "a.obj", content, a_mtl="newmtl a\nKd 1 1 1\n")


def two_libraries(folder: Path) -> Path:
    """Two libraries in one line."""
    content = "mtllib a.mtl b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl b\nf 1 2 3\n"
    return text(folder, "a.obj", content, a_mtl="newmtl a\nKd 1 0 0\n", b_mtl="newmtl b\nKd 0 1 0\n")


def fan(folder: Path) -> Path:
    """A fan of two triangles."""
    return gltf(folder, [QUAD, np.array([0, 1, 2, 3], "u2")], {**PLAIN, "mode": 6})


def _facing(found: Found) -> float:
    a, b, c = found.vertices[found.faces[0]]
    return float(np.sign(np.cross(b - a, c - a)[2]))


def _rounded(values: np.ndarray | None) -> list | None:
    return None if values is None else np.round(np.asarray(values, dtype=float)[..., :3], 3).tolist()


def _color(found: Found) -> list | None:
    return None if found.colors is None else _rounded(found.colors[0])


def _colors(found: Found) -> list | None:
    return None if found.colors is None else sorted({tuple(row) for row in _rounded(found.colors)})


# What each case is called, its file, what is measured, and the right value of it; None: the file is to be refused.
CASES: list[tuple[str, Callable, Callable, object]] = [
    ("PLY: binary polygons of mixed size", mixed, lambda found: len(found.faces), 3),
    ("PLY: triangle strips", strips, lambda found: len(found.faces), 3),
    ("PLY: doubles [mm]", far, lambda f: np.abs(f.vertices[0] - [EAST, NORTH, 0]).max() < 1e-3, True),
    ("PLY: colours of 16 bits", deep_colors, _color, [0.1, 0.2, 0.8]),
    ("PLY: colours of polygons", face_colors, _colors, [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]),
    ("OBJ: concave polygon", arrow, lambda found: round(found.area(), 6), 1.0),
    ("OBJ: colours of vertices with a material", tinted, _color, [1.0, 0.0, 0.0]),
    ("OBJ: two libraries in one line", two_libraries, _color, [0.0, 1.0, 0.0]),
    ("STL: VisCAM colours", viscam, _colors, [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]),
    ("glTF: sparse accessor", sparse, lambda found: found.vertices[:, 0].max(), 5.0),
    ("glTF: quantised positions", quantised, lambda found: found.vertices.max(), 1.0),
    ("glTF: fan", fan, lambda found: round(found.area(), 6), 4.0),
    ("glTF: morph target", morphed, lambda found: found.vertices[:, 2].max(), 1.0),
    ("glTF: instances", instanced, lambda found: len(found.faces), 2),
    ("glTF: colours of 16 bits", linear_colors, _color, [0.1, 0.2, 0.3]),
    ("glTF: mirrored node faces outwards", mirrored, _facing, 1.0),
    ("glTF: unknown extension required", unknown, lambda found: "read", None),
]


def by_warpfrag(path: Path) -> Found:
    """Read by this package."""
    from warpfrag.colors import linear_to_srgb
    from warpfrag.files.meshes import load_mesh

    mesh = load_mesh(path)
    colors = mesh.color
    if colors is not None:
        colors = np.broadcast_to(colors, (len(mesh.vertices), 3))[np.unique(mesh.faces)]
        colors = colors if path.suffix == ".gltf" else linear_to_srgb(colors)
    return Found(mesh.vertices, mesh.faces, colors)


def by_trimesh(path: Path) -> Found:
    """Read by trimesh, as it gives things without being told more."""
    import trimesh

    mesh = trimesh.load_scene(path, process=False).to_mesh()
    visual, colors = mesh.visual, None
    if visual.kind == "face":
        colors = visual.face_colors / 255.0
    elif visual.kind == "vertex":
        colors = visual.vertex_colors / 255.0
    elif visual.kind == "texture":
        colors = np.tile(visual.material.main_color / 255.0, (len(mesh.vertices), 1))
    return Found(np.asarray(mesh.vertices), np.asarray(mesh.faces), colors)


def by_assimp(path: Path) -> Found:
    """Read by assimp through assimp-py, triangulated, with its nodes' transforms."""
    import assimp_py as assimp

    scene = assimp.import_file(str(path), assimp.Process_Triangulate | assimp.Process_PreTransformVertices)
    vertices, faces, colors, first = [], [], [], 0
    for mesh in scene.meshes:
        points = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
        vertices.append(points)
        faces.append(np.asarray(mesh.indices, dtype=int).reshape(-1, 3) + first)
        first += len(points)
        if mesh.colors:
            colors.append(np.asarray(mesh.colors[0], dtype=float).reshape(len(points), -1))
        else:
            material = scene.materials[mesh.material_index]
            diffuse = material.get("COLOR_DIFFUSE")
            colors.append(np.tile(np.asarray(diffuse or [0.0] * 4, dtype=float)[:4], (len(points), 1)))
    return Found(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors))


def by_plyfile(path: Path) -> Found:
    """Read by plyfile; polygons have to be cut by oneself, here into fans."""
    if path.suffix != ".ply":
        raise NotImplementedError
    import plyfile

    data = plyfile.PlyData.read(str(path))
    vertex, faces = data["vertex"], []
    points = np.stack([vertex[axis].astype(float) for axis in "xyz"], axis=-1)
    colors = None
    names = ("red", "green", "blue")
    if "face" in data:
        face = data["face"]
        faces = [(f[0], f[i], f[i + 1]) for f in face["vertex_indices"] for i in range(1, len(f) - 1)]
        colored = vertex if "red" in vertex else face
        if "red" in colored:
            colors = np.stack([colored[n] / float(np.iinfo(colored[n].dtype).max) for n in names], axis=-1)
    return Found(points, np.array(faces, dtype=int).reshape(-1, 3), colors)


READERS = {"warpfrag": by_warpfrag, "trimesh": by_trimesh, "assimp-py": by_assimp, "plyfile": by_plyfile}


def outcome(reader: Callable[[Path], Found], case: tuple[str, Callable, Callable, object]) -> str:
    """Return what a reader makes of a case, as a cell of the table."""
    _, write, measure, right = case
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = write(Path(folder))
        try:
            value = measure(reader(path))
        except NotImplementedError:
            return ""
        # Whatever a reader raises is its answer.
        except Exception:
            return "right" if right is None else "refused"
    same = value == right if right is not None else False
    if not same and isinstance(right, (float, list)) and value is not None:
        same = np.shape(value) == np.shape(right) and bool(np.allclose(value, right, atol=0.003))
    return "right" if same else "wrong"


def main() -> None:
    """Rewrite the table."""
    columns = {}
    for name, reader in READERS.items():
        try:
            columns[f"{name} {version(name)}"] = [outcome(reader, case) for case in CASES]
        except PackageNotFoundError:
            print(f"{name} is not installed: left out", file=sys.stderr)
    head = ["", *columns]
    rows = [[title, *(column[i] for column in columns.values())] for i, (title, *_) in enumerate(CASES)]
    rows.append(["**right**", *(f"{c.count('right')} of {sum(bool(cell) for cell in c)}" for c in columns.values())])
    lines = [" | ".join(["", *row, ""]).strip() for row in (head, ["---"] * len(head), *rows)]
    table = "\n".join([BEGIN, *lines, END])
    content = TARGET.read_text(encoding="utf-8")
    TARGET.write_text(re.sub(f"{BEGIN}.*{END}", lambda _: table, content, flags=re.DOTALL), encoding="utf-8")
    print(table)


if __name__ == "__main__":
    main()
