"""The tables `[[object]]` of a scene file: shapes, their places and their looks.

- `name`;
- `mesh` (a path relative to the scene file, an absolute path, or `"warp:<asset>"`), `primitive` with its sizes, or
  `points` (a ply, pts, pwn or xyz file), which become discs (surfels) of `segments` (8) corners and of `radius` (2)
  times the points' mean distance to their nearest neighbours;
- `translate`, `rotate` ({axis, degrees} or a list of them, in order), `scale`, applied scale first and translate last,
  or `matrix` (4 rows);
- `color`, `opacity`, `thickness` (a number, or `"2P"`: multiples of P(z), the default; of points `"10P"`);
- `split` (of a mesh file: `"nodes"` or `"groups"`): an object for each node of a glTF or USD file, or each group of an
  obj file, with its name there (after `name` and a dot, if that is given); `thickness` may then be a table with a value
  for each of them, such as `{ lid = 0.1, box = "2P" }`;
- `texture` (an image with sRGB colours, which `color` tints); `normals` (`"smooth"` or `"flat"`). Points have neither.

A `color` replaces the file's colours and the colours of its images; an `opacity` replaces its alpha, but what an image
cuts out (alpha 0) stays cut out.
"""

from collections.abc import Container
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.errors import SceneError, is_number, range_wording, shorten, suggest
from warpfrag.files.images import ImageError, read_texture
from warpfrag.files.meshes import load_mesh, load_parts, warp_asset
from warpfrag.files.placement import PLACEMENT_KEYS, read_matrix
from warpfrag.files.points import load_points
from warpfrag.files.source import resolved
from warpfrag.files.table import LARGEST, Table, is_numbers
from warpfrag.scene.names import CAMERA
from warpfrag.scene.parameters import multiple_of_p
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes import primitives
from warpfrag.shapes.mesh import GREY, Mesh, smooth_normals, split_faces
from warpfrag.shapes.surfels import surfels

_OBJECT = ("name", *PLACEMENT_KEYS, "color", "opacity", "thickness", "texture", "normals")
PRIMITIVES = {
    "sphere": ("radius", "segments"),
    "cube": ("size",),
    "cylinder": ("radius", "height", "segments"),
    "cone": ("radius", "height", "segments"),
    "torus": ("radius", "tube", "segments"),
    "plane": ("size",),
    "grid": ("size", "cells"),
}
# What a disc has no use for: it is flat, and has no texture coordinates.
_POINTS = ("points", "radius", "segments", *(key for key in _OBJECT if key not in ("texture", "normals")))
_SHAPES = ("mesh", "primitive", "points")
_SPLITS = ("nodes", "groups")
# Beyond these a primitive is a slip of the keyboard: 4096 segments are 16 million triangles.
_SEGMENTS, _CELLS = 4096, 4096
# Of each disc: more are not rounder at any size worth a disc.
_DISC_SEGMENTS = 64


@dataclass
class _Reading:
    """What the objects of one scene file have in common: the file, meshes read already."""

    file: Path
    meshes: dict[tuple, list[Mesh]] = field(default_factory=dict)


def read_objects(top: Table) -> list[SceneObject]:
    """Read all objects of a scene file, in its order.

    Args:
        top: the table of the whole file.

    Raises:
        SceneError: a key, or a file that it names, cannot be used.
        ImportError: a mesh needs a reader that is not installed.
    """
    entries = top.data.get("object", [])
    if not isinstance(entries, list) or not entries:
        got = "none" if not entries else "one table"
        raise top.error("object", got, "one or more tables headed [[object]]")
    reading = _Reading(Path(top.file))
    objects: list[SceneObject] = []
    owner: dict[str, int] = {}
    for index, entry in enumerate(entries):
        for item in _objects(entry, index, reading):
            place = f"{top.file}: object[{index}].name"
            if "name" not in entry and item.name in owner:
                # Nobody has named it: it takes the next number.
                item = replace(item, name=_free_name(item.name, owner))
            if item.name == CAMERA:
                raise SceneError(f'{place}: got "camera", expected another: the camera has it')
            if item.name in owner:
                got = f"{shorten(item.name)}, which object[{owner[item.name]}] has too"
                raise SceneError(f"{place}: got {got}, expected a name of its own")
            owner[item.name] = index
            objects.append(item)
    return objects


def _objects(entry: Any, index: int, reading: _Reading) -> list[SceneObject]:
    path = f"object[{index}]"
    label = entry.get("name") if isinstance(entry, dict) else ""
    label = label if isinstance(label, str) else ""
    every = (*_SHAPES, "split", *_OBJECT, *sorted({key for keys in PRIMITIVES.values() for key in keys}))
    table = Table(entry, reading.file, path, every, label)
    shapes = [key for key in _SHAPES if key in table]
    if len(shapes) != 1:
        got = "both " + " and ".join(shapes) if shapes else "no shape"
        raise table.error("", got, "mesh, primitive or points")
    if "primitive" in table:
        kind = str(table.choice("primitive", tuple(PRIMITIVES)))
        Table(entry, reading.file, path, ("primitive", *_OBJECT, *PRIMITIVES[kind]), label, f'primitive "{kind}"')
        name, mesh = kind, _primitive(table, kind)
    elif "points" in table:
        Table(entry, reading.file, path, _POINTS, label, "points")
        name, mesh = _surfels(table)
    else:
        Table(entry, reading.file, path, ("mesh", "split", *_OBJECT), label, "a mesh")
        name, parts = _meshes(table, reading)
        if "split" in table:
            return _split(table, name, parts, reading)
        (mesh,) = parts
    name = table.text("name") or name
    table.label = name
    return [_scene_object(table, name, mesh, reading, table.data.get("thickness"))]


def _split(table: Table, stem: str, parts: list[Mesh], reading: _Reading) -> list[SceneObject]:
    """Return an object for each part of a mesh file."""
    prefix = table.text("name")
    thickness = table.data.get("thickness")
    names = _names_of_parts(parts, stem)
    if isinstance(thickness, dict):
        for key in thickness:
            if key not in names:
                raise table.error(f"thickness.{key}", "an unknown name", f"one of a part; {suggest(key, names)}")
    objects = []
    for name, mesh in zip(names, parts, strict=True):
        own = thickness.get(name) if isinstance(thickness, dict) else thickness
        objects.append(_scene_object(table, f"{prefix}.{name}" if prefix else name, mesh, reading, own))
    return objects


def _names_of_parts(parts: list[Mesh], stem: str) -> list[str]:
    """Return a name of its own for each part: that of the file, on one line, numbered where it is taken."""
    names: list[str] = []
    for part in parts:
        plain = " ".join(part.name.split()) or stem
        names.append(_free_name(plain, [*names, CAMERA]))
    return names


def _free_name(name: str, taken: Container[str]) -> str:
    """Return a name, with the least number that makes it one of its own."""
    free, number = name, 1
    while free in taken:
        number += 1
        free = f"{name} {number}"
    return free


def _scene_object(table: Table, name: str, mesh: Mesh, reading: _Reading, thickness_value: Any) -> SceneObject:
    """Return a mesh in its place, with its table's look and a z-thickness as the file has it (None for the default)."""
    matrix = read_matrix(table)
    normals = table.choice("normals", ("smooth", "flat"))
    if normals == "flat":
        mesh = split_faces(mesh)
    elif normals == "smooth" or mesh.normals is None:
        mesh = replace(mesh, normals=smooth_normals(mesh.vertices, mesh.faces))
    mesh = _look(table, mesh)
    # Discs of one surface overlap at angles to one another: the paper gives them more than its 2·P(z).
    default = "10P" if "points" in table else "2P"
    thickness, unit = _thickness(table, default if thickness_value is None else thickness_value)
    color = np.full(3, 1.0 if mesh.textures else GREY) if mesh.color is None else mesh.color
    try:
        return SceneObject(
            name,
            mesh.vertices,
            mesh.faces,
            matrix,
            color,
            1.0 if mesh.opacity is None else mesh.opacity,
            thickness,
            unit,
            mesh.uv if mesh.textures else None,
            (mesh.textures if mesh.texture_index is not None else mesh.textures[0]) if mesh.textures else None,
            mesh.texture_index if mesh.textures else None,
            normals=mesh.normals,
        )
    except ValueError as error:
        raise table.prefixed("", error) from None


def _meshes(table: Table, reading: _Reading) -> tuple[str, list[Mesh]]:
    """Return the stem of a mesh file's name and its parts: one, but where `split` is given."""
    text, split = str(table.text("mesh")), table.choice("split", _SPLITS)
    try:
        path, root = (warp_asset(text), None) if text.startswith("warp:") else _inside(table, "mesh", text)
        key = path, root, split is None
        if key not in reading.meshes:
            reading.meshes[key] = [load_mesh(path, root)] if split is None else load_parts(path, root)
    except SceneError:
        raise
    except (ValueError, OSError) as error:
        raise table.prefixed("mesh", error) from error
    except ImportError as error:
        raise ImportError(f"{reading.file}: {table.path}.mesh: {error}") from error
    return path.stem, reading.meshes[key]


def _surfels(table: Table) -> tuple[str, Mesh]:
    path, _ = _inside(table, "points", str(table.text("points")))
    sizes: dict[str, Any] = {"radius": table.number("radius", above=0.0)}
    sizes["segments"] = table.integer("segments", 3, _DISC_SEGMENTS)
    try:
        mesh = surfels(load_points(path), **{key: value for key, value in sizes.items() if value is not None})
    except (ValueError, OSError) as error:
        raise table.prefixed("points", error) from error
    except ImportError as error:
        raise ImportError(f"{table.file}: {table.path}.points: {error}") from error
    return path.stem, mesh


def _inside(table: Table, key: str, text: str) -> tuple[Path, Path | None]:
    """Return the path a key names, and the folder it is bound to: none for a path that is given absolutely."""
    path = Path(text)
    if path.is_absolute():
        return path, None
    # Symbolic links are followed before the check, those of the scene file's own folder included.
    try:
        folder = resolved(Path(table.file).parent)
        inside = resolved(folder / path).is_relative_to(folder)
    except ValueError as error:
        raise table.prefixed(key, error) from None
    if not inside:
        raise table.error(key, f"{shorten(text)}, outside of {folder}", "a file in it or below, or an absolute path")
    return folder / path, folder


def _primitive(table: Table, kind: str) -> Mesh:
    sizes: dict[str, Any] = {key: table.number(key, above=0.0) for key in ("radius", "height", "tube")}
    sizes["segments"] = table.integer("segments", 3, _SEGMENTS)
    if "size" in table:
        count = 3 if kind == "cube" else 2
        value = table.data["size"]
        edges = [value] * count if is_number(value) else value
        if not is_numbers(edges, count) or min(edges) <= 0:
            raise table.error("size", shorten(value), f"a number above 0, or {count} of them")
        sizes["size"] = tuple(float(edge) for edge in edges)
    if "cells" in table:
        value = table.data["cells"]
        cells = [value, value] if type(value) is int else value
        whole = isinstance(cells, list) and len(cells) == 2 and all(type(cell) is int for cell in cells)
        if not whole or not 1 <= min(cells) <= max(cells) <= _CELLS:
            raise table.error("cells", shorten(value), f"a whole number from 1 to {_CELLS}, or two of them")
        sizes["cells"] = tuple(cells)
    sizes = {key: value for key, value in sizes.items() if value is not None}
    if kind in ("sphere", "torus", "cylinder", "cone"):
        sizes["uv"] = "texture" in table
    return getattr(primitives, kind)(**sizes)


def _look(table: Table, mesh: Mesh) -> Mesh:
    """Apply the keys color, opacity and texture to what the mesh brought along."""
    color, opacity = table.color("color", 3), table.number("opacity", 0.0, 1.0)
    if "texture" in table:
        if mesh.uv is None:
            raise table.error("texture", "a mesh without texture coordinates", "a mesh with them, or no texture")
        mesh = replace(mesh, textures=[_image(table)], texture_index=None, color=None)
        if opacity is not None:
            mesh = replace(mesh, opacity=opacity)
        return mesh if color is None else replace(mesh, color=np.array(color))
    images = mesh.textures
    if color is not None:
        images = [np.concatenate([np.ones_like(image[..., :3]), image[..., 3:]], axis=-1) for image in images]
        mesh = replace(mesh, color=np.array(color))
    if opacity is not None:
        images = [np.concatenate([image[..., :3], image[..., 3:] > 0.0], axis=-1) for image in images]
        mesh = replace(mesh, opacity=opacity)
    if color is not None and all(image.min() == 1.0 for image in images):
        images = []
    return replace(mesh, textures=images)


def _image(table: Table) -> np.ndarray:
    path, _ = _inside(table, "texture", str(table.text("texture")))
    try:
        return read_texture(path)
    except (ImageError, OSError) as error:
        raise table.prefixed("texture", error) from error


def _thickness(table: Table, value: Any) -> tuple[float, Any]:
    multiple = multiple_of_p(value) if isinstance(value, str) else None
    if multiple is not None and np.isfinite(multiple):
        return multiple, "P"
    if isinstance(value, str) or not is_number(value) or value < 0:
        raise table.error("thickness", shorten(value), range_wording(0.0) + ', or multiples of P(z) like "2P"')
    if value > LARGEST:
        raise table.error("thickness", shorten(value), range_wording(0.0, LARGEST))
    return float(value), "scene"
