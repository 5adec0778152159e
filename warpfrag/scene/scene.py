"""What stands in a scene, and its parameters by name."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import kind_of
from warpfrag.errors import check_choice, check_number, check_whole, shorten
from warpfrag.scene.camera import Camera
from warpfrag.scene.light import Light, turned_normals
from warpfrag.scene.names import CAMERA, MERGES, MIXES, POSE_KEYS, Merge, Mix
from warpfrag.scene.parameters import BETA, COMMON_THICKNESS, VERTICES, Parameter, Thickness, check_name, describe
from warpfrag.scene.surface import SceneObject


@dataclass(repr=False)
class Scene:
    """A camera, the objects it sees, and how they are to be resolved.

    Attributes:
        camera: the view.
        objects: in submission order; their names are unique, and none is "camera".
        background: premultiplied linear RGBA behind everything, 4 numbers.
        beta: in-slab interpolation, 0 to 1.
        layers: largest number of layers of a pixel, from 1.
        merge: how overlapping fragments merge.
        mix: how their colours are weighted.
        light: what falls on objects that have normals; None leaves all unlit.

    Raises:
        TypeError: a value of the wrong kind.
        ValueError: two objects of one name, one named "camera", or a value out of its range.

    Example:
        >>> ball = wf.shapes.sphere(0.5).object("ball", color=(0.9, 0.2, 0.1), opacity=0.5, thickness=0.1)
        >>> floor = wf.shapes.plane((4, 4)).object("floor", rotate=(-90, 0, 0), translate=(0, -0.5, 0))
        >>> camera = wf.Camera.look_at((0, 1, 3), (0, 0, 0), fov=45.0, size=(320, 240))
        >>> wf.Scene(camera, [ball, floor], light=wf.Light((1, 2, 1)), background=(1, 1, 1, 1))
        Scene(320 × 240, objects: ball, floor)
    """

    camera: Camera
    objects: list[SceneObject] = field(default_factory=list)
    background: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    beta: float = 1.0
    layers: int = 8
    merge: Merge = "smooth"
    mix: Mix = "opacity"
    light: Light | None = None

    def __post_init__(self) -> None:
        self.objects = list(self.objects)
        repeated = [name for name, count in Counter(item.name for item in self.objects).items() if count > 1]
        if repeated:
            raise ValueError(f'objects: got the name "{repeated[0]}" more than once, expected unique names')
        if any(item.name == CAMERA for item in self.objects):
            raise ValueError('objects: got the name "camera", expected another (the camera\'s own parameters have it)')
        background = np.asarray(self.background, dtype=np.float64)
        if background.shape != (4,) or not np.isfinite(background).all() or background.min() < 0 or background[3] > 1:
            expected = "premultiplied RGBA: 4 numbers from 0, the last up to 1"
            raise ValueError(f"background: got {shorten(self.background)}, expected {expected}")
        red, green, blue, alpha = background.tolist()
        self.background = (red, green, blue, alpha)
        self.beta = check_number("beta", self.beta, BETA.low, BETA.high)
        self.layers = check_whole("layers", self.layers, 1)
        check_choice("merge", self.merge, MERGES)
        check_choice("mix", self.mix, MIXES)
        if self.light is not None and not isinstance(self.light, Light):
            raise TypeError(f"light: got {shorten(self.light)}, expected a Light or None")

    def __repr__(self) -> str:
        names = ", ".join(item.name for item in self.objects[:8]) + ", …" * (len(self.objects) > 8)
        width, height = self.camera.size
        return f"Scene({width} × {height}, objects: {names or 'none'})"

    def described(self) -> dict[str, Parameter]:
        """Return what is known of each parameter that `parameters=` takes, by name."""
        return describe(self.objects, self.camera)

    def parameters(self) -> dict[str, float | np.ndarray]:
        """Return what can be overridden, fitted or differentiated, by name.

        Returns:
            Floats and copies of arrays, safe to change: `"beta"`; for each object `"<name>.thickness"` (in the object's
            own `thickness_unit`), `".color"`, `".opacity"` and `".vertices"` (its own space); and as zeros
            `"<name>.translation"` [scene units] and `"<name>.rotation"` (rotation vector [degrees], about the middle of
            the bounding box of the object as it stands), along the world's axes, and `"camera.translation"` and
            `"camera.rotation"` (about the eye), along the camera's: right, down, forward.

        Example:
            >>> sorted(scene.parameters())[:4]
            ['ball.color', 'ball.opacity', 'ball.rotation', 'ball.thickness']
        """
        return {
            name: self._own_value(parameter)
            for name, parameter in self.described().items()
            if parameter.kind is not COMMON_THICKNESS
        }

    def parameter_names(self) -> set[str]:
        """Return all names that `parameters=` takes: those of `parameters()`, and `"thickness"` for all objects."""
        return set(self.described())

    def value_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of one value of each parameter, by name: () for a number."""
        return {name: parameter.kind.value_shape for name, parameter in self.described().items()}

    def own_value(self, name: str) -> float | np.ndarray | None:
        """Return one parameter's value, as `parameters` does; None for a common thickness where objects differ.

        Raises:
            ValueError: there is no parameter of this name.
        """
        parameter = check_name(name, self.described(), "parameters")
        if parameter.kind is not COMMON_THICKNESS:
            return self._own_value(parameter)
        values = [item.thickness for item in self.objects]
        alike = all(np.ndim(value) == 0 and value == values[0] for value in values)
        return values[0] if values and alike else None

    def with_parameters(self, values: Mapping[str, Any]) -> "Scene":
        """Return this scene with parameters built in: it renders as with `parameters=values`.

        Args:
            values: by the names of `parameters()`, and `"thickness"` for all objects without one among them: numbers,
                arrays, or texts such as "0.3", "2P", "#ff8000" or "0,90,0" (a text's thickness is in the unit it says).

        Raises:
            TypeError: a value that is no number, array or text.
            ValueError: an unknown name, a wrong shape, a value out of range.

        Example:
            >>> scene.with_parameters({"ball.thickness": "2P", "camera.rotation": (0, 10, 0)})
            Scene(512 × 512, objects: ball)
        """
        known, changes, moves, own = self.described(), {}, dict[str, Any](), dict[str, dict[str, Any]]()
        for name, value in values.items():
            parameter = check_name(name, known, "parameters")
            value = plain_value(parameter, value)
            if parameter.kind.field is None and parameter.kind is not COMMON_THICKNESS:
                moves.setdefault(parameter.owner, {})[parameter.kind.key] = value
            elif parameter.kind is BETA:
                changes.update(_fields(parameter, value))
            else:
                for owner in self._owners(parameter, values):
                    own.setdefault(owner, {}).update(_fields(parameter, value))
        objects = []
        for item in self.objects:
            changed = _changed(item, own[item.name]) if item.name in own else item
            # An object turns about the middle of what stands in this scene, whatever its vertices become.
            if item.name in moves:
                changed = changed.moved(*_pose(moves[item.name]), pivot=item.middle())
            objects.append(changed)
        camera = replace(self.camera, **own.get(CAMERA, {})) if CAMERA in own else self.camera
        if CAMERA in moves:
            camera = camera.moved(*_pose(moves[CAMERA]))
        return replace(self, objects=objects, camera=camera, **changes)

    def in_units_of(self, values: Mapping[str, Any], where: str = "parameters") -> tuple["Scene", dict[str, Any]]:
        """Turn texts among parameter values into numbers, and their objects into ones with thicknesses in that unit.

        Args:
            values: by name.
            where: what they are, for messages.

        Returns:
            The scene, in which only units (and with them values) of thicknesses differ, and the values.

        Raises:
            ValueError: a text that is not a value of its parameter.
        """
        if not any(isinstance(value, str) for value in values.values()):
            return self, dict(values)
        known, result, objects = self.described(), dict(values), list(self.objects)
        for name, text in values.items():
            if not isinstance(text, str):
                continue
            parameter = check_name(name, known, where)
            value = parameter.kind.read(f"{where}.{name}", text)
            if isinstance(value, Thickness):
                objects = [
                    replace(item, thickness=value.value, thickness_unit=value.unit)
                    if item.name in self._owners(parameter, values) and item.thickness_unit != value.unit
                    else item
                    for item in objects
                ]
                value = value.value
            result[name] = value
        return replace(self, objects=objects), result

    def _owners(self, parameter: Parameter, values: Mapping[str, Any]) -> list[str]:
        """Return whose a parameter is: that of all objects is no concern of those with one of their own."""
        if parameter.owner:
            return [parameter.owner]
        return [item.name for item in self.objects if f"{item.name}.{parameter.kind.key}" not in values]

    def _own_value(self, parameter: Parameter) -> float | np.ndarray:
        kind = parameter.kind
        if kind.field is None:
            return np.zeros(kind.value_shape, dtype=np.float32)
        owners: dict[str, Any] = {"": self, CAMERA: self.camera, **{item.name: item for item in self.objects}}
        value = getattr(owners[parameter.owner], kind.shown or kind.field)
        if np.ndim(value) == 0:
            return float(value)
        return np.array(value, dtype=np.float64 if getattr(value, "dtype", None) == np.float64 else np.float32)


def plain_value(parameter: Parameter, value: Any) -> Any:
    """Return a parameter's value as a float, a NumPy array or a `Thickness`, checked.

    Raises:
        TypeError: it is no number, array or text.
        ValueError: it has the wrong shape or is out of its range.
    """
    if isinstance(value, str):
        value = parameter.kind.read(parameter.name, value)
    number = value.value if isinstance(value, Thickness) else value
    kind = kind_of(number)
    try:
        array = np.asarray(number if kind is None else kind.to_numpy(number))
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "fiu":
        expected = "a number, an array or a text"
        raise TypeError(f"{parameter.name}: got {shorten(value)}, expected {expected}")
    parameter.check(array)
    if isinstance(value, Thickness):
        return value
    return float(array) if array.ndim == 0 else array


def _changed(item: SceneObject, fields: Mapping[str, Any]) -> SceneObject:
    """Return an object with other values, its normals turned as its surface is."""
    if item.normals is None or VERTICES.key not in fields:
        return replace(item, **fields)
    normals = turned_normals(item.normals, item.faces, item.vertices, fields[VERTICES.key])
    return replace(item, normals=normals, **fields)


def _fields(parameter: Parameter, value: Any) -> dict[str, Any]:
    """Return what of the owner's fields a value sets."""
    if isinstance(value, Thickness):
        return {"thickness": value.value, "thickness_unit": value.unit}
    return {parameter.kind.field or parameter.kind.key: value}


def _pose(motions: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    translation, rotation = (np.asarray(motions.get(key, (0.0, 0.0, 0.0)), dtype=np.float64) for key in POSE_KEYS)
    return translation, rotation
