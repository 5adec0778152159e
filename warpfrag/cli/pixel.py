"""`warpfrag inspect`: what one pixel of a scene is made of."""

import re
from pathlib import Path
from typing import Annotated

import typer

from warpfrag.cli.options import (
    BetaOption,
    DeviceOption,
    LayersOption,
    MergeOption,
    MixOption,
    ParametersOption,
    SceneArgument,
    SetOption,
    SizeOption,
    UsageError,
    VerboseOption,
    parse_device,
    read_scene,
)
from warpfrag.cli.streams import start_warp
from warpfrag.errors import shorten

_PIXEL = re.compile(r"(\d{1,5})\s*,\s*(\d{1,5})")


def inspect(
    scene: SceneArgument,
    pixel: Annotated[str, typer.Option("--pixel", metavar="X,Y", help="Column and row, from the top left, 0 first.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.png", help="The plot [SCENE_X_Y.png].")
    ] = None,
    beta: BetaOption = None,
    layers: LayersOption = None,
    merge: MergeOption = None,
    mix: MixOption = None,
    size: SizeOption = None,
    parameters: ParametersOption = None,
    settings: SetOption = None,
    device: DeviceOption = None,
    verbose: VerboseOption = False,
) -> None:
    """List the fragments of one pixel, and draw them with the absorbance along its ray, before and after merging."""
    start_warp(verbose)
    from warpfrag.analysis.pixel import inspect_pixel
    from warpfrag.files.images import check_target

    match = _PIXEL.fullmatch(pixel.strip())
    if match is None:
        raise UsageError(f"--pixel: got {shorten(pixel)}, expected column and row such as 320,240")
    column, row = int(match[1]), int(match[2])
    name = Path(scene.removeprefix("example:")).stem
    target = output if output is not None else Path(f"{name}_{column}_{row}.png")
    if target.suffix.lower() != ".png":
        raise UsageError(f"{target}: got the suffix {target.suffix or '(none)'}, expected .png")
    check_target(target)
    place = parse_device(device)
    wanted = read_scene(scene, parameters, settings, beta=beta, layers=layers, merge=merge, mix=mix, size=size)
    inspection = inspect_pixel(wanted, column, row, place)
    inspection.draw(target)
    for line in inspection.lines():
        print(line)
    print(f"plot in {target}")
