"""`warpfrag flatten`: a deep image to one that is flat."""

from pathlib import Path
from typing import Annotated

import typer

from warpfrag.cli.options import BetaOption, VerboseOption, parse_background, parse_number
from warpfrag.cli.streams import start_warp


def flatten(
    file: Annotated[Path, typer.Argument(metavar="DEEP.exr", help="A deep OpenEXR file.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="A .png, .exr or .npy file.")],
    beta: BetaOption = None,
    merge: Annotated[str, typer.Option(help="none, smooth, order_independent or exact.")] = "exact",
    mix: Annotated[str, typer.Option(help="opacity, average or optical_depth.")] = "optical_depth",
    background: Annotated[
        str | None, typer.Option(metavar="COLOR", help='"#rrggbb[aa]" (sRGB), "r,g,b[,a]" (linear) or none.')
    ] = None,
    bits: Annotated[int, typer.Option(help="Bits per channel of a PNG file, 8 or 16.")] = 8,
    verbose: VerboseOption = False,
) -> None:
    """Composite a deep OpenEXR file to a flat image; by default as OpenEXR says: cut, mixed by optical depth, over."""
    start_warp(verbose)
    from warpfrag.composite import composite
    from warpfrag.files.deep_exr import read_deep
    from warpfrag.files.images import check_target, write_image
    from warpfrag.render import over_background

    check_target(output, bits=bits)
    number = 0.0 if beta is None else parse_number("--beta", beta, 0.0, 1.0)
    image = composite(read_deep(file), number, merge=merge, mix=mix)  # type: ignore[arg-type]
    if background is not None:
        image = over_background(image, parse_background(background))
    write_image(output, image, bits=bits)
