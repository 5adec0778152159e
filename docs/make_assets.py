"""Make the small files that the example scenes name: a texture, points, and a glTF file of several nodes.

uv run python docs/make_assets.py
"""

import json
import struct
from pathlib import Path

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.files.images import write_image
from warpfrag.shapes.primitives import sphere

ASSETS = Path(__file__).parents[1] / "scenes" / "assets"


def lattice(cells: tuple[int, int] = (14, 7), pixels: int = 24) -> np.ndarray:
    """Return a woven lattice with holes, straight linear RGBA, (h, w, 4): bands that pass over and under each other."""
    columns, rows = cells
    place = (np.arange(pixels) + 0.5) / pixels
    x, y = np.meshgrid(np.tile(place, columns), np.tile(place, rows))
    column, row = np.meshgrid(np.arange(columns * pixels) // pixels, np.arange(rows * pixels) // pixels)
    from_band = {"across": np.abs(y - 0.5), "down": np.abs(x - 0.5)}
    inside = {name: distance < 0.27 for name, distance in from_band.items()}
    across_on_top = (column + row) % 2 == 0
    shows = {
        "across": inside["across"] & (across_on_top | ~inside["down"]),
        "down": inside["down"] & (~across_on_top | ~inside["across"]),
    }
    image = np.zeros((rows * pixels, columns * pixels, 4))
    for name, color in (("across", [0.98, 0.78, 0.33]), ("down", [0.86, 0.42, 0.18])):
        # Darker towards the edges of a band, as if it were round.
        shade = 1.0 - 1.6 * from_band[name] ** 2 - 2.2 * np.maximum(from_band[name] - 0.2, 0.0)
        image[shows[name], :3] = srgb_to_linear(np.array(color) * shade[..., None])[shows[name]]
        image[shows[name], 3] = 1.0
    return image


def moebius_strip(columns: int = 132, rows: int = 13) -> np.ndarray:
    """Return points of a Möbius strip: position, normal, colour from 0 to 255, (P, 9)."""
    generator = np.random.default_rng(1)
    u, v = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    u, v = (grid.ravel() + generator.uniform(-0.3, 0.3, grid.size) for grid in (u, v))
    angle, across = 2.0 * np.pi * u / columns, 0.42 * (2.0 * (v + 0.5) / rows - 1.0)
    along = np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=-1)
    half = np.stack([np.cos(angle / 2.0), np.sin(angle / 2.0)], axis=-1)
    rib = half[:, :1] * along + half[:, 1:] * np.array([0.0, 1.0, 0.0])
    point = along + across[:, None] * rib
    forward = np.stack([-np.sin(angle), 0.0 * angle, np.cos(angle)], axis=-1)
    # The rib turns by half the angle while the strip goes round.
    turn = 0.5 * (-half[:, 1:] * along + half[:, :1] * np.array([0.0, 1.0, 0.0]))
    tangent = forward * (1.0 + across * half[:, 0])[:, None] + across[:, None] * turn
    normal = np.cross(tangent, rib)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    hue = angle[:, None] + 2.0 * np.pi * np.array([0.0, 1.0, 2.0]) / 3.0
    color = np.rint(255.0 * (0.52 + 0.4 * np.cos(hue)))
    return np.column_stack([point, normal, color])


def write_points(path: Path, points: np.ndarray) -> None:
    """Write points as a binary PLY file."""
    kinds = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    kinds += [(name, "u1") for name in ("red", "green", "blue")]
    records = np.empty(len(points), dtype=kinds)
    for (name, _), column in zip(kinds, points.T, strict=True):
        records[name] = column
    words = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {words[kind]} {name}" for name, kind in kinds]
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + records.tobytes())


def write_egg(path: Path) -> None:
    """Write an egg as a binary glTF file: nodes "shell", "white" and "yolk", one sphere scaled three ways."""
    mesh = sphere(1.0, 56)
    points = np.array(mesh.vertices, dtype=np.float32)
    # Blunt below, pointed above.
    narrow = 1.0 - 0.16 * points[:, 1] - 0.06 * points[:, 1] ** 2
    egg = np.column_stack([points[:, 0] * narrow, 1.28 * points[:, 1], points[:, 2] * narrow]).astype(np.float32)
    faces = np.array(mesh.faces, dtype=np.uint16)
    parts = [egg.tobytes(), points.tobytes(), faces.tobytes()]
    begins = np.cumsum([0, *map(len, parts)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": begin, "byteLength": len(part)} for begin, part in zip(begins, parts, strict=False)
    ]
    accessors = [
        {
            "bufferView": view,
            "componentType": 5126,
            "count": len(points),
            "type": "VEC3",
            "min": shape.min(axis=0).tolist(),
            "max": shape.max(axis=0).tolist(),
        }
        for view, shape in enumerate((egg, points))
    ]
    accessors.append({"bufferView": 2, "componentType": 5123, "count": faces.size, "type": "SCALAR"})
    nodes = [
        ("shell", 0, 1.0, [0.0, 0.0, 0.0], [0.80, 0.42, 0.22, 0.4]),
        ("white", 0, 0.92, [0.0, -0.02, 0.0], [0.75, 0.82, 0.92, 0.4]),
        ("yolk", 1, 0.45, [0.05, -0.22, 0.04], [0.98, 0.36, 0.0, 0.95]),
    ]
    document = {
        "asset": {"version": "2.0", "generator": "docs/make_assets.py"},
        "buffers": [{"byteLength": begins[-1]}],
        "bufferViews": views,
        "accessors": accessors,
        "materials": [
            {"pbrMetallicRoughness": {"baseColorFactor": color}, "alphaMode": "BLEND"} for *_, color in nodes
        ],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": shape}, "indices": 2, "material": number}]}
            for number, (_, shape, *_) in enumerate(nodes)
        ],
        "nodes": [
            {"name": name, "mesh": number, "scale": [scale] * 3, "translation": place}
            for number, (name, _, scale, place, _) in enumerate(nodes)
        ],
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "scene": 0,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(parts)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def main() -> None:
    """Write all of them."""
    ASSETS.mkdir(exist_ok=True)
    image = lattice()
    image[..., :3] *= image[..., 3:]
    write_image(ASSETS / "lattice.png", image)
    write_points(ASSETS / "moebius.ply", moebius_strip())
    write_egg(ASSETS / "egg.glb")


if __name__ == "__main__":
    main()
