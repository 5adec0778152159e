"""The command line: `warpfrag render`, `warpfrag fit` and `warpfrag inspect`.

Whatever goes wrong is one line on standard error and exit status 2; Ctrl-C is 130. `WARPFRAG_TRACEBACK=1` lets Python's
traceback through. Everything heavy is imported by the command that needs it, so that `--help` is quick.
"""

import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from warpfrag.fit.session import Progress
    from warpfrag.scene.scene import Scene
    from warpfrag.scene.surface import SceneObject

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="A differentiable multi-fragment compositor: renders scenes and fits their parameters to images.",
)

_SIZE = re.compile(r"(\d{1,5})[xX×](\d{1,5})")
_PIXEL = re.compile(r"(\d{1,5})\s*,\s*(\d{1,5})")

SizeOption = Annotated[str | None, typer.Option("--size", metavar="WxH", help="Width and height in pixels.")]


class UsageError(ValueError):
    """An option that cannot be used, in one line."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status.

    Args:
        arguments: the words after the program's name; None takes those of the process.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return int(_command()(words or ["--help"]) or 0)
    except KeyboardInterrupt:
        return _complain("stopped", 130)
    except Exception as error:
        if os.environ.get("WARPFRAG_TRACEBACK"):
            raise
        # Typer's own errors word themselves without their class.
        words_of = getattr(error, "format_message", None)
        text = words_of() if callable(words_of) else str(error) or type(error).__name__
        expected = isinstance(error, (ValueError, TypeError, ImportError, OSError, MemoryError)) or callable(words_of)
        return _complain(text if expected else f"{type(error).__name__}: {text}", 2)


def _command() -> Callable[[list[str]], Any]:
    command = typer.main.get_command(app)
    return lambda words: command.main(words, prog_name="warpfrag", standalone_mode=False)


def _complain(text: str, status: int) -> int:
    print(f"warpfrag: {' '.join(text.split())}", file=sys.stderr)
    return status


def _quiet() -> None:
    """Keep Warp's notes about devices and compiled modules to itself; must come before its first use."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    # That there is no GPU is told by Warp's native half, straight to the file descriptor: no matter for a warning.
    sys.stderr.flush()
    before = os.dup(2)
    with tempfile.TemporaryFile() as told:
        os.dup2(told.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(before, 2)
            os.close(before)
        told.seek(0)
        lines = told.read().decode(errors="replace").splitlines()
    print(*(line + "\n" for line in lines if "NVIDIA CUDA driver" not in line), sep="", end="", file=sys.stderr)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"warpfrag {version('warpfrag')}")
        raise typer.Exit


@app.callback()
def _root(
    show: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


@app.command()
def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="The scene.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="A .png, .exr or .npy file.")],
    beta: Annotated[float | None, typer.Option(help="In-slab interpolation, 0 (optical) to 1 (linear).")] = None,
    thickness: Annotated[
        str | None,
        typer.Option(metavar="T", help='z-thickness of all objects: scene units, or "2P", multiples of P(z).'),
    ] = None,
    layers: Annotated[int | None, typer.Option(help="Largest number of layers of a pixel.")] = None,
    merge: Annotated[str | None, typer.Option(help="none, smooth, order_independent or exact.")] = None,
    mix: Annotated[str | None, typer.Option(help="opacity, average or optical_depth.")] = None,
    size: SizeOption = None,
    bits: Annotated[int, typer.Option(help="Bits per channel of a PNG file, 8 or 16.")] = 8,
    background: Annotated[
        str | None, typer.Option(metavar="COLOR", help='"#rrggbb[aa]" (sRGB), "r,g,b[,a]" (linear) or none.')
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any parameter, such as ball.opacity=0.5; may be repeated."),
    ] = None,
) -> None:
    """Render a scene to an image: PNG (sRGB), OpenEXR or .npy (linear, premultiplied) by suffix."""
    _quiet()
    from warpfrag.files.images import check_target, write_image
    from warpfrag.files.scene_file import load_scene
    from warpfrag.render import render as render_scene

    check_target(output, bits=bits)
    wanted = load_scene(scene)
    wanted = _set_all(wanted, settings or [])
    if thickness is not None:
        changed = [_with_thickness(item, "--thickness", thickness) for item in wanted.objects]
        wanted = replace(wanted, objects=changed)
    changes: dict[str, Any] = {"beta": beta, "layers": layers, "merge": merge, "mix": mix}
    changes = {key: value for key, value in changes.items() if value is not None}
    if background is not None:
        changes["background"] = _background(background)
    if size is not None:
        changes["camera"] = wanted.camera.resized(_parse_size(size))
    write_image(output, render_scene(replace(wanted, **changes)), bits=bits)


@app.command()
def fit(
    study: Annotated[
        Path | None,
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
    steps: Annotated[int | None, typer.Option(help="Most steps, in place of the study's.")] = None,
    size: SizeOption = None,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Log each step to the folder tensorboard in that of the results.")
    ] = False,
) -> None:
    """Fit the parameters of a scene to an image; write images, plots, result.json and a checkpoint to a folder.

    With --all, or a folder in place of a study file, whole studies run: each rewrites the numbers of its README, and
    report.html shows them all.
    """
    if every == (study is not None):
        found = "both STUDY and" if every else "neither STUDY nor"
        raise UsageError(f"fit: found {found} --all, expected one of them")
    if source is not None and not every:
        raise UsageError("--from: found it without --all, expected both")
    if study is None or study.is_dir():
        given = {"--resume": resume, "--steps": steps, "--size": size, "--tensorboard": tensorboard}
        for option, value in given.items():
            if value not in (None, False):
                raise UsageError(f"{option}: found it with {study or '--all'}, expected it with a study file only")
        _run_studies(study, source, output)
        return
    _quiet()
    from warpfrag.fit import fit as fit_study
    from warpfrag.fit import load_study
    from warpfrag.fit.processes import is_first_process
    from warpfrag.fit.session import CHECKPOINT

    wanted = load_study(study, size=None if size is None else _parse_size(size))
    if steps is not None:
        wanted = replace(wanted, steps=steps)
    folder = output if output is not None else Path("results") / wanted.name
    try:
        log = folder / "tensorboard" if tensorboard and is_first_process() else None
        with _logged(wanted.name, log) as progress:
            result = fit_study(wanted, resume=resume, output=folder, progress=progress)
    except KeyboardInterrupt:
        if not is_first_process():
            raise typer.Exit(130) from None
        if not (folder / CHECKPOINT).is_file():
            raise typer.Exit(_complain("stopped before the first checkpoint", 130)) from None
        again = f"warpfrag fit {study}" + (f" -o {output}" if output else "") + (f" --size {size}" if size else "")
        again += (f" --steps {steps}" if steps is not None else "") + (" --tensorboard" if tensorboard else "")
        raise typer.Exit(_complain(f"stopped; go on with: {again} --resume", 130)) from None
    if is_first_process():
        for line in result.lines():
            print(line)
        print(f"results in {folder}")


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


def _run_studies(study: Path | None, source: Path | None, output: Path | None) -> None:
    """Run a study's folder, or all, and write the report; status 1 if a study failed."""
    from warpfrag.studies.report import duration, write_gallery
    from warpfrag.studies.runner import LOG, SCRIPT, STUDIES, display, find_studies, run_study
    from warpfrag.studies.summary import RESULTS

    if study is None:
        folders, target = find_studies(source or STUDIES), output or RESULTS
    elif (study / SCRIPT).is_file():
        folders, target = [study], output or RESULTS / study.resolve().name
    else:
        raise UsageError(f"{study}: found no {SCRIPT} in it, expected a study's folder or a study file")
    # That it cannot be written is to be known before the studies have run.
    target.mkdir(parents=True, exist_ok=True)
    runs = []
    for number, folder in enumerate(folders, start=1):
        words = f"{folder.resolve().name} ({number} of {len(folders)})"
        try:
            with display(words) as show:
                run = run_study(folder, show)
        except KeyboardInterrupt:
            raise typer.Exit(_complain(f"stopped in {words}; the report is not written", 130)) from None
        runs.append(run)
        if run.summary is not None:
            print(f"{run.name}: {run.summary.headline} ({duration(run.seconds)})")
        else:
            _complain(f"{run.name}: {run.error} (more in {RESULTS / run.name / LOG})", 1)
    shown = write_gallery(runs, target / "report.html")
    for run, before in zip(shown, runs, strict=True):
        if run is not before:
            _complain(f"{run.name}: {run.error}", 1)
    print(f"report in {target / 'report.html'}")
    if any(run.error for run in shown):
        raise typer.Exit(1)


@app.command()
def inspect(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="The scene.", show_default=False)],
    pixel: Annotated[str, typer.Option("--pixel", metavar="X,Y", help="Column and row, from the top left, 0 first.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.png", help="The plot [SCENE_X_Y.png].")
    ] = None,
    beta: Annotated[float | None, typer.Option(help="In-slab interpolation, 0 (optical) to 1 (linear).")] = None,
    layers: Annotated[int | None, typer.Option(help="Largest number of layers of a pixel.")] = None,
    merge: Annotated[str | None, typer.Option(help="none, smooth, order_independent or exact.")] = None,
    mix: Annotated[str | None, typer.Option(help="opacity, average or optical_depth.")] = None,
    size: SizeOption = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any parameter, such as ball.opacity=0.5; may be repeated."),
    ] = None,
) -> None:
    """List the fragments of one pixel, and draw them with the absorbance along its ray, before and after merging."""
    _quiet()
    from warpfrag.analysis.pixel import inspect_pixel
    from warpfrag.files.images import check_target
    from warpfrag.files.scene_file import load_scene

    match = _PIXEL.fullmatch(pixel.strip())
    if match is None:
        raise UsageError(f"--pixel: found {pixel!r}, expected column and row such as 320,240")
    column, row = int(match[1]), int(match[2])
    target = output if output is not None else Path(f"{scene.stem}_{column}_{row}.png")
    if target.suffix.lower() != ".png":
        raise UsageError(f"{target}: found the suffix {target.suffix or '(none)'}, expected .png")
    check_target(target)
    wanted = load_scene(scene)
    wanted = _set_all(wanted, settings or [])
    changes: dict[str, Any] = {"beta": beta, "layers": layers, "merge": merge, "mix": mix}
    changes = {key: value for key, value in changes.items() if value is not None}
    if size is not None:
        changes["camera"] = wanted.camera.resized(_parse_size(size))
    inspection = inspect_pixel(replace(wanted, **changes), column, row)
    inspection.draw(target)
    for line in inspection.lines():
        print(line)
    print(f"plot in {target}")


def _parse_size(text: str) -> tuple[int, int]:
    match = _SIZE.fullmatch(text.strip())
    if match is None or int(match[1]) < 1 or int(match[2]) < 1:
        raise UsageError(f"--size: found {text!r}, expected width and height such as 640x480")
    return int(match[1]), int(match[2])


def _numbers(option: str, text: str, counts: Sequence[int], expected: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts:
        raise UsageError(f"{option}: found {text!r}, expected {expected}")
    return numbers


def _background(text: str) -> tuple[float, ...]:
    from warpfrag.colors import parse_hex

    if text.strip().lower() == "none":
        return 0.0, 0.0, 0.0, 0.0
    expected = '"#rrggbb[aa]", "r,g,b[,a]" from 0 to 1, or none'
    color = list(parse_hex(text) or _numbers("--background", text, (3, 4), expected))
    if not all(0.0 <= part <= 1.0 for part in color):
        raise UsageError(f"--background: found {text!r}, expected {expected}")
    red, green, blue, opacity = [*color, 1.0][:4]
    return red * opacity, green * opacity, blue * opacity, opacity


def _with_thickness(item: "SceneObject", option: str, text: str) -> "SceneObject":
    from warpfrag.scene.parameters import multiple_of_p

    multiple = multiple_of_p(text)
    if multiple is not None:
        return replace(item, thickness=multiple, thickness_unit="P")
    number = _numbers(option, text, (1,), 'a number, or multiples of P(z) such as "2P"')[0]
    return replace(item, thickness=number, thickness_unit="scene")


def _set_all(scene: "Scene", settings: Sequence[str]) -> "Scene":
    """Return the scene with parameters set, rotations last: the camera's translation is along its axes in the file."""
    for setting in sorted(settings, key=lambda each: each.partition("=")[0].strip().endswith(".rotation")):
        scene = _set(scene, setting)
    return scene


def _set(scene: "Scene", setting: str) -> "Scene":
    """Return the scene with one parameter set as `NAME=VALUE` says."""
    from warpfrag.colors import parse_hex
    from warpfrag.errors import suggest
    from warpfrag.scene.names import POSE_KEYS
    from warpfrag.scene.pose import posed

    name, equals, text = setting.partition("=")
    name, text = name.strip(), text.strip()
    known = [key for key in scene.parameters() if not key.endswith(".vertices")]
    if not equals:
        raise UsageError(f"--set: found {setting!r}, expected NAME=VALUE")
    if name not in known:
        raise UsageError(f'--set: found the unknown name "{name}"; {suggest(name, known)}')
    owner, _, key = name.rpartition(".")
    if key in POSE_KEYS:
        return posed(scene, {name: _numbers(f"--set {name}", text, (3,), "x,y,z")})
    if key == "beta":
        return replace(scene, beta=_numbers(f"--set {name}", text, (1,), "a number from 0 to 1")[0])
    objects = []
    for item in scene.objects:
        if item.name == owner and key == "thickness":
            item = _with_thickness(item, f"--set {name}", text)
        elif item.name == owner and key == "color":
            color = parse_hex(text) or _numbers(f"--set {name}", text, (3,), '"#rrggbb" or "r,g,b"')
            item = replace(item, color=tuple(color[:3]))
        elif item.name == owner:
            item = replace(item, opacity=_numbers(f"--set {name}", text, (1,), "a number from 0 to 1")[0])
        objects.append(item)
    return replace(scene, objects=objects)


if __name__ == "__main__":
    sys.exit(main())
