"""Every kind of parameter, described once: whose it is, its shapes, range, unit and scale, what it moves, its wording.

Checks of scenes, their assembly, the command line, study files, fits and their logs all go by these descriptions. A new
kind is one more of them.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, get_args

import numpy as np

from warpfrag.arrays.kinds import NUMPY, kind_of
from warpfrag.colors import parse_hex
from warpfrag.errors import is_number, range_wording, shorten, suggest
from warpfrag.scene.names import CAMERA, ThicknessUnit

# What becomes of a value outside its range: it is put on the end of the range, or refused.
Bounds = Literal["clamp", "error"]
BOUNDS: tuple[Bounds, ...] = get_args(Bounds)
Per = Literal["object", "vertex", "pixel", "view"]
PER: tuple[Per, ...] = get_args(Per)
Shape = tuple[int, ...]

# One unit of a vertex or translation in a method's coordinates, as a share of the scene's extent: they move less than
# colours do.
VERTEX_UNIT = 0.1
# Bounds of a fitted thickness, as shares of the scene's extent.
SMALLEST_THICKNESS, LARGEST_THICKNESS = 1e-6, 1.0

_MULTIPLE_OF_P = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*P\s*")


class Thickness(NamedTuple):
    """A z-thickness that says what it is measured in."""

    value: float
    unit: ThicknessUnit


@dataclass(frozen=True, eq=False)
class ParameterKind:
    """What all parameters of a kind have in common.

    Attributes:
        key: the last part of their names.
        owner: whose they are.
        per: what there may be a value for; a value per view is a camera's alone.
        value_shape: of one value: () for a number.
        field: where the owner keeps its value; None for a motion, which is zero in a scene as it stands.
        low: least number.
        high: largest number.
        logarithmic: whether fits move the logarithm.
        unit: size of one unit of a fit's coordinate (the logarithm's is 1).
        bounds: between which it is fitted unless told otherwise; None for anywhere.
        is_length: whether `unit` and `bounds` are shares of the scene's extent.
        shown: where its value is read, if not in that field.
        moves: what the parameter moves, and with it depths and coverage.
        in_jacobian: whether least squares has a column for it where it is few values.
        look: which of an object's `LOOK_COUNT` numbers it is; None for none of them.
        parse: reads a value from a text; None from one that is no value.
        text: what such a text looks like.
    """

    key: str
    owner: Literal["scene", "object", "camera"]
    per: tuple[Per, ...]
    value_shape: Shape = ()
    field: str | None = None
    low: float = -math.inf
    high: float = math.inf
    logarithmic: bool = False
    unit: float = 1.0
    bounds: tuple[float, float] | None = None
    is_length: bool = False
    shown: str | None = None
    moves: Literal["surfaces", "camera"] | None = None
    in_jacobian: bool = True
    look: slice | None = None
    parse: Callable[[str], Any] = lambda text: None
    text: str = "numbers"

    def __reduce__(self) -> Any:
        # There is one of each: a copy is the kind itself.
        return _find_kind, (self.owner, self.key)

    @property
    def is_bounded(self) -> bool:
        """Whether some numbers are out of its range."""
        return self.low > -math.inf or self.high < math.inf

    @property
    def range_wording(self) -> str:
        """Words for the numbers that are allowed."""
        if self.low == -math.inf:
            return "numbers that are finite"
        return f"numbers from {self.low:g}" + (", finite" if self.high == math.inf else f" to {self.high:g}")

    def read(self, name: str, text: str) -> Any:
        """Return the value that a text stands for: a number, an array, or a `Thickness`.

        Raises:
            ValueError: it stands for none.
        """
        value = self.parse(text)
        if value is None:
            raise ValueError(f"{name}: got {shorten(text)}, expected {self.text}")
        return value


def _numbers(count: int) -> Callable[[str], Any]:
    def parse(text: str) -> Any:
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            return None
        if len(numbers) != count or not all(map(math.isfinite, numbers)):
            return None
        return numbers[0] if count == 1 else np.array(numbers)

    return parse


def parse_thickness(text: str) -> Thickness | None:
    """Read "0.3", scene units, or "2P", multiples of P(z); None if it is neither."""
    multiple = multiple_of_p(text)
    if multiple is not None:
        return Thickness(multiple, "P")
    number = _numbers(1)(text)
    return None if number is None else Thickness(number, "scene")


def multiple_of_p(text: str) -> float | None:
    """Return the number of a thickness in multiples of P(z), 2 of "2P"; None for any other text."""
    match = _MULTIPLE_OF_P.fullmatch(text)
    return float(match[1]) if match is not None and math.isfinite(float(match[1])) else None


def _parse_color(text: str) -> Any:
    color = parse_hex(text)
    return _numbers(3)(text) if color is None else np.array(color[:3])


# An object's look is so many numbers: red, green, blue, opacity, thickness.
LOOK_COUNT = 5
_SHARE: dict[str, Any] = {"low": 0.0, "high": 1.0, "bounds": (0.0, 1.0), "parse": _numbers(1)}
_SHARE["text"] = range_wording(0.0, 1.0)
_THICKNESS: dict[str, Any] = {"key": "thickness", "low": 0.0, "logarithmic": True, "is_length": True}
_THICKNESS |= {"bounds": (SMALLEST_THICKNESS, LARGEST_THICKNESS), "look": slice(4, 5), "parse": parse_thickness}
_THICKNESS["text"] = 'a number, or multiples of P(z) such as "2P"'
_VECTOR: dict[str, Any] = {"value_shape": (3,), "parse": _numbers(3), "text": "x,y,z"}
_TRANSLATION = {**_VECTOR, "key": "translation", "unit": VERTEX_UNIT, "is_length": True}
_ROTATION = {**_VECTOR, "key": "rotation", "unit": math.degrees(1.0)}

BETA = ParameterKind("beta", "scene", ("object", "pixel"), field="beta", **_SHARE)
# Of all objects without a thickness of their own among the values given.
COMMON_THICKNESS = ParameterKind(owner="scene", per=("object", "pixel"), **_THICKNESS)
THICKNESS = ParameterKind(owner="object", per=("object", "vertex", "pixel"), field="thickness", **_THICKNESS)
COLOR = ParameterKind(
    "color", "object", ("object", "vertex"), (3,), "color",
    low=0.0, bounds=(0.0, 1.0), look=slice(0, 3), parse=_parse_color, text='3 numbers or "#rrggbb"',
)  # fmt: skip
OPACITY = ParameterKind("opacity", "object", ("object", "vertex"), field="opacity", look=slice(3, 4), **_SHARE)
VERTICES = ParameterKind(
    "vertices", "object", ("vertex",), (3,), "vertices", unit=VERTEX_UNIT, is_length=True, moves="surfaces"
)
TRANSLATION = ParameterKind(owner="object", per=("object",), moves="surfaces", **_TRANSLATION)
ROTATION = ParameterKind(owner="object", per=("object",), moves="surfaces", **_ROTATION)
CAMERA_TRANSLATION = ParameterKind(owner="camera", per=("object", "view"), moves="camera", **_TRANSLATION)
CAMERA_ROTATION = ParameterKind(owner="camera", per=("object", "view"), moves="camera", **_ROTATION)
_LENS: dict[str, Any] = {"owner": "camera", "per": ("object", "view"), "moves": "camera", "in_jacobian": False}
# Of a perspective camera, of an orthographic one, and of both.
FOV = ParameterKind(
    "fov", field="fov", low=0.01, high=179.99, unit=math.degrees(1.0), bounds=(1.0, 175.0), parse=_numbers(1),
    text="a number of degrees", **_LENS,
)  # fmt: skip
HEIGHT = ParameterKind(
    "height", field="height", low=1e-30, logarithmic=True, bounds=(1e-3, 10.0), is_length=True, parse=_numbers(1),
    text=range_wording(above=0.0), **_LENS,
)  # fmt: skip
PRINCIPAL = ParameterKind(
    "principal", value_shape=(2,), field="principal", shown="middle", unit=10.0, parse=_numbers(2), text="x,y", **_LENS
)

SCENE_KINDS = (BETA, COMMON_THICKNESS)
OBJECT_KINDS = (THICKNESS, COLOR, OPACITY, VERTICES)
OBJECT_MOTIONS = (TRANSLATION, ROTATION)
CAMERA_MOTIONS = (CAMERA_TRANSLATION, CAMERA_ROTATION)
LENS_KINDS = (FOV, HEIGHT, PRINCIPAL)
KINDS = (*SCENE_KINDS, *OBJECT_KINDS, *OBJECT_MOTIONS, *CAMERA_MOTIONS, *LENS_KINDS)


def kind_named(name: str) -> ParameterKind:
    """Return the kind of the parameter of a name that some scene has."""
    owner, _, key = name.rpartition(".")
    whose = {"": "scene", CAMERA: "camera"}.get(owner, "object")
    return _find_kind(whose, key)


def _find_kind(owner: str, key: str) -> ParameterKind:
    return next(kind for kind in KINDS if (kind.owner, kind.key) == (owner, key))


class HasVertices(Protocol):
    """An object as far as its parameters' shapes go."""

    name: str
    vertices: np.ndarray


class HasLens(Protocol):
    """A camera as far as it has parameters."""

    @property
    def is_perspective(self) -> bool:
        """Whether it has an opening angle."""
        ...


@dataclass(frozen=True, eq=False)
class Parameter:
    """A parameter of one scene.

    Attributes:
        name: such as "ball.thickness".
        kind: what it is.
        owner: the name of its object, "camera", or empty for the scene's.
        vertex_count: vertices of its object; 0 for others.
        keeps_float64: whether its owner keeps it in double precision.
    """

    name: str
    kind: ParameterKind
    owner: str = ""
    vertex_count: int = 0
    keeps_float64: bool = False

    def shapes(self, grid: Shape, view_count: int = 1) -> dict[Per, Shape]:
        """Return the shapes of values by what they are per; those of several views are stacked.

        Args:
            grid: pixels of a view, (H, W).
            view_count: number of views.
        """
        value = self.kind.value_shape
        shapes: dict[Per, Shape] = {
            "object": value,
            "vertex": (self.vertex_count, *value),
            "pixel": grid if view_count == 1 else (view_count, *grid),
            "view": (view_count, *value),
        }
        return {per: shapes[per] for per in self.kind.per}

    def bounded(self, value: Any, bounds: Bounds) -> Any:
        """Return a value, clamped to its range if that is what `bounds` says; see `Kind.clip` for its gradient.

        Infinities stay what they are, to be refused.
        """
        kind = kind_of(value) or NUMPY
        if bounds != "clamp" or not self.kind.is_bounded or not bool(kind.xp.isfinite(kind.detach(value)).all()):
            return value
        return kind.clip(value, self.kind.low, self.kind.high)

    def check(self, value: Any, grid: Shape | None = None) -> None:
        """Check shape, range and finiteness of a value.

        Args:
            value: an array of any kind that has a namespace of functions.
            grid: pixels that a map must have, (H, W); None takes any.

        Raises:
            ValueError: with the parameter's name, what was got and what is expected.
        """
        shape, allowed, words = tuple(value.shape), False, []
        for per, expected in self.shapes(grid or ()).items():
            if per == "pixel":
                allowed |= len(shape) == 2 if grid is None else shape == grid
                words.append(f"a map of shape {'(H, W)' if grid is None else grid}")
            elif per != "view":
                allowed |= shape == expected
                words.append(str(expected))
        if not allowed:
            expected_words = " or ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)
            raise ValueError(f"{self.name}: got shape {shape}, expected shape {expected_words}")
        kind = kind_of(value) or NUMPY
        value = kind.detach(value)
        good = kind.xp.isfinite(value) & (value >= self.kind.low) & (value <= self.kind.high)
        if not bool(good.all()):
            found = float(value[~good].reshape(-1)[0])
            raise ValueError(f"{self.name}: got {found:.9g}, expected {self.kind.range_wording}")


def bounded_beta(beta: Any, bounds: Bounds) -> Any:
    """Return a beta, a number or an array, clamped to its range if that is what `bounds` says."""
    if kind_of(beta) is not None:
        return Parameter(BETA.key, BETA).bounded(beta, bounds)
    return min(max(float(beta), BETA.low), BETA.high) if bounds == "clamp" and is_number(beta) else beta


def describe(objects: Iterable[HasVertices], camera: HasLens) -> dict[str, Parameter]:
    """Return the parameters of a scene of some objects and a camera by name, in the order in which they are listed."""
    objects = list(objects)
    found = [Parameter(kind.key, kind) for kind in SCENE_KINDS]
    for kinds in (OBJECT_KINDS, OBJECT_MOTIONS):
        found += [
            Parameter(
                f"{item.name}.{kind.key}",
                kind,
                item.name,
                len(item.vertices),
                kind is VERTICES and item.vertices.dtype == np.float64,
            )
            for item in objects
            for kind in kinds
        ]
    lens = (FOV if camera.is_perspective else HEIGHT, PRINCIPAL)
    found += [Parameter(f"{CAMERA}.{kind.key}", kind, CAMERA) for kind in (*CAMERA_MOTIONS, *lens)]
    return {parameter.name: parameter for parameter in found}


def check_name(name: Any, known: Mapping[str, Parameter], where: str) -> Parameter:
    """Return the parameter of a name.

    Raises:
        ValueError: there is none.
    """
    if name not in known:
        raise ValueError(f"{where}: got the unknown name {shorten(name)}; {suggest(str(name), known)}")
    return known[name]
