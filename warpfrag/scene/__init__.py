"""What there is to see: camera, objects, scene files, and all of it as flat arrays."""

from warpfrag.scene.camera import Camera
from warpfrag.scene.errors import SceneError
from warpfrag.scene.files import load_scene
from warpfrag.scene.geometry import Geometry, assemble
from warpfrag.scene.objects import Scene, SceneObject

__all__ = ["Camera", "Geometry", "Scene", "SceneError", "SceneObject", "assemble", "load_scene"]
