"""Study files: TOML files that describe a `Study`.

scene = "../three_spheres.toml"       # relative to the study file
method = "least_squares"              # or "adam", "lbfgs"; loss, delta, scales, steps, patience, seed, restarts, …
size = [256, 256]                     # and merge, mix, layers: in place of the scene's own
resolve = "kbuffer"                   # how images come about; default "sorted"
loss = {l1 = 0.8, ssim = 0.2}         # or one of "l2", "l1", "huber", "ssim"

[reference]
true = {beta = 0.5, red.thickness = 0.15}     # a render of the scene with these values; or image = "photo.png"

[[view]]                              # further cameras, in place of the scene's own
name = "left"
eye = [-2.0, 0.5, 1.0]                # target, up, fov | height, near, far, size: the scene's, where not given
image = "left.png"                    # in place of [reference]
held_out = true                       # compared at the end, not fitted

[parameters]
beta = 0.9                                              # where to start
red.thickness = {start = 0.4, lower = 0.01, upper = 2}  # and between which bounds
green.thickness = {start = "2P", per = "pixel", smoothness = 0.01, levels = 3}
"""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from warpfrag.errors import SceneError, shorten
from warpfrag.files.images import ImageError, read_image
from warpfrag.files.scene_file import CAMERA_KEYS, load_scene, read_camera, read_size
from warpfrag.files.table import Table, is_number, is_numbers, read_toml
from warpfrag.fit.parameters import FitParameter, flatten_names
from warpfrag.fit.study import MOST_RESTARTS, MOST_SCALES, Method, Study
from warpfrag.fit.views import RENDER_OPTIONS, Reference, Resolve, StudyError, View
from warpfrag.scene.names import MERGES, MIXES
from warpfrag.scene.parameters import PER, Parameter, Thickness, check_name
from warpfrag.scene.scene import Scene

# Keys that are whole numbers, and between which.
_MOST_STEPS = 10**9
_INTEGERS = {
    "steps": (1, _MOST_STEPS),
    "seed": (0, 2**63 - 1),
    "restarts": (0, MOST_RESTARTS),
    "scales": (1, MOST_SCALES),
    "patience": (1, _MOST_STEPS),
    "batch": (1, _MOST_STEPS),
}
_NUMBERS = ("delta", "tolerance", "learning_rate", "checkpoint_seconds")
_TOP: tuple[str, ...] = ("scene", "size", "reference", "view", "parameters", "loss", "method", "resolve", "device")
_TOP += (*_INTEGERS, *_NUMBERS, *RENDER_OPTIONS)
_PARAMETER = ("start", "lower", "upper", "per", "learning_rate", "smoothness", "levels")


def load_study(path: str | os.PathLike, *, size: tuple[int, int] | None = None) -> Study:
    """Read a study file, the scene it names and its reference images.

    Args:
        path: a TOML file.
        size: width and height in place of those in the files, of every view.

    Raises:
        StudyError: anything in it that cannot be used: file, key, what was got, what is expected.
        SceneError: the same about the scene file.
        ImageError: a reference image cannot be read.

    Example:
        >>> load_study("scenes/studies/bunny_in_sphere.toml").method
        'least_squares'
    """
    path = Path(path)
    try:
        top = Table(read_toml(path), path, "", _TOP)
        scene = _scene(top, path, size)
        values: dict[str, Any] = {
            key: top.choice(key, get_args(kind)) for key, kind in (("method", Method), ("resolve", Resolve))
        }
        values |= {key: top.integer(key, *span) for key, span in _INTEGERS.items()}
        values |= {key: top.number(key, 0.0) for key in _NUMBERS}
        values["loss"] = top.data.get("loss")
        values["device"] = top.text("device")
        views = _views(top, path, scene, size)
        reference = None
        if "reference" in top or not views or any(view.reference is None for view in views):
            reference = _reference(top, path, scene)
        parameters = _parameters(top, scene)
    except ImageError:
        raise
    except SceneError as error:
        # What a scene file did wrong keeps its own class.
        raise error if not str(error).startswith(str(path)) else StudyError(str(error)) from None
    try:
        given = {key: value for key, value in values.items() if value is not None}
        return Study(scene, reference, parameters, views=views, name=path.stem, **given)
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
    given = read_size(top)
    size = size or given
    if size is not None:
        scene = replace(scene, camera=scene.camera.resized(size))
    overrides = {key: value for key, value in _render_options(top).items() if value is not None}
    return replace(scene, **overrides)


def _views(top: Table, path: Path, scene: Scene, size: tuple[int, int] | None) -> list[View]:
    given = top.data.get("view", [])
    if not isinstance(given, list) or not all(isinstance(entry, dict) for entry in given):
        raise top.error("view", shorten(given), "tables [[view]]")
    views = []
    for index, entry in enumerate(given):
        keys = ("name", "image", "held_out", *CAMERA_KEYS)
        table = Table(entry, path, f"view[{index}]", keys, str(entry.get("name", "")))
        camera = read_camera(table, scene.camera)
        if size is not None or ("size" in top and "size" not in table):
            camera = camera.resized(scene.camera.size)
        held_out = table.data.get("held_out", False)
        if not isinstance(held_out, bool):
            raise table.error("held_out", shorten(held_out), "true or false")
        image = table.text("image")
        reference = None if image is None else _image_reference(path.parent / image)
        views.append(View(camera, reference, table.text("name") or f"view_{index}", held_out))
    return views


def _image_reference(file: Path) -> Reference:
    return Reference(read_image(file), source=str(file))


def _render_options(table: Table) -> dict[str, Any]:
    return {
        "merge": table.choice("merge", MERGES),
        "mix": table.choice("mix", MIXES),
        "layers": table.integer("layers", 1, 2**31 - 1),
    }


def _reference(top: Table, path: Path, scene: Scene) -> Reference:
    table = top.table("reference", ("image", "true", "supersampling", *RENDER_OPTIONS))
    if table is None:
        raise top.error("reference", "none", "a table [reference] with image or true")
    if ("image" in table) == ("true" in table):
        got = "both image and true" if "image" in table else "neither image nor true"
        raise table.error("", got, "one of them")
    options = _render_options(table)
    options["supersampling"] = table.integer("supersampling", 1, 64)
    options = {key: value for key, value in options.items() if value is not None}
    if "image" in table:
        if options:
            raise table.error(next(iter(options)), "it with an image", "it with true (it belongs to a render)")
        return _image_reference(path.parent / str(table.text("image")))
    true = table.data["true"]
    if not isinstance(true, dict):
        raise table.error("true", shorten(true), "a table of parameter names and values")
    true = flatten_names(true, scene)
    known, values = scene.described(), {}
    for name, value in true.items():
        parameter = _parameter(name, known, table.file, "reference.true")
        values[name] = _value(table, f"true.{name}", parameter, value)
    return Reference(true=values, **options)


def _parameters(top: Table, scene: Scene) -> dict[str, FitParameter]:
    table = top.data.get("parameters")
    if not isinstance(table, dict) or not table:
        got = "none" if not table else shorten(table)
        raise top.error("parameters", got, "a table [parameters] of names and start values")
    known, result = scene.described(), {}
    for name, given in flatten_names(table, scene).items():
        parameter = _parameter(name, known, top.file, "parameters")
        if not isinstance(given, dict):
            given = {"start": given}
        entry = Table(given, top.file, f"parameters.{name}", _PARAMETER)
        start = None if "start" not in entry else _value(entry, "start", parameter, given["start"])
        lower, upper = entry.number("lower"), entry.number("upper")
        per: Any = entry.choice("per", PER)
        result[name] = FitParameter(
            start=start,
            lower=lower,
            upper=upper,
            per=per,
            learning_rate=entry.number("learning_rate", above=0.0),
            smoothness=entry.number("smoothness", 0.0) or 0.0,
            levels=entry.integer("levels", 1, 64) or 1,
        )
    return result


def _parameter(name: str, known: Mapping[str, Parameter], file: Any, where: str) -> Parameter:
    try:
        return check_name(name, known, where)
    except ValueError as error:
        raise SceneError(f"{file}: {error}") from None


def _value(table: Table, key: str, parameter: Parameter, value: Any) -> Any:
    """Return a value from a file: a number, numbers, a colour "#rrggbb", or a thickness "2P", which stays a text."""
    kind = parameter.kind
    if isinstance(value, str):
        parsed = kind.parse(value)
        if parsed is not None:
            return value if isinstance(parsed, Thickness) else parsed
    if is_number(value) and not kind.value_shape:
        return float(value)
    if isinstance(value, list) and _is_numeric(value):
        return np.asarray(value, dtype=np.float64)
    raise table.error(key, shorten(value), kind.text)


def _is_numeric(value: list) -> bool:
    if all(isinstance(part, list) for part in value):
        return bool(value) and len({len(part) for part in value}) == 1 and all(is_numbers(p, len(p)) for p in value)
    return is_numbers(value, len(value))
