"""A surface of a scene: triangles, their place, and how they look."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warpfrag.errors import check_choice, shorten
from warpfrag.scene.names import ThicknessUnit
from warpfrag.scene.parameters import OBJECT_KINDS, VERTICES, Parameter, Thickness, parse_thickness
from warpfrag.scene.rotation import rotation_matrix
from warpfrag.scene.same import same


@dataclass(eq=False, repr=False)
class SceneObject:
    """One named surface: triangles, their place, and how they look.

    Arrays may be given as anything NumPy can read; they are kept as the types below. What the image uses as colour is
    `color · shade · light · texture colour`, as opacity `opacity · texture alpha`.

    Attributes:
        name: unique in its scene.
        vertices: positions in the object's own space [scene units], (V, 3): float64 if they are given as an array of
            that, else float32.
        faces: indices into `vertices`, (N, 3) int32.
        matrix: from the object's own space to world space (column vectors), (4, 4) float64, affine and invertible.
        color: straight linear RGB from 0, (3,) or per vertex (V, 3).
        opacity: 0 to 1, one number or per vertex (V,).
        thickness: z-thickness from 0, in `thickness_unit`: one number, per vertex (V,), or per pixel (H, W); a text
            such as "0.3" (scene units) or "2P" (multiples of P(z)) has its unit with it.
        thickness_unit: "scene" units, or "P": multiples of the depth resolution P(z) of the camera.
        uv: texture coordinates (V, 2), v up: (0, 0) is the lower left corner of the image, which repeats outside 0…1.
        texture: straight linear RGBA image (h, w, 4) float32, row 0 at the top, or a list of them; None without.
        texture_index: which image each face takes from a list, (N,) int32, −1 for none; None where all take the first.
        shade: baked factor per vertex (V,), multiplied into the colour; None for 1.
        normals: in the object's own space, of any length, (V, 3) float64, on which the scene's light falls; None is
            unlit.

    Raises:
        TypeError: a name that is no text.
        ValueError: a value of the wrong shape or out of its range, with the name of the object and the field.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    color: Any = (0.8, 0.8, 0.8)
    opacity: Any = 1.0
    thickness: Any = 2.0
    thickness_unit: ThicknessUnit = "P"
    uv: np.ndarray | None = None
    texture: np.ndarray | list[np.ndarray] | None = None
    texture_index: np.ndarray | None = None
    shade: np.ndarray | None = None
    normals: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise TypeError(f"name: got {shorten(self.name)}, expected the text that names an object")
        if not self.name.strip():
            raise ValueError(f"name: got {shorten(self.name)}, expected a text that is not blank")
        if isinstance(self.thickness, str):
            self._set_thickness(self.thickness)
        check_choice(f"{self.name}.thickness_unit", self.thickness_unit, ("scene", "P"))
        vertices = self._array("vertices", self.vertices)
        # Only an array asks for a precision: a list of Python's floats does not.
        keep = getattr(self.vertices, "dtype", None) == np.float64
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64 if keep else np.float32)
        shaped = self.vertices.ndim == 2 and self.vertices.shape[1] == 3
        self._fail_unless(shaped, "vertices", f"shape {self.vertices.shape}", "shape (V, 3)")
        self._check_faces()
        self._check_matrix()
        for kind in OBJECT_KINDS:
            array = self._array(kind.key, getattr(self, kind.key))
            Parameter(f"{self.name}.{kind.key}", kind, self.name, len(self.vertices)).check(array)
            if kind is not VERTICES:
                number = array.ndim == 0
                setattr(self, kind.key, float(array) if number else np.ascontiguousarray(array, dtype=np.float32))
        self._check_texture()
        if self.shade is not None:
            self.shade = self._array("shade", self.shade).astype(np.float32)
            expected = f"shape ({len(self.vertices)},)"
            self._fail_unless(self.shade.shape == (len(self.vertices),), "shade", f"shape {self.shade.shape}", expected)
        if self.normals is not None:
            self.normals = self._array("normals", self.normals).astype(np.float64)
            shaped = self.normals.shape == (len(self.vertices), 3) and bool(np.isfinite(self.normals).all())
            expected = f"finite numbers of shape ({len(self.vertices)}, 3)"
            self._fail_unless(shaped, "normals", f"shape {self.normals.shape}", expected)

    def __repr__(self) -> str:
        return f"SceneObject({self.name!r}, {len(self.vertices)} vertices, {len(self.faces)} faces)"

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    __hash__ = None  # type: ignore[assignment]

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

    def moved(self, translation: np.ndarray, rotation: np.ndarray, pivot: np.ndarray | None = None) -> "SceneObject":
        """Return this object turned about a point and then moved, along the world's axes.

        Args:
            translation: [scene units], (3,).
            rotation: rotation vector [degrees], (3,).
            pivot: the point to turn about [scene units], (3,); None takes the middle of the bounding box.
        """
        about = self.middle() if pivot is None else pivot
        motion = np.eye(4)
        motion[:3, :3] = turn = rotation_matrix(rotation)
        motion[:3, 3] = about - turn @ about + translation
        return replace(self, matrix=motion @ self.matrix)

    def _set_thickness(self, text: str) -> None:
        thickness: Thickness | None = parse_thickness(text)
        expected = 'a number, or multiples of P(z) such as "2P"'
        self._fail_unless(thickness is not None, "thickness", shorten(text), expected)
        assert thickness is not None
        self.thickness, self.thickness_unit = thickness

    def _check_faces(self) -> None:
        faces = np.asarray(self.faces)
        whole = np.issubdtype(faces.dtype, np.integer) and faces.ndim == 2 and faces.shape[1] == 3
        got = f"{faces.dtype} of shape {faces.shape}"
        self._fail_unless(whole, "faces", got, "whole numbers of shape (N, 3)")
        if faces.size:
            got, last = f"indices {faces.min()} to {faces.max()}", len(self.vertices) - 1
            self._fail_unless(faces.min() >= 0 and faces.max() <= last, "faces", got, f"indices from 0 to {last}")
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)

    def _check_matrix(self) -> None:
        self.matrix = self._array("matrix", self.matrix).astype(np.float64)
        self._fail_unless(self.matrix.shape == (4, 4), "matrix", f"shape {self.matrix.shape}", "shape (4, 4)")
        affine = bool(np.isfinite(self.matrix).all()) and np.array_equal(self.matrix[3], [0.0, 0.0, 0.0, 1.0])
        affine = affine and np.linalg.matrix_rank(self.matrix[:3, :3]) == 3
        expected = "finite numbers, invertible, with the last row 0 0 0 1"
        self._fail_unless(affine, "matrix", self.matrix.tolist(), expected)

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
            expected = "numbers"
            if getattr(value, "requires_grad", False):
                expected = "numbers without a gradient (detach them; what is differentiated is given as `parameters`)"
            raise ValueError(f"{self.name}.{key}: got {shorten(value)}, expected {expected}") from error
        self._fail_unless(array.dtype.kind in "fiu", key, shorten(value), "numbers")
        return array

    def _fail_unless(self, condition: object, key: str, got: object, expected: str) -> None:
        if not condition:
            raise ValueError(f"{self.name}.{key}: got {got}, expected {expected}")
