"""A scene small enough to be fitted in a second: two or three unlit spheres that intersect, or stand apart."""

import numpy as np

from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes.primitives import sphere

COLORS = ((0.9, 0.1, 0.1), (0.1, 0.8, 0.2), (0.1, 0.2, 0.9))
THICKNESSES = (0.3, 0.4, 0.25)
NAMES = ("red", "green", "blue")
# A scene file of a ball and a disc, of which studies and commands are tried.
SCENE = """
beta = 0.5
background = [1, 1, 1]
[camera]
eye = [0, 0, 3]
target = [0, 0, 0]
fov = 40
size = [24, 16]
[[object]]
name = "ball"
primitive = "sphere"
segments = 12
thickness = 0.2
[[object]]
name = "disc"
primitive = "plane"
thickness = "2P"
"""


def spheres(count: int = 3, *, size: tuple[int, int] = (40, 36), apart: float = 0.4, beta: float = 0.5) -> Scene:
    """Build spheres of radius 0.6 whose middles lie `apart` from one another, over a light background."""
    mesh = sphere(0.6, 24)
    middles = apart * np.array([[-1.0, -0.4, 0.0], [1.0, -0.4, 0.15], [0.0, 0.7, -0.15]])
    objects = []
    for name, color, thickness, middle in zip(NAMES, COLORS, THICKNESSES, middles[:count], strict=False):
        matrix = np.eye(4)
        matrix[:3, 3] = middle
        objects.append(SceneObject(name, mesh.vertices, mesh.faces, matrix, color, 0.6, thickness, "scene"))
    camera = Camera((0.1, 0.3, 3.6), (0.0, 0.0, 0.0), fov=40.0, near=0.1, far=10.0, size=size)
    return Scene(camera, objects, background=(0.9, 0.9, 0.9, 1.0), beta=beta)
