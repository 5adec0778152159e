"""OBJ files: polygons with positions, texture coordinates and normals of their own, materials, colours of vertices.

Corners that agree in all of these are one vertex. A file without materials, coordinates and normals keeps its vertices
as they are.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.files.mtl import Material, material_image, placing, read_materials, sampling
from warpfrag.files.polygons import cut_polygons
from warpfrag.files.source import Source
from warpfrag.files.texture_images import fitted_image
from warpfrag.shapes.mesh import GREY, Mesh, smooth_normals

_LEFT_OUT = {"l": "lines", "p": "points", "curv": "curves", "curv2": "curves", "surf": "surfaces"}


@dataclass
class _Lines:
    """The lines of a file, sorted by their keyword; faces with what was in force at their place."""

    positions: list[str] = field(default_factory=list)
    coordinates: list[str] = field(default_factory=list)
    normals: list[str] = field(default_factory=list)
    corners: list[str] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    # Name of the material and the group from a face on: (face, name).
    materials: list[tuple[int, str]] = field(default_factory=list)
    groups: list[tuple[int, str]] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)
    left_out: set[str] = field(default_factory=set)


def read_obj(source: Source, *, split: bool) -> tuple[list[Mesh], str]:
    """Read the mesh of an OBJ file.

    Args:
        source: the file.
        split: whether each group (or object, where there are no groups) is a mesh of its own, with its name.

    Returns:
        The meshes, and words about what else the file holds.

    Raises:
        ValueError: the file cannot be read.
    """
    lines = _sorted_lines(source.read().decode("utf-8", "replace"))
    held = f" (it holds {', '.join(sorted(lines.left_out))})" if lines.left_out else ""
    if not lines.counts:
        return [], held
    if lines.left_out:
        source.note(f"{' and '.join(sorted(lines.left_out))} are not drawn")
    materials: dict[str, Material] = {}
    for library in lines.libraries:
        materials.update(read_materials(source, library))
    mesh, polygon = _mesh(lines, materials, source)
    if not len(mesh.faces):
        return [], held
    if not split:
        return [mesh], held
    starts = np.array([face for face, _ in lines.groups] or [0])
    names = [name for _, name in lines.groups] or [""]
    which = np.searchsorted(starts, polygon, side="right") - 1
    return _by_name(mesh, [names[at] if at >= 0 else "" for at in which]), held


def _sorted_lines(text: str) -> _Lines:
    lines = _Lines()
    if "\\\n" in text or "\\\r\n" in text:
        text = text.replace("\\\r\n", " ").replace("\\\n", " ")
    for line in text.splitlines():
        key, _, rest = line.partition(" ")
        if key not in _KEYWORDS:
            # Blanks before the keyword, or a tab after it.
            words = line.split(None, 1)
            if not words:
                continue
            key, rest = words[0], words[1] if len(words) > 1 else ""
        if key == "v":
            lines.positions.append(rest)
        elif key == "f":
            corners = rest.split() if "#" not in rest else rest.partition("#")[0].split()
            if "-" in rest:
                corners = _absolute(corners, len(lines.positions), len(lines.coordinates), len(lines.normals))
            lines.counts.append(len(corners))
            lines.corners += corners
        elif key == "vt":
            lines.coordinates.append(rest)
        elif key == "vn":
            lines.normals.append(rest)
        elif key == "usemtl":
            lines.materials.append((len(lines.counts), rest.strip()))
        elif key in ("g", "o"):
            lines.groups.append((len(lines.counts), rest.strip()))
        elif key == "mtllib":
            lines.libraries.append(rest.strip())
        elif key in _LEFT_OUT:
            lines.left_out.add(_LEFT_OUT[key])
    return lines


_KEYWORDS = frozenset(("v", "vt", "vn", "f", "usemtl", "g", "o", "mtllib", "s", "#", *_LEFT_OUT))


def _absolute(corners: Iterable[str], *counts: int) -> list[str]:
    """Count from the beginning what a face counts back from its place."""
    result = []
    for corner in corners:
        parts = corner.split("/")
        for place, (part, count) in enumerate(zip(parts, counts, strict=False)):
            if part.startswith("-"):
                parts[place] = str(count + 1 + int(part))
        result.append("/".join(parts))
    return result


def _mesh(lines: _Lines, materials: dict[str, Material], source: Source) -> tuple[Mesh, np.ndarray]:
    """Return all faces of a file as one mesh, and the polygon of each triangle."""
    rows = _rows(lines.positions, 3)
    positions, colors = rows[:, :3], _colors(rows)
    if not np.isfinite(positions).all():
        raise ValueError("a vertex is not finite")
    # Each different corner once: there are about as many of them as vertices.
    different = dict.fromkeys(lines.corners)
    place_of = {word: place for place, word in enumerate(different)}
    corner = np.fromiter(map(place_of.__getitem__, lines.corners), np.int64, len(lines.corners))
    triples = np.array([_triple(word) for word in different], dtype=np.int64).reshape(-1, 3)
    for column, (what, given) in enumerate(
        (("vertex", lines.positions), ("coordinate", lines.coordinates), ("normal", lines.normals))
    ):
        low, high = int(triples[:, column].min()), int(triples[:, column].max())
        if column and (low < 0 or high > len(given)):
            source.note(f"some faces name {what}s that are not there, drawn without")
            triples[(triples[:, column] < 0) | (triples[:, column] > len(given)), column] = 0
        elif column == 0 and (low < 1 or high > len(given)):
            raise ValueError(f"a face names {what} {high if high > len(given) else low}, there are {len(given)}")
    counts = np.array(lines.counts, dtype=np.int64)
    polygon, places = cut_polygons(positions, counts, triples[corner, 0] - 1)
    starts = np.array([face for face, _ in lines.materials], dtype=np.int64)
    # −1 before the first material, and where there is none.
    which = np.searchsorted(starts, np.arange(len(counts)), side="right") - 1
    names = [name for _, name in lines.materials]
    if not triples[:, 1:].any() and not any(name in materials for name in names):
        _note_unknown(names, lines, materials, source)
        return Mesh(positions, (triples[corner, 0] - 1)[places].astype(np.int32), color=colors), polygon
    distinct = list(dict.fromkeys(names))
    number = np.array([distinct.index(name) for name in names] + [-1], dtype=np.int64)[which]
    _note_unknown(distinct, lines, materials, source)
    # A vertex for each corner of a material.
    key = (np.repeat(number, counts) + 1) * len(triples) + corner
    used, vertex = np.unique(key[places.reshape(-1)], return_inverse=True)
    triple, material_of = triples[used % len(triples)], used // len(triples) - 1
    faces = vertex.reshape(-1, 3).astype(np.int32)
    mesh = Mesh(positions[triple[:, 0] - 1], faces)
    if colors is not None:
        mesh = replace(mesh, color=colors[triple[:, 0] - 1])
    mesh = _with_normals(mesh, triple[:, 2], lines)
    uv = None
    if triple[:, 1].any():
        coordinates = np.concatenate([np.zeros((1, 2)), _rows(lines.coordinates, 1, pad=2)[:, :2]])
        uv = coordinates[triple[:, 1]]
        mesh = replace(mesh, uv=uv.astype(np.float32))
    looks = [materials.get(name) for name in distinct]
    if any(looks):
        mesh = _with_looks(mesh, looks, material_of, number[polygon], (triple[:, 1] > 0)[faces].all(axis=1), uv, source)
    return mesh, polygon


def _with_looks(
    mesh: Mesh,
    looks: list[Material | None],
    material_of: np.ndarray,
    face_material: np.ndarray,
    has_uv: np.ndarray,
    uv: np.ndarray | None,
    source: Source,
) -> Mesh:
    """Give vertices and faces the looks of their materials.

    Args:
        mesh: the geometry, with the colours of vertices, if the file has them.
        looks: the materials; None for those that are not known.
        material_of: material of each vertex, −1 for none.
        face_material: material of each face, −1 for none.
        has_uv: whether a face has texture coordinates at all of its corners.
        uv: texture coordinates of each vertex; None without.
        source: the file.
    """
    cache: dict[str, np.ndarray | None] = {}
    textures: list[np.ndarray] = []
    index = np.full(len(mesh.faces), -1, dtype=np.int32)
    color, opacity = np.full((len(mesh.vertices), 3), GREY), np.ones(len(mesh.vertices))
    if mesh.color is not None:
        color = np.array(mesh.color)
    uv = None if uv is None else uv.copy()
    for number, material in enumerate(looks):
        vertices = material_of == number
        if material is None or not vertices.any():
            continue
        image = material_image(material, source, cache) if uv is not None else None
        own = material.color if material.color is not None else np.full(3, 1.0 if image is not None else GREY)
        if mesh.color is None:
            color[vertices] = own
        elif material.color is not None:
            color[vertices] *= material.color
        opacity[vertices] = material.opacity
        faces = (face_material == number) & has_uv
        if image is None or uv is None or not faces.any():
            continue
        at = placing(material)
        fitted, uv[vertices], left_out = fitted_image(image, uv[vertices] * at.scale + at.offset, sampling(material))
        if left_out:
            source.note(left_out)
        index[faces] = len(textures)
        textures.append(fitted)
    mesh = replace(mesh, color=_one_or_all(color), opacity=_one_or_all(opacity))
    if not textures or uv is None:
        return mesh
    everywhere = len(textures) == 1 and bool((index == 0).all())
    return replace(mesh, uv=uv.astype(np.float32), textures=textures, texture_index=None if everywhere else index)


def _one_or_all(values: np.ndarray) -> np.ndarray:
    return values[0] if len(values) and (values == values[0]).all() else values


def _with_normals(mesh: Mesh, normal_of: np.ndarray, lines: _Lines) -> Mesh:
    """Give vertices the file's normals; those without one that of their faces."""
    if not normal_of.any():
        return mesh
    given = np.concatenate([np.zeros((1, 3)), _rows(lines.normals, 3)[:, :3]])[normal_of]
    if not np.isfinite(given).all():
        return mesh
    lacking = normal_of == 0
    if lacking.any():
        given[lacking] = smooth_normals(mesh.vertices, mesh.faces)[lacking]
    return replace(mesh, normals=given)


def _note_unknown(names: list[str], lines: _Lines, materials: dict[str, Material], source: Source) -> None:
    unknown = [name for name in dict.fromkeys(names) if name and name not in materials]
    # Without any library at all names are only names.
    if unknown and materials and lines.libraries:
        source.note(f"material {', '.join(unknown[:3])} is in no library, drawn without")


def _by_name(mesh: Mesh, names: list[str]) -> list[Mesh]:
    """Divide a mesh by the name of each face, in the order of their first faces."""
    labels = {name: number for number, name in enumerate(dict.fromkeys(names))}
    number = np.array([labels[name] for name in names])
    return [_subset(mesh, number == at, name) for name, at in labels.items()]


def _subset(mesh: Mesh, faces: np.ndarray, name: str) -> Mesh:
    used, vertex = np.unique(mesh.faces[faces], return_inverse=True)

    def pick(values: np.ndarray | float | None) -> np.ndarray | float | None:
        return values[used] if isinstance(values, np.ndarray) and len(values) == len(mesh.vertices) else values

    index = None if mesh.texture_index is None else mesh.texture_index[faces]
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=vertex.reshape(-1, 3).astype(np.int32),
        normals=None if mesh.normals is None else mesh.normals[used],
        color=mesh.color if mesh.color is None or mesh.color.ndim == 1 else mesh.color[used],
        opacity=pick(mesh.opacity),
        uv=None if mesh.uv is None else mesh.uv[used],
        texture_index=index,
        name=name,
    )


def _colors(rows: np.ndarray) -> np.ndarray | None:
    """Return colours that follow positions, linear; None without."""
    if rows.shape[1] < 6:
        return None
    colors = np.where(np.isnan(rows[:, 3:6]), 1.0, rows[:, 3:6])
    colors = colors / 255.0 if 1.0 < colors.max(initial=0.0) <= 255.0 else colors
    return srgb_to_linear(np.clip(colors, 0.0, 1.0))


def _rows(lines: list[str], least: int, pad: int = 0) -> np.ndarray:
    """Return the numbers of lines as rows; where they differ in length, short ones are filled with NaN (or zeros)."""
    if not lines:
        return np.zeros((0, max(least, pad)))
    width = len(lines[0].split())
    try:
        numbers = np.array(" ".join(lines).split(), dtype=np.float64)
        even = len(numbers) == width * len(lines) and width >= least
    except ValueError:
        even = False
    if even and (len(lines) < 2 or all(len(line.split()) == width for line in lines)):
        rows = numbers.reshape(len(lines), width)
    else:
        words = [line.partition("#")[0].split() for line in lines]
        if min(map(len, words)) < least:
            raise ValueError(f"got a line of {min(map(len, words))} numbers, expected at least {least}")
        rows = np.full((len(words), max(map(len, words))), 0.0 if pad else np.nan)
        for row, each in zip(rows, words, strict=True):
            row[: len(each)] = [float(word) for word in each]
    if rows.shape[1] < pad:
        rows = np.concatenate([rows, np.zeros((len(rows), pad - rows.shape[1]))], axis=1)
    return rows


def _triple(word: str) -> tuple[int, int, int]:
    """Read the position, coordinate and normal of a corner, counted from 1; 0 for none."""
    parts = word.split("/")
    position, coordinate, normal = [*parts, "", ""][:3]
    return int(position), int(coordinate or 0), int(normal or 0)
