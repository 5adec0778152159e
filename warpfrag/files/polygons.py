"""Polygons cut into triangles: fans where they are convex, ears where they are not.

A polygon of n corners becomes n − 2 triangles that cover it once and run around the way it does. Fans of concave
polygons would cover what lies outside.
"""

import numpy as np


def cut_polygons(points: np.ndarray, counts: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide polygons into triangles.

    Args:
        points: positions (P, 3).
        counts: corners of each polygon, (N,); those with fewer than 3 give nothing.
        corners: the point of each corner, one polygon after the other.

    Returns:
        The polygon of each triangle (T,), and the places of its corners in `corners`, (T, 3); in the polygons' order.

    Raises:
        ValueError: a corner names a point that is not there.
    """
    counts = np.asarray(counts, dtype=np.int64)
    if len(corners) and not (corners.min() >= 0 and corners.max() < len(points)):
        wrong = corners.min() if corners.min() < 0 else corners.max()
        raise ValueError(f"a face names vertex {wrong}, there are {len(points)}")
    if (counts == 3).all():
        return np.arange(len(counts)), np.arange(3 * len(counts)).reshape(-1, 3)
    corners = np.asarray(corners, dtype=np.int64)
    first = np.cumsum(counts) - counts
    polygon, places = _fans(counts, first)
    if counts.max() <= 3:
        return polygon, places
    reflex = _reflex_corners(points, counts, first, corners)
    concave = np.unique(np.repeat(np.arange(len(counts)), counts)[reflex])
    if not len(concave):
        return polygon, places
    first_triangle = np.concatenate([[0], np.cumsum(np.maximum(counts - 2, 0))])
    quads = concave[counts[concave] == 4]
    # A fan from a quadrilateral's reflex corner, or from the one across, is right; from its neighbours it is not.
    turned = quads[reflex[first[quads] + 1] | reflex[first[quads] + 3]]
    places[first_triangle[turned]] = first[turned][:, None] + [1, 2, 3]
    places[first_triangle[turned] + 1] = first[turned][:, None] + [1, 3, 0]
    for which in concave[counts[concave] > 4]:
        own = first[which] + np.arange(counts[which])
        ears = _ears(points[corners[own]])
        if len(ears) == counts[which] - 2:
            places[first_triangle[which] : first_triangle[which + 1]] = own[ears]
    return polygon, places


def _fans(counts: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    triangles = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = first[polygon]
    return polygon, np.stack([start, start + step + 1, start + step + 2], axis=-1)


def _normals(points: np.ndarray, counts: np.ndarray, first: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the area vector of each polygon (Newell)."""
    ahead = _neighbours(counts, first, 1)
    base = points[corners[np.minimum(first, len(corners) - 1)]]
    owner = np.repeat(np.arange(len(counts)), counts)
    here = points[corners] - base[owner]
    area = np.cross(here, points[corners[ahead]] - base[owner])
    return np.stack([np.bincount(owner, area[:, axis], minlength=len(counts)) for axis in range(3)], axis=-1)


def _neighbours(counts: np.ndarray, first: np.ndarray, step: int) -> np.ndarray:
    """Return for each corner the place of the one before (−1) or after (1) in its polygon."""
    own, size = np.repeat(first, counts), np.repeat(counts, counts)
    return own + (np.arange(len(own)) - own + step) % size


def _reflex_corners(points: np.ndarray, counts: np.ndarray, first: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Tell for each corner whether its polygon turns the other way there, (C,) bool."""
    points = np.asarray(points, dtype=np.float64)
    here = points[corners]
    into = here - points[corners[_neighbours(counts, first, -1)]]
    out = points[corners[_neighbours(counts, first, 1)]] - here
    normal = np.repeat(_normals(points, counts, first, corners), counts, axis=0)
    turn = np.einsum("ij,ij->i", np.cross(into, out), normal)
    # Corners of a straight line turn by rounding alone.
    scale = np.linalg.norm(into, axis=1) * np.linalg.norm(out, axis=1) * np.linalg.norm(normal, axis=1)
    return (turn < -1e-9 * scale) & (np.repeat(counts, counts) > 3)


def _ears(polygon: np.ndarray) -> np.ndarray:
    """Return the triangles of one polygon (n, 3) as its corners' numbers, in its own sense of turning."""
    import mapbox_earcut

    count = np.array([len(polygon)])
    normal = _normals(polygon, count, np.array([0]), np.arange(len(polygon)))[0]
    # Seen along the axis that the normal is closest to.
    axis = int(np.abs(normal).argmax())
    across = (axis + 1) % 3, (axis + 2) % 3
    flat = np.ascontiguousarray((polygon - polygon.mean(axis=0))[:, across])
    triangles = mapbox_earcut.triangulate_float64(flat, count.astype(np.uint32)).reshape(-1, 3).astype(np.int64)
    a, b, c = flat[triangles].transpose(1, 0, 2)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    wrong = area * normal[axis] < 0.0
    triangles[wrong] = triangles[wrong][:, ::-1]
    return triangles
