"""`warpfrag render`: a scene to an image."""

from dataclasses import replace
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
    ResolveOption,
    SceneArgument,
    SetOption,
    SizeOption,
    UsageError,
    VerboseOption,
    parse_background,
    parse_device,
    parse_whole,
    read_scene,
    with_thickness,
)
from warpfrag.cli.streams import start_warp
from warpfrag.errors import check_choice

# What an image file holds of what `render` gives.
SHOWN = ("color", "depth", "normal", "object_id", "count")


def render(
    scene: SceneArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="A .png, .exr or .npy file.")],
    beta: BetaOption = None,
    thickness: Annotated[
        str | None,
        typer.Option(metavar="T", help='z-thickness of all objects: scene units, or "2P", multiples of P(z).'),
    ] = None,
    layers: LayersOption = None,
    merge: MergeOption = None,
    mix: MixOption = None,
    resolve: ResolveOption = None,
    size: SizeOption = None,
    samples: Annotated[
        str, typer.Option("--samples", metavar="NUMBER", help="Samples along each edge of a pixel (box filter).")
    ] = "1",
    show: Annotated[
        str, typer.Option("--show", metavar="OUTPUT", help="color, depth, normal, object_id or count (of layers).")
    ] = "color",
    bits: Annotated[int, typer.Option(help="Bits per channel of a PNG file, 8 or 16.")] = 8,
    background: Annotated[
        str | None, typer.Option(metavar="COLOR", help='"#rrggbb[aa]" (sRGB), "r,g,b[,a]" (linear) or none.')
    ] = None,
    parameters: ParametersOption = None,
    settings: SetOption = None,
    device: DeviceOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Render a scene to an image: PNG (sRGB), OpenEXR or .npy (linear, premultiplied) by suffix.

    With --show depth, normal, object_id or count OpenEXR and .npy hold the values themselves, and a PNG shows them as
    grey levels or colours, whose range is told.
    """
    start_warp(verbose)
    from warpfrag.files.images import check_target, write_image
    from warpfrag.files.value_images import write_values
    from warpfrag.render import render as render_scene

    check_target(output, bits=bits)
    check_choice("--show", show, SHOWN, UsageError)
    options = {"samples": parse_whole("--samples", samples, 1), "device": parse_device(device), "resolve": resolve}
    wanted = read_scene(scene, parameters, settings, beta=beta, layers=layers, merge=merge, mix=mix, size=size)
    if thickness is not None:
        wanted = replace(wanted, objects=[with_thickness(item, thickness) for item in wanted.objects])
    if background is not None:
        wanted = replace(wanted, background=parse_background(background))
    try:
        image = render_scene(wanted, output=show, **options)  # type: ignore[arg-type]
    except (RuntimeError, MemoryError) as error:
        # Warp says how many bytes it lacks, not what for.
        if isinstance(error, MemoryError) or "allocate" in str(error):
            size = " × ".join(map(str, wanted.camera.size))
            raise MemoryError(f"size: got {size} pixels, expected what fits into memory ({error})") from error
        raise
    if show == "color":
        write_image(output, image, bits=bits)
    elif told := write_values(output, show, image, bits=bits):
        print(told)
