"""The images as functions of the fitted parameters, and the references they are compared with.

While nothing moves, what each pixel sees stays: a view is captured once, and only shaded and composited in each step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import NUMPY, kind_of
from warpfrag.capture.coverage import Coverage
from warpfrag.composite import composite
from warpfrag.fit.parameters import with_places
from warpfrag.fit.processes import Processes
from warpfrag.fit.result import Run, plain_value
from warpfrag.fit.scaled_fragments import UnitFragments
from warpfrag.fit.study import PreparedStudy, Study
from warpfrag.fit.views import Resolve, View
from warpfrag.fragments import Fragments
from warpfrag.render import Renderer, over_background
from warpfrag.scene.parameters import BETA
from warpfrag.storage.kbuffer import kbuffer

# Random starts keep this share of the range away from the bounds, and a study's own this one where no method moves away
# from a bound.
_MARGIN = 0.1
INSIDE = 1e-3


class ViewProblem:
    """One view of a study: its image for parameter values, and the reference.

    Args:
        study: the study.
        view: the view.
        index: its place among the fitted views; 0 for one that is held out, for which no value is stacked.
        device: where to compute.
    """

    def __init__(self, study: PreparedStudy, view: View, index: int, device: str) -> None:
        self.study, self.view, self.index, self.device = study, view, index, device
        self.scene = replace(study.scene, camera=view.camera)
        self.resolve: Resolve = study.asked.resolve
        self.has_motion = any(each.is_motion for each in study.parameters)
        self.reference = reference_image(study, view, index)
        self.channels = self.reference.shape[2]

    @cached_property
    def renderer(self) -> Renderer:
        """What makes the images; while nothing moves it keeps what each pixel sees."""
        return Renderer(self.scene, resolve=self.resolve)

    @property
    def coverage(self) -> Coverage:
        """What each pixel sees, where nothing moves."""
        return self.renderer.coverage

    @cached_property
    def unit(self) -> UnitFragments:
        """The fragments as functions of few values per object, where nothing moves."""
        return UnitFragments(self.scene, self.coverage, self.study.parameters)

    @cached_property
    def fragments(self) -> Fragments:
        """The fragments of the scene as it is, where only beta is fitted."""
        return self.renderer.fragments()

    def parameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return this view's part of parameter values, in single precision."""
        return {each.name: _single(each.of_view(values[each.name], self.index)) for each in self.study.parameters}

    def image(self, values: Mapping[str, Any]) -> Any:
        """Return the image for parameter values, (H, W, 4) float32; torch tensors get their gradient."""
        parameters = self.parameters(values)
        if set(parameters) - {BETA.key}:
            return self.renderer.image(parameters)
        # Nothing has to be shaded anew.
        beta = parameters.get(BETA.key, float(self.scene.beta))
        fragments = self.fragments
        if kind_of(beta) not in (None, NUMPY):
            fragments = fragments.torch(beta.device)
        return self.over_background(self.composite(fragments, beta))

    def sees_something(self, image: np.ndarray) -> bool:
        """Tell whether any object is in an image of this view."""
        return bool((image != np.asarray(self.scene.background, image.dtype)).any()) or bool(self.coverage.count)

    def composite(self, fragments: Fragments, beta: Any) -> Any:
        """Composite fragments as the scene says, without its background."""
        scene = self.scene
        if self.resolve == "kbuffer":
            return composite(kbuffer(fragments, scene.layers, merge=scene.merge))  # type: ignore[arg-type]
        return composite(fragments, beta, max_layers=scene.layers, merge=scene.merge, mix=scene.mix)

    def over_background(self, image: Any) -> Any:
        """Return a premultiplied image, an array or a tensor, over the scene's background."""
        return over_background(image, self.scene.background)

    def residual(self, image: Any) -> Any:
        """Return image minus reference, (H, W, C), an array or a tensor."""
        return image[..., : self.channels] - self._reference_like(image)

    def loss(self, image: Any) -> Any:
        """Return the study's loss of a torch image, a 0-d float64 tensor."""
        return self.study.image_loss(image[..., : self.channels], self._reference_like(image))

    def _reference_like(self, image: Any) -> Any:
        kind = kind_of(image) or NUMPY
        return kind.asarray(self.reference, kind.astype(image, "float32"))


class Problem:
    """What a study compares: its views, and the vector of coordinates that a method moves.

    Args:
        study: the study.
        processes: those that share the work; None for those of this program.
    """

    def __init__(self, study: Study, processes: Processes | None = None) -> None:
        self.study, self.processes = study.prepared, processes or Processes(study.device)
        device = self.processes.device
        fitted = enumerate(self.study.fitted_views)
        self.views = [ViewProblem(self.study, view, index, device) for index, view in fitted]
        self.held_out = [ViewProblem(self.study, view, 0, device) for view in self.study.held_out_views]

    def values(self, coordinates: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parameters for a vector of a method's coordinates."""
        return {
            each.name: np.asarray(each.to_value(coordinates[place].reshape(each.start.shape)))
            for each, place in with_places(self.study.parameters)
        }

    def start(self) -> np.ndarray:
        """Return the start as a vector of a method's coordinates, float64."""
        return np.concatenate([each.to_coordinate(each.start).reshape(-1) for each in self.study.parameters])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the vector."""
        spans = [np.tile(each.coordinate_bounds, (each.start.size, 1)) for each in self.study.parameters]
        lower, upper = np.concatenate(spans).T
        return lower, upper

    def inside(self, coordinates: np.ndarray) -> np.ndarray:
        """Return a vector of coordinates with those on their bounds moved in by a thousandth of the range."""
        lower, upper = self.bounds()
        bounded = np.isfinite(lower) & np.isfinite(upper)
        room = INSIDE * np.subtract(upper, lower, out=np.zeros_like(upper), where=bounded)
        return np.clip(coordinates, lower + room, upper - room)

    def starts(self) -> list[np.ndarray]:
        """Return the study's start and the random ones.

        What is fitted per vertex, pixel or view starts from one value everywhere; what has no bounds from the study's.
        """
        generator = np.random.default_rng(self.study.asked.seed)
        lower, upper = self.bounds()
        starts = [np.clip(self.start(), lower, upper)]
        for _ in range(self.study.asked.restarts):
            parts = []
            for each in self.study.parameters:
                low, high = each.coordinate_bounds
                share = generator.uniform(_MARGIN, 1.0 - _MARGIN, each.kind.value_shape)
                start = each.to_coordinate(each.start) if np.isinf(low) else low + share * (high - low)
                parts.append(np.broadcast_to(start, each.start.shape).reshape(-1))
            starts.append(np.concatenate(parts))
        return starts


def describe_run(
    problem: Problem, start: np.ndarray, end: np.ndarray, *, losses: Sequence[float], **outcome: Any
) -> Run:
    """Return what a method did from a start, given in its coordinates as its end is.

    Args:
        problem: what was fitted.
        start: where it began.
        end: where the loss was least.
        losses: the loss of each step.
        outcome: the other fields of `Run`.
    """
    return Run(
        start={name: plain_value(value) for name, value in problem.values(start).items()},
        found={name: plain_value(value) for name, value in problem.values(end).items()},
        coordinates=end,
        losses=tuple(losses),
        **outcome,
    )


def _single(value: Any) -> Any:
    kind = kind_of(value)
    return np.asarray(value, np.float32) if kind is None else kind.astype(value, "float32")


def reference_image(study: PreparedStudy, view: View, index: int = 0) -> np.ndarray:
    """Return the image that a view approaches, (H, W, 3 or 4) float32.

    Args:
        study: the study.
        view: the view.
        index: its place among the fitted views.
    """
    reference, scene = view.reference, replace(study.asked.scene, camera=view.camera)
    assert reference is not None
    height, width = view.camera.shape
    if reference.image is not None:
        image = np.asarray(reference.image, np.float32)
        return over_background(image, scene.background) if image.shape[2] == 4 else image
    samples = reference.supersampling
    fine = replace(scene, camera=view.camera.resized((width * samples, height * samples)), **reference.render_options)
    fine, true = fine.in_units_of(reference.of_view(index, len(study.fitted_views)), "reference.true")
    image = np.asarray(Renderer(fine, resolve=study.asked.resolve).image(true))
    if samples > 1:
        image = image.reshape(height, samples, width, samples, 4).mean(axis=(1, 3), dtype=np.float64)
    return np.ascontiguousarray(image, np.float32)
