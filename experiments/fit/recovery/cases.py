"""The eight scenes, each captured once: what is drawn at random is shaded and composited anew."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import warpfrag as wf
from warpfrag.fit.views import View
from warpfrag.scene.light import lambert
from warpfrag.shapes.mesh import Mesh, smooth_normals
from warpfrag.shapes.primitives import sphere
from warpfrag.shapes.surfels import PointSet, surfels

SCENES = Path("scenes")
WHITE = (1.0, 1.0, 1.0, 1.0)
LIGHT, AMBIENT = (0.4, 0.8, 1.0), 0.4


@dataclass(frozen=True)
class Case:
    """A scene whose beta and thicknesses are drawn.

    Attributes:
        name: what the tables call it.
        words: what is in it.
        build: returns the scene, of any image size.
        depth: how far the scene reaches along the view [scene units]: thicknesses are drawn as shares of it.
        eyes: further eyes, each another view towards the same target.
    """

    name: str
    words: str
    build: Callable[[], wf.Scene]
    depth: float
    eyes: tuple[tuple[float, float, float], ...] = ()

    def scene(self, size: int, merge: str) -> wf.Scene:
        """Return the scene with a square image, and room for all of its layers."""
        scene = self.build()
        return replace(scene, camera=scene.camera.resized((size, size)), merge=merge, layers=64)

    def views(self, scene: wf.Scene) -> list[View]:
        """Return the views, the scene's camera first."""
        cameras = [scene.camera, *(replace(scene.camera, eye=eye) for eye in self.eyes)]
        return [View(camera, name=f"view_{index}") for index, camera in enumerate(cameras)]


def of_file(name: str, opacity: float | None = None) -> Callable[[], wf.Scene]:
    """Return a builder of a scene file's scene, its objects all of one opacity if it is given."""

    def build() -> wf.Scene:
        scene = wf.load_scene(SCENES / f"{name}.toml")
        if opacity is not None:
            scene.objects = [replace(item, opacity=opacity) for item in scene.objects]
        return scene

    return build


def surfel_spheres() -> wf.Scene:
    """Return two spheres that intersect, as discs around points spread evenly over them."""
    camera = wf.Camera((0.0, 0.4, 4.5), (0.0, 0.0, 0.0), fov=32.0, near=0.1, far=20.0)
    objects = []
    for name, x, color in (("orange", -0.42, (0.95, 0.4, 0.05)), ("blue", 0.42, (0.06, 0.2, 0.9))):
        points = spiral(400)
        mesh = surfels(PointSet(0.75 * points + (x, 0.0, 0.1 * x), points), radius=0.9, segments=6)
        objects.append(_object(name, mesh, color, 0.5, camera))
    return wf.Scene(camera, objects, background=WHITE)


def layered_spheres() -> wf.Scene:
    """Return five spheres one behind the other, ten surfaces along the middle of the view."""
    camera = wf.Camera((0.0, 0.3, 5.0), (0.0, 0.0, 0.0), fov=26.0, near=0.1, far=20.0)
    colors = ((0.9, 0.06, 0.05), (0.9, 0.6, 0.04), (0.06, 0.65, 0.1), (0.04, 0.45, 0.8), (0.5, 0.06, 0.75))
    objects = []
    for index, color in enumerate(colors):
        mesh = sphere(0.75, 64)
        place = np.array([0.28 * np.cos(2.4 * index), 0.28 * np.sin(2.4 * index), 0.25 * (index - 2)])
        mesh = replace(mesh, vertices=mesh.vertices + place, normals=smooth_normals(mesh.vertices, mesh.faces))
        objects.append(_object(f"sphere_{index}", mesh, color, 0.3, camera))
    return wf.Scene(camera, objects, background=WHITE)


def spiral(count: int) -> np.ndarray:
    """Return points spread evenly over the unit sphere, along a spiral of golden angles, (count, 3)."""
    index = np.arange(count) + 0.5
    y, angle = 1.0 - 2.0 * index / count, np.pi * (3.0 - np.sqrt(5.0)) * index
    ring = np.sqrt(1.0 - y * y)
    return np.stack([ring * np.cos(angle), y, ring * np.sin(angle)], axis=-1)


def _object(name: str, mesh: Mesh, color: tuple, opacity: float, camera: wf.Camera) -> wf.SceneObject:
    item = wf.SceneObject(name, mesh.vertices, mesh.faces, color=color, opacity=opacity, thickness_unit="scene")
    item.shade = lambert(mesh.normals, np.array(LIGHT), AMBIENT)
    return item


CASES = (
    Case("intersecting", "three spheres side by side, A = 0.6", of_file("three_spheres"), 1.4),
    Case("nested", "three spheres in a fourth, A = 0.6", of_file("spheres_in_sphere", 0.6), 2.0),
    Case("coplanar", "two cubes that share four planes, A = 0.8", of_file("coplanar_cubes"), 1.5),
    Case("surfels", "two spheres of 400 discs each, A = 0.5", surfel_spheres, 1.5),
    Case("many layers", "five spheres in a row, A = 0.3", layered_spheres, 2.0),
    Case("bunny", "the bunny, A = 0.9, in a sphere, A = 0.5", of_file("bunny_in_sphere"), 1.9),
    Case("two views", "two crossing cylinders, A = 0.85", of_file("two_cylinders"), 0.9, ((4.2, 1.6, 2.8),)),
    Case("opaque", "three spheres in a fourth, A = 0.99", of_file("spheres_in_sphere", 0.99), 2.0),
)
