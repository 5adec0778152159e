"""The scenes of the study: those of high depth complexity, the one with text, and those that come as files."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapes

import warpfrag as wf
from warpfrag.files.meshes import load_mesh, warp_asset
from warpfrag.files.points import POINT_SUFFIXES, load_points
from warpfrag.scene.light import lambert
from warpfrag.shapes.mesh import Mesh, smooth_normals
from warpfrag.shapes.surfels import PointSet, surfels

SCENES = Path(__file__).parents[2] / "scenes"
WHITE = (1.0, 1.0, 1.0, 1.0)
# The paper's z-thickness in the comparisons, in multiples of P(z).
THICKNESS = 100.0
VIEW = (1.9, 1.5, 2.6)
AMBIENT = 0.35
LIGHT = (0.4, 0.8, 0.6)


def engine(size: int, detail: float = 1.0) -> wf.Scene:
    """Return the many-part model, several hundred objects, or a share of them."""
    camera = _camera((5.6, 1.9, 3.0), (-0.15, 0.08, 0.0), 30.0, size)
    parts = list(shapes.machine())[:: max(round(1.0 / detail), 1)]
    parts = [_item(name, mesh, color, 0.2, camera) for name, mesh, color in parts]
    return wf.Scene(camera, parts, background=WHITE)


def hair_ball(size: int, strands: int = 100_000, segments: int = 14) -> wf.Scene:
    """Return the hair ball: one object of 2.8 million triangles."""
    camera = _camera((0.0, 0.0, 3.6), (0.0, 0.0, 0.0), 33.0, size)
    # Fewer strands are wider, so that as many layers are left.
    mesh = shapes.hair_ball(strands, segments, width=0.0042 * 100_000 / strands)
    return wf.Scene(camera, [_item("hair", mesh, None, 0.1, camera)], background=WHITE)


def floor(size: int, count: int = 60_000, radius: float = 3.2) -> wf.Scene:
    """Return the floor: a dense point set as surfels that are large against its spacing."""
    camera = _camera((-3.7, 1.35, 1.5), (-0.05, 0.05, 0.05), 36.0, size)
    mesh = surfels(shapes.floor_points(count), radius=radius)
    return wf.Scene(camera, [_item("floor", mesh, None, 0.12, camera)], background=WHITE)


def occlusion(size: int, count: int = 30_000, points: Path | None = None) -> wf.Scene:
    """Return the bunny as large surfels, two planes that cross in it, and text on the planes."""
    camera = _camera((0.9, 0.75, 3.4), (0.0, 0.0, 0.0), 33.0, size)
    if points is None:
        bunny = load_mesh(warp_asset("warp:bunny.usd"))
        cloud = shapes.sample_points(bunny, count)
    else:
        cloud = load_points(points)
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    scale = 1.7 / (high - low).max()
    cloud = PointSet((cloud.points - (low + high) / 2.0) * scale, cloud.normals)
    objects = [_item("bunny", surfels(cloud, radius=4.0), (0.62, 0.53, 0.42), 0.07, camera)]
    plane = Mesh(
        np.array([[-1.0, -0.85, 0.0], [1.0, -0.85, 0.0], [1.0, 0.85, 0.0], [-1.0, 0.85, 0.0]]),
        np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        np.tile([0.0, 0.0, 1.0], (4, 1)),
    )
    for name, color, ink, degrees, words in (
        ("blue", (0.1, 0.3, 0.85), (1.0, 0.75, 0.02), 38.0, ("SLAB", "DEPTH")),
        ("red", (0.85, 0.12, 0.08), (0.02, 0.55, 0.3), -42.0, ("OVER", "MERGE")),
    ):
        turn = shapes.turned([0, 1, 0], degrees)
        objects.append(_item(f"{name} plane", shapes.placed(plane, turn), color, 0.35, camera))
        for number, (word, side) in enumerate(zip(words * 2, (-1, 1, 1, -1), strict=True)):
            # Twice each: above, and in the middle of the bunny.
            letters = shapes.moved(shapes.text(word, 0.18), [0.52 * side, 0.64 - 0.8 * (number // 2), 0.0])
            objects.append(_item(f"{name} text {number}", shapes.placed(letters, turn), ink, 0.9, camera))
    return wf.Scene(camera, objects, background=WHITE)


def of_model(path: Path, size: int, view: Sequence[float] = VIEW, opacity: float = 0.2) -> wf.Scene:
    """Return a scene of a mesh or point file that fills the image, seen from a direction, with its own colours."""
    mesh = None
    if path.suffix.lower() in POINT_SUFFIXES:
        try:
            mesh = load_mesh(path) if path.suffix.lower() == ".ply" else None
        except ValueError:
            mesh = None
        if mesh is None:
            mesh, opacity = surfels(load_points(path), radius=4.0), 0.6 * opacity
    else:
        mesh = load_mesh(path)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    scale = 2.0 / np.linalg.norm(high - low)
    normals = smooth_normals(mesh.vertices, mesh.faces) if mesh.normals is None else mesh.normals
    mesh = replace(mesh, vertices=(mesh.vertices - (low + high) / 2.0) * scale, normals=normals)
    eye = 3.5 * np.asarray(view) / np.linalg.norm(view)
    camera = _camera(eye, (0.0, 0.0, 0.0), 35.0, size)
    view_matrix = camera.view_matrix()
    x, y, z = view_matrix[:3, :3] @ mesh.vertices.T + view_matrix[:3, 3:]
    tangent = 1.05 * max(np.abs(x / z).max(), np.abs(y / z).max())
    camera = replace(camera, fov=float(np.degrees(2.0 * np.arctan(tangent))))
    color: Any = (0.8, 0.8, 0.8) if mesh.color is None else None
    return wf.Scene(camera, [_item(path.stem, mesh, color, opacity, camera)], background=WHITE)


def from_file(name: str, size: int) -> wf.Scene:
    """Return one of the repository's scene files, at a size."""
    scene = wf.load_scene(SCENES / f"{name}.toml")
    return replace(scene, camera=scene.camera.resized((size, size)))


def with_thickness(scene: wf.Scene, multiple: float) -> wf.Scene:
    """Return a scene with all its thicknesses a multiple of P(z)."""
    objects = [replace(item, thickness=multiple, thickness_unit="P") for item in scene.objects]
    return replace(scene, objects=objects)


def triangle_count(scene: wf.Scene) -> int:
    """Return the number of triangles of a scene."""
    return sum(len(item.faces) for item in scene.objects)


def _camera(eye: Sequence[float], target: Sequence[float], fov: float, size: int) -> wf.Camera:
    # The package's own planes, 0.01 and 100: P(z) follows from them.
    return wf.Camera(tuple(eye), tuple(target), fov=fov, size=(size, size))


def _item(name: str, mesh: Mesh, color: Any, opacity: float, camera: wf.Camera) -> wf.SceneObject:
    assert mesh.normals is not None
    return wf.SceneObject(
        name,
        mesh.vertices,
        mesh.faces,
        color=mesh.color if color is None else color,
        opacity=opacity,
        thickness=THICKNESS,
        thickness_unit="P",
        shade=lambert(mesh.normals, np.asarray(LIGHT), AMBIENT),
    )
