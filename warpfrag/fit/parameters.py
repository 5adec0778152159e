"""What is fitted: its start and bounds, and the coordinates in which a method moves it.

Beta, opacities, colours and vertices are moved as they are, a thickness as its logarithm: a step then means a factor,
whatever the scene's unit, and a thickness cannot become negative. Bounds hold in both coordinates.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from warpfrag.scene.errors import shorten, suggest
from warpfrag.scene.objects import PARAMETER_KEYS, Scene, SceneObject

Per = Literal["object", "vertex", "pixel"]
PER = ("object", "vertex", "pixel")

# Defaults of the bounds of a thickness, as shares of the diagonal of the scene's bounding box.
SMALLEST_THICKNESS = 1e-6
LARGEST_THICKNESS = 1.0
# One unit of a vertex coordinate in a method's coordinates, as a share of the diagonal: vertices move less than colours
# do.
VERTEX_UNIT = 0.1


@dataclass(frozen=True, eq=False)
class FitParameter:
    """A parameter to fit.

    Attributes:
        start: number or array to start from; None takes the scene's value.
        lower: lower bound; None takes 0 for beta, opacity and colour, a millionth of the scene's extent for a
            thickness, and none for vertices.
        upper: upper bound; None takes 1 for beta, opacity and colour, the scene's extent for a thickness, and none for
            vertices.
        per: "object" for one value (three for a colour), "vertex", or "pixel" for a map; None as the start is shaped.
        learning_rate: Adam's step for this parameter; None takes the study's.
    """

    start: Any = None
    lower: float | None = None
    upper: float | None = None
    per: Per | None = None
    learning_rate: float | None = None


@dataclass(frozen=True, eq=False)
class Variable:
    """A parameter with everything resolved against a scene.

    Attributes:
        name: the parameter's name.
        start: where it starts, float64, of the shape the scene takes.
        lower: lower bound, or -inf.
        upper: upper bound, or inf.
        logarithm: whether methods move its logarithm.
        unit: size of one unit of a method's coordinate; 1 but for vertices.
        learning_rate: Adam's step, None for the study's.
    """

    name: str
    start: np.ndarray
    lower: float
    upper: float
    logarithm: bool
    unit: float
    learning_rate: float | None

    @property
    def key(self) -> str:
        """What it is: "beta" or one of `PARAMETER_KEYS`."""
        return self.name.rpartition(".")[2]

    @property
    def owner(self) -> str:
        """The name of its object, empty for beta."""
        return self.name.rpartition(".")[0]

    @property
    def is_global(self) -> bool:
        """Whether it is one value for a whole object or scene (three for a colour)."""
        return self.key != "vertices" and self.start.shape == ((3,) if self.key == "color" else ())

    @property
    def span(self) -> tuple[float, float]:
        """Its bounds in a method's coordinates."""
        return float(self.inward(np.asarray(self.lower))), float(self.inward(np.asarray(self.upper)))

    def inward(self, value: np.ndarray) -> np.ndarray:
        """Return a method's coordinate of a value."""
        return np.log(value) if self.logarithm else np.asarray(value / self.unit)

    def outward(self, coordinate: Any) -> Any:
        """Return the value of a coordinate, an array or a tensor."""
        if isinstance(coordinate, (np.ndarray, np.floating)):
            coordinate = np.asarray(coordinate)
            return np.clip(np.exp(coordinate), self.lower, self.upper) if self.logarithm else coordinate * self.unit
        # Rounding must not carry a bound across itself.
        return coordinate.exp().clamp(self.lower, self.upper) if self.logarithm else coordinate * self.unit


def resolve_parameters(scene: Scene, parameters: Mapping[str, FitParameter]) -> tuple[Variable, ...]:
    """Resolve parameters to fit against a scene.

    Raises:
        ValueError: an unknown name, a start of the wrong shape, or one that is not between the bounds.
    """
    known = scene.parameters()
    variables = []
    for name, parameter in parameters.items():
        check_name(name, known, "parameters")
        variables.append(_resolve(scene, name, known[name], parameter))
    return tuple(variables)


def check_name(name: str, known: Mapping[str, Any], where: str) -> None:
    """Raise for a parameter that the scene does not have."""
    if name not in known:
        raise ValueError(f"{where}: found the unknown name {shorten(name)}; {suggest(name, known)}")


def find_object(scene: Scene, name: str) -> SceneObject:
    """Return the object that a parameter belongs to."""
    return next(item for item in scene.objects if item.name == name.rpartition(".")[0])


def extent(scene: Scene) -> float:
    """Return the diagonal of the scene's bounding box [scene units]; 1 for a scene without vertices."""
    vertices = [item.world_vertices() for item in scene.objects if len(item.vertices)]
    if not vertices:
        return 1.0
    joined = np.concatenate(vertices)
    return float(np.linalg.norm(joined.max(axis=0) - joined.min(axis=0))) or 1.0


def flatten_names(table: Mapping[str, Any], scene: Scene) -> dict[str, Any]:
    """Turn `ball.thickness = 1`, which TOML reads as a table in a table, into the name "ball.thickness"."""
    names = {item.name for item in scene.objects}
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if key in names and isinstance(value, Mapping):
            flat.update({f"{key}.{inner}": inner_value for inner, inner_value in value.items()})
        else:
            flat[key] = value
    return flat


def _resolve(scene: Scene, name: str, current: Any, parameter: FitParameter) -> Variable:
    where = f"parameters.{name}"
    key = name.rpartition(".")[2]
    start = _start(scene, name, current, parameter, where)
    size, lower, upper = extent(scene), -math.inf, math.inf
    if key == "thickness":
        lower, upper = _thickness_bounds(scene, find_object(scene, name), size)
    elif key != "vertices":
        lower, upper = 0.0, 1.0
    lower = lower if parameter.lower is None else float(parameter.lower)
    upper = upper if parameter.upper is None else float(parameter.upper)
    if not lower < upper:
        raise ValueError(f"{where}: found bounds from {lower:g} to {upper:g}, expected lower below upper")
    if math.isinf(lower) != math.isinf(upper):
        raise ValueError(f"{where}: found one bound, expected both or none")
    if key == "thickness" and not lower > 0.0:
        raise ValueError(f"{where}.lower: found {lower:g}, expected a number above 0 (its logarithm is fitted)")
    if key in ("beta", "opacity") and not (lower >= 0.0 and upper <= 1.0):
        raise ValueError(f"{where}: found bounds from {lower:g} to {upper:g}, expected them from 0 to 1")
    outside = ~((start >= lower) & (start <= upper))
    if outside.any():
        found = float(start[outside].reshape(-1)[0])
        raise ValueError(f"{where}.start: found {found:g}, expected from {lower:g} to {upper:g}")
    rate = parameter.learning_rate
    if rate is not None and not (math.isfinite(rate) and rate > 0.0):
        raise ValueError(f"{where}.learning_rate: found {rate:g}, expected a number above 0")
    unit = VERTEX_UNIT * size if key == "vertices" else 1.0
    return Variable(name, start, lower, upper, key == "thickness", unit, rate)


def _start(scene: Scene, name: str, current: Any, parameter: FitParameter, where: str) -> np.ndarray:
    key = name.rpartition(".")[2]
    try:
        value = np.array(current if parameter.start is None else parameter.start, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{where}.start: found {shorten(parameter.start)}, expected numbers") from None
    if not np.isfinite(value).all():
        raise ValueError(f"{where}.start: found a value that is not finite, expected finite numbers")
    shapes = _shapes(scene, name, key)
    if parameter.per is not None and parameter.per not in shapes:
        expected = " or ".join(f'"{per}"' for per in shapes)
        raise ValueError(f"{where}.per: found {shorten(parameter.per)}, expected {expected} for a {key}")
    if parameter.per is None:
        if value.shape in shapes.values():
            return value
        words = " or ".join(str(shape) for shape in shapes.values())
        raise ValueError(f"{where}.start: found shape {value.shape}, expected shape {words}")
    shape = shapes[parameter.per]
    # One value, or one colour, stands for all vertices or pixels.
    if value.shape not in (shape, next(iter(shapes.values()))):
        raise ValueError(f"{where}.start: found shape {value.shape}, expected shape {shape}")
    return np.ascontiguousarray(np.broadcast_to(value, shape))


def _shapes(scene: Scene, name: str, key: str) -> dict[str, tuple[int, ...]]:
    if key == "beta":
        return {"object": ()}
    count = len(find_object(scene, name).vertices)
    last = (3,) if key in ("color", "vertices") else ()
    if key == "vertices":
        return {"vertex": (count, 3)}
    shapes = {"object": last, "vertex": (count, *last)}
    if key == "thickness":
        shapes["pixel"] = scene.camera.shape
    return shapes


def _thickness_bounds(scene: Scene, item: SceneObject, size: float) -> tuple[float, float]:
    lower, upper = SMALLEST_THICKNESS * size, LARGEST_THICKNESS * size
    if item.thickness_unit == "P":
        # In multiples of P(z) at the object's middle (FORMULAS 11, 24 bits).
        camera, step = scene.camera, 2.0**-24
        middle = item.world_vertices().mean(axis=0) if len(item.vertices) else np.asarray(camera.target)
        z = max(float((camera.view_matrix()[:3, :3] @ (middle - np.asarray(camera.eye)))[2]), camera.near)
        resolution = z * z * step / (camera.near * camera.far / (camera.far - camera.near) + z * step)
        return lower / resolution, upper / resolution
    return lower, upper


def value_words(value: Any) -> str:
    """Word a parameter's value shortly: a number, a few numbers, or the mean of many."""
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 0:
        return f"{float(array):.4g}"
    if array.size <= 3:
        return "(" + ", ".join(f"{part:.3g}" for part in array.reshape(-1)) + ")"
    return f"mean {array.mean():.4g}"


def values_words(values: Mapping[str, Any]) -> str:
    """Word the values of several parameters on one line."""
    return ", ".join(f"{name} {value_words(value)}" for name, value in values.items())


def component_names(variables: Sequence[Variable]) -> list[str]:
    """Return a name for each number: "ball.color[0]" for the first of a colour."""
    names: list[str] = []
    for variable in variables:
        count = variable.start.size
        single = variable.start.ndim == 0
        names += [variable.name] if single else [f"{variable.name}[{index}]" for index in range(count)]
    return names


__all__ = ["PARAMETER_KEYS", "FitParameter", "Per", "Variable", "resolve_parameters"]
