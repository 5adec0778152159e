"""Primitive shapes, centred on the origin, with their own normals and texture coordinates.

Round shapes stand along y. A plane or grid lies in the x–y plane and faces +z. Without texture coordinates a round
shape is closed, with one vertex at each position of a smooth part; with them it is cut open along a seam.
"""

from collections.abc import Callable

import numpy as np

from warpfrag.shapes.mesh import Mesh

_TURN = 2.0 * np.pi


def sphere(radius: float = 1.0, segments: int = 64, *, uv: bool = False) -> Mesh:
    """Build a sphere of `segments` around and half as many from pole to pole."""

    def point(u, v):
        ring = np.sin(np.pi * v)
        return np.stack([ring * np.sin(_TURN * u), -np.cos(np.pi * v), ring * np.cos(_TURN * u)], axis=-1)

    mesh = _surface(point, point, segments, max(2, segments // 2), wrap_u=True, poles=True, uv=uv)
    return _scaled(mesh, radius)


def torus(radius: float = 1.0, tube: float = 0.25, segments: int = 64, *, uv: bool = False) -> Mesh:
    """Build a torus: `radius` from its centre to the middle of its tube, `tube` the radius of that."""

    def normal(u, v):
        ring = -np.cos(_TURN * v)
        return np.stack([ring * np.sin(_TURN * u), -np.sin(_TURN * v), ring * np.cos(_TURN * u)], axis=-1)

    def point(u, v):
        middle = np.stack([np.sin(_TURN * u), np.zeros_like(u), np.cos(_TURN * u)], axis=-1)
        return radius * middle + tube * normal(u, v)

    return _surface(point, normal, segments, max(3, segments // 2), wrap_u=True, wrap_v=True, uv=uv)


def cylinder(radius: float = 1.0, height: float = 2.0, segments: int = 64, *, uv: bool = False) -> Mesh:
    """Build a closed cylinder with sharp edges at its caps."""

    def normal(u, v):
        return np.stack([np.sin(_TURN * u), np.zeros_like(v), np.cos(_TURN * u)], axis=-1)

    def point(u, v):
        return normal(u, v) * radius + np.stack([0.0 * v, (v - 0.5) * height, 0.0 * v], axis=-1)

    side = _surface(point, normal, segments, 1, wrap_u=True, uv=uv)
    caps = [_disc(radius, 0.5 * height * way, segments, way, uv=uv) for way in (1, -1)]
    return _joined([side, *caps])


def cone(radius: float = 1.0, height: float = 2.0, segments: int = 64, *, uv: bool = False) -> Mesh:
    """Build a closed cone, its base at −height/2 and its tip at +height/2, sharp at both.

    The tip has a vertex per segment, since it has no one normal.
    """
    slope = np.array([height, radius]) / np.hypot(height, radius)

    def normal(u, v):
        # Each triangle's tip vertex takes the normal of the middle of its segment.
        u = np.where(v == 1.0, u - 0.5 / segments, u)
        return np.stack([slope[0] * np.sin(_TURN * u), slope[1] + 0.0 * u, slope[0] * np.cos(_TURN * u)], axis=-1)

    def point(u, v):
        ring = radius * (1.0 - v)
        return np.stack([ring * np.sin(_TURN * u), (v - 0.5) * height, ring * np.cos(_TURN * u)], axis=-1)

    side = _surface(point, normal, segments, 1, wrap_u=True, uv=uv)
    # The upper triangle of each quad of the side has two corners at the tip.
    side = Mesh(side.vertices, side.faces[0::2], side.normals, uv=side.uv)
    return _joined([side, _disc(radius, -0.5 * height, segments, -1, uv=uv)])


def cube(size: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Mesh:
    """Build a box with edges of `size` along x, y, z, four vertices a side."""
    sides = []
    for axis in range(3):
        for way in (1.0, -1.0):
            across, up = (axis + 1) % 3, (axis + 2) % 3
            corners = np.zeros((4, 3))
            corners[:, axis] = way
            corners[:, across] = np.array([-1, 1, 1, -1]) * way
            corners[:, up] = [-1, -1, 1, 1]
            normals = np.zeros((4, 3))
            normals[:, axis] = way
            texture = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
            faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
            sides.append(Mesh(corners * np.asarray(size) / 2.0, faces, normals, uv=texture))
    return _joined(sides)


def grid(size: tuple[float, float] = (1.0, 1.0), cells: tuple[int, int] = (10, 10)) -> Mesh:
    """Build a rectangle in the x–y plane, facing +z, divided into `cells` along x and y."""

    def point(u, v):
        return np.stack([(u - 0.5) * size[0], (v - 0.5) * size[1], 0.0 * u], axis=-1)

    def normal(u, v):
        return np.stack([0.0 * u, 0.0 * u, 1.0 + 0.0 * u], axis=-1)

    return _surface(point, normal, *cells, uv=True)


def plane(size: tuple[float, float] = (1.0, 1.0)) -> Mesh:
    """Build a rectangle of two triangles in the x–y plane, facing +z."""
    return grid(size, (1, 1))


def _surface(
    point: Callable,
    normal: Callable,
    columns: int,
    rows: int,
    *,
    wrap_u: bool = False,
    wrap_v: bool = False,
    poles: bool = False,
    uv: bool,
) -> Mesh:
    """Triangulate a parametric surface over (u, v) in [0, 1]², counterclockwise seen from outside.

    Faces 2i and 2i + 1 are the lower and upper triangle of quad i, but at poles, where the empty ones are left out.
    """
    column, row = np.meshgrid(np.arange(columns + 1), np.arange(rows + 1))
    # Positions on the seam come from the same parameter on both sides, so that they are equal to the bit.
    u = np.where(wrap_u & (column == columns), 0, column).reshape(-1) / columns
    v = np.where(wrap_v & (row == rows), 0, row).reshape(-1) / rows
    index = (row * (columns + 1) + column).astype(np.int32)
    first, right, above, both = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.stack([first, right, both, first, both, above], axis=-1).reshape(-1, 3)
    vertices, normals = point(u, v), normal(u, v)
    if poles:
        # sin π is not quite 0: put the poles on the axis.
        pole = (row == 0).reshape(-1) | (row == rows).reshape(-1)
        vertices[pole] = normals[pole] = [0.0, 1.0, 0.0] * np.sign(vertices[pole, 1])[:, None]
        lower, upper = np.arange(len(faces)) % 2 == 0, np.arange(len(faces)) % 2 == 1
        bottom, top = np.arange(len(faces)) < 2 * columns, np.arange(len(faces)) >= 2 * columns * (rows - 1)
        faces = faces[~((bottom & lower) | (top & upper))]
    if uv:
        coordinates = np.stack([column.reshape(-1) / columns, row.reshape(-1) / rows], axis=-1).astype(np.float32)
        return Mesh(vertices, np.ascontiguousarray(faces), normals, uv=coordinates)
    same = (row % rows if wrap_v else row) * (columns + 1) + (column % columns if wrap_u else column)
    if poles:
        same = np.where(row == 0, 0, np.where(row == rows, rows * (columns + 1), same))
    kept, inverse = np.unique(same.reshape(-1), return_inverse=True)
    return Mesh(vertices[kept], inverse.reshape(-1)[faces].astype(np.int32), normals[kept])


def _disc(radius: float, y: float, segments: int, way: int, *, uv: bool) -> Mesh:
    """Build a cap at height `y` that faces up (way = 1) or down (−1): a fan around its centre."""
    angle = _TURN * np.arange(segments) / segments
    circle = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    vertices = np.zeros((segments + 1, 3))
    vertices[1:, [0, 2]] = radius * circle
    vertices[:, 1] = y
    around = np.arange(segments)
    ahead = (around + 1) % segments
    faces = np.stack([0 * around, around + 1, ahead + 1], axis=-1)[:, ::way].astype(np.int32)
    normals = np.tile([0.0, float(way), 0.0], (segments + 1, 1))
    coordinates = np.full((segments + 1, 2), 0.5, dtype=np.float32)
    coordinates[1:] += 0.5 * circle * [1.0, -way]
    return Mesh(vertices, np.ascontiguousarray(faces), normals, uv=coordinates if uv else None)


def _scaled(mesh: Mesh, factor: float) -> Mesh:
    return Mesh(mesh.vertices * factor, mesh.faces, mesh.normals, uv=mesh.uv)


def _joined(parts: list[Mesh]) -> Mesh:
    counts = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = [part.faces + np.int32(first) for part, first in zip(parts, counts, strict=False)]
    normals = [part.normals for part in parts if part.normals is not None]
    uv = [part.uv for part in parts if part.uv is not None]
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(faces),
        np.concatenate(normals),
        uv=np.concatenate(uv) if len(uv) == len(parts) else None,
    )
