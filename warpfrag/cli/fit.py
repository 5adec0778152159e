"""`warpfrag fit`: the parameters of a scene from images, or whole studies."""

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from warpfrag.cli.options import (
    DeviceOption,
    ParametersOption,
    SizeOption,
    UsageError,
    VerboseOption,
    parse_device,
    parse_size,
    parse_whole,
)
from warpfrag.cli.streams import complain, start_warp
from warpfrag.cli.studies import run_studies

if TYPE_CHECKING:
    from warpfrag.fit.session import Progress
    from warpfrag.fit.study import Study


def fit(
    study: Annotated[
        str | None,
        typer.Argument(metavar="STUDY", help="A study file, or a folder with a study.py.", show_default=False),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Run every study's folder and write one report.")] = False,
    source: Annotated[
        Path | None, typer.Option("--from", metavar="DIR", help="Folder of --all's studies [experiments/fit].")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder of the results [results/STUDY], or of the report [results/fit].",
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in the folder.")] = False,
    steps: Annotated[
        str | None, typer.Option("--steps", metavar="NUMBER", help="Most steps, in place of the study's.")
    ] = None,
    size: SizeOption = None,
    parameters: ParametersOption = None,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Log each step to the folder tensorboard in that of the results.")
    ] = False,
    device: DeviceOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Fit the parameters of a scene to an image; write images, plots, result.json and a checkpoint to a folder.

    With --all, or a folder in place of a study file, whole studies run: each rewrites the numbers of its README, and
    report.html shows them all. With --parameters the fit starts where another one ended.
    """
    if every == (study is not None):
        got = "both STUDY and" if every else "neither STUDY nor"
        raise UsageError(f"fit: got {got} --all, expected one of them")
    if source is not None and not every:
        raise UsageError("--from: got it without --all, expected both")
    options: dict[str, Any] = {"--resume": resume, "--steps": steps, "--size": size}
    options |= {"--parameters": parameters, "--tensorboard": tensorboard, "--device": device}
    if study is None or Path(study).is_dir():
        for option, value in options.items():
            if value not in (None, False):
                raise UsageError(f"{option}: got it with {study or '--all'}, expected it with a study file only")
        run_studies(None if study is None else Path(study), source, output)
        return
    start_warp(verbose)
    wanted = _read_study(study, size, steps, parameters, parse_device(device))
    folder = output if output is not None else Path("results") / wanted.name
    again = _command(study, output, options)
    result = _run(wanted, folder, again, resume=resume, tensorboard=tensorboard)
    if result is not None:
        for line in result.lines():
            print(line)
        print(f"results in {folder}")


def _read_study(path: str, size: str | None, steps: str | None, parameters: Path | None, device: str | None) -> "Study":
    from warpfrag.files.examples import example_path
    from warpfrag.files.result_file import read_found
    from warpfrag.fit import load_study

    study = load_study(example_path(path), size=None if size is None else parse_size(size), device=device)
    if steps is not None:
        study = replace(study, steps=parse_whole("--steps", steps, 1))
    if parameters is not None:
        found = read_found(parameters, study.scene.parameter_names())
        unknown = [name for name in found if name not in study.parameters]
        if unknown:
            fitted = ", ".join(study.parameters)
            raise UsageError(f'{parameters}: got "{unknown[0]}", expected values of what the study fits: {fitted}')
        starts = {
            name: replace(each, start=found[name]) if name in found else each for name, each in study.parameters.items()
        }
        study = replace(study, parameters=starts)
    return study


def _run(study: "Study", folder: Path, again: str, *, resume: bool, tensorboard: bool) -> Any:
    """Run a fit; return its result, None in processes that are not the first."""
    from warpfrag.fit import fit as fit_study
    from warpfrag.fit.processes import is_first_process
    from warpfrag.fit.session import CHECKPOINT

    try:
        log = folder / "tensorboard" if tensorboard and is_first_process() else None
        with _logged(study.name, log) as progress:
            result = fit_study(study, resume=resume, output=folder, progress=progress)
    except KeyboardInterrupt:
        if not is_first_process():
            raise typer.Exit(130) from None
        if not (folder / CHECKPOINT).is_file():
            raise typer.Exit(complain("stopped before the first checkpoint", 130)) from None
        raise typer.Exit(complain(f"stopped; go on with: {again} --resume", 130)) from None
    return result if is_first_process() else None


def _command(study: str, output: Path | None, options: dict[str, Any]) -> str:
    """Word the command that goes on with a fit, so that a shell takes it as it is."""
    words = ["warpfrag", "fit", study, *(["-o", str(output)] if output else [])]
    for option, value in options.items():
        if value not in (None, False) and option != "--resume":
            words += [option] if value is True else [option, str(value)]
    return shlex.join(words)


@contextmanager
def _logged(name: str, log: Path | None) -> "Iterator[Callable[[Progress], None] | bool]":
    """Yield what a fit reports to: its own progress bar, or one and a TensorBoard log."""
    if log is None:
        yield True
        return
    from warpfrag.fit.progress import progress_bar
    from warpfrag.fit.tensorboard import TensorBoard

    with TensorBoard(log) as board, progress_bar(name) as bar:

        def show(progress: "Progress") -> None:
            bar(progress)
            board(progress)

        yield show
