"""`warpfrag render`: a scene to an image, flat or deep."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from warpfrag.cli.options import (
    BetaOption,
    LayersOption,
    MergeOption,
    MixOption,
    ParametersOption,
    SceneArgument,
    SetOption,
    SizeOption,
    UsageError,
    VerboseOption,
    parse_background,
    read_scene,
    with_thickness,
)
from warpfrag.cli.streams import start_warp

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
    size: SizeOption = None,
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
    verbose: VerboseOption = False,
) -> None:
    """Render a scene to an image: PNG (sRGB), OpenEXR or .npy (linear, premultiplied) by suffix; deep to .deep.exr."""
    start_warp(verbose)
    from warpfrag.capture.coverage import capture
    from warpfrag.files.deep_exr import check_deep_target, write_deep
    from warpfrag.files.images import check_target, write_image
    from warpfrag.render import render as render_scene

    deep = deep or output.name.lower().endswith(".deep.exr")
    if deep:
        check_deep_target(output)
        options = {"beta": beta, "layers": layers, "merge": merge, "mix": mix, "background": background}
        for name in (name for name, value in options.items() if value is not None):
            raise UsageError(f"--{name}: got it with a deep image, expected it with a flat one, which is composited")
    else:
        check_target(output, bits=bits)
    wanted = read_scene(scene, parameters, settings, beta=beta, layers=layers, merge=merge, mix=mix, size=size)
    if thickness is not None:
        wanted = replace(wanted, objects=[with_thickness(item, thickness) for item in wanted.objects])
    if background is not None:
        wanted = replace(wanted, background=parse_background(background))
    try:
        if deep:
            fragments = capture(wanted, method=method or "dfb")
        else:
            image = render_scene(wanted) if method is None else _render_by(wanted, method)
    except (RuntimeError, MemoryError) as error:
        # Warp says how many bytes it lacks, not what for.
        if isinstance(error, MemoryError) or "allocate" in str(error):
            size = " × ".join(map(str, wanted.camera.size))
            raise MemoryError(f"size: got {size} pixels, expected what fits into memory ({error})") from error
        raise
    if deep:
        write_deep(output, fragments)
    else:
        write_image(output, image, bits=bits)


def _render_by(scene: "Scene", method: str) -> Any:
    """Return the image of the fragments that a method captures."""
    from warpfrag.capture.coverage import capture
    from warpfrag.composite import composite
    from warpfrag.render import over_background

    fragments = capture(scene, method=method)
    image = composite(fragments, scene.beta, max_layers=scene.layers, merge=scene.merge, mix=scene.mix)
    return over_background(image, scene.background)
