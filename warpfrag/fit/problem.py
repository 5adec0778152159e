"""The images as functions of the fitted parameters, and the references they are compared with.

While nothing moves, what each pixel sees stays: a view is captured once, and only shaded and composited in each step.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from warpfrag.arrays.legacy import kind_of
from warpfrag.capture.bounded import capture_kbuffer
from warpfrag.capture.coverage import Coverage
from warpfrag.composite import composite
from warpfrag.fit.parameters import in_multiples_of_p, placed
from warpfrag.fit.processes import Processes
from warpfrag.fit.scaled_fragments import UnitFragments
from warpfrag.fit.study import RENDER_OPTIONS, Study, View, true_of_view
from warpfrag.fragments import Fragments
from warpfrag.render import over_background, render
from warpfrag.scene.scene import Scene
from warpfrag.storage.kbuffer import kbuffer

# Random starts keep this share of the range away from the bounds.
_MARGIN = 0.1


class ViewProblem:
    """One view of a study: its image for parameter values, and the reference.

    Args:
        study: the study.
        view: the view.
        index: its place among the fitted views; 0 for one that is held out, for which no value is stacked.
        device: where to compute.
    """

    def __init__(self, study: Study, view: View, index: int, device: str) -> None:
        self.study, self.view, self.index, self.device = study, view, index, device
        self.scene = replace(study.fitted_scene, camera=view.camera)
        self.moves = any(variable.moves for variable in study.variables)
        self.reference = reference_image(study, view, index)
        self.channels = self.reference.shape[2]

    @cached_property
    def coverage(self) -> Coverage:
        """What each pixel sees, where nothing moves."""
        return Coverage.of(self.scene, sort=self.study.resolve == "sorted")

    @cached_property
    def unit(self) -> UnitFragments:
        """The fragments as functions of few values per object, where nothing moves."""
        return UnitFragments(self.scene, self.coverage, self.study.variables)

    @cached_property
    def fragments(self) -> Fragments:
        """The fragments of the scene as it is, where only beta is fitted."""
        return self.coverage.shade()

    def parameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return this view's part of parameter values, in single precision."""
        return {v.name: _single(v.in_view(values[v.name], self.index)) for v in self.study.variables}

    def image(self, values: Mapping[str, Any]) -> Any:
        """Return the image for parameter values, (H, W, 4) float32; torch tensors get their gradient."""
        parameters = self.parameters(values)
        if self.moves:
            return render_scene(self.scene, self.study.resolve, parameters)
        beta = parameters.pop("beta", float(self.scene.beta))
        fragments = self.coverage.shade(parameters) if parameters else self.fragments
        if kind_of(beta) == "torch" and kind_of(fragments.rgba) == "numpy":
            fragments = fragments.torch(beta.device)
        return self.over_background(self.composite(fragments, beta))

    def composite(self, fragments: Fragments, beta: Any) -> Any:
        """Composite fragments as the scene says, without its background."""
        scene = self.scene
        if self.study.resolve == "kbuffer":
            return composite(kbuffer(fragments, scene.layers, merge=scene.merge))  # type: ignore[arg-type]
        return composite(fragments, beta, max_layers=scene.layers, merge=scene.merge, mix=scene.mix)

    def over_background(self, image: Any) -> Any:
        """Return a premultiplied image, an array or a tensor, over the scene's background."""
        return over_background(image, self.scene.background)

    def residual(self, image: Any) -> Any:
        """Return image minus reference, (H, W, C), an array or a tensor."""
        return image[..., : self.channels] - _like(self.reference, image)

    def loss(self, image: Any) -> Any:
        """Return the study's loss of a torch image, a 0-d float64 tensor."""
        return self.study.image_loss(image[..., : self.channels], _like(self.reference, image))


class Problem:
    """What a study compares: its views, and the vector of coordinates that a method moves.

    Args:
        study: the study.
        processes: those that share the work; None for those of this program.
    """

    def __init__(self, study: Study, processes: Processes | None = None) -> None:
        self.study, self.processes = study, processes or Processes(study.device)
        fitted = study.fitted_views
        device = self.processes.device
        self.views = [ViewProblem(study, view, index, device) for index, view in enumerate(fitted)]
        self.held_out = [ViewProblem(study, view, 0, device) for view in study.all_views if view.held_out]

    def values(self, coordinates: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parameters for a vector of a method's coordinates."""
        return {
            variable.name: np.asarray(variable.outward(coordinates[place].reshape(variable.start.shape)))
            for variable, place in placed(self.study.variables)
        }

    def start(self) -> np.ndarray:
        """Return the start as a vector of a method's coordinates, float64."""
        return np.concatenate([variable.inward(variable.start).reshape(-1) for variable in self.study.variables])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the vector."""
        spans = [np.tile(variable.span, (variable.start.size, 1)) for variable in self.study.variables]
        lower, upper = np.concatenate(spans).T
        return lower, upper

    def starts(self) -> list[np.ndarray]:
        """Return the study's start and the random ones.

        What is fitted per vertex, pixel or view starts from one value everywhere; what has no bounds from the study's.
        """
        generator = np.random.default_rng(self.study.seed)
        lower, upper = self.bounds()
        starts = [np.clip(self.start(), lower, upper)]
        for _ in range(self.study.restarts):
            parts = []
            for variable in self.study.variables:
                low, high = variable.span
                one = (3,) if variable.key == "color" or variable.moves else ()
                share = generator.uniform(_MARGIN, 1.0 - _MARGIN, one)
                start = variable.inward(variable.start) if np.isinf(low) else low + share * (high - low)
                parts.append(np.broadcast_to(start, variable.start.shape).reshape(-1))
            starts.append(np.concatenate(parts))
        return starts


def _like(array: np.ndarray, image: Any) -> Any:
    if kind_of(image) != "torch":
        return array
    import torch

    return torch.as_tensor(array, device=image.device)


def _single(value: Any) -> Any:
    return value.float() if kind_of(value) == "torch" else np.asarray(value, np.float32)


def render_scene(scene: Scene, resolve: str, parameters: Mapping[str, Any]) -> Any:
    """Render a scene as `Study.resolve` says."""
    if resolve == "sorted":
        return render(scene, parameters=parameters)
    layers = capture_kbuffer(scene, slots=scene.layers, merge=scene.merge, parameters=parameters)  # type: ignore[arg-type]
    return over_background(composite(layers), scene.background)


def reference_image(study: Study, view: View, index: int = 0) -> np.ndarray:
    """Return the image that a view approaches, (H, W, 3 or 4) float32.

    Args:
        study: the study.
        view: the view.
        index: its place among the fitted views.
    """
    reference, scene = view.reference, replace(study.scene, camera=view.camera)
    assert reference is not None
    height, width = view.camera.shape
    if reference.image is not None:
        image = np.asarray(reference.image, np.float32)
        return over_background(image, scene.background) if image.shape[2] == 4 else image
    samples = reference.supersampling
    own = {key: getattr(reference, key) for key in RENDER_OPTIONS}
    options = {key: value for key, value in own.items() if value is not None}
    fine = replace(scene, camera=view.camera.resized((width * samples, height * samples)), **options)
    fine, true = in_multiples_of_p(fine, true_of_view(reference, index, len(study.fitted_views)), "reference.true")
    image = np.asarray(render_scene(fine, study.resolve, true))
    if samples > 1:
        image = image.reshape(height, samples, width, samples, 4).mean(axis=(1, 3), dtype=np.float64)
    return np.ascontiguousarray(image, np.float32)
