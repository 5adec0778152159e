"""Poses: rigid motions of objects and of the camera, as parameters.

A rotation vector v [degrees] points along the axis, its length is the angle θ. With [v]× the matrix of v × ·, and in
radians:

    R(v) = I + sin θ/θ [v]× + (1 − cos θ)/θ² [v]×²                   (Rodrigues)
    J(v) = I + (1 − cos θ)/θ² [v]× + (θ − sin θ)/θ³ [v]×²            R(v + dv) = R(J dv) R(v), to first order in dv

An object's world vertices x become x + (R − I)(x − m) + d, with m the middle of its bounding box as the scene stands. A
point p in camera space becomes Rᵀ(p − d): the camera moves by d along its own axes and turns about its eye. R − I is
what is computed, so that a pose of zeros changes no bit.
"""

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warpfrag.errors import shorten
from warpfrag.scene.camera import Camera

if TYPE_CHECKING:
    from warpfrag.scene.scene import Scene

POSE_KEYS = ("translation", "rotation")
# Whose parameters are the camera's; no object may be named so.
CAMERA = "camera"

RADIANS = math.pi / 180.0
# Below an angle of 1 the ratios are power series, of as many terms as float64 can tell.
_SERIES_TERMS = 10


def rotation_matrix(vector: Any) -> Any:
    """Return the rotation R of a rotation vector.

    Differentiable in torch, at zero too.

    Args:
        vector: along the axis, as long as the angle [degrees], (3,): NumPy array or torch tensor.

    Returns:
        (3, 3) float64, of the kind of the vector.

    Example:
        >>> rotation_matrix(np.array([0.0, 0.0, 90.0])).round(6) @ [1, 0, 0]
        array([0., 1., 0.])
    """
    change = _rotation_change(vector)
    if isinstance(change, np.ndarray):
        return np.eye(3) + change
    torch = sys.modules["torch"]
    return torch.eye(3, dtype=change.dtype, device=change.device) + change


def left_jacobian(vector: np.ndarray) -> np.ndarray:
    """Return J with R(v + dv) = R(J dv) R(v) to first order in dv, both rotation vectors in degrees.

    Args:
        vector: the rotation vector v [degrees], (3,).

    Returns:
        (3, 3) float64; the identity at zero.
    """
    turn = np.asarray(vector, dtype=np.float64) * RADIANS
    square = turn @ turn
    _, second, third = _ratios(square)
    return np.eye(3) + second * cross_matrix(turn) + third * (np.outer(turn, turn) - square * np.eye(3))


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the matrix [v]× with [v]× w = v × w, (3, 3)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def move_object(vertices: Any, middle: np.ndarray, translation: Any, rotation: Any) -> Any:
    """Return x + (R − I)(x − m) + d for world vertices x, computed in float64, in their own precision.

    Args:
        vertices: world space [scene units], (V, 3), NumPy or torch.
        middle: the point m about which to turn [scene units], (3,).
        translation: d [scene units], (3,), of the same kind.
        rotation: rotation vector [degrees], (3,), of the same kind.
    """
    points, shift = _double(vertices), _double(translation)
    about = [points[:, axis] - float(middle[axis]) for axis in range(3)]
    change = _rotation_change(rotation)
    columns = [points[:, i] + _row(change[i], about) + shift[i] for i in range(3)]
    return _stacked(columns, vertices)


def move_camera(points: list[Any], translation: Any, rotation: Any) -> list[Any]:
    """Return Rᵀ(p − d) for the coordinates [x, y, z] of points p in camera space, float64 arrays (V,)."""
    shift, change = _double(translation), _rotation_change(rotation)
    seen = [points[axis] - shift[axis] for axis in range(3)]
    return [seen[i] + _row(change[:, i], seen) for i in range(3)]


def pose_matrix(
    name: str, scene: "Scene", camera: Camera | None = None, parameters: Mapping[str, Any] | None = None
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
    owner, _, key = name.rpartition(".")
    owned = [item for item in scene.objects if item.name == owner]
    if key not in POSE_KEYS or not (owned or owner == CAMERA):
        raise ValueError(
            f"name: found {shorten(name)}, expected the translation or rotation of an object or the camera"
        )
    translation, rotation = pose_values(owner, parameters or {})
    camera_translation, camera_rotation = pose_values(CAMERA, parameters or {})
    view = (camera or scene.camera).view_matrix()
    turned = rotation_matrix(camera_rotation).T
    by_force, by_torque = np.zeros((3, 3)), np.zeros((3, 3))
    if name == "camera.translation":
        by_force = -turned
    elif name == "camera.rotation":
        by_torque = -turned @ left_jacobian(rotation) * RADIANS
    else:
        axes = turned @ view[:3, :3]
        if key == "translation":
            by_force = axes
        else:
            pivot = owned[0].middle() + translation
            seen = turned @ (view[:3, :3] @ pivot + view[:3, 3] - camera_translation)
            # About the pivot c the torque is Σ (p − c) × g.
            by_torque = axes @ left_jacobian(rotation) * RADIANS
            by_force = -cross_matrix(seen).T @ by_torque
    return np.concatenate([by_force, by_torque])


def pose_values(owner: str, parameters: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the translation and rotation of an object or the camera, (3,) float64 each; zeros where none is given.

    Raises:
        ValueError: one of them is not 3 finite numbers.
    """
    found = []
    for name in (f"{owner}.{key}" for key in POSE_KEYS):
        value = parameters.get(name, (0.0, 0.0, 0.0))
        value = value.detach().cpu().numpy() if hasattr(value, "detach") else value
        array = np.asarray(value, dtype=np.float64)
        if array.shape != (3,) or not np.isfinite(array).all():
            raise ValueError(f"{name}: found {shorten(value)}, expected 3 finite numbers")
        found.append(array)
    return found[0], found[1]


def posed(scene: "Scene", parameters: Mapping[str, Any]) -> "Scene":
    """Return a scene with poses built into its matrices and its camera: it renders as with these parameters.

    Args:
        scene: the scene.
        parameters: translations and rotations by name; anything else is passed over.

    Raises:
        ValueError: a pose is not 3 finite numbers.
    """
    owners = {name.rpartition(".")[0] for name in parameters if name.rpartition(".")[2] in POSE_KEYS}
    objects = list(scene.objects)
    for index, item in enumerate(objects):
        if item.name in owners:
            translation, vector = pose_values(item.name, parameters)
            motion = np.eye(4)
            motion[:3, :3] = rotation = rotation_matrix(vector)
            motion[:3, 3] = item.middle() - rotation @ item.middle() + translation
            objects[index] = replace(item, matrix=motion @ item.matrix)
    camera = scene.camera
    if CAMERA in owners:
        translation, vector = pose_values(CAMERA, parameters)
        axes = camera.view_matrix()[:3, :3].T
        _, down, forward = (axes @ rotation_matrix(vector)).T
        eye = camera.eye + axes @ translation
        target = eye + np.linalg.norm(np.subtract(camera.target, camera.eye)) * forward
        camera = replace(camera, eye=tuple(eye), target=tuple(target), up=tuple(-down))
    return replace(scene, objects=objects, camera=camera)


def _rotation_change(vector: Any) -> Any:
    """Return R − I, exactly zero at zero."""
    turn = _double(vector) * RADIANS
    x, y, z = turn[0], turn[1], turn[2]
    square = x * x + y * y + z * z
    first, second, _ = _ratios(square)
    entries = [
        *(-second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y),
        *(second * x * y + first * z, -second * (x * x + z * z), second * y * z - first * x),
        *(second * x * z - first * y, second * y * z + first * x, -second * (x * x + y * y)),
    ]
    return _namespace(turn).stack(entries).reshape(3, 3)


def _ratios(square: Any) -> list[Any]:
    """Return sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³ of θ², smooth at 0."""
    xp = _namespace(square)
    small = square < 1.0
    one = xp.ones_like(square)
    # Each branch gets what it can take: a gradient flows through both, and through none may it be infinite.
    near, far = xp.where(small, square, 0.0 * one), xp.where(small, one, square)
    angle = xp.sqrt(far)
    half = xp.sin(0.5 * angle)
    closed = [xp.sin(angle) / angle, 2.0 * half * half / far, (angle - xp.sin(angle)) / (angle * far)]
    ratios = []
    for order, value in enumerate(closed, start=1):
        # Σ (−θ²)^k order!/(2k + order)!, nested, over order!.
        series = one
        for k in range(_SERIES_TERMS, 0, -1):
            series = one - near / ((2 * k + order - 1) * (2 * k + order)) * series
        ratios.append(xp.where(small, series / math.factorial(order), value))
    return ratios


def _row(row: Any, coordinates: list[Any]) -> Any:
    return row[0] * coordinates[0] + row[1] * coordinates[1] + row[2] * coordinates[2]


def _namespace(array: Any) -> Any:
    return np if isinstance(array, (np.ndarray, np.floating)) else sys.modules["torch"]


def _double(array: Any) -> Any:
    return array.astype(np.float64) if _namespace(array) is np else array.double()


def _stacked(columns: list[Any], like: Any) -> Any:
    if _namespace(like) is np:
        return np.stack(columns, 1).astype(like.dtype)
    return sys.modules["torch"].stack(columns, 1).to(like.dtype)
