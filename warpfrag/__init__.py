"""A differentiable multi-fragment compositor on NVIDIA Warp.

A scene is captured into per-pixel fragments, fragments are resolved into a few layers, layers are composited into an
image, and every step can be differentiated, on the CPU and on CUDA from the same kernels:

    fragments = wf.capture(wf.load_scene("scene.toml"))
    layers = wf.resolve(fragments, beta=0.5, max_layers=8)
    image = wf.composite(layers)

`wf.render` does all of it, `wf.composite(fragments, ...)` the last two at once, `wf.fit` finds the parameters of a
scene from an image. Arrays may be torch tensors, Warp arrays or NumPy arrays: what goes in comes out.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpfrag import baselines, shapes, storage
    from warpfrag.analysis.absorbance import Absorbance, absorbance
    from warpfrag.analysis.coplanarity import coplanarity
    from warpfrag.analysis.csg import csg
    from warpfrag.capture.coverage import capture
    from warpfrag.composite import composite
    from warpfrag.deep import concat, holdout
    from warpfrag.errors import SceneError
    from warpfrag.files.deep_exr import read_deep, write_deep
    from warpfrag.files.images import ImageError, read_image, write_image
    from warpfrag.files.scene_file import load_scene
    from warpfrag.fit import FitError, FitParameter, FitResult, Reference, Study, StudyError, View, fit, load_study
    from warpfrag.fit.session import Progress
    from warpfrag.fragments import Fragments, Layers
    from warpfrag.render import render
    from warpfrag.renderer import Renderer
    from warpfrag.resolve.resolve import resolve
    from warpfrag.scene.camera import Camera
    from warpfrag.scene.depth_resolution import z_resolution
    from warpfrag.scene.light import Light
    from warpfrag.scene.scene import Scene
    from warpfrag.scene.surface import SceneObject
    from warpfrag.storage.kbuffer import kbuffer

__version__ = "0.1.0"

# Where each name comes from. A module is imported when one of its names is asked for: kernels take time to read.
_HOMES = {
    "Absorbance": "analysis.absorbance",
    "Camera": "scene.camera",
    "FitError": "fit",
    "FitParameter": "fit",
    "FitResult": "fit",
    "Fragments": "fragments",
    "ImageError": "files.images",
    "Layers": "fragments",
    "Light": "scene.light",
    "Progress": "fit.session",
    "Reference": "fit",
    "Renderer": "renderer",
    "Scene": "scene.scene",
    "SceneError": "errors",
    "SceneObject": "scene.surface",
    "Study": "fit",
    "StudyError": "fit",
    "View": "fit",
    "absorbance": "analysis.absorbance",
    "baselines": "",
    "capture": "capture.coverage",
    "composite": "composite",
    "concat": "deep",
    "coplanarity": "analysis.coplanarity",
    "csg": "analysis.csg",
    "fit": "fit",
    "holdout": "deep",
    "kbuffer": "storage.kbuffer",
    "load_scene": "files.scene_file",
    "load_study": "fit",
    "read_deep": "files.deep_exr",
    "read_image": "files.images",
    "render": "render",
    "resolve": "resolve.resolve",
    "shapes": "",
    "storage": "",
    "write_deep": "files.deep_exr",
    "write_image": "files.images",
    "z_resolution": "scene.depth_resolution",
}

__all__ = [
    "Absorbance",
    "Camera",
    "FitError",
    "FitParameter",
    "FitResult",
    "Fragments",
    "ImageError",
    "Layers",
    "Light",
    "Progress",
    "Reference",
    "Renderer",
    "Scene",
    "SceneError",
    "SceneObject",
    "Study",
    "StudyError",
    "View",
    "absorbance",
    "baselines",
    "capture",
    "composite",
    "concat",
    "coplanarity",
    "csg",
    "fit",
    "holdout",
    "kbuffer",
    "load_scene",
    "load_study",
    "read_deep",
    "read_image",
    "render",
    "resolve",
    "shapes",
    "storage",
    "write_deep",
    "write_image",
    "z_resolution",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'warpfrag' has no attribute {name!r}")
    home = _HOMES[name]
    value = getattr(import_module(f"warpfrag.{home}"), name) if home else import_module(f"warpfrag.{name}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]


class _Package(ModuleType):
    """The package, in which a function keeps its name although the module that it is in has the same."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Python puts every module that is imported into its package, under its name.
        if isinstance(value, ModuleType) and _HOMES.get(name):
            return
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
