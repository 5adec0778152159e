"""What is fitted: its start and bounds, and the coordinates in which a method moves it.

Beta, opacities, colours, vertices and transforms are moved as they are, a thickness as its logarithm: a step then means
a factor, whatever the scene's unit, and a thickness cannot become negative. Bounds hold in both coordinates.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from warpfrag.errors import shorten, suggest
from warpfrag.scene.camera import Camera
from warpfrag.scene.depth_resolution import z_resolution
from warpfrag.scene.pose import CAMERA, POSE_KEYS
from warpfrag.scene.scene import Scene, SceneObject, multiple_of_p

Per = Literal["object", "vertex", "pixel", "view"]
PER = get_args(Per)

# Defaults of the bounds of a thickness, as shares of the diagonal of the scene's bounding box.
SMALLEST_THICKNESS = 1e-6
LARGEST_THICKNESS = 1.0
# One unit of a vertex or translation in a method's coordinates, as a share of the diagonal: they move less than colours
# do. One of a rotation is a radian.
VERTEX_UNIT = 0.1
# What moves surfaces or the camera: depths, and not only colours and thicknesses, depend on it.
MOTIONS = ("vertices", *POSE_KEYS)


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


@dataclass(frozen=True, eq=False)
class Variable:
    """A parameter with everything resolved against a scene and its views.

    Attributes:
        name: the parameter's name.
        start: where it starts, float64, of the shape the scene takes; maps and transforms of several views stacked.
        lower: lower bound, or -inf.
        upper: upper bound, or inf.
        per: what it has a value for.
        logarithm: whether methods move its logarithm.
        unit: size of one unit of a method's coordinate.
        learning_rate: Adam's step, None for the study's.
        smoothness: weight of the prior.
        levels: stages from coarse to fine.
    """

    name: str
    start: np.ndarray
    lower: float
    upper: float
    per: Per
    logarithm: bool
    unit: float
    learning_rate: float | None
    smoothness: float
    levels: int

    @property
    def key(self) -> str:
        """What it is: "beta", "thickness", "color" and so on."""
        return self.name.rpartition(".")[2]

    @property
    def owner(self) -> str:
        """The name of its object, "camera", or empty where it is the whole scene's."""
        return self.name.rpartition(".")[0]

    @property
    def is_global(self) -> bool:
        """Whether it is few values, for a whole object, scene or view."""
        return self.per in ("object", "view")

    @property
    def moves(self) -> bool:
        """Whether it moves surfaces or the camera."""
        return self.key in MOTIONS

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

    def in_view(self, value: Any, view: int) -> Any:
        """Return what of a value belongs to a view, given its place among the fitted ones."""
        stacked = self.per == "view" or (self.per == "pixel" and len(value.shape) == 3)
        return value[view] if stacked else value


def placed(variables: Sequence[Variable]) -> Iterator[tuple[Variable, slice]]:
    """Yield each variable with its place in the vector of all coordinates."""
    first = 0
    for variable in variables:
        yield variable, slice(first, first + variable.start.size)
        first += variable.start.size


def in_multiples_of_p(scene: Scene, values: Mapping[str, Any], where: str) -> tuple[Scene, dict[str, Any]]:
    """Turn values such as "2P" into numbers, and their objects into ones whose thickness is in multiples of P(z).

    Args:
        scene: the scene.
        values: by parameter name.
        where: what they are, for messages.

    Raises:
        ValueError: a text that is not such a multiple, or one that is not for a thickness.
    """
    result, objects = {}, list(scene.objects)
    for name, value in values.items():
        if isinstance(value, str):
            owner, _, key = name.rpartition(".")
            multiple = multiple_of_p(value) if key == "thickness" else None
            if multiple is None:
                expected = 'numbers or multiples of P(z) such as "2P"' if key == "thickness" else "numbers"
                raise ValueError(f"{where}.{name}: found {shorten(value)}, expected {expected}")
            value = multiple
            objects = [
                replace(item, thickness=value, thickness_unit="P")
                if owner in ("", item.name) and item.thickness_unit != "P"
                else item
                for item in objects
            ]
        result[name] = value
    return replace(scene, objects=objects), result


def thickness_units(scene: Scene, name: str) -> set[str]:
    """Return the units that a thickness is in: one, or those of several objects."""
    owner = name.rpartition(".")[0]
    return {item.thickness_unit for item in scene.objects if owner in ("", item.name)}


def resolve_parameters(
    scene: Scene, cameras: Sequence[Camera], parameters: Mapping[str, FitParameter]
) -> tuple[Variable, ...]:
    """Resolve parameters to fit against a scene.

    Args:
        scene: the scene.
        cameras: those of the views that are fitted.
        parameters: what to fit.

    Raises:
        ValueError: an unknown name, a start of the wrong shape, or one that is not between the bounds.
    """
    variables, size = [], extent(scene)
    for name, parameter in parameters.items():
        check_name(name, scene, "parameters")
        variables.append(_resolve(scene, cameras, size, name, parameter))
    if "thickness" in parameters and len({item.thickness_unit for item in scene.objects}) > 1:
        found = "objects with thicknesses in scene units and in multiples of P(z)"
        raise ValueError(f'parameters.thickness: found {found}, expected one unit (a start such as "2P" sets it)')
    return tuple(variables)


def check_name(name: str, scene: Scene, where: str) -> None:
    """Raise for a parameter that the scene does not have."""
    known = scene.parameter_names()
    if name not in known:
        raise ValueError(f"{where}: found the unknown name {shorten(name)}; {suggest(name, known)}")


def scene_value(scene: Scene, name: str) -> Any:
    """Return a parameter's value in a scene; None for a thickness of all objects that is not one value."""
    if name != "thickness":
        return scene.parameters()[name]
    values = [item.thickness for item in scene.objects]
    same = all(np.ndim(value) == 0 and value == values[0] for value in values)
    return values[0] if values and same else None


def find_object(scene: Scene, name: str) -> SceneObject:
    """Return the object that a parameter belongs to."""
    owner = name.rpartition(".")[0]
    return next(item for item in scene.objects if item.name == owner)


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


def _resolve(scene: Scene, cameras: Sequence[Camera], size: float, name: str, parameter: FitParameter) -> Variable:
    where = f"parameters.{name}"
    key = name.rpartition(".")[2]
    start, per = _start(scene, cameras, name, parameter, where)
    lower, upper = -math.inf, math.inf
    if key == "thickness":
        items = scene.objects if name == "thickness" else [find_object(scene, name)]
        lower, upper = _thickness_bounds(scene, items, size)
    elif key not in MOTIONS:
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
    _check_map_options(parameter, per, cameras, where)
    unit = {"vertices": VERTEX_UNIT * size, "translation": VERTEX_UNIT * size, "rotation": math.degrees(1.0)}
    return Variable(
        name=name,
        start=start,
        lower=lower,
        upper=upper,
        per=per,
        logarithm=key == "thickness",
        unit=unit.get(key, 1.0),
        learning_rate=rate,
        smoothness=float(parameter.smoothness),
        levels=parameter.levels,
    )


def _check_map_options(parameter: FitParameter, per: Per, cameras: Sequence[Camera], where: str) -> None:
    weight, levels = parameter.smoothness, parameter.levels
    if not (math.isfinite(weight) and weight >= 0.0):
        raise ValueError(f"{where}.smoothness: found {weight:g}, expected a number from 0")
    if weight and per not in ("pixel", "vertex"):
        raise ValueError(f'{where}.smoothness: found it with one value per {per}, expected per "pixel" or "vertex"')
    if isinstance(levels, bool) or not isinstance(levels, int) or levels < 1:
        raise ValueError(f"{where}.levels: found {shorten(levels)}, expected a whole number from 1")
    if levels > 1 and per != "pixel":
        raise ValueError(f'{where}.levels: found {levels} with one value per {per}, expected per "pixel"')
    most = int(math.log2(max(cameras[0].size))) + 1
    if levels > most:
        raise ValueError(f"{where}.levels: found {levels}, expected up to {most} for an image of this size")


def _start(
    scene: Scene, cameras: Sequence[Camera], name: str, parameter: FitParameter, where: str
) -> tuple[np.ndarray, Per]:
    key = name.rpartition(".")[2]
    given = scene_value(scene, name) if parameter.start is None else parameter.start
    if given is None:
        raise ValueError(f"{where}.start: found none, expected a number (the objects' thicknesses differ)")
    try:
        value = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{where}.start: found {shorten(parameter.start)}, expected numbers") from None
    if not np.isfinite(value).all():
        raise ValueError(f"{where}.start: found a value that is not finite, expected finite numbers")
    shapes = _shapes(scene, cameras, name, key)
    if parameter.per is not None and parameter.per not in shapes:
        expected = " or ".join(f'"{per}"' for per in shapes)
        raise ValueError(f"{where}.per: found {shorten(parameter.per)}, expected {expected} for a {key}")
    if parameter.per is None:
        for per, shape in shapes.items():
            if value.shape == shape:
                return value, per
        words = " or ".join(str(shape) for shape in shapes.values())
        raise ValueError(f"{where}.start: found shape {value.shape}, expected shape {words}")
    shape = shapes[parameter.per]
    if parameter.per == "pixel" and len({camera.size for camera in cameras}) > 1:
        raise ValueError(f'{where}.per: found "pixel" with views of different sizes, expected one size')
    # One value, or one colour, stands for all vertices or pixels; one map for those of all views.
    stacked = parameter.per == "view" or len(shape) == 3
    if value.shape not in (shape, shape[1:] if stacked else shape, next(iter(shapes.values()))):
        raise ValueError(f"{where}.start: found shape {value.shape}, expected shape {shape}")
    return np.broadcast_to(value, shape).copy(), parameter.per


def _shapes(scene: Scene, cameras: Sequence[Camera], name: str, key: str) -> dict[Per, tuple[int, ...]]:
    pixels = cameras[0].shape if len(cameras) == 1 else (len(cameras), *cameras[0].shape)
    if name in ("beta", "thickness"):
        return {"object": (), "pixel": pixels}
    if key in ("translation", "rotation"):
        by_view: dict[Per, tuple[int, ...]] = {"view": (len(cameras), 3)} if name.startswith(f"{CAMERA}.") else {}
        return {"object": (3,), **by_view}
    count = len(find_object(scene, name).vertices)
    if key == "vertices":
        return {"vertex": (count, 3)}
    last = (3,) if key == "color" else ()
    shapes: dict[Per, tuple[int, ...]] = {"object": last, "vertex": (count, *last)}
    if key == "thickness":
        shapes["pixel"] = pixels
    return shapes


def _thickness_bounds(scene: Scene, items: Sequence[SceneObject], size: float) -> tuple[float, float]:
    lower, upper = SMALLEST_THICKNESS * size, LARGEST_THICKNESS * size
    if items and items[0].thickness_unit == "P":
        # In multiples of P(z) at the objects' middle.
        camera = scene.camera
        vertices = [item.world_vertices() for item in items if len(item.vertices)]
        middle = np.concatenate(vertices).mean(axis=0) if vertices else np.asarray(camera.target)
        z = max(float((camera.view_matrix()[:3, :3] @ (middle - np.asarray(camera.eye)))[2]), camera.near)
        resolution = float(z_resolution(z, camera.near, camera.far))
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
