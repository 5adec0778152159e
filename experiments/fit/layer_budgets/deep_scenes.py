"""The deep scenes: a machine of many parts, a ball of hair, and a floor of surfels."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import warpfrag as wf
from warpfrag.scene.light import lambert
from warpfrag.shapes.mesh import Mesh
from warpfrag.shapes.surfels import surfels

HERE = Path(__file__).parent
# The shapes are those of the study of order-independent transparency.
sys.path.append(str(HERE.parents[1] / "oit"))

import shapes  # noqa: E402

WHITE = (1.0, 1.0, 1.0, 1.0)
LIGHT, AMBIENT = np.array([0.4, 0.8, 0.6]), 0.35


def assembly(size: int) -> wf.Scene:
    """Return the machine, that of study.toml."""
    scene = wf.load_scene(HERE / "assembly.toml")
    return replace(scene, camera=scene.camera.resized((size, size)))


def hair_ball(size: int) -> wf.Scene:
    """Return a ball of curly hair."""
    camera = wf.Camera((0.0, 0.0, 3.6), (0.0, 0.0, 0.0), fov=33.0, size=(size, size))
    return _scene(camera, shapes.hair_ball(strands=4000, segments=12, width=0.05), 0.2)


def floor(size: int) -> wf.Scene:
    """Return a floor with boxes and balls on it, of points drawn as large surfels."""
    camera = wf.Camera((-3.7, 1.35, 1.5), (-0.05, 0.05, 0.05), fov=36.0, size=(size, size))
    return _scene(camera, surfels(shapes.floor_points(6000), radius=3.2), 0.2)


def _scene(camera: wf.Camera, mesh: Mesh, opacity: float) -> wf.Scene:
    assert mesh.normals is not None
    color: Any = mesh.color
    shade = lambert(mesh.normals, LIGHT, AMBIENT)
    return wf.Scene(
        camera,
        [wf.SceneObject("all", mesh.vertices, mesh.faces, color=color, opacity=opacity, shade=shade)],
        background=WHITE,
    )
