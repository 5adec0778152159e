"""Why an image shows nothing of a scene."""

import inspect
import warnings

import numpy as np

from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene


class EmptyImageWarning(UserWarning):
    """An image has no fragment of its scene."""


def why_empty(scene: Scene, camera: Camera | None = None) -> str:
    """Word in one line why nothing of a scene is seen, given that nothing is.

    Args:
        scene: the scene.
        camera: where from; default the scene's.

    Example:
        >>> why_empty(scene_of_a_ball_behind_the_eye)
        'no object of the scene lies between near and far: depths from -4 to -2, expected from 0.01 to 100'
    """
    camera = camera or scene.camera
    seen = [item.world_vertices()[np.unique(item.faces)] for item in scene.objects if len(item.faces)]
    if not seen:
        return "the scene has no triangles"
    view = camera.view_matrix()
    depths = np.concatenate(seen) @ view[2, :3] + view[2, 3]
    low, high = float(depths.min()), float(depths.max())
    if high < camera.near or low > camera.far:
        return (
            f"no object of the scene lies between near and far: depths from {low:.4g} to {high:.4g}, expected from "
            f"{camera.near:g} to {camera.far:g}"
        )
    return "no object of the scene covers the centre of a pixel: out of the image, edge-on, or smaller than a pixel"


def warn_if_empty(fragment_count: int, scene: Scene, camera: Camera | None = None) -> None:
    """Warn that an image shows nothing, unless there are fragments, or no triangles to see."""
    if fragment_count == 0 and any(len(item.faces) for item in scene.objects):
        warnings.warn(why_empty(scene, camera), EmptyImageWarning, stacklevel=_level_of_caller())


def _level_of_caller() -> int:
    """Return how many frames above the one that asks the first is that is not of this package."""
    package, level, frame = __name__.partition(".")[0], 0, inspect.currentframe()
    while frame is not None and frame.f_globals["__name__"].partition(".")[0] == package:
        level, frame = level + 1, frame.f_back
    return level
