"""The camera: from scene units to pixels.

Camera space has x to the right, y down and z forward (the planar depth), in scene units. Pixel (column, row) has its
centre at +0.5, row 0 is the top one. A perspective camera looks along ((column + 0.5 − W/2)/f, (row + 0.5 − H/2)/f, 1)
with f = (H/2)/tan(fov/2); an orthographic one along z from ((column + 0.5 − W/2), (row + 0.5 − H/2)) · height/H.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from warpfrag.errors import check_number, is_whole, shorten
from warpfrag.scene.rotation import rotation_matrix


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

    def __post_init__(self) -> None:
        for key in ("eye", "target", "up"):
            object.__setattr__(self, key, _triple(key, getattr(self, key)))
        for key in ("fov", "height", "near", "far"):
            value = getattr(self, key)
            object.__setattr__(self, key, None if value is None else check_number(f"camera.{key}", value))
        object.__setattr__(self, "size", _size(self.size))
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
        return replace(self, size=size)

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


def _triple(key: str, value: object) -> tuple[float, float, float]:
    if isinstance(value, (list, tuple, np.ndarray)) and len(value) == 3:
        x, y, z = (check_number(f"camera.{key}", part) for part in value)
        return x, y, z
    raise ValueError(f"camera.{key}: got {shorten(value)}, expected 3 numbers")


def _size(value: object) -> tuple[int, int]:
    if isinstance(value, (list, tuple, np.ndarray)) and len(value) == 2:
        parts = [int(part) for part in value if is_whole(part)]
        if len(parts) == 2 and min(parts) >= 1:
            return parts[0], parts[1]
    raise ValueError(f"camera.size: got {shorten(value)}, expected width and height, two whole numbers from 1")
