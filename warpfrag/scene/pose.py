"""Poses: rigid motions of objects and of the camera, as parameters.

An object's world vertices x become x + (R − I)(x − m) + d, with m the middle of its bounding box as the scene stands. A
point p in camera space becomes Rᵀ(p − d): the camera moves by d along its own axes and turns about its eye. R − I is
what is computed, so that a pose of zeros changes no bit.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import kind_of
from warpfrag.errors import shorten
from warpfrag.scene.camera import Camera
from warpfrag.scene.names import CAMERA, POSE_KEYS
from warpfrag.scene.parameters import (
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    TRANSLATION,
    ParameterKind,
)
from warpfrag.scene.rotation import RADIANS, cross_matrix, left_jacobian, rotation_change, rotation_matrix
from warpfrag.scene.scene import Scene


def move_object(points: list[Any], middle: np.ndarray, translation: Any, rotation: Any) -> list[Any]:
    """Return x + (R − I)(x − m) + d for the coordinates of world points x.

    Args:
        points: [x, y, z] in world space [scene units], float64 arrays (V,) of one kind.
        middle: the point m about which to turn [scene units], (3,).
        translation: d [scene units], (3,), of the same kind.
        rotation: rotation vector [degrees], (3,), of the same kind.
    """
    shift = _double(translation)
    about = [points[axis] - float(middle[axis]) for axis in range(3)]
    change = rotation_change(rotation)
    return [points[i] + _row(change[i], about) + shift[i] for i in range(3)]


def move_camera(points: list[Any], translation: Any, rotation: Any) -> list[Any]:
    """Return Rᵀ(p − d) for the coordinates [x, y, z] of points p in camera space, float64 arrays (V,)."""
    shift, change = _double(translation), rotation_change(rotation)
    seen = [points[axis] - shift[axis] for axis in range(3)]
    return [seen[i] + _row(change[:, i], seen) for i in range(3)]


def pose_matrix(
    name: str, scene: Scene, camera: Camera | None = None, parameters: Mapping[str, Any] | None = None
) -> np.ndarray:
    """Return the matrix that turns derivatives in a rigid motion in camera space into those in a pose parameter.

    `Coverage.motion_gradients(...) @ pose_matrix(...)` are the derivatives (F, 3) that fragments have in
    `"<object>.translation"`, `"<object>.rotation"` (those of this object's fragments; to the others it means nothing),
    `"camera.translation"` or `"camera.rotation"`.

    Args:
        name: the parameter.
        scene: the scene.
        camera: where from; default the scene's.
        parameters: the values at which to differentiate, as for `capture`; poses that are not in it are zero.

    Returns:
        (6, 3) float64: the derivatives of a translation and of a rotation about the camera's eye [radians], in camera
        space, by the three numbers of the parameter [scene units or degrees].

    Raises:
        ValueError: `name` is no pose parameter of the scene.
    """
    parameter = scene.described().get(name)
    if parameter is None or not is_pose(parameter.kind):
        raise ValueError(f"name: got {shorten(name)}, expected the translation or rotation of an object or the camera")
    translation, rotation = pose_values(parameter.owner, parameters or {})
    camera_translation, camera_rotation = pose_values(CAMERA, parameters or {})
    view = (camera or scene.camera).view_matrix()
    turned = rotation_matrix(camera_rotation).T
    by_force, by_torque = np.zeros((3, 3)), np.zeros((3, 3))
    axes = turned @ view[:3, :3]
    if parameter.kind is CAMERA_TRANSLATION:
        by_force = -turned
    elif parameter.kind is CAMERA_ROTATION:
        by_torque = -turned @ left_jacobian(rotation) * RADIANS
    elif parameter.kind is TRANSLATION:
        by_force = axes
    else:
        item = next(item for item in scene.objects if item.name == parameter.owner)
        pivot = item.middle() + translation
        seen = turned @ (view[:3, :3] @ pivot + view[:3, 3] - camera_translation)
        # About the pivot c the torque is Σ (p − c) × g.
        by_torque = axes @ left_jacobian(rotation) * RADIANS
        by_force = -cross_matrix(seen).T @ by_torque
    return np.concatenate([by_force, by_torque])


def is_pose(kind: ParameterKind) -> bool:
    """Tell whether a kind of parameter is a translation or a rotation."""
    return kind.key in POSE_KEYS


def pose_values(owner: str, parameters: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the translation and rotation of an object or the camera, (3,) float64 each; zeros where none is given.

    Raises:
        ValueError: one of them is not 3 finite numbers.
    """
    found = []
    for name in (f"{owner}.{key}" for key in POSE_KEYS):
        value = parameters.get(name, (0.0, 0.0, 0.0))
        kind = kind_of(value)
        array = np.asarray(value if kind is None else kind.to_numpy(value), dtype=np.float64)
        if array.shape != (3,) or not np.isfinite(array).all():
            raise ValueError(f"{name}: got {shorten(value)}, expected 3 finite numbers")
        found.append(array)
    return found[0], found[1]


def posed(scene: Scene, parameters: Mapping[str, Any]) -> Scene:
    """Return a scene with poses built into its matrices and its camera: it renders as with these parameters.

    Args:
        scene: the scene.
        parameters: translations and rotations by name; anything else is passed over.

    Raises:
        ValueError: a pose is not 3 finite numbers.
    """
    known = scene.described()
    poses = {name: value for name, value in parameters.items() if name in known and is_pose(known[name].kind)}
    return scene.with_parameters(poses)


def _row(row: Any, coordinates: list[Any]) -> Any:
    return row[0] * coordinates[0] + row[1] * coordinates[1] + row[2] * coordinates[2]


def _double(array: Any) -> Any:
    kind = kind_of(array)
    assert kind is not None
    return kind.astype(array, "float64")
