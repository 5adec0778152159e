"""The camera: from scene units to pixels.

Camera space has x to the right, y down and z forward (the planar depth), in scene units, as OpenCV's. Pixel
(column, row) has its centre at +0.5, row 0 is the top one. With (cx, cy) the middle, the principal point or (W/2, H/2),
a perspective camera looks along ((column + 0.5 − cx)/f, (row + 0.5 − cy)/f, 1) with f = (H/2)/tan(fov/2); an
orthographic one along z from ((column + 0.5 − cx), (row + 0.5 − cy)) · height/H.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from warpfrag.errors import check_choice, check_number, is_whole, shorten
from warpfrag.scene.rotation import rotation_matrix

# The axes of a camera's own space: x right, y down, z forward; or x right, y up, z back.
Axes = Literal["opencv", "opengl"]
# A matrix counts as a rotation, and pixels count as square, if they differ from that no more than files round.
ROTATION_TOLERANCE, SQUARE_TOLERANCE = 1e-4, 1e-4
# Kernels count pixels, and where their fragments begin, in 32 bits.
MOST_PIXELS = 2**31 - 2


@dataclass(frozen=True)
class Camera:
    """Where the image is taken from; perspective (`fov`) or orthographic (`height`).

    Attributes:
        eye: position of the eye, world space [scene units].
        target: a point the camera looks at; the middle of the image.
        up: world direction that points up in the image; any length, not along the line of sight.
        fov: vertical opening angle [degrees], between 0 and 180; None for an orthographic camera.
        height: vertical extent of the image [scene units], above 0; None for a perspective camera.
        near: planar depth of the near plane [scene units], above 0.
        far: planar depth of the far plane [scene units], beyond `near`.
        size: width and height of the image [pixels].
        principal: where the line of sight meets the image, from its left and top edges [pixels]; None is its middle.

    Raises:
        ValueError: a value out of its range, both or neither of `fov` and `height`, eye at the target, up along the
            view.

    Example:
        >>> Camera(eye=(0, 0, 2), target=(0, 0, 0), fov=90.0, size=(64, 48)).focal
        24.0
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    fov: float | None = None
    height: float | None = None
    near: float = 0.01
    far: float = 100.0
    size: tuple[int, int] = (512, 512)
    principal: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for key in ("eye", "target", "up"):
            object.__setattr__(self, key, _numbers(key, getattr(self, key), 3))
        for key in ("fov", "height", "near", "far"):
            value = getattr(self, key)
            object.__setattr__(self, key, None if value is None else check_number(f"camera.{key}", value))
        object.__setattr__(self, "size", _size(self.size))
        if self.principal is not None:
            object.__setattr__(self, "principal", _numbers("principal", self.principal, 2))
        if (self.fov is None) == (self.height is None):
            found = "neither" if self.fov is None else "both"
            raise ValueError(
                f"camera: got {found} of fov and height, expected fov (perspective) or height (orthographic)"
            )
        if self.fov is not None and not 0.0 < self.fov < 180.0:
            raise ValueError(f"camera.fov: got {self.fov:g}, expected degrees between 0 and 180")
        if self.height is not None and not self.height > 0.0:
            raise ValueError(f"camera.height: got {self.height:g}, expected a number above 0")
        if not self.near > 0.0:
            raise ValueError(f"camera.near: got {self.near:g}, expected a number above 0")
        if not self.far > self.near:
            raise ValueError(f"camera.far: got {self.far:g}, expected a number above near ({self.near:g})")
        forward = np.subtract(self.target, self.eye)
        if not np.any(forward):
            raise ValueError(f"camera.target: got the eye itself ({list(self.eye)}), expected another point")
        sine = np.linalg.norm(np.cross(_unit(forward), _unit(np.asarray(self.up)))) if any(self.up) else 0.0
        # Below this angle the image's own up direction is only rounding.
        if sine < 1e-9:
            raise ValueError(
                f"camera.up: got {list(self.up)}, expected a direction that is not along the line of sight"
            )

    @classmethod
    def look_at(cls, eye: Any, target: Any, up: Any = (0.0, 1.0, 0.0), **options: Any) -> "Camera":
        """Return a camera at a point that looks at another; `options` are the other attributes."""
        return cls(tuple(eye), tuple(target), tuple(up), **options)

    @classmethod
    def from_matrix(cls, matrix: Any, *, axes: Axes = "opencv", **options: Any) -> "Camera":
        """Return the camera that a matrix puts into the world.

        Args:
            matrix: from camera space to world space (column vectors), (4, 4): a rotation and the eye's position.
            axes: those of its camera space: "opencv", x right, y down, z forward; or "opengl", x right, y up, z back.
            options: the other attributes: `fov` or `height`, `near`, `far`, `size`, `principal`.

        Raises:
            TypeError: a value of the wrong kind.
            ValueError: a matrix that is no rigid motion, or a value out of its range.

        Example:
            >>> Camera.from_matrix(np.eye(4), fov=60.0).target
            (0.0, 0.0, 1.0)
        """
        check_choice("axes", axes, get_args(Axes))
        given = _matrix("matrix", matrix, (4, 4))
        if not np.array_equal(given[3], [0.0, 0.0, 0.0, 1.0]):
            raise ValueError(f"matrix: got {given[3].tolist()} in its last row, expected 0, 0, 0, 1")
        turn, eye = _rotation("matrix", given[:3, :3]), given[:3, 3]
        down, forward = (turn[:, 1], turn[:, 2]) if axes == "opencv" else (-turn[:, 1], -turn[:, 2])
        # As far away as the eye from the origin, so that the difference keeps its digits.
        target = eye + max(1.0, float(np.linalg.norm(eye))) * forward
        return cls(tuple(eye.tolist()), tuple(target.tolist()), tuple((-down).tolist()), **options)

    @classmethod
    def from_intrinsics(
        cls, intrinsics: Any, rotation: Any, translation: Any, size: tuple[int, int], **options: Any
    ) -> "Camera":
        """Return a camera of a calibration or a data set: K, R and t in OpenCV's convention.

        A world point x projects to K (R x + t), with x right, y down, z forward, and whole numbers of pixels at the
        corners of pixels (for values that mean their centres add 0.5 to the principal point).

        Args:
            intrinsics: K, (3, 3): focal length [pixels], the same along x and y, principal point anywhere, no skew.
            rotation: R, from world space to camera space, (3, 3).
            translation: t [scene units], (3,).
            size: width and height of the image [pixels].
            options: `near` and `far`.

        Raises:
            TypeError: a value of the wrong kind.
            ValueError: a K with skew or pixels that are not square, an R that is no rotation, a value out of its range.
        """
        k = _matrix("intrinsics", intrinsics, (3, 3))
        turn = _rotation("rotation", _matrix("rotation", rotation, (3, 3)))
        shift = _matrix("translation", np.reshape(translation, -1), (3,))
        fx, fy = float(k[0, 0]), float(k[1, 1])
        if not (fx > 0.0 and fy > 0.0 and np.array_equal(k[2], [0.0, 0.0, 1.0]) and k[1, 0] == 0.0):
            raise ValueError(f"intrinsics: got {shorten(k.tolist())}, expected focal lengths above 0, last row 0 0 1")
        if abs(k[0, 1]) > SQUARE_TOLERANCE * fx or abs(fx / fy - 1.0) > SQUARE_TOLERANCE:
            got = f"focal lengths {fx:g} and {fy:g} and skew {k[0, 1]:g}"
            raise ValueError(f"intrinsics: got {got}, expected square pixels without skew (resample the image)")
        width, height = _size(size)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn.T, -turn.T @ shift
        fov = 2.0 * math.degrees(math.atan2(0.5 * height, 0.5 * (fx + fy)))
        principal = (float(k[0, 2]), float(k[1, 2]))
        return cls.from_matrix(matrix, fov=fov, size=(width, height), principal=principal, **options)

    def intrinsics(self) -> np.ndarray:
        """Return K of a perspective camera, (3, 3) float64; see `from_intrinsics`.

        Raises:
            ValueError: the camera is orthographic.
        """
        return np.array([[self.focal, 0.0, self.middle[0]], [0.0, self.focal, self.middle[1]], [0.0, 0.0, 1.0]])

    @property
    def middle(self) -> tuple[float, float]:
        """Where the line of sight meets the image, from its left and top edges [pixels]."""
        return self.principal or (0.5 * self.size[0], 0.5 * self.size[1])

    @property
    def width(self) -> int:
        """Width of the image [pixels]."""
        return self.size[0]

    @property
    def shape(self) -> tuple[int, int]:
        """The pixel grid as an array shape: (H, W)."""
        return self.size[1], self.size[0]

    @property
    def is_perspective(self) -> bool:
        """Whether view rays spread from the eye."""
        return self.fov is not None

    @property
    def focal(self) -> float:
        """Focal length of a perspective camera [pixels].

        Raises:
            ValueError: the camera is orthographic.
        """
        if self.fov is None:
            raise ValueError("camera.focal: an orthographic camera has none, expected a camera with fov")
        return 0.5 * self.size[1] / math.tan(math.radians(self.fov) / 2.0)

    @property
    def pixel_size(self) -> float:
        """Edge of a pixel of an orthographic camera [scene units per pixel].

        Raises:
            ValueError: the camera is perspective.
        """
        if self.height is None:
            raise ValueError("camera.pixel_size: a perspective camera has none, expected a camera with height")
        return self.height / self.size[1]

    def view_matrix(self) -> np.ndarray:
        """Return the (4, 4) float64 matrix that takes world points (columns) to camera space."""
        forward = _unit(np.subtract(self.target, self.eye))
        right = _unit(np.cross(forward, _unit(np.asarray(self.up))))
        down = np.cross(forward, right)
        matrix = np.eye(4)
        matrix[:3, :3] = [right, down, forward]
        matrix[:3, 3] = -matrix[:3, :3] @ np.asarray(self.eye)
        return matrix

    def resized(self, size: tuple[int, int]) -> "Camera":
        """Return this camera with another image size (width, height); the vertical field of view stays."""
        principal = self.principal
        if principal is not None:
            width, height = _size(size)
            principal = principal[0] * width / self.size[0], principal[1] * height / self.size[1]
        return replace(self, size=size, principal=principal)

    def moved(self, translation: np.ndarray, rotation: np.ndarray) -> "Camera":
        """Return this camera moved along its own axes (right, down, forward) and then turned about its eye.

        Args:
            translation: [scene units], (3,).
            rotation: rotation vector [degrees], (3,).
        """
        axes = self.view_matrix()[:3, :3].T
        _, down, forward = (axes @ rotation_matrix(rotation)).T
        eye = self.eye + axes @ translation
        target = eye + np.linalg.norm(np.subtract(self.target, self.eye)) * forward
        return replace(self, eye=tuple(eye), target=tuple(target), up=tuple(-down))


def _unit(vector: np.ndarray) -> np.ndarray:
    # Scaled by the largest component first, so that neither tiny nor huge vectors under- or overflow when squared.
    vector = vector / np.abs(vector).max()
    return vector / np.linalg.norm(vector)


def _numbers(key: str, value: object, count: int) -> tuple[float, ...]:
    if isinstance(value, (list, tuple, np.ndarray)) and len(value) == count:
        return tuple(check_number(f"camera.{key}", part) for part in value)
    raise ValueError(f"camera.{key}: got {shorten(value)}, expected {count} numbers")


def _matrix(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{name}: got {shorten(value)}, expected numbers of shape {shape}") from None
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise ValueError(f"{name}: got shape {matrix.shape}, expected finite numbers of shape {shape}")
    return matrix


def _rotation(name: str, matrix: np.ndarray) -> np.ndarray:
    """Return a matrix (3, 3) that is a rotation up to rounding."""
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0.0:
        raise ValueError(f"{name}: got a matrix that is no rotation, expected orthonormal axes, right-handed")
    return matrix


def _size(value: object) -> tuple[int, int]:
    if isinstance(value, (list, tuple, np.ndarray)) and len(value) == 2:
        parts = [int(part) for part in value if is_whole(part)]
        if len(parts) == 2 and min(parts) >= 1 and parts[0] * parts[1] <= MOST_PIXELS:
            return parts[0], parts[1]
    expected = f"width and height, two whole numbers from 1, up to {MOST_PIXELS} pixels in all"
    raise ValueError(f"camera.size: got {shorten(value)}, expected {expected}")
