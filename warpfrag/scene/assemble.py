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
from typing import Any

import numpy as np

from warpfrag.errors import check_choice
from warpfrag.scene.camera import Camera
from warpfrag.scene.frame import Frame, Precision, checked_overrides
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
)
from warpfrag.scene.pose import move_object
from warpfrag.scene.rotation import rotation_matrix
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject


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
    scene, overrides = checked_overrides(scene, parameters or {}, known)
    frame = Frame.of(overrides, known)
    camera, lens = through_lens(camera, overrides, known, bounds, frame.double)
    if COMMON_THICKNESS.key in overrides:
        # One array for all: a map is then there once.
        common = known[COMMON_THICKNESS.key].bounded(frame.array(overrides[COMMON_THICKNESS.key]), bounds)
        known[COMMON_THICKNESS.key].check(common, camera.shape)
        overrides[COMMON_THICKNESS.key] = common
    camera_pose = _pose(CAMERA, overrides, known, frame)
    # The camera as light goes with it.
    eye = camera if camera_pose is None else camera.moved(*(frame.kind.to_numpy(value) for value in camera_pose))
    vertices, rgba, thickness = [], [], []
    thickness_maps: dict[int, Any] = {}
    xp = frame.kind.xp
    for index, item in enumerate(scene.objects):
        values = _values(item, overrides, known, frame, camera, bounds)
        count = len(item.vertices)
        pose = _pose(item.name, overrides, known, frame)
        world = world_vertices_of(values[VERTICES], item, pose, frame)
        vertices.append(world)
        color = xp.broadcast_to(values[COLOR], (count, 3))
        if item.shade is not None:
            color = color * frame.array(item.shade)[:, None]
        if scene.light is not None and item.normals is not None:
            own = values[VERTICES] if f"{item.name}.{VERTICES.key}" in overrides else None
            factor = scene.light.factor(world_normals_of(item, own, pose, frame), frame.kind.to_numpy(world), eye)
            color = color * frame.array(factor)[:, None]
        opacity = xp.broadcast_to(values[OPACITY], (count,))
        rgba.append(xp.concatenate([color, opacity[:, None]], 1))
        if len(values[THICKNESS].shape) == 2:
            thickness_maps[index] = values[THICKNESS]
            values[THICKNESS] = frame.array(0.0)
        thickness.append(xp.broadcast_to(values[THICKNESS], (count,)))
    return Geometry(
        vertices=xp.concatenate([frame.double(np.zeros((0, 3))), *vertices]),
        rgba=xp.concatenate([frame.array(np.zeros((0, 4))), *rgba]),
        thickness=xp.concatenate([frame.array(np.zeros(0)), *thickness]),
        thickness_maps=thickness_maps,
        camera=camera,
        lens=lens,
        precision=frame.precision,
        camera_pose=camera_pose,
        **_tables(scene),
    )


def _tables(scene: Scene) -> dict[str, Any]:
    """Return what of a geometry no parameter changes."""
    faces, uv, texture_id = [], [], []
    textures: list[np.ndarray] = []
    first_vertex = 0
    textured = any(item.texture is not None for item in scene.objects)
    for item in scene.objects:
        faces.append(item.faces + np.int32(first_vertex))
        texture_id.append(_texture_ids(item, len(textures)))
        textures.extend(item.textures)
        if textured:
            uv.append(item.uv if item.uv is not None else np.zeros((len(item.vertices), 2), dtype=np.float32))
        first_vertex += len(item.vertices)
    face_counts = [len(item.faces) for item in scene.objects]
    return {
        "faces": np.concatenate([np.zeros((0, 3), dtype=np.int32), *faces]),
        "object_id": np.repeat(np.arange(len(face_counts), dtype=np.int32), face_counts),
        "first_face": np.concatenate([[0], np.cumsum(face_counts)]).astype(np.int32),
        "uv": np.concatenate(uv) if textured else None,
        "texture_id": np.concatenate([np.zeros(0, dtype=np.int32), *texture_id]),
        "textures": textures,
        "thickness_in_p": np.array([item.thickness_unit == "P" for item in scene.objects], dtype=bool),
    }


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
