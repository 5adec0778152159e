"""What is fitted: its start and bounds, and the coordinates in which a method moves it.

Parameters are moved as they are, or as their logarithm where their kind says so (`scene.parameters`): a step of a
thickness then means a factor, whatever the scene's unit, and it cannot become negative. Bounds hold in both
coordinates.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import NUMPY, kind_of
from warpfrag.errors import check_number, check_whole, shorten
from warpfrag.scene.camera import Camera
from warpfrag.scene.depth_resolution import z_resolution
from warpfrag.scene.names import CAMERA
from warpfrag.scene.parameters import COMMON_THICKNESS, Parameter, ParameterKind, Per, check_name
from warpfrag.scene.same import same
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject


@dataclass(frozen=True, eq=False)
class FitParameter:
    """A parameter to fit.

    Attributes:
        start: number or array to start from; for a thickness also "2P", which has it fitted in multiples of P(z). None
            takes the scene's value.
        lower: lower bound; None takes 0 for beta, opacity and colour, a millionth of the scene's extent for a
            thickness, and none for vertices and transforms.
        upper: upper bound; None takes 1 for beta, opacity and colour, the scene's extent for a thickness, and none for
            vertices and transforms.
        per: "object" for one value (three for a colour or a transform), "vertex", "pixel" for a map (of each view),
            "view" for a camera's transform apart in each view; None as the start is shaped.
        learning_rate: Adam's step for this parameter; None takes the study's.
        smoothness: weight of a prior on what is fitted per pixel or vertex: the mean squared difference of neighbours,
            in the coordinates that methods move (for a thickness the logarithm), is added to the loss so many times.
        levels: stages in which a map is fitted from coarse to fine: the first has pixels of 2^(levels − 1).
    """

    start: Any = None
    lower: float | None = None
    upper: float | None = None
    per: Per | None = None
    learning_rate: float | None = None
    smoothness: float = 0.0
    levels: int = 1

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class FittedParameter:
    """A parameter with everything resolved against a scene and its views.

    Attributes:
        parameter: the scene's parameter.
        start: where it starts, float64, of the shape the scene takes; maps and transforms of several views stacked.
        lower: lower bound, or -inf.
        upper: upper bound, or inf.
        per: what it has a value for.
        unit: size of one unit of a method's coordinate; 1 for a logarithm.
        learning_rate: Adam's step, None for the study's.
        smoothness: weight of the prior.
        levels: stages from coarse to fine.
    """

    parameter: Parameter
    start: np.ndarray = field(repr=False)
    lower: float
    upper: float
    per: Per
    unit: float
    learning_rate: float | None
    smoothness: float
    levels: int

    @property
    def name(self) -> str:
        """The parameter's name."""
        return self.parameter.name

    @property
    def kind(self) -> ParameterKind:
        """What it is."""
        return self.parameter.kind

    @property
    def owner(self) -> str:
        """The name of its object, "camera", or empty where it is the whole scene's."""
        return self.parameter.owner

    @property
    def is_global(self) -> bool:
        """Whether it is few values, for a whole object, scene or view."""
        return self.per in ("object", "view")

    @property
    def is_motion(self) -> bool:
        """Whether it moves surfaces or the camera."""
        return self.kind.moves is not None

    @property
    def is_logarithmic(self) -> bool:
        """Whether methods move its logarithm."""
        return self.kind.logarithmic

    @property
    def coordinate_bounds(self) -> tuple[float, float]:
        """Its bounds in a method's coordinates."""
        return float(self.to_coordinate(np.asarray(self.lower))), float(self.to_coordinate(np.asarray(self.upper)))

    def to_coordinate(self, value: np.ndarray) -> np.ndarray:
        """Return a method's coordinate of a value."""
        return np.log(value) if self.is_logarithmic else np.asarray(value / self.unit)

    def to_value(self, coordinate: Any) -> Any:
        """Return the value of a coordinate, an array of any kind."""
        xp = (kind_of(coordinate) or NUMPY).xp
        if not self.is_logarithmic:
            return coordinate * self.unit
        # Rounding must not carry a bound across itself.
        return xp.clip(xp.exp(coordinate), self.lower, self.upper)

    def of_view(self, value: Any, view: int) -> Any:
        """Return what of a value belongs to a view, given its place among the fitted ones."""
        stacked = self.per == "view" or (self.per == "pixel" and len(value.shape) == 3)
        return value[view] if stacked else value


def with_places(parameters: Sequence[FittedParameter]) -> Iterator[tuple[FittedParameter, slice]]:
    """Yield each parameter with its place in the vector of all coordinates."""
    first = 0
    for each in parameters:
        yield each, slice(first, first + each.start.size)
        first += each.start.size


def resolve_parameters(
    scene: Scene, cameras: Sequence[Camera], parameters: Mapping[str, FitParameter]
) -> tuple[FittedParameter, ...]:
    """Resolve parameters to fit against a scene.

    Args:
        scene: the scene.
        cameras: those of the views that are fitted.
        parameters: what to fit.

    Raises:
        ValueError: an unknown name, a start of the wrong shape, or one that is not between the bounds.
    """
    known, size = scene.described(), extent(scene)
    resolved = tuple(
        _resolve(scene, cameras, size, check_name(name, known, "parameters"), parameter)
        for name, parameter in parameters.items()
    )
    if any(each.kind is COMMON_THICKNESS for each in resolved) and len(thickness_units(scene, parameters)) > 1:
        got = "objects with thicknesses in scene units and in multiples of P(z)"
        raise ValueError(f'parameters.thickness: got {got}, expected one unit (a start such as "2P" sets it)')
    return resolved


def thickness_units(scene: Scene, names: Mapping[str, Any]) -> set[str]:
    """Return the units of the objects that have no thickness of their own among some names."""
    return {item.thickness_unit for item in scene.objects if f"{item.name}.{COMMON_THICKNESS.key}" not in names}


def owners(scene: Scene, parameter: Parameter) -> list[SceneObject]:
    """Return the objects that a parameter belongs to: its own one, or all of them."""
    return [item for item in scene.objects if parameter.owner in ("", item.name)]


def extent(scene: Scene) -> float:
    """Return the diagonal of the bounding box of everything in the scene; 1 if it is empty."""
    vertices = [item.world_vertices() for item in scene.objects if len(item.vertices)]
    if not vertices:
        return 1.0
    joined = np.concatenate(vertices)
    return float(np.linalg.norm(joined.max(axis=0) - joined.min(axis=0))) or 1.0


def flatten_names(table: Mapping[str, Any], scene: Scene) -> dict[str, Any]:
    """Turn `ball.thickness = 1`, which TOML reads as a table in a table, into the name "ball.thickness"."""
    names = {CAMERA, *(item.name for item in scene.objects)}
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if key in names and isinstance(value, Mapping):
            flat.update({f"{key}.{inner}": inner_value for inner, inner_value in value.items()})
        else:
            flat[key] = value
    return flat


def _resolve(
    scene: Scene, cameras: Sequence[Camera], size: float, parameter: Parameter, asked: FitParameter
) -> FittedParameter:
    where, kind = f"parameters.{parameter.name}", parameter.kind
    start, per = _start(scene, cameras, parameter, asked, where)
    lower, upper = _default_bounds(scene, parameter, size)
    lower = lower if asked.lower is None else check_number(f"{where}.lower", asked.lower)
    upper = upper if asked.upper is None else check_number(f"{where}.upper", asked.upper)
    if not lower < upper:
        raise ValueError(f"{where}: got bounds from {lower:g} to {upper:g}, expected lower below upper")
    if math.isinf(lower) != math.isinf(upper):
        raise ValueError(f"{where}: got one bound, expected both or none")
    if kind.logarithmic and not lower > 0.0:
        raise ValueError(f"{where}.lower: got {lower:g}, expected a number above 0 (its logarithm is fitted)")
    if kind.high < math.inf and not (lower >= kind.low and upper <= kind.high):
        expected = f"them from {kind.low:g} to {kind.high:g}"
        raise ValueError(f"{where}: got bounds from {lower:g} to {upper:g}, expected {expected}")
    outside = ~((start >= lower) & (start <= upper))
    if outside.any():
        got = float(start[outside].reshape(-1)[0])
        raise ValueError(f"{where}.start: got {got:g}, expected from {lower:g} to {upper:g}")
    if asked.learning_rate is not None:
        check_number(f"{where}.learning_rate", asked.learning_rate, above=0.0)
    _check_map_options(asked, per, cameras, where)
    unit = 1.0 if kind.logarithmic else kind.unit * (size if kind.is_length else 1.0)
    return FittedParameter(
        parameter=parameter,
        start=start,
        lower=lower,
        upper=upper,
        per=per,
        unit=unit,
        learning_rate=asked.learning_rate,
        smoothness=float(asked.smoothness),
        levels=asked.levels,
    )


def _check_map_options(asked: FitParameter, per: Per, cameras: Sequence[Camera], where: str) -> None:
    check_number(f"{where}.smoothness", asked.smoothness, 0.0)
    if asked.smoothness and per not in ("pixel", "vertex"):
        raise ValueError(f'{where}.smoothness: got it with one value per {per}, expected per "pixel" or "vertex"')
    levels = check_whole(f"{where}.levels", asked.levels, 1)
    if levels > 1 and per != "pixel":
        raise ValueError(f'{where}.levels: got {levels} with one value per {per}, expected per "pixel"')
    most = int(math.log2(max(cameras[0].size))) + 1
    if levels > most:
        raise ValueError(f"{where}.levels: got {levels}, expected up to {most} for an image of this size")


def _start(
    scene: Scene, cameras: Sequence[Camera], parameter: Parameter, asked: FitParameter, where: str
) -> tuple[np.ndarray, Per]:
    given = scene.own_value(parameter.name) if asked.start is None else asked.start
    if given is None:
        raise ValueError(f"{where}.start: got none, expected a number (the objects' thicknesses differ)")
    kind = kind_of(given)
    try:
        value = np.array(given if kind is None else kind.to_numpy(given), dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{where}.start: got {shorten(asked.start)}, expected numbers") from None
    if not np.isfinite(value).all():
        raise ValueError(f"{where}.start: got a value that is not finite, expected finite numbers")
    shapes = parameter.shapes(cameras[0].shape, len(cameras))
    if asked.per is not None and asked.per not in shapes:
        expected = " or ".join(f'"{per}"' for per in shapes)
        raise ValueError(f"{where}.per: got {shorten(asked.per)}, expected {expected} for a {parameter.kind.key}")
    if asked.per is None:
        for per, shape in shapes.items():
            if value.shape == shape:
                return value, per
        words = " or ".join(str(shape) for shape in shapes.values())
        raise ValueError(f"{where}.start: got shape {value.shape}, expected shape {words}")
    shape = shapes[asked.per]
    if asked.per == "pixel" and len({camera.size for camera in cameras}) > 1:
        raise ValueError(f'{where}.per: got "pixel" with views of different sizes, expected one size')
    # One value, or one colour, stands for all vertices or pixels; one map for those of all views.
    stacked = asked.per == "view" or len(shape) == 3
    if value.shape not in (shape, shape[1:] if stacked else shape, next(iter(shapes.values()))):
        raise ValueError(f"{where}.start: got shape {value.shape}, expected shape {shape}")
    return np.broadcast_to(value, shape).copy(), asked.per


def _default_bounds(scene: Scene, parameter: Parameter, size: float) -> tuple[float, float]:
    kind = parameter.kind
    if kind.bounds is None:
        return -math.inf, math.inf
    lower, upper = kind.bounds
    if not kind.is_length:
        return lower, upper
    lower, upper = lower * size, upper * size
    items = owners(scene, parameter)
    if not items or items[0].thickness_unit != "P":
        return lower, upper
    # In multiples of P(z) at the objects' middle.
    camera = scene.camera
    vertices = [item.world_vertices() for item in items if len(item.vertices)]
    middle = np.concatenate(vertices).mean(axis=0) if vertices else np.asarray(camera.target)
    z = max(float((camera.view_matrix()[:3, :3] @ (middle - np.asarray(camera.eye)))[2]), camera.near)
    resolution = float(z_resolution(z, camera.near, camera.far, orthographic=not camera.is_perspective))
    return lower / resolution, upper / resolution


def value_wording(value: Any) -> str:
    """Word a parameter's value shortly: a number, a few numbers, or the mean of many."""
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 0:
        return f"{float(array):.4g}"
    if array.size <= 3:
        return "(" + ", ".join(f"{part:.3g}" for part in array.reshape(-1)) + ")"
    return f"mean {array.mean():.4g}"


def values_wording(values: Mapping[str, Any]) -> str:
    """Word the values of several parameters on one line."""
    return ", ".join(f"{name} {value_wording(value)}" for name, value in values.items())


def component_names(parameters: Sequence[FittedParameter]) -> list[str]:
    """Return a name for each number: "ball.color[0]" for the first of a colour."""
    names: list[str] = []
    for each in parameters:
        single = each.start.ndim == 0
        names += [each.name] if single else [f"{each.name}[{index}]" for index in range(each.start.size)]
    return names
