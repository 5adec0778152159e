"""Options that several commands have, and how their words are read: numbers, sizes, colours, NAME=VALUE."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from warpfrag.errors import range_wording, shorten, suggest

if TYPE_CHECKING:
    from warpfrag.scene.scene import Scene
    from warpfrag.scene.surface import SceneObject

_SIZE = re.compile(r"(\d{1,9})\s*[xX×]\s*(\d{1,9})")
_VERTICES = ".vertices"

SceneArgument = Annotated[
    str, typer.Argument(metavar="SCENE.toml", help="The scene, or example:NAME.", show_default=False)
]
BetaOption = Annotated[
    str | None, typer.Option("--beta", metavar="NUMBER", help="In-slab interpolation, 0 (optical) to 1 (linear).")
]
LayersOption = Annotated[
    str | None, typer.Option("--layers", metavar="NUMBER", help="Largest number of layers of a pixel.")
]
MergeOption = Annotated[str | None, typer.Option("--merge", help="none, smooth, order_independent or exact.")]
MixOption = Annotated[str | None, typer.Option("--mix", help="opacity, average or optical_depth.")]
SizeOption = Annotated[str | None, typer.Option("--size", metavar="WxH", help="Width and height in pixels.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Any parameter, such as ball.opacity=0.5; may be repeated."),
]
ResolveOption = Annotated[
    str | None, typer.Option("--resolve", help="sorted, or kbuffer: as submitted, into as many slots as layers.")
]
DeviceOption = Annotated[
    str | None, typer.Option("--device", metavar="DEVICE", help="Where to compute: cpu, cuda or cuda:NUMBER [cpu].")
]
ParametersOption = Annotated[
    Path | None, typer.Option("--parameters", metavar="FILE", help="The result.json of a fit, whose values to take.")
]
VerboseOption = Annotated[bool, typer.Option("--verbose", help="Show what Warp finds and compiles.")]


class UsageError(ValueError):
    """An option that cannot be used, in one line."""


def read_scene(
    path: str,
    parameters: Path | None,
    settings: Sequence[str] | None,
    *,
    beta: str | None = None,
    layers: str | None = None,
    merge: str | None = None,
    mix: str | None = None,
    size: str | None = None,
) -> "Scene":
    """Read a scene and apply the options that change it, later ones over earlier ones.

    Raises:
        UsageError: an option cannot be used.
        ValueError: the scene cannot be used, or a value is out of its range.
    """
    from warpfrag.files.scene_file import load_scene

    scene = load_scene(path)
    if parameters is not None:
        from warpfrag.files.result_file import read_found

        scene = scene.with_parameters(read_found(parameters, scene.parameter_names()))
    scene = _with_settings(scene, settings or [])
    changes: dict[str, Any] = {
        "beta": None if beta is None else parse_number("--beta", beta, 0.0, 1.0),
        "layers": None if layers is None else parse_whole("--layers", layers, 1),
        "merge": merge,
        "mix": mix,
        "camera": None if size is None else scene.camera.resized(parse_size(size)),
    }
    return replace(scene, **{key: value for key, value in changes.items() if value is not None})


def parse_number(option: str, text: str, low: float, high: float) -> float:
    """Read a number from `low` to `high`."""
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not low <= number <= high:
        raise UsageError(f"{option}: got {_shown(text)}, expected {range_wording(low, high)}")
    return number


def parse_whole(option: str, text: str, low: int) -> int:
    """Read a whole number of at least `low` that 32 bits hold."""
    digits = text.strip()
    if not (digits.isascii() and digits.isdecimal() and len(digits) < 11 and low <= int(digits) < 2**31):
        raise UsageError(f"{option}: got {_shown(text)}, expected {range_wording(low, whole=True)}")
    return int(digits)


def parse_device(text: str | None) -> str | None:
    """Read the name of a device of this machine; None stays. Warp must have been started."""
    from warpfrag.arrays.devices import check_device

    try:
        return check_device(text)
    except ValueError as error:
        raise UsageError(f"--{error}") from None


def parse_size(text: str) -> tuple[int, int]:
    """Read width and height such as 640x480."""
    from warpfrag.files.scene_file import MOST_IMAGE_PIXELS, MOST_PIXELS

    match = _SIZE.fullmatch(text.strip())
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (1 <= min(size) <= max(size) <= MOST_PIXELS and size[0] * size[1] <= MOST_IMAGE_PIXELS):
        limits = f"from 1 to {MOST_PIXELS} each and up to {MOST_IMAGE_PIXELS} pixels in all"
        raise UsageError(f'--size: got "{text}", expected width and height such as 640x480, {limits}')
    return size


def parse_background(text: str) -> tuple[float, float, float, float]:
    """Read a background as premultiplied linear RGBA."""
    from warpfrag.colors import parse_hex

    if text.strip().lower() == "none":
        return 0.0, 0.0, 0.0, 0.0
    expected = '"#rrggbb[aa]", "r,g,b[,a]" from 0 to 1, or none'
    color = list(parse_hex(text) or _numbers("--background", text, (3, 4), expected))
    if not all(0.0 <= part <= 1.0 for part in color):
        raise UsageError(f"--background: got {shorten(text)}, expected {expected}")
    red, green, blue, opacity = [*color, 1.0][:4]
    return red * opacity, green * opacity, blue * opacity, opacity


def parse_thickness(option: str, text: str) -> dict[str, Any]:
    """Read a z-thickness as the fields of an object that it changes."""
    from warpfrag.scene.parameters import multiple_of_p

    multiple = multiple_of_p(text)
    if multiple is not None:
        return {"thickness": multiple, "thickness_unit": "P"}
    number = _numbers(option, text, (1,), 'a number, or multiples of P(z) such as "2P"')[0]
    return {"thickness": number, "thickness_unit": "scene"}


def _with_settings(scene: "Scene", settings: Sequence[str]) -> "Scene":
    """Apply `NAME=VALUE`s: of one name the last, all at once, so that their order does not matter."""
    try:
        return scene.with_parameters(dict(_split(setting, scene) for setting in settings))
    except (ValueError, TypeError) as error:
        raise error if isinstance(error, UsageError) else UsageError(f"--set {error}") from None


def _split(setting: str, scene: "Scene") -> tuple[str, str]:
    """Divide NAME=VALUE; a name may have equals signs of its own."""
    known = [name for name in scene.parameter_names() if not name.endswith(_VERTICES)]
    if "=" not in setting:
        raise UsageError(f"--set: got {_shown(setting)}, expected NAME=VALUE")
    for name in sorted(known, key=len, reverse=True):
        rest = setting.strip().removeprefix(name).lstrip()
        if setting.strip().startswith(name) and rest.startswith("="):
            return name, rest[1:].strip()
    name = setting.partition("=")[0].strip()
    if name in scene.parameter_names():
        raise UsageError(f"--set: got {shorten(name)}, expected a parameter that one line holds")
    raise UsageError(f"--set: got the unknown name {shorten(name)}; {suggest(name, known)}")


def _numbers(option: str, text: str, counts: Sequence[int], expected: str) -> list[float]:
    from warpfrag.files.table import LARGEST

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) in counts and any(abs(number) > LARGEST for number in numbers):
        expected = f"{expected}, of at most {LARGEST:.3g}"
    elif len(numbers) in counts:
        return numbers
    raise UsageError(f"{option}: got {_shown(text)}, expected {expected}")


def _shown(text: str) -> str:
    """Word what was typed: a number as it stands, anything else in quotes."""
    try:
        float(text)
    except ValueError:
        return shorten(text)
    return text.strip()[:60]


def with_thickness(item: "SceneObject", text: str) -> "SceneObject":
    """Return an object with the z-thickness that `--thickness` gives."""
    return replace(item, **parse_thickness("--thickness", text))
