"""A scene as flat arrays, ready for capture, with parameters put in the place of the scene's own values.

Differentiable, with torch overrides: world vertices in ``"<name>.vertices"``, ``"<name>.translation"`` and
``"<name>.rotation"``, colour, opacity and thickness in theirs. Frozen: faces, transforms, the point about which an
object turns, textures and the baked Lambert factors (they stay those of the loaded mesh when vertices, objects or the
camera move). What captures the geometry holds coverage fixed as well: a gradient in vertices or poses moves depths and
attributes inside outlines, not the outlines.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.errors import shorten, suggest
from warpfrag.scene.camera import Camera
from warpfrag.scene.pose import CAMERA, POSE_KEYS, move_object
from warpfrag.scene.scene import (
    PARAMETER_KEYS,
    Scene,
    SceneObject,
    check_common_thickness,
    check_parameter,
    check_pose,
)


@dataclass(frozen=True)
class Geometry:
    """All objects of a scene in one set of arrays.

    Attributes:
        vertices: World space [scene units], (V, 3).
        faces: Indices into ``vertices``, (N, 3) int32 NumPy; objects one after the other, in submission order.
        rgba: Straight colour (shade included) and opacity, without textures, (V, 4).
        thickness: z-thickness (V,), in scene units or multiples of P(z) as ``thickness_in_p`` says; 0 where there is a
            map.
        object_id: Object of each face, (N,) int32 NumPy.
        first_face: First face of each object and the total, (objects + 1,) int32 NumPy; primitive = face −
            first_face[object].
        uv: Texture coordinates (V, 2) float32 NumPy, v up, repeating; None when nothing is textured.
        texture_id: Image of each face, (N,) int32 NumPy, −1 for none.
        textures: Straight linear RGBA images (h, w, 4) float32 NumPy, row 0 at the top, multiplied with ``rgba``.
        thickness_maps: z-thickness per pixel (H, W), by object index, for the objects that have a map.
        thickness_in_p: Whether the thickness of each object is in multiples of P(z), (objects,) bool NumPy.
        camera_pose: How the camera is moved: translation [scene units] and rotation vector [degrees] in its own axes,
            (3,) each; None where it stays.
    """

    vertices: Any
    faces: np.ndarray
    rgba: Any
    thickness: Any
    object_id: np.ndarray
    first_face: np.ndarray
    uv: np.ndarray | None
    texture_id: np.ndarray
    textures: list[np.ndarray]
    thickness_maps: dict[int, Any]
    thickness_in_p: np.ndarray
    camera_pose: tuple[Any, Any] | None = None


def assemble(scene: Scene, parameters: Mapping[str, Any] | None = None, *, camera: Camera | None = None) -> Geometry:
    """Flatten a scene, with parameter overrides applied.

    Args:
        scene: What to flatten.
        parameters: Values by the names of ``scene.parameters()``: numbers, NumPy arrays or torch tensors. A thickness
            is in the object's own unit; it may be one number, one per vertex, or an (H, W) map. ``"thickness"`` without
            a name, one number or a map, is that of all objects without one of their own here. ``"beta"`` is let
            through.
        camera: Whose pixel grid thickness maps must have; default the scene's.

    Returns:
        Float arrays as torch tensors, differentiable in the overrides, if any override is a tensor, else NumPy; float64
        if any override is a float64 array or tensor, else float32.

    Raises:
        ValueError: An unknown name, a wrong shape, a value out of range, or tensors on different devices.
        TypeError: An override that is neither a number, a NumPy array nor a torch tensor.

    Example:
        >>> assemble(scene, {"ball.opacity": 0.5}).rgba[0]
        array([0.8, 0.8, 0.8, 0.5], dtype=float32)
    """
    camera = camera or scene.camera
    overrides = _checked(scene, parameters or {})
    kind = _ArrayKind(overrides)
    overrides = {name: kind.array(value) for name, value in overrides.items()}
    if "thickness" in overrides:
        check_common_thickness(overrides["thickness"], camera)
    vertices, rgba, thickness, faces, uv, texture_id = [], [], [], [], [], []
    textures: list[np.ndarray] = []
    thickness_maps: dict[int, Any] = {}
    first_vertex = 0
    textured = any(item.texture is not None for item in scene.objects)
    for index, item in enumerate(scene.objects):
        values = {}
        for key in PARAMETER_KEYS:
            own = overrides.get("thickness", item.thickness) if key == "thickness" else getattr(item, key)
            values[key] = kind.array(overrides.get(f"{item.name}.{key}", own))
            check_parameter(item, key, values[key], camera)
        count = len(item.vertices)
        rotation, shift = kind.array(item.matrix[:3, :3].T.copy()), kind.array(item.matrix[:3, 3].copy())
        world = kind.xp.matmul(values["vertices"], rotation) + shift
        pose = _pose(item.name, overrides, kind)
        vertices.append(world if pose is None else move_object(world, item.middle(), *pose))
        color = kind.xp.broadcast_to(values["color"], (count, 3))
        if item.shade is not None:
            color = color * kind.array(item.shade)[:, None]
        opacity = kind.xp.broadcast_to(values["opacity"], (count,))
        rgba.append(kind.xp.concatenate([color, opacity[:, None]], 1))
        if _is_map(item, values["thickness"]):
            thickness_maps[index] = values["thickness"]
            values["thickness"] = kind.array(0.0)
        thickness.append(kind.xp.broadcast_to(values["thickness"], (count,)))
        faces.append(item.faces + np.int32(first_vertex))
        texture_id.append(_texture_ids(item, len(textures)))
        textures.extend(item.textures)
        if textured:
            uv.append(item.uv if item.uv is not None else np.zeros((count, 2), dtype=np.float32))
        first_vertex += count
    face_counts = [len(item.faces) for item in scene.objects]
    return Geometry(
        vertices=kind.join(vertices, (0, 3)),
        faces=np.concatenate([np.zeros((0, 3), dtype=np.int32), *faces]),
        rgba=kind.join(rgba, (0, 4)),
        thickness=kind.join(thickness, (0,)),
        object_id=np.repeat(np.arange(len(face_counts), dtype=np.int32), face_counts),
        first_face=np.concatenate([[0], np.cumsum(face_counts)]).astype(np.int32),
        uv=np.concatenate(uv) if textured else None,
        texture_id=np.concatenate([np.zeros(0, dtype=np.int32), *texture_id]),
        textures=textures,
        thickness_maps=thickness_maps,
        thickness_in_p=np.array([item.thickness_unit == "P" for item in scene.objects], dtype=bool),
        camera_pose=_pose(CAMERA, overrides, kind),
    )


class _ArrayKind:
    """NumPy or torch, with the precision and device that a set of overrides asks for."""

    def __init__(self, overrides: Mapping[str, Any]) -> None:
        tensors = {name: value for name, value in overrides.items() if _is_tensor(value)}
        devices = {str(value.device): name for name, value in tensors.items()}
        if len(devices) > 1:
            (device, name), (other, other_name) = list(devices.items())[:2]
            raise ValueError(f"parameters: found {name} on {device} and {other_name} on {other}, expected one device")
        arrays = [value for value in overrides.values() if _is_tensor(value) or isinstance(value, np.ndarray)]
        double = any(str(value.dtype).endswith("float64") for value in arrays)
        self.device = next(iter(tensors.values())).device if tensors else None
        self.xp: Any = sys.modules["torch"] if tensors else np
        self.dtype = self.xp.float64 if double else self.xp.float32

    def array(self, value: Any) -> Any:
        if self.xp is np:
            return np.asarray(value, dtype=self.dtype)
        if _is_tensor(value):
            return value.to(self.dtype)
        return self.xp.asarray(np.asarray(value), dtype=self.dtype, device=self.device)

    def join(self, parts: list[Any], empty_shape: tuple[int, ...]) -> Any:
        return self.xp.concatenate([self.array(np.zeros(empty_shape)), *parts])


def _is_tensor(value: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def _is_map(item: SceneObject, thickness: Any) -> bool:
    return len(thickness.shape) == 2


def _pose(owner: str, overrides: Mapping[str, Any], kind: _ArrayKind) -> tuple[Any, Any] | None:
    """Return the translation and rotation that overrides give an object or the camera, None without."""
    names = [f"{owner}.{key}" for key in POSE_KEYS]
    if not any(name in overrides for name in names):
        return None
    for name in names:
        if name in overrides:
            check_pose(name, overrides[name])
    translation, rotation = (overrides.get(name, kind.array(np.zeros(3))) for name in names)
    return translation, rotation


def _texture_ids(item: SceneObject, first: int) -> np.ndarray:
    if item.texture is None:
        return np.full(len(item.faces), -1, dtype=np.int32)
    if item.texture_index is None:
        return np.full(len(item.faces), first, dtype=np.int32)
    return np.where(item.texture_index < 0, -1, item.texture_index + first).astype(np.int32)


def _checked(scene: Scene, parameters: Mapping[str, Any]) -> dict[str, Any]:
    if not isinstance(parameters, Mapping):
        raise TypeError(f"parameters: found {type(parameters).__name__}, expected a mapping from names to values")
    known = scene.parameter_names()
    checked = {}
    for name, value in parameters.items():
        if name not in known:
            raise ValueError(f"parameters: found the unknown name {shorten(name)}; {suggest(str(name), known)}")
        if _is_tensor(value):
            if str(value.dtype) not in ("torch.float32", "torch.float64"):
                raise ValueError(f"{name}: found a tensor of {value.dtype}, expected torch.float32 or torch.float64")
            checked[name] = value
            continue
        if not isinstance(value, (bool, int, float, list, tuple, np.ndarray, np.number)) or isinstance(value, bool):
            found = type(value).__module__ + "." + type(value).__name__
            raise TypeError(f"{name}: found {found}, expected a number, a NumPy array or a torch tensor")
        try:
            array = np.asarray(value)
        except ValueError:
            array = np.asarray(None)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{name}: found {shorten(value)}, expected numbers")
        # A plain number or list says nothing about precision; only an array of float64 asks for it.
        checked[name] = value if isinstance(value, np.ndarray) else array.astype(np.float32)
    return checked
