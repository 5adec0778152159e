"""The images that a fit approaches, and the cameras they are seen from."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from warpfrag.errors import check_choice, check_whole, shorten
from warpfrag.files.scene_file import MOST_IMAGE_PIXELS
from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.names import MERGES, MIXES
from warpfrag.scene.parameters import BETA, check_name, kind_named
from warpfrag.scene.same import same
from warpfrag.scene.scene import Scene
from warpfrag.storage.kbuffer import KMerge

Resolve = Literal["sorted", "kbuffer"]

RENDER_OPTIONS = ("merge", "mix", "layers")
# What of them a k-buffer takes.
KBUFFER_MERGES, KBUFFER_MIXES = get_args(KMerge), ("opacity",)
# Samples along the edge of a pixel beyond this are a slip of the keyboard.
MOST_SAMPLES = 64


class StudyError(ValueError):
    """A study that cannot be run, in one line: file, key, what was got, what is expected."""


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

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def __repr__(self) -> str:
        if self.image is not None:
            return f"Reference(image of shape {np.shape(self.image)})"
        return f"Reference(true: {', '.join(self.true or ()) or 'the scene'})"

    __hash__ = None  # type: ignore[assignment]

    @property
    def render_options(self) -> dict[str, Any]:
        """What of the scene's options it has in its own place."""
        own = {key: getattr(self, key) for key in RENDER_OPTIONS}
        return {key: value for key, value in own.items() if value is not None}

    def of_view(self, index: int, count: int) -> dict[str, Any]:
        """Return the true values for one of `count` fitted views: its part of what is stacked by view."""
        return {
            name: np.asarray(value)[index] if is_stacked(name, value, count) else value
            for name, value in (self.true or {}).items()
        }


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

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    __hash__ = None  # type: ignore[assignment]


def complete_views(views: Sequence[View], scene: Scene, reference: Reference | None) -> tuple[View, ...]:
    """Give every view a reference, and check that they can be told apart; without views, the scene's camera is one.

    Raises:
        StudyError: names that are no names or not unique, or no view to fit.
    """
    complete = tuple(replace(view, reference=view.reference or reference) for view in views or (View(scene.camera),))
    names = [view.name for view in complete]
    for name in names:
        if not isinstance(name, str) or not re.fullmatch(r"[\w-]+", name):
            raise StudyError(f'views: got the name {shorten(name)}, expected letters, digits, "_" and "-"')
        if names.count(name) > 1:
            raise StudyError(f'views: got the name "{name}" more than once, expected unique names')
    if all(view.held_out for view in complete):
        raise StudyError("views: got all of them held out, expected one to fit")
    return complete


def check_reference(view: View, scene: Scene, count: int, resolve: Resolve) -> None:
    """Check the reference of a view, one of `count` that are fitted.

    Raises:
        ValueError: something of it does not exist, or is out of its range.
        TypeError: something of it is of the wrong kind.
    """
    reference = view.reference
    if reference is None:
        raise StudyError(f'reference: got none for the view "{view.name}", expected an image or true')
    if (reference.image is None) == (reference.true is None):
        got = "neither" if reference.image is None else "both"
        raise StudyError(f"reference: got {got} of image and true, expected one of them")
    if reference.true is not None:
        _check_render_options(reference, resolve)
        known = scene.described()
        for name in reference.true:
            check_name(name, known, "reference.true")
        scene, true = scene.in_units_of(reference.of_view(0, count), "reference.true")
        assemble(scene, true, camera=view.camera, bounds="error")
        _check_beta(reference.true.get(BETA.key, 0.0), view.camera, count)
    else:
        if reference.supersampling != 1 or reference.render_options:
            raise StudyError("reference: got options of a render with an image, expected them with true")
        _check_image(reference, view.camera)
    samples = check_whole("reference.supersampling", reference.supersampling, 1, MOST_SAMPLES)
    width, height = view.camera.size
    if samples > 1 and samples * samples * width * height > MOST_IMAGE_PIXELS:
        raise StudyError(
            f"reference.supersampling: got {samples} with {width} × {height} pixels, expected up to "
            f"{MOST_IMAGE_PIXELS} samples in all"
        )


def is_stacked(name: str, value: Any, count: int) -> bool:
    """Tell whether a reference's value has a part for each of `count` views."""
    array, kind = np.asarray(value), kind_named(name)
    is_map = "pixel" in kind.per and array.ndim == 3
    is_by_view = "view" in kind.per and array.ndim == 1 + len(kind.value_shape)
    return (is_map or is_by_view) and len(array) == count


def _check_render_options(reference: Reference, resolve: Resolve) -> None:
    """Raise for options of a reference's render that are none, or that a k-buffer does not have."""
    kbuffer = resolve == "kbuffer"
    for key, choices in (
        ("merge", KBUFFER_MERGES if kbuffer else MERGES),
        ("mix", KBUFFER_MIXES if kbuffer else MIXES),
    ):
        value = getattr(reference, key)
        if value is not None:
            try:
                check_choice(f"reference.{key}", value, choices)
            except ValueError as error:
                raise StudyError(str(error) + ' with resolve "kbuffer"' * kbuffer) from None
    if reference.layers is not None:
        check_whole("reference.layers", reference.layers, 1)


def _check_image(reference: Reference, camera: Camera) -> None:
    try:
        image = np.asarray(reference.image)
    except ValueError:
        image = np.asarray(None)
    where, expected = reference.source, "linear floating-point numbers of shape (H, W, 3 or 4)"
    if image.dtype.kind != "f" or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise StudyError(f"{where}: got {image.dtype} of shape {image.shape}, expected {expected}")
    if image.shape[:2] != camera.shape:
        got, wanted = f"{image.shape[1]} × {image.shape[0]}", f"{camera.size[0]} × {camera.size[1]}"
        raise StudyError(f"{where}: got {got} pixels, expected {wanted} like the study's camera")
    if not np.isfinite(image).all():
        row, column = np.argwhere(~np.isfinite(image).all(axis=-1))[0]
        raise StudyError(f"{where}: got a value that is not finite at column {column}, row {row}")


def _check_beta(value: Any, camera: Camera, count: int) -> None:
    beta = np.asarray(value, dtype=np.float64)
    shapes = ((), camera.shape, (count, *camera.shape))
    inside = np.isfinite(beta) & (beta >= BETA.low) & (beta <= BETA.high)
    if beta.shape not in shapes or not inside.all():
        got = shorten(value) if beta.ndim == 0 else f"an array of shape {beta.shape}"
        raise StudyError(f"reference.true.beta: got {got}, expected {BETA.range_wording}, one or a map")
