"""What stands in a scene, and its parameters by name."""

import math
import re
import sys
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from warpfrag.errors import shorten
from warpfrag.scene.camera import Camera
from warpfrag.scene.pose import CAMERA, POSE_KEYS

PARAMETER_KEYS = ("thickness", "color", "opacity", "vertices")
_MULTIPLE_OF_P = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*P\s*")
MERGES = ("none", "smooth", "order_independent", "exact")
MIXES = ("opacity", "average", "optical_depth")


@dataclass
class SceneObject:
    """One named surface: triangles, their place, and how they look.

    Arrays may be given as anything NumPy can read; they are kept as the types below. What the image uses as colour is
    ``color · shade · texture colour``, as opacity ``opacity · texture alpha``.

    Attributes:
        name: Unique in its scene.
        vertices: Positions in the object's own space [scene units], (V, 3) float32.
        faces: Indices into ``vertices``, (N, 3) int32.
        matrix: From the object's own space to world space (column vectors), (4, 4) float64, affine and invertible.
        color: Straight linear RGB from 0, (3,) or per vertex (V, 3).
        opacity: 0…1, one number or per vertex (V,).
        thickness: z-thickness from 0, in ``thickness_unit``: one number, per vertex (V,), or per pixel (H, W).
        thickness_unit: ``"scene"`` units, or ``"P"``: multiples of the depth resolution P(z) of the camera.
        uv: Texture coordinates (V, 2), v up: (0, 0) is the lower left corner of the image, which repeats outside 0…1.
        texture: Straight linear RGBA image (h, w, 4) float32, row 0 at the top, or a list of them; None without.
        texture_index: Which image each face takes from a list, (N,) int32, −1 for none; None where all take the first.
        shade: Baked Lambert factor per vertex (V,), multiplied into the colour; None is unlit.

    Raises:
        ValueError: A value of the wrong shape or out of its range, with the name of the object and the field.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    color: Any = (0.8, 0.8, 0.8)
    opacity: Any = 1.0
    thickness: Any = 2.0
    thickness_unit: Literal["scene", "P"] = "P"
    uv: np.ndarray | None = None
    texture: np.ndarray | list[np.ndarray] | None = None
    texture_index: np.ndarray | None = None
    shade: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise ValueError(f"object name: found {shorten(self.name)}, expected a text that is not blank")
        self._fail_unless(
            self.thickness_unit in ("scene", "P"), "thickness_unit", self.thickness_unit, '"scene" or "P"'
        )
        self.vertices = np.ascontiguousarray(self._array("vertices", self.vertices), dtype=np.float32)
        check_parameter(self, "vertices", self.vertices)
        faces = np.asarray(self.faces)
        found = f"{faces.dtype} of shape {faces.shape}"
        whole = np.issubdtype(faces.dtype, np.integer) and faces.ndim == 2 and faces.shape[1] == 3
        self._fail_unless(whole, "faces", found, "whole numbers of shape (N, 3)")
        if faces.size:
            found, last = f"indices {faces.min()} to {faces.max()}", len(self.vertices) - 1
            self._fail_unless(faces.min() >= 0 and faces.max() <= last, "faces", found, f"indices from 0 to {last}")
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        self.matrix = self._array("matrix", self.matrix).astype(np.float64)
        self._fail_unless(self.matrix.shape == (4, 4), "matrix", f"shape {self.matrix.shape}", "shape (4, 4)")
        affine = bool(np.isfinite(self.matrix).all()) and np.array_equal(self.matrix[3], [0.0, 0.0, 0.0, 1.0])
        affine = affine and np.linalg.matrix_rank(self.matrix[:3, :3]) == 3
        expected = "finite numbers, invertible, with the last row 0 0 0 1"
        self._fail_unless(affine, "matrix", self.matrix.tolist(), expected)
        for key in ("color", "opacity", "thickness"):
            value = self._array(key, getattr(self, key))
            check_parameter(self, key, value)
            setattr(self, key, float(value) if value.ndim == 0 else np.ascontiguousarray(value, dtype=np.float32))
        self._check_texture()
        if self.shade is not None:
            self.shade = self._array("shade", self.shade).astype(np.float32)
            expected = f"shape ({len(self.vertices)},)"
            self._fail_unless(self.shade.shape == (len(self.vertices),), "shade", f"shape {self.shade.shape}", expected)

    @property
    def textures(self) -> list[np.ndarray]:
        """The images of this object; empty without."""
        if self.texture is None:
            return []
        return self.texture if isinstance(self.texture, list) else [self.texture]

    def world_vertices(self) -> np.ndarray:
        """Return the vertices in world space [scene units], (V, 3) float64."""
        return self.vertices.astype(np.float64) @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def middle(self) -> np.ndarray:
        """Return the middle of the bounding box in world space [scene units], (3,) float64."""
        if not len(self.vertices):
            return self.matrix[:3, 3].copy()
        world = self.world_vertices()
        return 0.5 * (world.min(axis=0) + world.max(axis=0))

    def _check_texture(self) -> None:
        if self.uv is not None:
            self.uv = self._array("uv", self.uv).astype(np.float32)
            expected = f"shape ({len(self.vertices)}, 2)"
            self._fail_unless(self.uv.shape == (len(self.vertices), 2), "uv", f"shape {self.uv.shape}", expected)
        if self.texture is None:
            return
        self._fail_unless(self.uv is not None, "texture", "an image but no uv", "uv as well")
        images = [self._array("texture", image).astype(np.float32, copy=False) for image in self.textures]
        for image in images:
            sized = image.ndim == 3 and image.shape[2] == 4 and image.size > 0
            self._fail_unless(sized, "texture", f"shape {image.shape}", "shape (h, w, 4)")
        self.texture = images if isinstance(self.texture, list) else images[0]
        if self.texture_index is not None:
            index = self.texture_index = np.ascontiguousarray(self.texture_index, dtype=np.int32)
            expected = f"shape ({len(self.faces)},) of numbers from -1 to {len(images) - 1}"
            fits = index.shape == (len(self.faces),) and (
                index.size == 0 or -1 <= index.min() <= index.max() < len(images)
            )
            self._fail_unless(fits, "texture_index", f"shape {index.shape}", expected)

    def _array(self, key: str, value: Any) -> np.ndarray:
        try:
            array = np.asarray(value)
        except (ValueError, TypeError, RuntimeError) as error:
            raise ValueError(f"{self.name}.{key}: found {shorten(value)}, expected numbers") from error
        self._fail_unless(array.dtype.kind in "fiu", f"{key}", shorten(value), "numbers")
        return array

    def _fail_unless(self, condition: object, key: str, found: object, expected: str) -> None:
        if not condition:
            raise ValueError(f"{self.name}.{key}: found {found}, expected {expected}")


@dataclass
class Scene:
    """A camera, the objects it sees, and how they are to be resolved.

    Attributes:
        camera: The view.
        objects: In submission order; their names are unique, and none is "camera".
        background: Premultiplied linear RGBA behind everything, 4 numbers.
        beta: In-slab interpolation, 0…1.
        layers: Largest number of layers of a pixel, from 1.
        merge: How overlapping fragments merge.
        mix: How their colours are weighted.

    Raises:
        ValueError: Two objects of one name, one named "camera", or a value out of its range.
    """

    camera: Camera
    objects: list[SceneObject] = field(default_factory=list)
    background: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    beta: float = 1.0
    layers: int = 8
    merge: Literal["none", "smooth", "order_independent", "exact"] = "smooth"
    mix: Literal["opacity", "average", "optical_depth"] = "opacity"

    def __post_init__(self) -> None:
        self.objects = list(self.objects)
        repeated = [name for name, count in Counter(item.name for item in self.objects).items() if count > 1]
        if repeated:
            raise ValueError(f'objects: found the name "{repeated[0]}" more than once, expected unique names')
        if any(item.name == CAMERA for item in self.objects):
            raise ValueError(
                'objects: found the name "camera", expected another (the camera\'s own parameters have it)'
            )
        background = np.asarray(self.background, dtype=np.float64)
        if background.shape != (4,) or not np.isfinite(background).all() or background.min() < 0 or background[3] > 1:
            found = shorten(self.background)
            raise ValueError(
                f"background: found {found}, expected premultiplied RGBA: 4 numbers from 0, the last up to 1"
            )
        red, green, blue, alpha = background.tolist()
        self.background = (red, green, blue, alpha)
        if isinstance(self.beta, bool) or not isinstance(self.beta, (int, float)) or not 0.0 <= self.beta <= 1.0:
            raise ValueError(f"beta: found {shorten(self.beta)}, expected a number from 0 to 1")
        if isinstance(self.layers, bool) or not isinstance(self.layers, int) or self.layers < 1:
            raise ValueError(f"layers: found {shorten(self.layers)}, expected a whole number from 1")
        for key, choices in (("merge", MERGES), ("mix", MIXES)):
            if getattr(self, key) not in choices:
                raise ValueError(f"{key}: found {shorten(getattr(self, key))}, expected one of {', '.join(choices)}")

    def parameters(self) -> dict[str, float | np.ndarray]:
        """Return what can be overridden, fitted or differentiated, by name.

        Returns:
            Floats and copies of arrays, safe to change: ``"beta"``; for each object ``"<name>.thickness"`` (in the
            object's own ``thickness_unit``), ``".color"``, ``".opacity"`` and ``".vertices"`` (its own space); and as
            zeros ``"<name>.translation"`` [scene units] and ``"<name>.rotation"`` (rotation vector [degrees], about the
            middle of the bounding box of the object as it stands), along the world's axes, and
            ``"camera.translation"`` and ``"camera.rotation"`` (about the eye), along the camera's: right, down,
            forward.

        Example:
            >>> sorted(scene.parameters())[:4]
            ['ball.color', 'ball.opacity', 'ball.rotation', 'ball.thickness']
        """
        result: dict[str, float | np.ndarray] = {"beta": float(self.beta)}
        for item in self.objects:
            for key in PARAMETER_KEYS:
                value = getattr(item, key)
                result[f"{item.name}.{key}"] = (
                    float(value) if np.ndim(value) == 0 else np.array(value, dtype=np.float32)
                )
        for owner in (*(item.name for item in self.objects), CAMERA):
            result.update({f"{owner}.{key}": np.zeros(3, dtype=np.float32) for key in POSE_KEYS})
        return result

    def parameter_names(self) -> set[str]:
        """Return all names that `parameters=` takes: those of `parameters()`, and `"thickness"` for all objects."""
        names = {f"{item.name}.{key}" for item in self.objects for key in (*PARAMETER_KEYS, *POSE_KEYS)}
        return {"beta", "thickness", *names, *(f"{CAMERA}.{key}" for key in POSE_KEYS)}


def multiple_of_p(text: str) -> float | None:
    """Return the number of a thickness in multiples of P(z), 2 of "2P"; None for any other text."""
    match = _MULTIPLE_OF_P.fullmatch(text)
    return None if match is None else float(match[1])


def check_parameter(item: SceneObject, key: str, value: Any, camera: Camera | None = None) -> None:
    """Check shape, range and finiteness of one parameter of an object.

    Args:
        item: The object.
        key: One of ``PARAMETER_KEYS``.
        value: A NumPy array or torch tensor.
        camera: Whose pixel grid a thickness map must have; None checks its rank only.

    Raises:
        ValueError: With the parameter's name, what was found and what is expected.
    """
    count, shape = len(item.vertices), tuple(value.shape)
    if key == "vertices":
        low, high = -math.inf, math.inf
        allowed, words = len(shape) == 2 and shape[1] == 3, "(V, 3)"
        # At construction the object's own vertices are what is being checked.
        if value is not item.vertices:
            allowed, words = shape == (count, 3), f"({count}, 3)"
    elif key == "color":
        low, high = 0.0, math.inf
        allowed, words = shape in ((3,), (count, 3)), f"(3,) or ({count}, 3)"
    elif key == "opacity":
        low, high = 0.0, 1.0
        allowed, words = shape in ((), (count,)), f"() or ({count},)"
    else:
        low, high = 0.0, math.inf
        grid = "(H, W)" if camera is None else str(camera.shape)
        allowed = shape in ((), (count,)) or (len(shape) == 2 if camera is None else shape == camera.shape)
        words = f"(), ({count},) or a map of shape {grid}"
    span = {"opacity": "from 0 to 1", "vertices": "that are finite"}.get(key, "from 0, finite")
    _check_value(f"{item.name}.{key}", value, allowed, words, (low, high), span)


def check_pose(name: str, value: Any) -> None:
    """Check shape and finiteness of a translation or rotation, a NumPy array or torch tensor.

    Raises:
        ValueError: With the parameter's name, what was found and what is expected.
    """
    _check_value(name, value, tuple(value.shape) == (3,), "(3,)", (-math.inf, math.inf), "that are finite")


def check_common_thickness(value: Any, camera: Camera) -> None:
    """Check a thickness for all objects, a NumPy array or torch tensor: one number, or a map of the camera's pixels.

    Raises:
        ValueError: With the parameter's name, what was found and what is expected.
    """
    allowed = tuple(value.shape) in ((), camera.shape)
    _check_value("thickness", value, allowed, f"() or a map of shape {camera.shape}", (0.0, math.inf), "from 0, finite")


def _check_value(name: str, value: Any, allowed: bool, words: str, limits: tuple[float, float], span: str) -> None:
    """Raise unless a parameter has an allowed shape and finite values within limits, which `span` words."""
    if not allowed:
        raise ValueError(f"{name}: found shape {tuple(value.shape)}, expected shape {words}")
    if isinstance(value, np.ndarray):
        isfinite = np.isfinite
    else:
        isfinite, value = sys.modules["torch"].isfinite, value.detach()
    good = isfinite(value) & (value >= limits[0]) & (value <= limits[1])
    if not bool(good.all()):
        raise ValueError(f"{name}: found {float(value[~good].reshape(-1)[0]):g}, expected numbers {span}")
