"""A scene of two objects, one of them with everything that an object may have."""

import numpy as np

from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject

CAMERA = Camera(eye=(0, 0, 3), target=(0, 0, 0), fov=45, size=(4, 3))


TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)


def two_objects(**second):
    """Return a scene of one triangle, and of a textured square that is scaled by 2 and moved along z."""
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    matrix[2, 3] = 5.0
    tri = SceneObject("tri", TRIANGLE, [[0, 1, 2]], color=(0.1, 0.2, 0.3), opacity=0.5, thickness=0.25)
    tri.thickness_unit = "scene"
    given = {
        "matrix": matrix,
        "color": np.eye(4, 3),
        "opacity": [0.0, 0.25, 0.5, 1.0],
        "shade": np.array([1.0, 0.5, 0.25, 1.0]),
        "uv": SQUARE[:, :2],
        "texture": np.ones((2, 2, 4)),
    }
    return Scene(CAMERA, [tri, SceneObject("square", SQUARE, [[0, 1, 2], [0, 2, 3]], **{**given, **second})])
