"""`warpfrag render`: a scene to an image, flat or deep."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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

if TYPE_CHECKING:
    from warpfrag.scene.scene import Scene


def render(
    scene: SceneArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="A .png, .exr or .npy file; .deep.exr is deep.")
    ],
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
    method: Annotated[
        str | None, typer.Option(metavar="NAME", help="How to find fragments, such as f2b_2p; see warpfrag.storage.")
    ] = None,
    bits: Annotated[int, typer.Option(help="Bits per channel of a PNG file, 8 or 16.")] = 8,
    background: Annotated[
        str | None, typer.Option(metavar="COLOR", help='"#rrggbb[aa]" (sRGB), "r,g,b[,a]" (linear) or none.')
    ] = None,
    deep: Annotated[bool, typer.Option("--deep", help="Write all fragments: a deep .exr file.")] = False,
    parameters: ParametersOption = None,
    settings: SetOption = None,
    device: DeviceOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Render a scene to an image: PNG (sRGB), OpenEXR or .npy (linear, premultiplied) by suffix; deep to .deep.exr.

    With --show depth, normal, object_id or count OpenEXR and .npy hold the values themselves, and a PNG shows them as
    grey levels or colours, whose range is told.
    """
    start_warp(verbose)
    from warpfrag.capture.coverage import capture
    from warpfrag.files.deep_exr import check_deep_target, write_deep
    from warpfrag.files.images import check_target, write_image
    from warpfrag.files.value_images import write_values
    from warpfrag.render import render as render_scene

    deep = deep or output.name.lower().endswith(".deep.exr")
    drawn = {
        "resolve": resolve,
        "samples": None if samples == "1" else samples,
        "show": None if show == "color" else show,
    }
    if deep:
        check_deep_target(output)
        composited = {"beta": beta, "layers": layers, "merge": merge, "mix": mix, "background": background}
        _refuse({**composited, **drawn}, "with a deep image, expected it with a flat one, which is composited")
    else:
        check_target(output, bits=bits)
    if method is not None:
        _refuse(drawn, "with --method, expected one of the two")
    check_choice("--show", show, SHOWN, UsageError)
    options = {"samples": parse_whole("--samples", samples, 1), "resolve": resolve}
    on = parse_device(device)
    wanted = read_scene(scene, parameters, settings, beta=beta, layers=layers, merge=merge, mix=mix, size=size)
    if thickness is not None:
        wanted = replace(wanted, objects=[with_thickness(item, thickness) for item in wanted.objects])
    if background is not None:
        wanted = replace(wanted, background=parse_background(background))
    with _lack_of_memory(wanted):
        if deep:
            fragments = capture(wanted, method=method or "dfb", device=on)
        elif method is not None:
            image = _render_by(wanted, method, on)
        else:
            image = render_scene(wanted, output=show, device=on, **options)  # type: ignore[arg-type]
    if deep:
        write_deep(output, fragments)
    elif show == "color":
        write_image(output, image, bits=bits)
    elif told := write_values(output, show, image, bits=bits):
        print(told)


@contextmanager
def _lack_of_memory(scene: "Scene") -> Iterator[None]:
    """Say for what memory is lacking: Warp says how many bytes, not what for."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, MemoryError) or "allocate" in str(error):
            size = " × ".join(map(str, scene.camera.size))
            raise MemoryError(f"size: got {size} pixels, expected what fits into memory ({error})") from error
        raise


def _refuse(options: Mapping[str, Any], why: str) -> None:
    """Raise if one of the options is given."""
    for name, value in options.items():
        if value is not None:
            raise UsageError(f"--{name}: got it {why}")


def _render_by(scene: "Scene", method: str, device: str | None) -> Any:
    """Return the image of the fragments that a method captures."""
    from warpfrag.capture.coverage import capture
    from warpfrag.composite import composite
    from warpfrag.samples import over_background

    fragments = capture(scene, method=method, device=device)
    image = composite(fragments, scene.beta, max_layers=scene.layers, merge=scene.merge, mix=scene.mix)
    return over_background(image, scene.background)
