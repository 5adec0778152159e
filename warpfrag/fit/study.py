"""Studies: what is fitted to which images, and how. `study_file` reads them from TOML."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import warp as wp

from warpfrag.capture.memory import allowed_memory
from warpfrag.errors import check_choice, check_number, check_whole, shorten
from warpfrag.fit.losses import ImageLoss
from warpfrag.fit.parameters import FitParameter, FittedParameter, owners, resolve_parameters
from warpfrag.fit.views import (
    KBUFFER_MERGES,
    KBUFFER_MIXES,
    Reference,
    Resolve,
    StudyError,
    View,
    check_reference,
    complete_views,
    is_stacked,
)
from warpfrag.scene.parameters import BETA, COMMON_THICKNESS, THICKNESS
from warpfrag.scene.same import same
from warpfrag.scene.scene import Scene

Method = Literal["least_squares", "adam", "lbfgs"]

# Steps a method takes at most unless told: evaluations of least squares, iterations of the others.
DEFAULT_STEPS: dict[Method, int] = {"least_squares": 100, "adam": 300, "lbfgs": 100}
# Adam stops when the best loss of so many steps is not better than the best before them, L-BFGS after so many steps in
# a row that changed nothing.
DEFAULT_PATIENCE: dict[Method, int] = {"least_squares": 1, "adam": 50, "lbfgs": 3}
# More are a slip of the keyboard: each restart is a fit of its own, and the pyramid of any image ends before.
MOST_RESTARTS, MOST_SCALES = 10_000, 64
# Of each view: its reference, and its images at the start and at the end. Of a map: its start and where it is, its
# gradient and the two moments of it.
IMAGES_KEPT, MAPS_KEPT = 3, 5


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """What is fitted to which images, and how.

    Attributes:
        scene: the scene, as it is to be rendered.
        reference: the image to approach; with several views what they have in common, None where each has its own.
        parameters: what to fit: for each name a number to start from, or a `FitParameter`.
        views: cameras and their references; empty for the scene's camera alone.
        loss: "l2" (mean square), "l1" (mean absolute value, rounded off below 1e-3), "huber" (square up to `delta`) or
            "ssim" (1 − structural similarity); or several with weights, such as {"l1": 0.8, "ssim": 0.2}.
        delta: where Huber's loss becomes linear [linear light].
        scales: levels of the image pyramid that the loss is the mean over, each of half the size of the one before.
        method: "least_squares", "adam" or "lbfgs"; None takes least squares when every parameter is few values per
            object and the loss is one it can take, else Adam.
        steps: most evaluations (least squares) or iterations (the others); None takes 100, 300 and 100.
        tolerance: stop when loss or parameters change relatively less than this.
        patience: early stopping: Adam ends when the best loss of so many steps is not better, L-BFGS when so many steps
            in a row changed nothing, both relatively by more than `tolerance`; None takes 50 and 3.
        batch: views that Adam looks at in each step, drawn anew until all have had their turn; None takes all.
        seed: of the random starts, and of the order of the views.
        restarts: further starts, drawn at random between the bounds; the best end counts.
        learning_rate: Adam's step: beta, opacity and colour as they are, relative for a thickness.
        device: where torch and Warp compute.
        checkpoint_seconds: time between two checkpoints.
        resolve: how fragments become layers, in the reference as well: "sorted", or "kbuffer", as they come, into as
            many slots as the scene has layers (then beta plays no part).
        name: names the default output folder.

    Raises:
        StudyError: something of it does not exist, or is out of its range.
    """

    scene: Scene
    reference: Reference | None
    parameters: Mapping[str, Any]
    views: Sequence[View] = ()
    loss: str | Mapping[str, float] = "l2"
    delta: float = 0.1
    scales: int = 1
    method: Method | None = None
    steps: int | None = None
    tolerance: float = 1e-8
    patience: int | None = None
    batch: int | None = None
    seed: int = 0
    restarts: int = 0
    learning_rate: float = 0.02
    device: str = "cpu"
    checkpoint_seconds: float = 2.0
    resolve: Resolve = "sorted"
    name: str = "study"

    def __post_init__(self) -> None:
        try:
            self._check_options()
            # What cannot be prepared is not a study: said at once.
            _ = self.prepared
        except StudyError:
            raise
        except (ValueError, TypeError) as error:
            raise StudyError(str(error)) from error

    def __repr__(self) -> str:
        return f"Study({self.name!r}, {self.scene!r}, parameters: {', '.join(self.parameters)})"

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    __hash__ = None  # type: ignore[assignment]

    @cached_property
    def prepared(self) -> "PreparedStudy":
        """This study, resolved against its scene and views."""
        return _prepare(self)

    def resized(self, size: tuple[int, int]) -> "Study":
        """Return this study with another image size (width, height)."""
        views = [replace(view, camera=view.camera.resized(size)) for view in self.views]
        return replace(self, scene=replace(self.scene, camera=self.scene.camera.resized(size)), views=views)

    def _check_options(self) -> None:
        if self.method is not None:
            check_choice("method", self.method, get_args(Method))
        check_choice("resolve", self.resolve, get_args(Resolve))
        for key, least, most in (("seed", 0, math.inf), ("restarts", 0, MOST_RESTARTS), ("scales", 1, MOST_SCALES)):
            check_whole(key, getattr(self, key), least, most)
        for key in ("steps", "patience", "batch"):
            if getattr(self, key) is not None:
                check_whole(key, getattr(self, key), 1)
        for key in ("delta", "learning_rate"):
            check_number(key, getattr(self, key), above=0.0)
        for key in ("tolerance", "checkpoint_seconds"):
            check_number(key, getattr(self, key), 0.0)
        check_device(self.device)
        if not self.parameters:
            raise StudyError("parameters: got none, expected at least one to fit")


def check_device(device: Any) -> None:
    """Check that a device is one of this machine.

    Raises:
        StudyError: it is not.
    """
    match = re.fullmatch(r"cpu|cuda(?::(\d+))?", device) if isinstance(device, str) else None
    if match is None:
        raise StudyError(f'device: got {shorten(device)}, expected "cpu", "cuda" or "cuda:<number>"')
    count = 0 if device == "cpu" else wp.get_cuda_device_count()
    if device != "cpu" and int(match[1] or 0) >= count:
        here = f"{count} CUDA devices" if count else "no CUDA device"
        raise StudyError(f'device: got "{device}" on a machine with {here}, expected another, such as "cpu"')


@dataclass(frozen=True, eq=False)
class PreparedStudy:
    """A study with everything resolved: what fits go by.

    Attributes:
        asked: the study.
        scene: its scene, with thicknesses that are fitted in multiples of P(z) in that unit.
        views: all views, with their references.
        parameters: what is fitted.
        image_loss: the loss of one view's image.
        method: how it is fitted.
        steps: most evaluations or iterations.
        patience: steps without progress after which it ends.
    """

    asked: Study
    scene: Scene
    views: tuple[View, ...]
    parameters: tuple[FittedParameter, ...]
    image_loss: ImageLoss
    method: Method
    steps: int
    patience: int

    @property
    def fitted_views(self) -> list[View]:
        """The views that are fitted, those that are not held out."""
        return [view for view in self.views if not view.held_out]

    @property
    def held_out_views(self) -> list[View]:
        """The views that are only compared."""
        return [view for view in self.views if view.held_out]

    @property
    def is_global(self) -> bool:
        """Whether every parameter is few values with columns in the Jacobian."""
        return all(each.is_global and each.kind.in_jacobian for each in self.parameters)

    @property
    def true(self) -> dict[str, np.ndarray] | None:
        """The values that made the references, of the fitted parameters; None where they are not known."""
        reference = self.asked.reference
        if reference is None or reference.true is None or any(v.reference is not reference for v in self.views):
            return None
        # What a render of another kind was made with is not what a fit is to find.
        if any(value != getattr(self.asked.scene, key) for key, value in reference.render_options.items()):
            return None
        scene, true = self.asked.scene.in_units_of(reference.true, "reference.true")
        result = {}
        for each in self.parameters:
            value = true.get(each.name, scene.own_value(each.name))
            if value is None or _units(scene, each) != _units(self.scene, each):
                return None
            result[each.name] = np.asarray(value, dtype=np.float64)
        return result


def _units(scene: Scene, fitted: FittedParameter) -> set[str]:
    """Return the units that a parameter's values are in."""
    if fitted.kind not in (THICKNESS, COMMON_THICKNESS):
        return set()
    return {item.thickness_unit for item in owners(scene, fitted.parameter)}


def _prepare(study: Study) -> PreparedStudy:
    image_loss = ImageLoss.of(study.loss, study.delta, study.scales)
    asked = {
        name: value if isinstance(value, FitParameter) else FitParameter(value)
        for name, value in study.parameters.items()
    }
    scene, starts = study.scene.in_units_of({name: each.start for name, each in asked.items()})
    views = complete_views(study.views, study.scene, study.reference)
    _check_memory(views, asked, study.device)
    cameras = [view.camera for view in views if not view.held_out]
    if study.batch is not None and study.batch > len(cameras):
        raise StudyError(f"batch: got {study.batch}, expected up to {len(cameras)}, the views to fit")
    numeric = {name: replace(each, start=starts[name]) for name, each in asked.items()}
    parameters = resolve_parameters(scene, cameras, numeric)
    for view in views:
        check_reference(view, study.scene, len(cameras), study.resolve)
    _check_held_out(views, parameters, len(cameras))
    method = _chosen_method(study, parameters, image_loss)
    if study.resolve == "kbuffer":
        _check_kbuffer(scene, parameters)
    return PreparedStudy(
        asked=study,
        scene=scene,
        views=views,
        parameters=parameters,
        image_loss=image_loss,
        method=method,
        steps=DEFAULT_STEPS[method] if study.steps is None else study.steps,
        patience=DEFAULT_PATIENCE[method] if study.patience is None else study.patience,
    )


def _check_memory(views: Sequence[View], asked: Mapping[str, FitParameter], device: str) -> None:
    """Check that there is memory for the least that a fit keeps: reference, start and end of every view, and maps."""
    pixel_count = sum(view.camera.size[0] * view.camera.size[1] for view in views)
    maps = sum(each.per == "pixel" for each in asked.values())
    needed = pixel_count * (IMAGES_KEPT * 4 * 4 + maps * MAPS_KEPT * 8)
    allowed = allowed_memory(None, wp.get_device(device))
    if needed > allowed:
        width, height = max((view.camera.size for view in views), key=math.prod)
        raise StudyError(
            f"size: got views of up to {width} × {height} pixels, which take {needed / 2**30:.3g} GiB at "
            f"least, expected at most {allowed / 2**30:.3g} GiB (half of the free memory)"
        )


def _check_held_out(views: Sequence[View], parameters: Sequence[FittedParameter], count: int) -> None:
    held_out = [view for view in views if view.held_out]
    for view in held_out:
        assert view.reference is not None
        for name, value in (view.reference.true or {}).items():
            if is_stacked(name, value, count):
                raise StudyError(
                    f"reference.true.{name}: got one value per view with views that are held out, for which "
                    "there is none; expected one that all views share"
                )
    for each in parameters if held_out else ():
        if each.per in ("pixel", "view"):
            raise StudyError(
                f'parameters.{each.name}: got per "{each.per}" with views that are held out, for which there '
                "would be no value; expected one that all views share"
            )


def _chosen_method(study: Study, parameters: Sequence[FittedParameter], image_loss: ImageLoss) -> Method:
    """Return the method of a study, its own or the default, once it is known to go with all else."""
    robust = image_loss.robust is not None
    other = next((each.name for each in parameters if not (each.is_global and each.kind.in_jacobian)), None)
    method = study.method
    if method is None:
        method = "least_squares" if other is None and robust and study.batch is None else "adam"
    if method == "least_squares" and other is not None:
        expected = '"adam" or "lbfgs" (least squares fits few values per object, and no lens)'
        raise StudyError(f'method: got "least_squares" for {other}, expected {expected}')
    if method == "least_squares" and not robust:
        raise StudyError(f'loss: got {shorten(study.loss)} with "least_squares", expected "l2", "l1" or "huber"')
    if study.batch is not None and method != "adam":
        raise StudyError(f'batch: got {study.batch} with method "{method}", expected "adam"')
    return method


def _check_kbuffer(scene: Scene, parameters: Sequence[FittedParameter]) -> None:
    for key, choices in (("merge", KBUFFER_MERGES), ("mix", KBUFFER_MIXES)):
        if getattr(scene, key) not in choices:
            expected = " or ".join(f'"{choice}"' for choice in choices)
            raise StudyError(f'{key}: got "{getattr(scene, key)}" with resolve "kbuffer", expected {expected}')
    if any(each.kind is BETA for each in parameters):
        raise StudyError('parameters: got beta with resolve "kbuffer", in which it plays no part')
