"""Point sets as surfaces: files of points, their normals and spacing, and a disc (surfel) for each point.

A surfel is a regular polygon around its point, perpendicular to the point's normal; its radius is a multiple of the
spacing, the mean distance from a point to its nearest neighbour (Pfister et al. 2000). Normals that a file lacks are
estimated: the direction in which a point's neighbours spread least, made to face one way along the surface (Hoppe et
al. 1992).

Text files hold a point a row; their columns are told apart by number and content (``#`` and ``//`` start comments, a
first row with nothing but the number of points is skipped): 3 positions; with 4 or 7 columns an intensity follows,
which is not used; of the triples that follow, the one of unit length is the normal, the other the colour. The 6 columns
of a pwn file always end in normals. Colours from 0 to 255, or to 1 where none is larger, are sRGB, as those of ply
files are.
"""

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.extras import need
from warpfrag.shapes.mesh import Mesh

POINT_SUFFIXES = (".ply", ".pts", ".pwn", ".xyz")
# Enough for a plane to be told from noise, few enough to stay on one side of a thin sheet.
NEIGHBOURS = 12
# Rounding in text files: a normal of 3 digits is this far from unit length.
_UNIT = 0.02


@dataclass(frozen=True)
class PointSet:
    """Points of a surface.

    Attributes:
        points: Positions [scene units], (P, 3) float64.
        normals: Unit normals (P, 3) float64; None where they are to be estimated.
        color: Straight linear RGB, (P, 3) float64; None without.
        opacity: 0…1, (P,) float64; None without.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    color: np.ndarray | None = None
    opacity: np.ndarray | None = None


def load_points(path: str | os.PathLike) -> PointSet:
    """Read a file of points, or the vertices of a ply mesh.

    Args:
        path: A file with one of ``POINT_SUFFIXES``.

    Raises:
        ValueError: The file is missing, of an unknown kind, unreadable, or holds no points (one line each).
    """
    path = Path(path)
    if path.suffix.lower() not in POINT_SUFFIXES:
        raise ValueError(f"found the point file {path} of an unknown kind, expected one of {', '.join(POINT_SUFFIXES)}")
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise ValueError(f"found {found} at {path}, expected a file of points")
    read = _read_ply if path.suffix.lower() == ".ply" else _read_text
    try:
        points = read(path)
    except Exception as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise ValueError(f"found a file of points that cannot be read: {path} ({reason})") from error
    if len(points.points) == 0:
        raise ValueError(f"found no points in {path}, expected at least 2")
    return points


def surfels(points: PointSet, radius: float = 2.0, segments: int = 8) -> Mesh:
    """Build a disc for each point, perpendicular to its normal.

    Args:
        points: The points.
        radius: Radius of the discs in multiples of the spacing, above 0. At 2 a surface of randomly scattered points
            has few holes.
        segments: Corners of each disc, from 3.

    Returns:
        ``segments`` vertices and ``segments`` − 2 faces a point, point by point, with the points' normals and colours.

    Raises:
        ValueError: Fewer than two of the points are distinct, so that there is no spacing.
        ImportError: scipy is missing.

    Example:
        >>> surfels(PointSet(np.random.default_rng(0).random((100, 3))), segments=6).faces.shape
        (400, 3)
    """
    normals = estimate_normals(points.points) if points.normals is None else points.normals
    size = radius * spacing(points.points)
    across, up = _tangents(normals)
    angle = 2.0 * np.pi * np.arange(segments) / segments
    rim = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * up[:, None]
    vertices = points.points[:, None] + size * rim
    corner = np.arange(1, segments - 1)
    fan = np.stack([np.zeros_like(corner), corner, corner + 1], axis=-1)
    faces = (np.arange(len(vertices)) * segments)[:, None, None] + fan

    def spread(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else np.repeat(values, segments, axis=0)

    return Mesh(
        vertices.reshape(-1, 3),
        faces.reshape(-1, 3).astype(np.int32),
        spread(normals),
        spread(points.color),
        spread(points.opacity),
    )


def spacing(points: np.ndarray) -> float:
    """Return the mean distance from a point to its nearest neighbour [scene units]; points at one place count as one.

    Raises:
        ValueError: Fewer than two points are distinct.
    """
    tree, distinct = _tree(points)
    if len(distinct) < 2:
        raise ValueError(f"found {len(distinct)} distinct points, expected at least 2")
    return float(tree.query(distinct, k=2)[0][:, 1].mean())


def estimate_normals(points: np.ndarray, neighbours: int = NEIGHBOURS) -> np.ndarray:
    """Estimate the unit normals of points on a surface, (P, 3).

    Each is perpendicular to the plane that its nearest neighbours fit best. Signs agree along the surface: from the
    outermost point of each connected part, which faces away from the part's middle, they spread along the edges
    between neighbours whose normals differ least.

    Args:
        points: (P, 3).
        neighbours: How many of the nearest points (the point itself is one of them) make the plane.
    """
    tree, distinct = _tree(points)
    count = min(neighbours, len(distinct))
    _, near = tree.query(distinct, k=count)
    near = near.reshape(len(distinct), count)
    offset = distinct[near] - distinct[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", offset, offset))
    normals = axes[:, :, 0]
    normals = normals * _facing(distinct, normals, near)[:, None]
    return normals[tree.query(points)[1]]


def _facing(points: np.ndarray, normals: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the sign (1 or −1) of each normal with which they face one way along the surface."""
    graph = need("scipy.sparse.csgraph", "fit", "Facing the normals of points one way")
    sparse = need("scipy.sparse", "fit", "Facing the normals of points one way")
    count = len(points)
    start, end = np.repeat(np.arange(count), near.shape[1]), near.reshape(-1)
    start, end = start[start != end], end[start != end]
    # A weight of 0 would be no edge at all.
    weight = 1.0 + 1e-6 - np.minimum(np.abs(np.einsum("ij,ij->i", normals[start], normals[end])), 1.0)
    # The two directions of an edge have one weight, or none: max, where adding them up would count some twice.
    edges = sparse.coo_matrix((weight, (start, end)), shape=(count, count)).tocsr()
    edges = edges.maximum(edges.T)
    part_count, part = graph.connected_components(edges, directed=False)
    tree = graph.minimum_spanning_tree(edges).tocoo()
    middle = np.stack([np.bincount(part, points[:, axis]) for axis in range(3)], axis=-1)
    outward = points - (middle / np.bincount(part)[:, None])[part]
    by_part = np.lexsort((-np.einsum("ij,ij->i", outward, outward), part))
    roots = by_part[np.searchsorted(part[by_part], np.arange(part_count))]
    # One more node above the roots makes the forest a tree, which is walked from the top.
    rows = np.concatenate([tree.row, np.full(part_count, count)])
    columns = np.concatenate([tree.col, roots])
    linked = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count + 1, count + 1)).tocsr()
    order, above = graph.breadth_first_order(linked, count, directed=False)
    agrees = np.ones(count + 1)
    child = order[1:]
    parent_normal = np.concatenate([normals, np.zeros((1, 3))])[above[child]]
    parent_normal[above[child] == count] = outward[child[above[child] == count]]
    agrees[child] = np.where(np.einsum("ij,ij->i", normals[child], parent_normal) < 0.0, -1.0, 1.0)
    signs = agrees.tolist()
    for node, parent in zip(child.tolist(), above[child].tolist(), strict=True):
        signs[node] *= signs[parent]
    return np.array(signs[:count])


def _tree(points: np.ndarray) -> tuple[Any, np.ndarray]:
    """Return a search tree of the distinct points, and them."""
    spatial = need("scipy.spatial", "fit", "Finding the neighbours of points")
    distinct = np.unique(np.asarray(points, dtype=np.float64), axis=0)
    return spatial.cKDTree(distinct), distinct


def _tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors at right angles to each normal and each other (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    across = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    return across, np.stack([b, sign + y * y * a, -y], axis=-1)


def _read_ply(path: Path) -> PointSet:
    from trimesh.exchange.ply import load_ply

    # Of what trimesh makes of a mesh only this is one entry a point, in the file's order and precision.
    vertex = load_ply(io.BytesIO(path.read_bytes()))["metadata"]["_ply_raw"]["vertex"]
    if not vertex["length"]:
        return PointSet(np.zeros((0, 3)))
    data = vertex["data"]
    names = data.keys() if isinstance(data, dict) else data.dtype.names

    def columns(*wanted: str) -> np.ndarray | None:
        if any(name not in names for name in wanted):
            return None
        arrays = [np.asarray(data[name]).reshape(-1) for name in wanted]
        # Whole numbers are shares of their type's largest; that of a float is 1.
        scale = np.iinfo(arrays[0].dtype).max if arrays[0].dtype.kind in "iu" else 1.0
        return np.stack(arrays, axis=-1).astype(np.float64) / scale

    opacity = columns("alpha")
    points = np.stack([np.asarray(data[name], dtype=np.float64).reshape(-1) for name in "xyz"], axis=-1)
    return _checked(
        points,
        columns("nx", "ny", "nz"),
        columns("red", "green", "blue"),
        None if opacity is None else opacity[:, 0],
    )


def _read_text(path: Path) -> PointSet:
    text = path.read_text(encoding="utf-8").replace(",", " ")
    first, _, rest = text.partition("\n")
    if len(first.split()) == 1:
        text = rest
    if not text.strip():
        return PointSet(np.zeros((0, 3)))
    rows = np.loadtxt(io.StringIO(text), comments=("#", "//"), ndmin=2)
    width = rows.shape[1]
    if width not in (3, 4, 6, 7, 9):
        raise ValueError(f"{width} columns, expected 3, 4, 6, 7 or 9")
    skip = 4 if width in (4, 7) else 3
    normals = color = None
    for begin in range(skip, width, 3):
        triple = rows[:, begin : begin + 3]
        length = np.linalg.norm(triple, axis=1)
        if normals is None and (path.suffix.lower() == ".pwn" or np.mean(np.abs(length - 1.0) < _UNIT) > 0.9):
            normals = triple
        else:
            color = triple / (255.0 if triple.max() > 1.0 else 1.0)
    return _checked(rows[:, :3], normals, color, None)


def _checked(
    points: np.ndarray, normals: np.ndarray | None, color: np.ndarray | None, opacity: np.ndarray | None
) -> PointSet:
    if not np.isfinite(points).all():
        raise ValueError("a position is not finite")
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        # A file with normals for some of its points only gets all of them estimated.
        normals = normals / length if np.isfinite(length).all() and length.min() > 0.0 else None
    if color is not None:
        if not _is_share(color):
            raise ValueError("a colour is out of its range")
        color = srgb_to_linear(color)
    if opacity is not None and not _is_share(opacity):
        raise ValueError("an alpha is out of its range")
    return PointSet(points, normals, color, opacity)


def _is_share(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and values.min() >= 0.0 and values.max() <= 1.0)
