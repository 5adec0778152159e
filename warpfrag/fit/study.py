"""Studies: what is fitted to which images, and how. `study_file` reads them from TOML."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from warpfrag.errors import shorten
from warpfrag.files.table import is_number
from warpfrag.fit.losses import ImageLoss
from warpfrag.fit.parameters import (
    FitParameter,
    Variable,
    check_name,
    in_multiples_of_p,
    resolve_parameters,
    scene_value,
    thickness_units,
)
from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import MERGES, MIXES, Scene

Method = Literal["least_squares", "adam", "lbfgs"]
Resolve = Literal["sorted", "kbuffer"]

# Steps a method takes at most unless told: evaluations of least squares, iterations of the others.
DEFAULT_STEPS = {"least_squares": 100, "adam": 300, "lbfgs": 100}
# Adam stops when the best loss of so many steps is not better than the best before them, L-BFGS after so many steps in
# a row that changed nothing.
DEFAULT_PATIENCE = {"least_squares": 1, "adam": 50, "lbfgs": 3}

RENDER_OPTIONS = ("merge", "mix", "layers")
# What of them a k-buffer takes.
KBUFFER_MERGES, KBUFFER_MIXES = ("order_independent", "none"), ("opacity",)


class StudyError(ValueError):
    """A study that cannot be run, in one line: file, key, what was found, what is expected."""


@dataclass(frozen=True, eq=False)
class Reference:
    """The image to approach: a given one, or a render of the study's scene.

    Attributes:
        image: linear premultiplied image of floats (H, W, 4), or (H, W, 3) where opacity is not to be compared (in a
            scene without a background that is the image over black); None to render. One with opacity is laid over the
            scene's background, if the scene has one.
        true: values to render with, by parameter name; those of the scene where there is none. None with an image.
        supersampling: samples along each edge of a pixel; their mean (a box filter) is the reference.
        merge: in place of the study's, for the reference alone; so are `mix` and `layers`.
        mix: how colours are weighted.
        layers: largest number of layers of a pixel.
        source: where the image comes from, for messages.
    """

    image: np.ndarray | None = None
    true: Mapping[str, Any] | None = None
    supersampling: int = 1
    merge: str | None = None
    mix: str | None = None
    layers: int | None = None
    source: str = "reference.image"


@dataclass(frozen=True, eq=False)
class View:
    """A camera of a study, and the image to approach from there.

    Attributes:
        camera: where from, and the size of the image.
        reference: the image to approach; None takes the study's reference, rendered from this camera.
        name: of the folder that this view's images are saved in: letters, digits, "_" and "-".
        held_out: whether it is only rendered and compared at the end, and not fitted.
    """

    camera: Camera
    reference: Reference | None = None
    name: str = "view"
    held_out: bool = False


@dataclass(frozen=True, eq=False)
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
        variables: the parameters, resolved against the scene (not given).
        fitted_scene: the scene, with thicknesses that are fitted in multiples of P(z) in that unit (not given).
        all_views: the views with their references, the scene's camera where no views are given (not given).

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
    variables: tuple[Variable, ...] = field(init=False, repr=False)
    fitted_scene: Scene = field(init=False, repr=False)
    all_views: tuple[View, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._check_options()
        given = {
            name: value if isinstance(value, FitParameter) else FitParameter(value)
            for name, value in self.parameters.items()
        }
        if not given:
            raise StudyError("parameters: found none, expected at least one to fit")
        try:
            object.__setattr__(self, "parameters", given)
            starts = {name: parameter.start for name, parameter in given.items()}
            scene, starts = in_multiples_of_p(self.scene, starts, "parameters")
            object.__setattr__(self, "fitted_scene", scene)
            self._complete_views()
            cameras = [view.camera for view in self.fitted_views]
            numeric = {name: replace(parameter, start=starts[name]) for name, parameter in given.items()}
            object.__setattr__(self, "variables", resolve_parameters(scene, cameras, numeric))
            for view in self.all_views:
                _check_reference(view, self.scene, len(cameras), self.resolve)
        except StudyError:
            raise
        except (ValueError, TypeError) as error:
            raise StudyError(str(error)) from error
        self._check_held_out()
        self._choose_method()
        if self.resolve == "kbuffer":
            self._check_kbuffer()

    @property
    def fitted_views(self) -> list[View]:
        """The views that are fitted, those that are not held out."""
        return [view for view in self.all_views if not view.held_out]

    @property
    def is_global(self) -> bool:
        """Whether every parameter is few values, for a whole object, scene or view."""
        return all(variable.is_global for variable in self.variables)

    @property
    def image_loss(self) -> ImageLoss:
        """The loss of one view's image."""
        return ImageLoss.of(self.loss, self.delta, self.scales)

    @property
    def true(self) -> dict[str, np.ndarray] | None:
        """The values that made the references, of the fitted parameters; None where they are not known."""
        reference = self.reference
        if reference is None or reference.true is None or any(v.reference is not reference for v in self.all_views):
            return None
        result = {}
        scene, true = in_multiples_of_p(self.scene, reference.true, "reference.true")
        # What a render of another kind was made with is not what a fit is to find.
        if any(getattr(reference, key) not in (None, getattr(self.scene, key)) for key in RENDER_OPTIONS):
            return None
        for variable in self.variables:
            name = variable.name
            value = true.get(name, scene_value(scene, name))
            other = variable.key == "thickness" and thickness_units(scene, name) != thickness_units(
                self.fitted_scene, name
            )
            if value is None or other:
                return None
            result[name] = np.asarray(value, dtype=np.float64)
        return result

    def resized(self, size: tuple[int, int]) -> "Study":
        """Return this study with another image size (width, height)."""
        views = [replace(view, camera=view.camera.resized(size)) for view in self.views]
        return replace(self, scene=replace(self.scene, camera=self.scene.camera.resized(size)), views=views)

    def _check_options(self) -> None:
        for key, choices in (("method", (*get_args(Method), None)), ("resolve", get_args(Resolve))):
            if getattr(self, key) not in choices:
                expected = ", ".join(f'"{choice}"' for choice in choices if choice)
                raise StudyError(f"{key}: found {shorten(getattr(self, key))}, expected one of {expected}")
        for key, least in (("steps", 1), ("seed", 0), ("restarts", 0), ("scales", 1), ("patience", 1), ("batch", 1)):
            value = getattr(self, key)
            optional = value is None and key in ("steps", "patience", "batch")
            if not optional and (isinstance(value, bool) or not isinstance(value, int) or value < least):
                raise StudyError(f"{key}: found {shorten(value)}, expected a whole number from {least}")
        for key, strict in (
            ("delta", True),
            ("tolerance", False),
            ("learning_rate", True),
            ("checkpoint_seconds", False),
        ):
            value = getattr(self, key)
            if not is_number(value) or value < 0 or (strict and value == 0):
                raise StudyError(f"{key}: found {shorten(value)}, expected a number {'above' if strict else 'from'} 0")
        try:
            ImageLoss.of(self.loss, self.delta, self.scales)
        except ValueError as error:
            raise StudyError(str(error)) from None

    def _complete_views(self) -> None:
        """Give every view a reference with numbers only, and check that they can be told apart."""
        views = tuple(self.views) or (View(self.scene.camera),)
        views = tuple(replace(view, reference=view.reference or self.reference) for view in views)
        object.__setattr__(self, "all_views", views)
        names = [view.name for view in views]
        for name in names:
            if not isinstance(name, str) or not re.fullmatch(r"[\w-]+", name):
                raise StudyError(f'views: found the name {shorten(name)}, expected letters, digits, "_" and "-"')
            if names.count(name) > 1:
                raise StudyError(f'views: found the name "{name}" more than once, expected unique names')
        if not self.fitted_views:
            raise StudyError("views: found all of them held out, expected one to fit")
        if self.batch is not None and self.batch > len(self.fitted_views):
            raise StudyError(f"batch: found {self.batch}, expected up to {len(self.fitted_views)}, the views to fit")

    def _check_held_out(self) -> None:
        held_out = [view for view in self.all_views if view.held_out]
        if not held_out:
            return
        for view in held_out:
            assert view.reference is not None
            for name, value in (view.reference.true or {}).items():
                if is_stacked(name, value, len(self.fitted_views)):
                    raise StudyError(
                        f"reference.true.{name}: found one value per view with views that are held out, for which "
                        "there is none; expected one that all views share"
                    )
        for variable in self.variables:
            if variable.per in ("pixel", "view"):
                raise StudyError(
                    f'parameters.{variable.name}: found per "{variable.per}" with views that are held out, for which '
                    "there would be no value; expected one that all views share"
                )

    def _choose_method(self) -> None:
        robust = self.image_loss.robust is not None
        if self.method is None:
            chosen = "least_squares" if self.is_global and robust and self.batch is None else "adam"
            object.__setattr__(self, "method", chosen)
        method = str(self.method)
        if method == "least_squares" and not self.is_global:
            other = next(v.name for v in self.variables if not v.is_global)
            expected = '"adam" or "lbfgs" (least squares fits few values per object)'
            raise StudyError(f'method: found "least_squares" for {other}, expected {expected}')
        if method == "least_squares" and not robust:
            raise StudyError(f'loss: found {shorten(self.loss)} with "least_squares", expected "l2", "l1" or "huber"')
        if self.batch is not None and method != "adam":
            raise StudyError(f'batch: found {self.batch} with method "{method}", expected "adam"')
        for key, defaults in (("steps", DEFAULT_STEPS), ("patience", DEFAULT_PATIENCE)):
            if getattr(self, key) is None:
                object.__setattr__(self, key, defaults[method])

    def _check_kbuffer(self) -> None:
        scene = self.scene
        for key, choices in (("merge", KBUFFER_MERGES), ("mix", KBUFFER_MIXES)):
            if getattr(scene, key) not in choices:
                expected = " or ".join(f'"{choice}"' for choice in choices)
                raise StudyError(f'{key}: found "{getattr(scene, key)}" with resolve "kbuffer", expected {expected}')
        if "beta" in self.parameters:
            raise StudyError('parameters: found beta with resolve "kbuffer", in which it plays no part')


def _check_render_options(reference: Reference, resolve: str) -> None:
    """Raise for options of a reference's render that are none, or that a k-buffer does not have."""
    kbuffer = resolve == "kbuffer"
    for key, choices in (
        ("merge", KBUFFER_MERGES if kbuffer else MERGES),
        ("mix", KBUFFER_MIXES if kbuffer else MIXES),
    ):
        value = getattr(reference, key)
        if value is not None and value not in choices:
            expected = " or ".join(f'"{choice}"' for choice in choices)
            raise StudyError(
                f"reference.{key}: found {shorten(value)}, expected {expected}" + ' with resolve "kbuffer"' * kbuffer
            )
    layers = reference.layers
    if layers is not None and (isinstance(layers, bool) or not isinstance(layers, int) or layers < 1):
        raise StudyError(f"reference.layers: found {shorten(layers)}, expected a whole number from 1")


def _check_reference(view: View, scene: Scene, count: int, resolve: str) -> None:
    reference = view.reference
    if reference is None:
        raise StudyError(f'reference: found none for the view "{view.name}", expected an image or true')
    if (reference.image is None) == (reference.true is None):
        found = "neither" if reference.image is None else "both"
        raise StudyError(f"reference: found {found} of image and true, expected one of them")
    if reference.true is not None:
        _check_render_options(reference, resolve)
        for name in reference.true:
            check_name(name, scene, "reference.true")
        scene, true = in_multiples_of_p(scene, true_of_view(reference, 0, count), "reference.true")
        assemble(scene, true, camera=view.camera)
        _check_beta(reference.true.get("beta", 0.0), view.camera, count)
    else:
        if reference.supersampling != 1 or any(getattr(reference, key) is not None for key in RENDER_OPTIONS):
            raise StudyError("reference: found options of a render with an image, expected them with true")
        _check_image(reference, view.camera)
    samples = reference.supersampling
    if isinstance(samples, bool) or not isinstance(samples, int) or not 1 <= samples <= 64:
        raise StudyError(f"reference.supersampling: found {shorten(samples)}, expected a whole number from 1 to 64")


def _check_image(reference: Reference, camera: Camera) -> None:
    try:
        image = np.asarray(reference.image)
    except ValueError:
        image = np.asarray(None)
    where, expected = reference.source, "linear floating-point numbers of shape (H, W, 3 or 4)"
    if image.dtype.kind != "f" or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise StudyError(f"{where}: found {image.dtype} of shape {image.shape}, expected {expected}")
    if image.shape[:2] != camera.shape:
        found, wanted = f"{image.shape[1]} × {image.shape[0]}", f"{camera.size[0]} × {camera.size[1]}"
        raise StudyError(f"{where}: found {found} pixels, expected {wanted} like the study's camera")
    if not np.isfinite(image).all():
        row, column = np.argwhere(~np.isfinite(image).all(axis=-1))[0]
        raise StudyError(f"{where}: found a value that is not finite at column {column}, row {row}")


def _check_beta(value: Any, camera: Camera, count: int) -> None:
    beta = np.asarray(value, dtype=np.float64)
    shapes = ((), camera.shape, (count, *camera.shape))
    if beta.shape not in shapes or not (np.isfinite(beta) & (beta >= 0.0) & (beta <= 1.0)).all():
        found = shorten(value) if beta.ndim == 0 else f"an array of shape {beta.shape}"
        raise StudyError(f"reference.true.beta: found {found}, expected numbers from 0 to 1, one or a map")


def true_of_view(reference: Reference, index: int, count: int) -> dict[str, Any]:
    """Return a reference's values for one of `count` fitted views: its part of what is stacked by view."""
    return {
        name: np.asarray(value)[index] if is_stacked(name, value, count) else value
        for name, value in (reference.true or {}).items()
    }


def is_stacked(name: str, value: Any, count: int) -> bool:
    """Whether a reference's value has a part for each of `count` views."""
    array = np.asarray(value)
    is_map = name.endswith(("thickness", "beta")) and array.ndim == 3
    is_pose = name.startswith("camera.") and array.ndim == 2
    return (is_map or is_pose) and len(array) == count
