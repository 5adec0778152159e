"""Studies: what is fitted to which image, and how; and the TOML files that describe them.

A study file:

scene = "../three_spheres.toml"       # relative to the study file
method = "least_squares"              # or "adam", "lbfgs"; loss, delta, steps, tolerance, seed, restarts, …
size = [256, 256]                     # and merge, mix, layers: in place of the scene's own
resolve = "kbuffer"                   # how images come about; default "sorted"

[reference]
true = {beta = 0.5, red.thickness = 0.15}     # a render of the scene with these values; or image = "photo.png"

[parameters]
beta = 0.9                                              # where to start
red.thickness = {start = 0.4, lower = 0.01, upper = 2}  # and between which bounds
"""

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from warpfrag.fit.parameters import (
    PER,
    FitParameter,
    Variable,
    check_name,
    find_object,
    flatten_names,
    resolve_parameters,
)
from warpfrag.images import ImageError, read_image
from warpfrag.scene.colors import parse_hex
from warpfrag.scene.errors import SceneError, shorten
from warpfrag.scene.files import load_scene
from warpfrag.scene.geometry import assemble
from warpfrag.scene.objects import MERGES, MIXES, Scene
from warpfrag.scene.table import Table, is_number, is_numbers, read_toml

Method = Literal["least_squares", "adam", "lbfgs"]
Loss = Literal["l2", "l1", "huber"]
Resolve = Literal["sorted", "kbuffer"]

# Steps a method takes at most unless told: evaluations of least squares, iterations of the others.
DEFAULT_STEPS = {"least_squares": 100, "adam": 300, "lbfgs": 100}

_RENDER = ("merge", "mix", "layers")
_TOP: tuple[str, ...] = (
    "scene",
    "reference",
    "parameters",
    "loss",
    "delta",
    "method",
    "steps",
    "tolerance",
    "seed",
    "restarts",
)
_TOP += ("learning_rate", "device", "checkpoint_seconds", "size", "resolve", *_RENDER)
_MOST_PIXELS, _MOST_STEPS = 65536, 10**9
_P = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*P\s*")


class StudyError(ValueError):
    """A study that cannot be run, in one line: file, key, what was found, what is expected."""


@dataclass(frozen=True, eq=False)
class Reference:
    """The image to approach: a given one, or a render of the study's scene.

    Attributes:
        image: linear premultiplied image (H, W, 4), or (H, W, 3) where opacity is not to be compared; None to render.
            One with opacity is laid over the scene's background, if the scene has one.
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
class Study:
    """What is fitted to which image, and how.

    Attributes:
        scene: the scene, as it is to be rendered (its camera's size is the size of the images).
        reference: the image to approach.
        parameters: what to fit: for each name a number to start from, or a `FitParameter`.
        loss: "l2" (mean square), "l1" (mean absolute value, rounded off below 1e-3) or "huber" (square up to `delta`).
        delta: where Huber's loss becomes linear [linear light].
        method: "least_squares", "adam" or "lbfgs"; None takes least squares when every parameter is one value per
            object, else Adam.
        steps: most evaluations (least squares) or iterations (the others); None takes 100, 300 and 100.
        tolerance: stop when loss or parameters change relatively less than this.
        seed: of the random starts.
        restarts: further starts of least squares, drawn between the bounds; the best end counts.
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
    reference: Reference
    parameters: Mapping[str, FitParameter]
    loss: Loss = "l2"
    delta: float = 0.1
    method: Method | None = None
    steps: int | None = None
    tolerance: float = 1e-8
    seed: int = 0
    restarts: int = 0
    learning_rate: float = 0.02
    device: str = "cpu"
    checkpoint_seconds: float = 2.0
    resolve: Resolve = "sorted"
    name: str = "study"
    variables: tuple[Variable, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        given = {
            name: value if isinstance(value, FitParameter) else FitParameter(value)
            for name, value in self.parameters.items()
        }
        object.__setattr__(self, "parameters", given)
        if not given:
            raise StudyError("parameters: found none, expected at least one to fit")
        try:
            object.__setattr__(self, "variables", resolve_parameters(self.scene, given))
            self._check_reference()
        except StudyError:
            raise
        except (ValueError, TypeError) as error:
            raise StudyError(str(error)) from error
        for key, choices in (
            ("loss", get_args(Loss)),
            ("method", (*get_args(Method), None)),
            ("resolve", get_args(Resolve)),
        ):
            if getattr(self, key) not in choices:
                expected = ", ".join(f'"{choice}"' for choice in choices if choice)
                raise StudyError(f"{key}: found {shorten(getattr(self, key))}, expected one of {expected}")
        if self.method is None:
            object.__setattr__(self, "method", "least_squares" if self.is_global else "adam")
        if self.method == "least_squares" and not self.is_global:
            other = next(v.name for v in self.variables if not v.is_global)
            expected = '"adam" or "lbfgs" (least squares fits one value per object)'
            raise StudyError(f'method: found "least_squares" for {other}, expected {expected}')
        if self.resolve == "kbuffer":
            self._check_kbuffer()
        if self.steps is None:
            object.__setattr__(self, "steps", DEFAULT_STEPS[str(self.method)])
        for key, least in (("steps", 1), ("seed", 0), ("restarts", 0)):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
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
        if self.restarts and self.method != "least_squares":
            raise StudyError(f'restarts: found {self.restarts} with method "{self.method}", expected "least_squares"')

    @property
    def is_global(self) -> bool:
        """Whether every parameter is one value for a whole object or scene."""
        return all(variable.is_global for variable in self.variables)

    @property
    def true(self) -> dict[str, np.ndarray] | None:
        """The values that made the reference, of the fitted parameters; None where they are not known."""
        if self.reference.true is None:
            return None
        known = {**self.scene.parameters(), **self.reference.true}
        return {variable.name: np.asarray(known[variable.name], dtype=np.float64) for variable in self.variables}

    def resized(self, size: tuple[int, int]) -> "Study":
        """Return this study with another image size (width, height)."""
        return replace(self, scene=replace(self.scene, camera=self.scene.camera.resized(size)))

    def _check_kbuffer(self) -> None:
        scene = self.scene
        for key, choices in (("merge", ("order_independent", "none")), ("mix", ("opacity",))):
            if getattr(scene, key) not in choices:
                expected = " or ".join(f'"{choice}"' for choice in choices)
                raise StudyError(f'{key}: found "{getattr(scene, key)}" with resolve "kbuffer", expected {expected}')
        if "beta" in self.parameters:
            raise StudyError('parameters: found beta with resolve "kbuffer", in which it plays no part')

    def _check_reference(self) -> None:
        reference = self.reference
        if (reference.image is None) == (reference.true is None):
            found = "neither" if reference.image is None else "both"
            raise StudyError(f"reference: found {found} of image and true, expected one of them")
        if reference.true is not None:
            known = self.scene.parameters()
            for name in reference.true:
                check_name(name, known, "reference.true")
            beta = reference.true.get("beta", 0.0)
            if not is_number(beta) or not 0.0 <= beta <= 1.0:
                raise StudyError(f"reference.true.beta: found {shorten(beta)}, expected a number from 0 to 1")
            assemble(self.scene, dict(reference.true))
        elif reference.supersampling != 1 or any(getattr(reference, key) is not None for key in _RENDER):
            raise StudyError("reference: found options of a render with an image, expected them with true")
        samples = reference.supersampling
        if isinstance(samples, bool) or not isinstance(samples, int) or not 1 <= samples <= 64:
            raise StudyError(f"reference.supersampling: found {shorten(samples)}, expected a whole number from 1 to 64")


def load_study(path: str | os.PathLike, *, size: tuple[int, int] | None = None) -> Study:
    """Read a study file, the scene it names and its reference image.

    Args:
        path: a TOML file.
        size: width and height in place of those in the files.

    Raises:
        StudyError: anything in it that cannot be used: file, key, what was found, what is expected.
        SceneError: the same about the scene file.
        ImageError: the reference image cannot be read.

    Example:
        >>> load_study("scenes/studies/bunny_in_sphere.toml").method
        'least_squares'
    """
    path = Path(path)
    try:
        data = read_toml(path)
        top = Table(data, path, "", _TOP)
        scene = _scene(top, path, size)
        values: dict[str, Any] = {
            key: top.choice(key, get_args(kind))
            for key, kind in (("loss", Loss), ("method", Method), ("resolve", Resolve))
        }
        values["steps"] = top.integer("steps", 1, _MOST_STEPS)
        values["seed"] = top.integer("seed", 0, 2**63 - 1)
        values["restarts"] = top.integer("restarts", 0, _MOST_STEPS)
        values["delta"] = top.number("delta", above=0.0)
        values["tolerance"] = top.number("tolerance", 0.0)
        values["learning_rate"] = top.number("learning_rate", above=0.0)
        values["checkpoint_seconds"] = top.number("checkpoint_seconds", 0.0)
        values["device"] = top.text("device")
        reference = _reference(top, path, scene)
        parameters = _parameters(top, scene)
    except ImageError:
        raise
    except SceneError as error:
        # What a scene file did wrong keeps its own class.
        raise error if not str(error).startswith(str(path)) else StudyError(str(error)) from None
    try:
        given = {key: value for key, value in values.items() if value is not None}
        return Study(scene, reference, parameters, name=path.stem, **given)
    except StudyError as error:
        raise StudyError(f"{path}: {error}") from None


def _scene(top: Table, path: Path, size: tuple[int, int] | None) -> Scene:
    name = top.text("scene")
    if name is None:
        raise top.error("scene", "none", "the path of a scene file, relative to the study's folder")
    file = path.parent / name
    if not file.is_file():
        raise top.error("scene", f"no such file at {file}", "a scene file")
    scene = load_scene(file)
    if "size" in top:
        value = top.data["size"]
        whole = isinstance(value, list) and len(value) == 2 and all(type(part) is int for part in value)
        if not whole or not 1 <= min(value) <= max(value) <= _MOST_PIXELS:
            raise top.error("size", shorten(value), f"width and height, two whole numbers from 1 to {_MOST_PIXELS}")
        size = size or (value[0], value[1])
    if size is not None:
        scene = replace(scene, camera=scene.camera.resized(size))
    overrides = {key: value for key, value in _render_options(top).items() if value is not None}
    return replace(scene, **overrides)


def _render_options(table: Table) -> dict[str, Any]:
    return {
        "merge": table.choice("merge", MERGES),
        "mix": table.choice("mix", MIXES),
        "layers": table.integer("layers", 1, 2**31 - 1),
    }


def _reference(top: Table, path: Path, scene: Scene) -> Reference:
    table = top.table("reference", ("image", "true", "supersampling", *_RENDER))
    if table is None:
        raise top.error("reference", "none", "a table [reference] with image or true")
    if ("image" in table) == ("true" in table):
        found = "both image and true" if "image" in table else "neither image nor true"
        raise table.error("", found, "one of them")
    options = _render_options(table)
    options["supersampling"] = table.integer("supersampling", 1, 64)
    options = {key: value for key, value in options.items() if value is not None}
    if "image" in table:
        if options:
            raise table.error(next(iter(options)), "it with an image", "it with true (it belongs to a render)")
        file = path.parent / str(table.text("image"))
        return Reference(read_image(file), source=str(file))
    true = table.data["true"]
    if not isinstance(true, dict):
        raise table.error("true", shorten(true), "a table of parameter names and values")
    true = flatten_names(true, scene)
    return Reference(true={name: _value(table, f"true.{name}", name, true[name], scene) for name in true}, **options)


def _parameters(top: Table, scene: Scene) -> dict[str, FitParameter]:
    table = top.data.get("parameters")
    if not isinstance(table, dict) or not table:
        found = "none" if not table else shorten(table)
        raise top.error("parameters", found, "a table [parameters] of names and start values")
    result = {}
    for name, given in flatten_names(table, scene).items():
        if name not in scene.parameters():
            try:
                check_name(name, scene.parameters(), "parameters")
            except ValueError as error:
                raise SceneError(f"{top.file}: {error}") from None
        if not isinstance(given, dict):
            given = {"start": given}
        entry = Table(given, top.file, f"parameters.{name}", ("start", "lower", "upper", "per", "learning_rate"))
        start = None if "start" not in entry else _value(entry, "start", name, given["start"], scene)
        lower, upper = entry.number("lower"), entry.number("upper")
        per: Any = entry.choice("per", PER)
        result[name] = FitParameter(start, lower, upper, per, entry.number("learning_rate", above=0.0))
    return result


def _value(table: Table, key: str, name: str, value: Any, scene: Scene) -> Any:
    """Return a value from a file: a number, numbers, a colour "#rrggbb", or a thickness "2P"."""
    kind = name.rpartition(".")[2]
    if isinstance(value, str):
        color = parse_hex(value) if kind == "color" else None
        if color is not None:
            return list(color[:3])
        match = _P.fullmatch(value) if kind == "thickness" and name in scene.parameters() else None
        if match is not None and find_object(scene, name).thickness_unit == "P":
            return float(match[1])
        if match is not None:
            raise table.error(key, shorten(value), "a number, as the scene gives this thickness in scene units")
    if is_number(value) and kind != "color":
        return float(value)
    if isinstance(value, list) and _is_numeric(value):
        return np.asarray(value, dtype=np.float64)
    expected = '3 numbers or "#rrggbb"' if kind == "color" else "a number"
    raise table.error(key, shorten(value), expected)


def _is_numeric(value: list) -> bool:
    if all(isinstance(part, list) for part in value):
        return bool(value) and len({len(part) for part in value}) == 1 and all(is_numbers(p, len(p)) for p in value)
    return is_numbers(value, len(value)) and math.prod((len(value),)) > 0
