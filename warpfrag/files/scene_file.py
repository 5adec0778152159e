"""Scene files: TOML to ``Scene``.

Lengths are in scene units, angles in degrees, colours straight linear RGB in 0…1 or ``"#rrggbb"`` in sRGB.

Top level: ``beta layers merge mix background`` and the tables ``[camera]``, ``[light]``, ``[[object]]``.

- ``[camera]``: ``eye target up fov | height near far size``, as in ``Camera``.
- ``[light]``: ``direction`` (towards the light, or ``"camera"``: from the eye, the default) and ``ambient`` (0.3). The
  colour of each vertex is multiplied by ambient + (1 − ambient)·|n·l|, once, when the file is read. Without the table
  all is unlit.
- ``[[object]]``: ``name``; ``mesh`` (a path relative to the scene file, an absolute path, or ``"warp:<asset>"``),
  ``primitive`` with its sizes, or ``points`` (a ply, pts, pwn or xyz file), which become discs (surfels) of
  ``segments`` (8) corners and of ``radius`` (2) times the points' mean distance to their nearest neighbours;
  ``translate``, ``rotate`` ({axis, degrees} or a list of them, in order), ``scale``, applied scale first and translate
  last, or ``matrix`` (4 rows); ``color``, ``opacity``, ``thickness`` (a number, or ``"2P"``: multiples of P(z), the
  default; of points ``"10P"``); ``texture`` (an image with sRGB colours, which ``color`` tints); ``normals``
  (``"smooth"`` or ``"flat"``). Points have neither texture nor ``normals``.

A ``color`` replaces the file's colours and the colours of its images; an ``opacity`` replaces its alpha, but what an
image cuts out (alpha 0) stays cut out.
"""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.colors import linear_image, parse_hex
from warpfrag.errors import SceneError, shorten
from warpfrag.files.meshes import GREY, load_mesh, warp_asset
from warpfrag.files.table import Table, is_number, is_numbers, number_words, read_toml
from warpfrag.scene.camera import Camera
from warpfrag.scene.names import CAMERA, MERGES, MIXES
from warpfrag.scene.parameters import multiple_of_p
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes import primitives
from warpfrag.shapes.mesh import Mesh, lambert, smooth_normals, split_faces, transformed_normals
from warpfrag.shapes.surfels import load_points, surfels

_TOP = ("beta", "layers", "merge", "mix", "background", "camera", "light", "object")
CAMERA_KEYS = ("eye", "target", "up", "fov", "height", "near", "far", "size")
_PLACE = ("translate", "rotate", "scale")
_OBJECT = ("name", *_PLACE, "matrix", "color", "opacity", "thickness", "texture", "normals")
_PRIMITIVES = {
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
# Beyond these a primitive is a slip of the keyboard: 4096 segments are 16 million triangles.
_SEGMENTS, _CELLS, _PIXELS = 4096, 4096, 65536
# Of each disc: more are not rounder at any size worth a disc.
_DISC_SEGMENTS = 64


def load_scene(path: str | os.PathLike) -> Scene:
    """Read a scene file.

    Args:
        path: A TOML file. The files it names lie in its folder or below, unless their path is absolute.

    Raises:
        SceneError: Anything in the file, or a file it names, that cannot be used: file, key, what was found, what is
            expected.
        ImportError: A mesh needs a reader that is not installed.

    Example:
        >>> load_scene("scenes/bunny_in_sphere.toml").beta
        0.5
    """
    path = Path(path)
    top = Table(read_toml(path), path, "", _TOP)
    camera = _camera(top)
    values: dict[str, Any] = {
        "beta": top.number("beta", 0.0, 1.0),
        "layers": top.integer("layers", 1, 2**31 - 1),
        "merge": top.choice("merge", MERGES),
        "mix": top.choice("mix", MIXES),
        "background": _background(top),
    }
    light = top.table("light", ("direction", "ambient"))
    entries = top.data.get("object", [])
    if not isinstance(entries, list) or not entries:
        found = "none" if not entries else "one table"
        raise top.error("object", found, "one or more tables headed [[object]]")
    meshes: dict[tuple, Mesh] = {}
    objects: list[SceneObject] = []
    for index, entry in enumerate(entries):
        item = _object(entry, path, index, meshes, camera, light)
        if item.name == CAMERA:
            raise SceneError(f'{path}: object[{index}].name: found "camera", expected another: the camera has it')
        for other, earlier in enumerate(objects):
            if earlier.name == item.name:
                found = f'"{item.name}", which object[{other}] has too'
                raise SceneError(f"{path}: object[{index}].name: found {found}, expected a name of its own")
        objects.append(item)
    return Scene(camera, objects, **{key: value for key, value in values.items() if value is not None})


def _camera(top: Table) -> Camera:
    table = top.table("camera", CAMERA_KEYS)
    if table is None:
        raise top.error("camera", "none", "a table [camera] with eye, target and fov or height")
    for key in ("eye", "target"):
        if key not in table:
            raise table.error(key, "none", "3 numbers")
    return read_camera(table)


def read_camera(table: Table, base: Camera | None = None) -> Camera:
    """Read a camera from the keys of a table.

    Args:
        table: A table with some of ``CAMERA_KEYS``.
        base: The camera whose values stand for those that the table does not give; None takes the defaults.

    Raises:
        SceneError: A value of the wrong type or out of its range.
    """
    values: dict[str, Any] = {key: table.numbers(key, 3, "3 numbers") for key in ("eye", "target", "up")}
    values.update({key: table.number(key) for key in ("fov", "height", "near", "far")})
    values["size"] = read_size(table)
    values = {key: value for key, value in values.items() if value is not None}
    # One of the two kinds of camera takes the place of the other.
    for key, other in (("fov", "height"), ("height", "fov")):
        if base is not None and key in values and other not in values:
            values[other] = None
    try:
        return Camera(**values) if base is None else replace(base, **values)
    except ValueError as error:
        raise SceneError(f"{table.file}: {' '.join(str(error).split())}") from None


def read_size(table: Table) -> tuple[int, int] | None:
    """Read ``size``, width and height in pixels; None where it is absent.

    Raises:
        SceneError: It is not two whole numbers in range.
    """
    if "size" not in table:
        return None
    size = table.data["size"]
    whole = isinstance(size, list) and len(size) == 2 and all(type(part) is int for part in size)
    if not whole or not 1 <= min(size) <= max(size) <= _PIXELS:
        raise table.error("size", shorten(size), f"width and height, two whole numbers from 1 to {_PIXELS}")
    return size[0], size[1]


def _object(
    entry: Any, file: Path, index: int, meshes: dict[tuple, Mesh], camera: Camera, light: Table | None
) -> SceneObject:
    path = f"object[{index}]"
    label = entry.get("name") if isinstance(entry, dict) else ""
    label = label if isinstance(label, str) else ""
    every = (*_SHAPES, *_OBJECT, *sorted({key for keys in _PRIMITIVES.values() for key in keys}))
    table = Table(entry, file, path, every, label)
    shapes = [key for key in _SHAPES if key in table]
    if len(shapes) != 1:
        found = "both " + " and ".join(shapes) if shapes else "no shape"
        raise table.error("", found, "mesh, primitive or points")
    if "primitive" in table:
        kind = str(table.choice("primitive", tuple(_PRIMITIVES)))
        Table(entry, file, path, ("primitive", *_OBJECT, *_PRIMITIVES[kind]), label, f'primitive "{kind}"')
        name, mesh = kind, _primitive(table, kind)
    elif "points" in table:
        Table(entry, file, path, _POINTS, label, "points")
        name, mesh = _surfels(table, file)
    else:
        Table(entry, file, path, ("mesh", *_OBJECT), label, "a mesh")
        name, mesh = _mesh(table, file, meshes)
    name = table.text("name") or name
    table.label = name
    matrix = _matrix(table)
    normals = table.choice("normals", ("smooth", "flat"))
    if normals == "flat":
        mesh = split_faces(mesh)
    elif normals == "smooth" or mesh.normals is None:
        mesh = replace(mesh, normals=smooth_normals(mesh.vertices, mesh.faces))
    mesh = _look(table, file, mesh)
    # Discs of one surface overlap at angles to one another: the paper gives them more than its 2·P(z).
    thickness, unit = _thickness(table, "10P" if "points" in table else "2P")
    color = np.full(3, 1.0 if mesh.textures else GREY) if mesh.color is None else mesh.color
    try:
        item = SceneObject(
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
        )
    except ValueError as error:
        raise table.wrap("", error) from None
    if light is not None:
        item.shade = _shade(light, camera, item, mesh)
    return item


def _mesh(table: Table, file: Path, meshes: dict[tuple, Mesh]) -> tuple[str, Mesh]:
    text = str(table.text("mesh"))
    try:
        path, root = (warp_asset(text), None) if text.startswith("warp:") else _inside(table, "mesh", text, file)
        key = path, root
        if key not in meshes:
            meshes[key] = load_mesh(path, root)
    except SceneError:
        raise
    except ValueError as error:
        raise table.wrap("mesh", error) from error
    except ImportError as error:
        raise ImportError(f"{file}: {table.path}.mesh: {error}") from error
    return path.stem, meshes[key]


def _surfels(table: Table, file: Path) -> tuple[str, Mesh]:
    path, _ = _inside(table, "points", str(table.text("points")), file)
    sizes: dict[str, Any] = {"radius": table.number("radius", above=0.0)}
    sizes["segments"] = table.integer("segments", 3, _DISC_SEGMENTS)
    try:
        mesh = surfels(load_points(path), **{key: value for key, value in sizes.items() if value is not None})
    except ValueError as error:
        raise table.wrap("points", error) from error
    except ImportError as error:
        raise ImportError(f"{file}: {table.path}.points: {error}") from error
    return path.stem, mesh


def _inside(table: Table, key: str, text: str, file: Path) -> tuple[Path, Path | None]:
    """Return the path a key names, and the folder it is bound to: none for a path that is given absolutely."""
    path = Path(text)
    if path.is_absolute():
        return path, None
    # Symbolic links are followed before the check, those of the scene file's own folder included.
    folder = file.parent.resolve()
    if not (folder / path).resolve().is_relative_to(folder):
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


def _matrix(table: Table) -> np.ndarray:
    if "matrix" in table:
        others = [key for key in _PLACE if key in table]
        if others:
            raise table.error("matrix", f"{', '.join(others)} as well", "either matrix or " + ", ".join(_PLACE))
        rows = table.data["matrix"]
        if not isinstance(rows, list) or len(rows) != 4 or not all(is_numbers(row, 4) for row in rows):
            raise table.error("matrix", shorten(rows), "4 rows of 4 numbers")
        matrix = np.array(rows, dtype=np.float64)
        if not np.array_equal(matrix[3], [0, 0, 0, 1]) or np.linalg.matrix_rank(matrix[:3, :3]) < 3:
            raise table.error("matrix", shorten(rows), "an invertible matrix with the last row 0, 0, 0, 1")
        return matrix
    matrix = np.eye(4)
    if "scale" in table:
        value = table.data["scale"]
        factors = [value] * 3 if is_number(value) else value
        if not is_numbers(factors, 3) or 0 in factors:
            raise table.error("scale", shorten(value), "a number other than 0, or 3 of them")
        matrix[:3, :3] = np.diag(factors)
    turns = table.data.get("rotate", [])
    for index, turn in enumerate(turns if isinstance(turns, list) else [turns]):
        place = f"rotate[{index}]" if isinstance(turns, list) else "rotate"
        given = Table(turn, table.file, f"{table.path}.{place}", ("axis", "degrees"), table.label)
        axis, degrees = given.numbers("axis", 3, "3 numbers"), given.number("degrees")
        if axis is None or degrees is None or not any(axis):
            raise given.error("", shorten(turn), "{axis = [x, y, z], degrees = …} with an axis other than 0")
        matrix[:3, :3] = _rotation(np.array(axis), np.radians(degrees)) @ matrix[:3, :3]
    matrix[:3, 3] = table.numbers("translate", 3, "3 numbers") or [0.0, 0.0, 0.0]
    return matrix


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    axis = axis / np.abs(axis).max()
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def _look(table: Table, file: Path, mesh: Mesh) -> Mesh:
    """Apply the keys color, opacity and texture to what the mesh brought along."""
    color, opacity = _color(table, "color", 3), table.number("opacity", 0.0, 1.0)
    if "texture" in table:
        if mesh.uv is None:
            raise table.error("texture", "a mesh without texture coordinates", "a mesh with them, or no texture")
        mesh = replace(mesh, textures=[_image(table, file)], texture_index=None, color=None)
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


def _image(table: Table, file: Path) -> np.ndarray:
    from PIL import Image

    path, _ = _inside(table, "texture", str(table.text("texture")), file)
    if not path.is_file():
        raise table.error("texture", f"no such file at {path}", "an image file")
    try:
        with Image.open(path) as image:
            return linear_image(image)
    except Exception as error:
        raise table.error("texture", f"an image that cannot be read: {path}", "a PNG, JPEG or other image") from error


def _thickness(table: Table, default: str) -> tuple[float, Any]:
    value = table.data.get("thickness", default)
    multiple = multiple_of_p(value) if isinstance(value, str) else None
    if multiple is not None and np.isfinite(multiple):
        return multiple, "P"
    if not is_number(value) or value < 0:
        raise table.error(
            "thickness", shorten(value), number_words(0.0, np.inf, None) + ', or multiples of P(z) like "2P"'
        )
    return float(value), "scene"


def _color(table: Table, key: str, *counts: int) -> list[float] | None:
    if key not in table:
        return None
    value = table.data[key]
    if isinstance(value, str):
        parsed = parse_hex(value)
        if parsed is not None and (len(value.strip()) == 7 or 4 in counts):
            return list(parsed[: max(counts)])
    elif any(is_numbers(value, count) for count in counts) and min(value) >= 0 and max(value) <= 1:
        return [float(part) for part in value]
    words = " or ".join(f"{count} numbers from 0 to 1" for count in counts)
    raise table.error(key, shorten(value), f'{words}, or "#rrggbb{"[aa]" if 4 in counts else ""}"')


def _background(top: Table) -> tuple[float, float, float, float] | None:
    """Read a background, straight in the file, as premultiplied RGBA."""
    value = _color(top, "background", 3, 4)
    if value is None:
        return None
    red, green, blue, alpha = [*value, 1.0][:4]
    return red * alpha, green * alpha, blue * alpha, alpha


def _shade(light: Table, camera: Camera, item: SceneObject, mesh: Mesh) -> np.ndarray:
    direction = light.data.get("direction", "camera")
    ambient = light.number("ambient", 0.0, 1.0)
    if direction != "camera" and (not is_numbers(direction, 3) or not any(direction)):
        raise light.error("direction", shorten(direction), '3 numbers that are not all 0, or "camera"')
    if direction != "camera":
        towards = np.array(direction, dtype=np.float64)
    elif camera.is_perspective:
        towards = np.asarray(camera.eye) - item.world_vertices()
    else:
        towards = np.subtract(camera.eye, camera.target)
    assert mesh.normals is not None
    return lambert(transformed_normals(mesh.normals, item.matrix), towards, 0.3 if ambient is None else ambient)
