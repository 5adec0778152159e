"""Point sets as surfaces: their normals and spacing, and a disc (surfel) for each point.

A surfel is a regular polygon around its point, perpendicular to the point's normal; its radius is a multiple of the
spacing, the mean distance from a point to its nearest neighbour (Pfister et al. 2000). Normals that a set lacks are
estimated: the direction in which a point's neighbours spread least, made to face one way along the surface (Hoppe et
al. 1992).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.shapes.mesh import Mesh

# Enough for a plane to be told from noise, few enough to stay on one side of a thin sheet.
NEIGHBOURS = 12


@dataclass(frozen=True, repr=False)
class PointSet:
    """Points of a surface.

    Attributes:
        points: positions [scene units], (P, 3) float64.
        normals: unit normals (P, 3) float64; None where they are to be estimated.
        color: straight linear RGB, (P, 3) float64; None without.
        opacity: 0…1, (P,) float64; None without.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    color: np.ndarray | None = None
    opacity: np.ndarray | None = None

    def __repr__(self) -> str:
        return f"PointSet({len(self.points)} points)"


def surfels(points: PointSet | np.ndarray, radius: float = 2.0, segments: int = 8) -> Mesh:
    """Build a disc for each point, perpendicular to its normal.

    Args:
        points: the points, or their positions alone, (P, 3).
        radius: radius of the discs in multiples of the spacing, above 0. At 2 a surface of randomly scattered points
            has few holes.
        segments: corners of each disc, from 3.

    Returns:
        `segments` vertices and `segments` − 2 faces a point, point by point, with the points' normals and colours.

    Raises:
        ValueError: fewer than two of the points are distinct, so that there is no spacing.
        ImportError: scipy is missing.

    Example:
        >>> surfels(np.random.default_rng(0).random((100, 3)), segments=6).faces.shape
        (400, 3)
    """
    points = points if isinstance(points, PointSet) else PointSet(np.asarray(points, np.float64))
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
        ValueError: fewer than two points are distinct.
    """
    tree, distinct = _tree(points)
    if len(distinct) < 2:
        raise ValueError(f"got {len(distinct)} distinct points, expected at least 2")
    return float(tree.query(distinct, k=2)[0][:, 1].mean())


def estimate_normals(points: np.ndarray, neighbours: int = NEIGHBOURS) -> np.ndarray:
    """Estimate the unit normals of points on a surface, (P, 3).

    Each is perpendicular to the plane that its nearest neighbours fit best. Signs agree along the surface: from the
    outermost point of each connected part, which faces away from the part's middle, they spread along the edges
    between neighbours whose normals differ least.

    Args:
        points: (P, 3).
        neighbours: how many of the nearest points (the point itself is one of them) make the plane.
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
