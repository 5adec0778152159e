"""A scene as flat arrays, ready for capture, with parameters put in the place of the scene's own values.

Differentiable, with torch overrides: world vertices in `"<name>.vertices"`, `"<name>.translation"` and
`"<name>.rotation"`, colour, opacity and thickness in theirs. Frozen: faces, transforms, the point about which an object
turns, textures and the factors of light (see `light`). What captures the geometry holds coverage fixed as well: a
gradient in vertices or poses moves depths and attributes inside outlines, not the outlines.

Coordinates are computed in float64 from the object's own vertices, its matrix and its pose, component by component:
NumPy and torch round alike, and no matrix product is left to what autocast makes of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from warpfrag.arrays.kinds import NUMPY, Kind, dtype_name, kind_of
from warpfrag.errors import check_choice, shorten
from warpfrag.scene.camera import Camera
from warpfrag.scene.lens import Lens, through_lens
from warpfrag.scene.light import transformed_normals, turned_normals
from warpfrag.scene.names import CAMERA, POSE_KEYS
from warpfrag.scene.parameters import (
    BOUNDS,
    COLOR,
    COMMON_THICKNESS,
    OPACITY,
    THICKNESS,
    VERTICES,
    Bounds,
    Parameter,
    check_name,
)
from warpfrag.scene.pose import move_object
from warpfrag.scene.rotation import rotation_matrix
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject

Precision = Literal["float32", "float64"]


@dataclass(frozen=True)
class Geometry:
    """All objects of a scene in one set of arrays.

    Attributes:
        vertices: world space [scene units], (V, 3) float64, whatever the precision of the image.
        faces: indices into `vertices`, (N, 3) int32 NumPy; objects one after the other, in submission order.
        rgba: straight colour (shade and light included) and opacity, without textures, (V, 4).
        thickness: z-thickness (V,), in scene units or multiples of P(z) as `thickness_in_p` says; 0 where there is a
            map.
        object_id: object of each face, (N,) int32 NumPy.
        first_face: first face of each object and the total, (objects + 1,) int32 NumPy; primitive = face −
            first_face[object].
        uv: texture coordinates (V, 2) float32 NumPy, v up, repeating; None when nothing is textured.
        texture_id: image of each face, (N,) int32 NumPy, −1 for none.
        textures: straight linear RGBA images (h, w, 4) float32 NumPy, row 0 at the top, multiplied with `rgba`.
        thickness_maps: z-thickness per pixel (H, W), by object index, for the objects that have a map.
        thickness_in_p: whether the thickness of each object is in multiples of P(z), (objects,) bool NumPy.
        precision: of the image, and of `rgba`, `thickness` and the maps.
        camera: the camera, with the lens that parameters give it.
        lens: how points in camera space move with that; None without gradients.
        camera_pose: how the camera is moved: translation [scene units] and rotation vector [degrees] in its own axes,
            (3,) float64 each; None where it stays.
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
    camera: Camera
    lens: Lens | None = None
    precision: Precision = "float32"
    camera_pose: tuple[Any, Any] | None = None


@dataclass(frozen=True)
class Frame:
    """What arrays a scene is assembled in.

    Attributes:
        kind: the kind of arrays.
        precision: of all but coordinates.
        like: an array of that kind and precision, on its device.
    """

    kind: Kind
    precision: Precision
    like: Any

    @staticmethod
    def of(overrides: Mapping[str, Any], known: Mapping[str, Parameter]) -> "Frame":
        """Return the frame that a set of overrides asks for.

        Raises:
            TypeError: arrays of two libraries.
            ValueError: arrays on different devices.
        """
        arrays, kinds, devices = {}, {}, {}
        for name, value in overrides.items():
            kind = kind_of(value)
            if kind is not None and kind is not NUMPY:
                arrays[name], kinds[kind.name], devices[str(kind.device_of(value))] = value, name, name
        if len(kinds) > 1:
            (kind_name, name), (other, other_name) = list(kinds.items())[:2]
            raise TypeError(f"parameters: got {name} of {kind_name} and {other_name} of {other}, expected one library")
        if len(devices) > 1:
            (device, name), (other, other_name) = list(devices.items())[:2]
            raise ValueError(f"parameters: got {name} on {device} and {other_name} on {other}, expected one device")
        asking = [*arrays.values()]
        # Vertices that an object keeps in float64 say where it stands (far away), and nothing of the image.
        asking += [v for n, v in overrides.items() if isinstance(v, np.ndarray) and not known[n].keeps_float64]
        precision: Precision = "float64" if any(dtype_name(value) == "float64" for value in asking) else "float32"
        kind = kind_of(next(iter(arrays.values()))) if arrays else NUMPY
        assert kind is not None
        like = kind.astype(next(iter(arrays.values())), precision) if arrays else np.zeros(0, precision)
        return Frame(kind, precision, like)

    def array(self, value: Any) -> Any:
        """Return a number or an array in this kind and precision."""
        if self.kind.owns(value):
            return self.kind.astype(value, self.precision)
        return self.kind.asarray(np.asarray(value), self.like)

    def double(self, value: Any) -> Any:
        """Return a number or an array in this kind, in float64."""
        if self.kind.owns(value):
            return self.kind.astype(value, "float64")
        return self.kind.asarray(np.asarray(value, np.float64), self.kind.astype(self.like, "float64"))


def assemble(
    scene: Scene,
    parameters: Mapping[str, Any] | None = None,
    *,
    camera: Camera | None = None,
    bounds: Bounds = "clamp",
) -> Geometry:
    """Flatten a scene, with parameter overrides applied.

    Args:
        scene: what to flatten.
        parameters: values by the names of `scene.parameters()`: numbers, NumPy arrays or torch tensors, or texts such
            as "2P". A number is in the object's own unit; a thickness may be one number, one per vertex, or an (H, W)
            map. `"thickness"` without a name, one number or a map, is that of all objects without one of their own
            here. `"beta"` is let through.
        camera: whose pixel grid thickness maps must have; default the scene's.
        bounds: what becomes of parameters out of their range: "clamp" puts them on its end, with a gradient that leads
            back in but not farther out; "error" refuses them.

    Returns:
        Arrays as torch tensors, differentiable in the overrides, if any override is a tensor, else NumPy. The image is
        float64 if any override is a float64 tensor or NumPy array, else float32; NumPy's vertices of an object that
        keeps its own in float64 have no say in that.

    Raises:
        ValueError: an unknown name, a wrong shape, a value out of range, or tensors on different devices.
        TypeError: an override that is neither a number, a NumPy array, a torch tensor nor a text.

    Example:
        >>> assemble(scene, {"ball.opacity": 0.5}).rgba[0]
        array([0.8, 0.8, 0.8, 0.5], dtype=float32)
    """
    check_choice("bounds", bounds, BOUNDS)
    camera = camera or scene.camera
    known = scene.described()
    scene, overrides = _checked(scene, parameters or {}, known)
    frame = Frame.of(overrides, known)
    camera, lens = through_lens(camera, overrides, known, bounds, frame.double)
    if COMMON_THICKNESS.key in overrides:
        # One array for all: a map is then there once.
        common = known[COMMON_THICKNESS.key].bounded(frame.array(overrides[COMMON_THICKNESS.key]), bounds)
        known[COMMON_THICKNESS.key].check(common, camera.shape)
        overrides[COMMON_THICKNESS.key] = common
    vertices, rgba, thickness, faces, uv, texture_id = [], [], [], [], [], []
    textures: list[np.ndarray] = []
    thickness_maps: dict[int, Any] = {}
    first_vertex = 0
    textured = any(item.texture is not None for item in scene.objects)
    xp = frame.kind.xp
    camera_pose = _pose(CAMERA, overrides, known, frame)
    # The camera as light goes with it.
    eye = camera if camera_pose is None else camera.moved(*(frame.kind.to_numpy(value) for value in camera_pose))
    for index, item in enumerate(scene.objects):
        values = _values(item, overrides, known, frame, camera, bounds)
        count = len(item.vertices)
        pose = _pose(item.name, overrides, known, frame)
        vertices.append(world_vertices_of(values[VERTICES], item, pose, frame))
        color = xp.broadcast_to(values[COLOR], (count, 3))
        if item.shade is not None:
            color = color * frame.array(item.shade)[:, None]
        if scene.light is not None and item.normals is not None:
            own = values[VERTICES] if f"{item.name}.{VERTICES.key}" in overrides else None
            normals = world_normals_of(item, own, pose, frame)
            points = frame.kind.to_numpy(vertices[-1])
            color = color * frame.array(scene.light.factor(normals, points, eye))[:, None]
        opacity = xp.broadcast_to(values[OPACITY], (count,))
        rgba.append(xp.concatenate([color, opacity[:, None]], 1))
        if len(values[THICKNESS].shape) == 2:
            thickness_maps[index] = values[THICKNESS]
            values[THICKNESS] = frame.array(0.0)
        thickness.append(xp.broadcast_to(values[THICKNESS], (count,)))
        faces.append(item.faces + np.int32(first_vertex))
        texture_id.append(_texture_ids(item, len(textures)))
        textures.extend(item.textures)
        if textured:
            uv.append(item.uv if item.uv is not None else np.zeros((count, 2), dtype=np.float32))
        first_vertex += count
    face_counts = [len(item.faces) for item in scene.objects]
    return Geometry(
        vertices=xp.concatenate([frame.double(np.zeros((0, 3))), *vertices]),
        faces=np.concatenate([np.zeros((0, 3), dtype=np.int32), *faces]),
        rgba=xp.concatenate([frame.array(np.zeros((0, 4))), *rgba]),
        thickness=xp.concatenate([frame.array(np.zeros(0)), *thickness]),
        object_id=np.repeat(np.arange(len(face_counts), dtype=np.int32), face_counts),
        first_face=np.concatenate([[0], np.cumsum(face_counts)]).astype(np.int32),
        uv=np.concatenate(uv) if textured else None,
        texture_id=np.concatenate([np.zeros(0, dtype=np.int32), *texture_id]),
        textures=textures,
        thickness_maps=thickness_maps,
        thickness_in_p=np.array([item.thickness_unit == "P" for item in scene.objects], dtype=bool),
        camera=camera,
        lens=lens,
        precision=frame.precision,
        camera_pose=camera_pose,
    )


def world_vertices_of(own: Any, item: SceneObject, pose: tuple[Any, Any] | None, frame: Frame) -> Any:
    """Return an object's vertices in world space, (V, 3) float64.

    Args:
        own: in its own space [scene units], (V, 3) float64.
        item: the object.
        pose: its translation and rotation vector, float64; None where it stays.
        frame: the kind of all of them.
    """
    x, y, z = own[:, 0], own[:, 1], own[:, 2]
    # Python's own floats: torch would turn NumPy's into arrays.
    rows = [[float(value) for value in row] for row in item.matrix[:3]]
    points = [row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows]
    return frame.kind.xp.stack(points if pose is None else move_object(points, item.middle(), *pose), 1)


def world_normals_of(item: SceneObject, own: Any, pose: tuple[Any, Any] | None, frame: Frame) -> np.ndarray:
    """Return an object's normals in world space, of any length, (V, 3) float64 NumPy, without gradient.

    Args:
        item: the object, which has normals.
        own: vertices in the place of its own, (V, 3); None for its own.
        pose: its translation and rotation vector; None where it stays.
        frame: the kind of all of them.
    """
    assert item.normals is not None
    normals = item.normals
    if own is not None:
        normals = turned_normals(normals, item.faces, item.vertices, frame.kind.to_numpy(own))
    normals = transformed_normals(normals, item.matrix)
    return normals if pose is None else normals @ rotation_matrix(frame.kind.to_numpy(pose[1])).T


def _values(
    item: SceneObject,
    overrides: Mapping[str, Any],
    known: Mapping[str, Parameter],
    frame: Frame,
    camera: Camera,
    bounds: Bounds,
) -> dict[Any, Any]:
    """Return an object's values by kind, checked: those given, or its own."""
    values = {}
    for kind in (THICKNESS, COLOR, OPACITY, VERTICES):
        name = f"{item.name}.{kind.key}"
        own = getattr(item, kind.key)
        if kind is THICKNESS:
            own = overrides.get(COMMON_THICKNESS.key, own)
        given = overrides.get(name, own)
        value = frame.double(given) if kind is VERTICES else frame.array(given)
        values[kind] = known[name].bounded(value, bounds) if name in overrides else value
        known[name].check(values[kind], camera.shape)
    return values


def _pose(
    owner: str, overrides: Mapping[str, Any], known: Mapping[str, Parameter], frame: Frame
) -> tuple[Any, Any] | None:
    """Return the translation and rotation that overrides give an object or the camera, float64; None without."""
    names = [f"{owner}.{key}" for key in POSE_KEYS]
    if not any(name in overrides for name in names):
        return None
    translation, rotation = (frame.double(overrides.get(name, np.zeros(3))) for name in names)
    for name, value in zip(names, (translation, rotation), strict=True):
        known[name].check(value)
    return translation, rotation


def _texture_ids(item: SceneObject, first: int) -> np.ndarray:
    if item.texture is None:
        return np.full(len(item.faces), -1, dtype=np.int32)
    if item.texture_index is None:
        return np.full(len(item.faces), first, dtype=np.int32)
    return np.where(item.texture_index < 0, -1, item.texture_index + first).astype(np.int32)


def _checked(
    scene: Scene, parameters: Mapping[str, Any], known: Mapping[str, Parameter]
) -> tuple[Scene, dict[str, Any]]:
    """Return the overrides as arrays or plain numbers, and the scene in the units that texts among them say."""
    if not isinstance(parameters, Mapping):
        raise TypeError(f"parameters: got {type(parameters).__name__}, expected a mapping from names to values")
    for name in parameters:
        check_name(name, known, "parameters")
    scene, parameters = scene.in_units_of(parameters)
    return scene, {name: _checked_array(name, value) for name, value in parameters.items()}


def _checked_array(name: str, value: Any) -> Any:
    kind = kind_of(value)
    if kind is not None and kind is not NUMPY and kind.xp is not None:
        if dtype_name(value) not in ("float32", "float64"):
            expected = f"a {kind.type_name} of float32 or float64"
            raise ValueError(f"{name}: got a {kind.type_name} of {dtype_name(value)}, expected {expected}")
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float, list, tuple, np.ndarray, np.number)):
        got = type(value).__module__ + "." + type(value).__name__
        raise TypeError(f"{name}: got {got}, expected a number, a NumPy array or a torch tensor")
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: got {shorten(value)}, expected numbers")
    # A plain number or list says nothing about precision: it stays Python's.
    return value
