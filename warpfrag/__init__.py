"""A differentiable multi-fragment compositor on NVIDIA Warp.

A scene is captured into per-pixel fragments, fragments are resolved into a few layers, layers are composited into an
image, and every step can be differentiated, on the CPU and on CUDA from the same kernels:

    fragments = wf.capture(wf.load_scene("scene.toml"))
    layers = wf.resolve(fragments, beta=0.5, max_layers=8)
    image = wf.composite(layers)

`wf.render` does all of it, `wf.composite(fragments, ...)` the last two at once, `wf.fit` finds the parameters of a
scene from an image. Arrays may be torch tensors, Warp arrays or NumPy arrays: what goes in comes out.
"""

from warpfrag import baselines
from warpfrag.analysis.absorbance import Absorbance, absorbance
from warpfrag.capture.bounded import Culling, capture_kbuffer, count_culled
from warpfrag.capture.capture import capture
from warpfrag.composite import composite
from warpfrag.errors import SceneError
from warpfrag.files.scene_file import load_scene
from warpfrag.fit import FitError, FitParameter, FitResult, Reference, Study, StudyError, View, fit, load_study
from warpfrag.fragments import Fragments, Layers
from warpfrag.render import render
from warpfrag.resolve.resolve import resolve
from warpfrag.scene.camera import Camera
from warpfrag.scene.depth_resolution import z_resolution
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject
from warpfrag.storage.kbuffer import kbuffer

__version__ = "0.1.0"

__all__ = [
    "Absorbance",
    "Camera",
    "Culling",
    "FitError",
    "FitParameter",
    "FitResult",
    "Fragments",
    "Layers",
    "Reference",
    "Scene",
    "SceneError",
    "SceneObject",
    "Study",
    "StudyError",
    "View",
    "absorbance",
    "baselines",
    "capture",
    "capture_kbuffer",
    "composite",
    "count_culled",
    "fit",
    "kbuffer",
    "load_scene",
    "load_study",
    "render",
    "resolve",
    "z_resolution",
]
