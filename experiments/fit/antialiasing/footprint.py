"""Where surfaces cross in an image, and how fast their depths change across a pixel, from one sample a pixel.

A surface's slope is the gradient of its depth along the ray in pixel coordinates (column, row) [scene units per pixel],
that of the plane of the triangle which the pixel's centre hits: a shader has it from its own derivatives (dFdx, dFdy).
Its length is the pixel's footprint along the ray: pixel size times the tangent of the angle between normal and ray.
"""

from dataclasses import dataclass

import numpy as np

import warpfrag as wf

# Within a pixel normals of one surface that differ more than this [degrees] are those of different sides of an edge.
CREASE = 20.0
# Width of the band on either side of the pixels that a curve of intersection passes through [pixels].
MARGIN = 2


@dataclass(frozen=True, eq=False)
class Pairs:
    """In each pixel the two fragments of different objects that cross nearest by.

    Attributes:
        distance: to the line in which the planes of the two cross [pixels], (P,); infinite without such a pair.
        slopes: of either surface [scene units per pixel], (P, 2, 2).
        pixel_size: edge of a pixel at the pair's depth, across the line of sight [scene units], (P,).
    """

    distance: np.ndarray
    slopes: np.ndarray
    pixel_size: np.ndarray

    def footprints(self) -> dict[str, np.ndarray]:
        """Return what the best thickness may be a multiple of, by name [scene units], (P,)."""
        first, second = self.slopes[:, 0], self.slopes[:, 1]
        lengths = np.linalg.norm(self.slopes, axis=2)
        return {
            "s": self.pixel_size,
            "max(|g₁|, |g₂|)": lengths.max(axis=1),
            "|g₁| + |g₂|": lengths.sum(axis=1),
            "|g₁ − g₂|₁": np.abs(first - second).sum(axis=1),
            "|g₁ − g₂|": np.linalg.norm(first - second, axis=1),
        }


def nearest_pairs(scene: wf.Scene, fragments: wf.Fragments) -> Pairs:
    """Return for each pixel the pair of fragments whose surfaces cross nearest by.

    Args:
        scene: what the fragments are of, seen by its own camera.
        fragments: sorted, NumPy.
    """
    slopes, sizes = slopes_of(scene, fragments)
    owner = padded(fragments, fragments.object_id, -1)
    depth, slope = padded(fragments, fragments.depth.astype(np.float64)), padded(fragments, slopes)
    pixel = np.arange(len(owner))
    distance = np.full(len(owner), np.inf)
    one, other = np.zeros(len(owner), np.int64), np.zeros(len(owner), np.int64)
    for i in range(owner.shape[1]):
        for j in range(i + 1, owner.shape[1]):
            apart = np.abs(depth[:, i] - depth[:, j])
            change = np.linalg.norm(slope[:, i] - slope[:, j], axis=1)
            crosses = (owner[:, i] >= 0) & (owner[:, j] >= 0) & (owner[:, i] != owner[:, j]) & (change > 0.0)
            pixels_away = np.divide(apart, change, out=np.full_like(apart, np.inf), where=crosses)
            nearer = pixels_away < distance
            distance[nearer], one[nearer], other[nearer] = pixels_away[nearer], i, j
    pair = np.stack([slope[pixel, one], slope[pixel, other]], axis=1)
    return Pairs(distance, pair, padded(fragments, sizes)[pixel, one])


def intersection_band(scene: wf.Scene, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels that a curve of intersection passes through, and those near it; neither near other edges.

    All samples of such a pixel meet the same surfaces, on the same side of each surface's own edges. Where they meet
    them in different orders, surfaces cross.

    Args:
        scene: the scene, seen by its own camera.
        samples: along each edge of a pixel.

    Returns:
        Two masks (H, W) bool: crossing, and the band of `MARGIN` pixels around it.
    """
    height, width = scene.camera.shape
    fine = scene.camera.resized((width * samples, height * samples))
    crossing, smooth = np.zeros((height, width), bool), np.zeros((height, width), bool)
    for row in range(height):
        fragments = wf.capture(scene, fine, rows=(row * samples, (row + 1) * samples)).numpy()
        crossing[row], smooth[row] = _row_of_pixels(scene, fragments, samples)
    crossing &= smooth
    near = np.zeros_like(crossing)
    around = np.pad(crossing, MARGIN)
    for down in range(2 * MARGIN + 1):
        for right in range(2 * MARGIN + 1):
            near |= around[down : down + height, right : right + width]
    return crossing, near & smooth


def slopes_of(scene: wf.Scene, fragments: wf.Fragments) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope of each fragment, (F, 2), and the size of a pixel at its depth, (F,)."""
    camera = scene.camera
    height, width = camera.shape
    normals, offsets = _planes(scene, fragments)
    row, column = np.divmod(fragments.pixel, width)
    x, y = (column + 0.5 - width / 2) / camera.focal, (row + 0.5 - height / 2) / camera.focal
    # The ray through (x, y, 1) of length L meets the plane at depth k·L/(n·ray); differentiated by x and y.
    length = np.sqrt(x * x + y * y + 1.0)
    across = normals[:, 0] * x + normals[:, 1] * y + normals[:, 2]
    along = np.stack([x, y], axis=1) / (length * across)[:, None]
    slopes = offsets[:, None] * (along - (length / across**2)[:, None] * normals[:, :2]) / camera.focal
    return slopes, offsets / across / camera.focal


def padded(fragments: wf.Fragments, values: np.ndarray, fill: float = 0.0) -> np.ndarray:
    """Return values of fragments by pixel and place in its list, (P, K, ...)."""
    counts = np.diff(fragments.offsets)
    pixel = fragments.pixel
    place = np.arange(fragments.count) - fragments.offsets[:-1][pixel]
    result = np.full((counts.size, max(counts.max(initial=0), 1), *values.shape[1:]), fill, values.dtype)
    result[pixel, place] = values
    return result


def _row_of_pixels(scene: wf.Scene, fragments: wf.Fragments, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for a row of pixels whether the order of surfaces changes within each, and whether nothing else does."""
    owner = padded(fragments, fragments.object_id, -1)
    normal = padded(fragments, _planes(scene, fragments)[0])
    # Sorted by owner first: the list of surfaces, whatever their order.
    by_owner = np.argsort(owner, axis=1, kind="stable")
    surfaces = np.take_along_axis(owner, by_owner, axis=1)
    normal = np.take_along_axis(normal, by_owner[..., None], axis=1)

    def by_pixel(values: np.ndarray) -> np.ndarray:
        blocks = values.reshape(samples, -1, samples, *values.shape[1:]).swapaxes(0, 1)
        return blocks.reshape(blocks.shape[0], samples**2, *values.shape[1:])

    owner, surfaces, normal = by_pixel(owner), by_pixel(surfaces), by_pixel(normal)
    changes = (owner != owner[:, :1]).any(axis=(1, 2))
    same = (surfaces == surfaces[:, :1]).all(axis=(1, 2))
    level = np.sum(normal * normal[:, :1], axis=-1) > np.cos(np.radians(CREASE))
    return changes, same & (level | (surfaces < 0)).all(axis=(1, 2))


def _planes(scene: wf.Scene, fragments: wf.Fragments) -> tuple[np.ndarray, np.ndarray]:
    """Return the plane n·p = k of each fragment's triangle in camera space: unit normals (F, 3) and k (F,)."""
    view = scene.camera.view_matrix()
    normals, offsets = np.zeros((fragments.count, 3)), np.zeros(fragments.count)
    for index, item in enumerate(scene.objects):
        members = fragments.object_id == index
        points = item.world_vertices() @ view[:3, :3].T + view[:3, 3]
        a, b, c = (points[item.faces[fragments.primitive_id[members], corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        normals[members] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        offsets[members] = np.sum(normals[members] * a, axis=1)
    return normals, offsets
