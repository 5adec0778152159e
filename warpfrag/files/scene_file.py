"""Scene files: TOML to `Scene`.

Lengths are in scene units, angles in degrees, colours straight linear RGB in 0…1 or `"#rrggbb"` in sRGB.

Top level: `beta layers merge mix background` and the tables `[camera]`, `[light]`, `[[object]]`.

- `[camera]`: `eye target up fov | height near far size`, as in `Camera`.
- `[light]`: `direction` (towards the light, or `"camera"`: from the eye of the camera that renders, the default) and
  `ambient` (0.3). The colour of each vertex is multiplied by ambient + (1 − ambient)·|n·l|, wherever objects and camera
  have been moved to. Without the table all is unlit.
- `[[object]]`: see `scene_objects`.
"""

import os
from dataclasses import replace
from typing import Any

from warpfrag.errors import SceneError, shorten
from warpfrag.files.examples import example_path
from warpfrag.files.scene_objects import read_objects
from warpfrag.files.table import Table, is_numbers, read_toml
from warpfrag.scene.camera import Camera
from warpfrag.scene.light import Light
from warpfrag.scene.names import MERGES, MIXES
from warpfrag.scene.scene import Scene

_TOP = ("beta", "layers", "merge", "mix", "background", "camera", "light", "object")
CAMERA_KEYS = ("eye", "target", "up", "fov", "height", "near", "far", "size")
# Of an image's side, and of all of it: 4 GiB as float32 RGBA.
MOST_PIXELS, MOST_IMAGE_PIXELS = 65536, 2**28


def load_scene(path: str | os.PathLike) -> Scene:
    """Read a scene file.

    Args:
        path: a TOML file, or `"example:<name>"` for one that comes with the package. The files it names lie in its
            folder or below, unless their path is absolute.

    Raises:
        SceneError: anything in the file, or a file it names, that cannot be used: file, key, what was got, what is
            expected.
        ImportError: a mesh needs a reader that is not installed.

    Example:
        >>> load_scene("scenes/bunny_in_sphere.toml").beta
        0.5
    """
    path = example_path(path)
    top = Table(read_toml(path), path, "", _TOP)
    camera = _camera(top)
    values: dict[str, Any] = {
        "beta": top.number("beta", 0.0, 1.0),
        "layers": top.integer("layers", 1, 2**31 - 1),
        "merge": top.choice("merge", MERGES),
        "mix": top.choice("mix", MIXES),
        "background": _background(top),
    }
    values["light"] = _light(top)
    return Scene(camera, read_objects(top), **{key: value for key, value in values.items() if value is not None})


def _camera(top: Table) -> Camera:
    table = top.table("camera", CAMERA_KEYS)
    if table is None:
        raise top.error("camera", "none", "a table [camera] with eye, target and fov or height")
    for key in ("eye", "target"):
        if key not in table:
            raise table.error(key, "none", "3 numbers")
    return read_camera(table)


def _light(top: Table) -> Light | None:
    table = top.table("light", ("direction", "ambient"))
    if table is None:
        return None
    direction, ambient = table.data.get("direction", "camera"), table.number("ambient", 0.0, 1.0)
    if direction != "camera" and (not is_numbers(direction, 3) or not any(direction)):
        raise table.error("direction", shorten(direction), '3 numbers that are not all 0, or "camera"')
    given: dict[str, Any] = {} if ambient is None else {"ambient": ambient}
    return Light(None if direction == "camera" else tuple(direction), **given)


def read_camera(table: Table, base: Camera | None = None) -> Camera:
    """Read a camera from the keys of a table.

    Args:
        table: a table with some of `CAMERA_KEYS`.
        base: the camera whose values stand for those that the table does not give; None takes the defaults.

    Raises:
        SceneError: a value of the wrong type or out of its range.
    """
    values: dict[str, Any] = {key: table.numbers(key, 3, "3 numbers") for key in ("eye", "target", "up")}
    values.update({key: table.number(key) for key in ("fov", "height", "near", "far")})
    values["size"] = read_size(table)
    values = {key: value for key, value in values.items() if value is not None}
    # One of the two kinds of camera takes the place of the other.
    for key, other in (("fov", "height"), ("height", "fov")):
        if base is not None and key in values and other not in values:
            values[other] = None
    try:
        return Camera(**values) if base is None else replace(base, **values)
    except ValueError as error:
        raise SceneError(f"{table.file}: {' '.join(str(error).split())}") from None


def read_size(table: Table) -> tuple[int, int] | None:
    """Read `size`, width and height in pixels; None where it is absent.

    Raises:
        SceneError: it is not two whole numbers in range.
    """
    if "size" not in table:
        return None
    size = table.data["size"]
    whole = isinstance(size, list) and len(size) == 2 and all(type(part) is int for part in size)
    if not whole or not 1 <= min(size) <= max(size) <= MOST_PIXELS or size[0] * size[1] > MOST_IMAGE_PIXELS:
        limits = f"from 1 to {MOST_PIXELS}, up to {MOST_IMAGE_PIXELS} pixels in all"
        raise table.error("size", shorten(size), f"width and height, two whole numbers {limits}")
    return size[0], size[1]


def _background(top: Table) -> tuple[float, float, float, float] | None:
    """Read a background, straight in the file, as premultiplied RGBA."""
    value = top.color("background", 3, 4)
    if value is None:
        return None
    red, green, blue, alpha = [*value, 1.0][:4]
    return red * alpha, green * alpha, blue * alpha, alpha
