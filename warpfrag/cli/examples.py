"""`warpfrag examples`: the scenes and studies that come with the package."""

from pathlib import Path
from typing import Annotated

import typer

from warpfrag.cli.options import UsageError


def examples(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Which of them [all].", show_default=False)
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Copy them to this folder.")
    ] = None,
) -> None:
    """List the example scenes and studies, or copy them to a folder.

    Each can be used in place of a file: warpfrag render example:three_spheres -o out.png.
    """
    from warpfrag.files.examples import copy_examples, example_names, example_path, title_of

    known = example_names()
    for name in names or []:
        example_path(f"example:{name.removeprefix('example:')}")
    chosen = [name.removeprefix("example:") for name in names] if names else known
    if output is not None:
        for path in copy_examples(chosen, output):
            print(path)
        return
    if not chosen:
        raise UsageError("examples: got none in this installation, expected those of the wheel or of a clone")
    width = max(len(name) for name in chosen)
    for name in chosen:
        print(f"{name.ljust(width)}  {title_of(name)}".rstrip())
