"""Shapes: meshes, primitives and surfels, and the objects of a scene that they become.

    ball = wf.shapes.sphere(0.5).object("ball", color=(0.9, 0.2, 0.1), opacity=0.5, thickness=0.1)
    bunny = wf.shapes.load_mesh("bunny.ply").object("bunny", translate=(0.0, -0.5, 0.0))
    cloud = wf.shapes.surfels(wf.shapes.load_points("scan.xyz")).object("cloud", thickness="10P")

The room is a public name; of the readers of files, which stand on it, it knows where they are, and no more.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from warpfrag.shapes.mesh import Mesh, smooth_normals, split_faces
from warpfrag.shapes.primitives import cone, cube, cylinder, grid, plane, sphere, torus
from warpfrag.shapes.surfels import PointSet, surfels

if TYPE_CHECKING:
    from warpfrag.files.images import read_texture
    from warpfrag.files.meshes import load_mesh, load_parts
    from warpfrag.files.points import load_points

__all__ = [
    "Mesh",
    "PointSet",
    "cone",
    "cube",
    "cylinder",
    "grid",
    "load_mesh",
    "load_parts",
    "load_points",
    "plane",
    "read_texture",
    "smooth_normals",
    "sphere",
    "split_faces",
    "surfels",
    "torus",
]

_HOMES = {
    "load_mesh": "warpfrag.files.meshes",
    "load_parts": "warpfrag.files.meshes",
    "load_points": "warpfrag.files.points",
    "read_texture": "warpfrag.files.images",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'warpfrag.shapes' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
