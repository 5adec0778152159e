"""Studies small enough to be fitted in a second: of the small scene, from one view or several."""

from typing import Any

import numpy as np
from small_scene import spheres

from warpfrag.fit import Reference, Study, View
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene

STARTS = {"beta": 0.9, "red.thickness": 0.8, "green.thickness": 0.12, "blue.thickness": 0.6}
FEWER_STARTS = {"beta": 0.9, "red.thickness": 0.8, "green.thickness": 0.12}
EVERYTHING = {
    **{"beta": 0.4, "red.thickness": 0.5, "green.opacity": 0.7, "blue.color": [0.3, 0.4, 0.5]},
    "blue.opacity": 0.5,
}

# A study file of three views, its batch to be filled in, and the scene file that it names.
VIEWS_STUDY = """
scene = "scene.toml"
method = "adam"
steps = 12
batch = {batch}
[reference]
true = {{a.opacity = 0.4}}
[parameters]
a.opacity = 0.8
b.thickness = {{start = 0.3, lower = 0.05, upper = 1.0}}
beta = 0.9
[[view]]
name = "front"
[[view]]
name = "left"
eye = [-2.0, 0.3, 1.5]
[[view]]
name = "right"
eye = [2.0, 0.3, 1.5]
"""
VIEWS_SCENE = """
beta = 0.5
[camera]
eye = [0.0, 0.0, 3.0]
target = [0.0, 0.0, 0.0]
fov = 40.0
near = 0.1
far = 10.0
size = [32, 24]
[[object]]
name = "a"
primitive = "sphere"
radius = 0.5
opacity = 0.6
thickness = 0.2
[[object]]
name = "b"
primitive = "cube"
scale = [0.8, 0.3, 0.7]
opacity = 0.5
thickness = 0.2
"""


def make_study(parameters: Any = None, *, true: Any = None, scene: Scene | None = None, **options: Any) -> Study:
    """Return a study of the small scene against its own render."""
    return Study(scene or spheres(), Reference(true=true or {}), parameters or STARTS, **options)


def around(count: int, scene: Scene, held_out: int = 0) -> tuple[View, ...]:
    """Return views from places around a scene, the last few held out."""
    views = []
    for index in range(count):
        angle = 2.0 * np.pi * index / count
        eye = (3.0 * np.sin(angle), 0.4, 3.0 * np.cos(angle))
        camera = Camera(eye, (0.0, 0.0, 0.0), fov=40.0, size=scene.camera.size)
        views.append(View(camera, name=f"view{index}", held_out=index >= count - held_out))
    return tuple(views)


def study_of_views(
    parameters: Any = None,
    *,
    true: Any = None,
    scene: Scene | None = None,
    count: int = 3,
    held_out: int = 0,
    **options: Any,
) -> Study:
    """Return a study of the small scene from several views, against its own renders."""
    scene = scene or spheres()
    views = around(count, scene, held_out)
    return Study(scene, Reference(true=true or {}), parameters or FEWER_STARTS, views=views, **options)


def textured(size: tuple[int, int] = (64, 56)) -> Scene:
    """Return the small scene with smooth colours by vertex: what moves is seen inside of outlines."""
    scene = spheres(size=size)
    for item in scene.objects:
        item.color = (0.5 + 0.45 * np.sin(9.0 * item.vertices + np.arange(3.0))).astype(np.float32)
    return scene


class Killed(BaseException):
    """What ends a fit in tests as suddenly as a signal: nothing is caught or cleaned up."""


def kill_at(step: int) -> Any:
    """Return a progress function that ends the fit after so many steps."""

    def progress(report: Any) -> None:
        if report.step >= step:
            raise Killed

    return progress
