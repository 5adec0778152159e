"""`warpfrag merge`: deep images put together into one."""

from pathlib import Path
from typing import Annotated

import typer

from warpfrag.cli.options import UsageError, VerboseOption
from warpfrag.cli.streams import start_warp


def merge(
    files: Annotated[list[Path], typer.Argument(metavar="DEEP.exr...", help="Deep OpenEXR files of one size.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="A deep .exr file.")],
    half: Annotated[bool, typer.Option("--half", help="Store colours and opacity in half precision.")] = False,
    verbose: VerboseOption = False,
) -> None:
    """Put deep OpenEXR files together: all their samples, sorted by depth; texts and numbers are those of the first."""
    start_warp(verbose)
    from warpfrag.deep import concat, tidy
    from warpfrag.files.deep_exr import check_deep_target, read_attributes, read_deep, write_deep

    check_deep_target(output)
    images = [read_deep(file) for file in files]
    for file, image in zip(files, images, strict=True):
        if image.shape != images[0].shape:
            got, expected = (f"{width} × {height}" for height, width in (image.shape, images[0].shape))
            raise UsageError(f"{file}: got {got} pixels, expected {expected} like {files[0]}")
    write_deep(output, tidy(concat(*images)), half=half, attributes=read_attributes(files[0]))
