"""Light on surfaces: a two-sided Lambert factor by vertex, which multiplies their colours.

The factor goes by where surfaces and camera are: whatever turns or moves them, in a file or by a parameter, the light
falls as it would. In gradients it is held fixed; that is the one place where a derivative of a lit image in vertices,
rotations and translations is not complete even inside outlines.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.errors import check_number, shorten
from warpfrag.scene.camera import Camera


@dataclass(frozen=True)
class Light:
    """A white light, from one direction or from the eye.

    Attributes:
        direction: towards the light, in world space, of any length; None is a headlight: from the eye of the camera
            that renders (of an orthographic one against its line of sight).
        ambient: share of the light that comes from everywhere, 0 to 1.

    Raises:
        TypeError: a value of the wrong kind.
        ValueError: a value out of its range.
    """

    direction: tuple[float, float, float] | None = None
    ambient: float = 0.3

    def __post_init__(self) -> None:
        object.__setattr__(self, "ambient", check_number("light.ambient", self.ambient, 0.0, 1.0))
        if self.direction is None:
            return
        given: Any = self.direction
        if not isinstance(given, (list, tuple, np.ndarray)) or len(given) != 3 or not np.any(np.asarray(given)):
            raise ValueError(f"light.direction: got {shorten(given)}, expected 3 numbers that are not all 0")
        object.__setattr__(self, "direction", tuple(check_number("light.direction", part) for part in given))

    def factor(self, normals: np.ndarray, points: np.ndarray, camera: Camera) -> np.ndarray:
        """Return the factor of each vertex, (V,) float32.

        Args:
            normals: in world space, of any length, (V, 3).
            points: vertices in world space [scene units], (V, 3).
            camera: the one that renders.
        """
        if self.direction is not None:
            towards = np.array(self.direction)
        elif camera.is_perspective:
            towards = np.asarray(camera.eye) - points
        else:
            towards = np.subtract(camera.eye, camera.target)
        return lambert(normals, towards, self.ambient)


def lambert(normals: np.ndarray, towards_light: np.ndarray, ambient: float) -> np.ndarray:
    """Return the two-sided Lambert factor `ambient + (1 − ambient)·|n·l|` of each vertex, (V,) float32.

    Args:
        normals: (V, 3) world-space normals of any length; a zero normal is lit by the ambient part alone.
        towards_light: world direction towards the light, (3,) or one per vertex (V, 3), any length.
        ambient: share of the light that comes from everywhere, 0…1.
    """
    # One direction for all stays one row.
    normals, light = unit_rows(normals), unit_rows(np.atleast_2d(towards_light))
    facing = np.minimum(np.abs(np.einsum("ij,ij->i", normals, np.broadcast_to(light, normals.shape))), 1.0)
    return (ambient + (1.0 - ambient) * facing).astype(np.float32)


def transformed_normals(normals: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Carry normals (V, 3) through the linear part of `matrix`; of any length, NaN-free for singular matrices."""
    # The cofactor matrix is the inverse transpose up to a factor, and exists for every matrix.
    a, b, c = np.asarray(matrix, dtype=np.float64)[:3, :3]
    return normals @ np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)]).T


def turned_normals(normals: np.ndarray, faces: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return normals turned as the surface around them is when vertices move.

    Each is turned by the smallest rotation that takes the mean normal of its faces before to that after.

    Args:
        normals: (V, 3).
        faces: (N, 3).
        before: vertices to which the normals belong, (V, 3).
        after: where they have moved, (V, 3).
    """
    old, new = (unit_rows(_sums_at_vertices(vertices, faces)) for vertices in (before, after))
    axis, cosine = np.cross(old, new), np.einsum("ij,ij->i", old, new)[:, None]
    first = np.cross(axis, normals)
    # A surface that is turned over has no smallest rotation: its normals may stay, as light falls on both sides.
    return normals + first + np.cross(axis, first) / np.maximum(1.0 + cosine, 1e-6)


def _sums_at_vertices(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    area, total = area_vectors(vertices, faces), np.zeros((len(vertices), 3))
    for corner in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], area[:, axis], minlength=len(vertices))
    return total


def area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normal of each face, as long as twice its area, (N, 3) float64."""
    first, second, third = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    return np.cross(second - first, third - first)


def unit_rows(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (V, 3) of length 1, float64; zeros stay."""
    # By columns: NumPy's sums and maxima over an axis of 3 take ten times as long.
    x, y, z = np.array(vectors, dtype=np.float64).T
    # Tiny meshes have areas whose square underflows: scale by the largest component first.
    largest = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))
    largest[largest == 0.0] = 1.0
    x, y, z = x / largest, y / largest, z / largest
    length = np.sqrt(x * x + y * y + z * z)
    length[length == 0.0] = 1.0
    return np.stack([x / length, y / length, z / length], axis=1)
