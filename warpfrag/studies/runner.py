"""Running whole studies: each a folder with a study.py, run in a process of its own from the root of the project."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from warpfrag.studies.summary import RESULTS, SUMMARY, Summary, SummaryError

STUDIES = Path("experiments") / "fit"
SCRIPT = "study.py"
LOG = "log.txt"

# Time a study has to end after Ctrl-C, before it is killed.
_GRACE_SECONDS = 10.0
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_TRACEBACK = "Traceback (most recent call last):"


class StudiesError(ValueError):
    """There is no study to run; the message is one line."""


@dataclass(frozen=True)
class StudyRun:
    """How the run of a study ended.

    Attributes:
        folder: the study's.
        seconds: time it took.
        summary: what it found; None if it failed.
        error: why it failed, in one line; empty if it did not.
    """

    folder: Path
    seconds: float
    summary: Summary | None = None
    error: str = ""

    @property
    def name(self) -> str:
        """The name of the study's folder."""
        return self.folder.resolve().name


def find_studies(folder: str | os.PathLike = STUDIES) -> list[Path]:
    """Return the folders in `folder` that hold a study.py, in the order of their names.

    Raises:
        StudiesError: there is no such folder, or no study in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise StudiesError(
            f"{folder}: got no such folder, expected one of studies: run it in a clone of the repository"
        )
    studies = sorted(script.parent for script in folder.glob(f"*/{SCRIPT}"))
    if not studies:
        raise StudiesError(f"{folder}: got no study, expected folders with a {SCRIPT}")
    return studies


def run_study(folder: Path, show: Callable[[str], None] | None = None) -> StudyRun:
    """Run a study in a process of its own; what it prints goes to `results/fit/<study>/log.txt`.

    Args:
        folder: the study's, with a study.py.
        show: called with each line it prints.

    Returns:
        Its summary, or why it failed.

    Raises:
        KeyboardInterrupt: the user stopped it; its process has ended.
    """
    results = RESULTS / folder.resolve().name
    results.mkdir(parents=True, exist_ok=True)
    before = _state(results / SUMMARY)
    started = time.monotonic()
    lines = []
    # In a group of its own, Ctrl-C reaches it once, from here.
    process = subprocess.Popen(
        [sys.executable, str(folder / SCRIPT)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"},
        encoding="utf-8",
        errors="replace",
        process_group=0,
    )
    with process, (results / LOG).open("w", encoding="utf-8") as log:
        assert process.stdout is not None
        try:
            for text in process.stdout:
                line = _ESCAPES.sub("", text).rstrip()
                lines.append(line)
                print(line, file=log, flush=True)
                if show is not None and line.strip():
                    show(line.strip())
            status = process.wait()
        except BaseException:
            _stop(process)
            raise
    seconds = time.monotonic() - started
    if status != 0:
        return StudyRun(folder, seconds, error=_reason(status, lines))
    if _state(results / SUMMARY) in (None, before):
        return StudyRun(folder, seconds, error=f"got no new {results / SUMMARY}, expected {SCRIPT} to save a Summary")
    try:
        return StudyRun(folder, seconds, Summary.load(results / SUMMARY))
    except SummaryError as error:
        return StudyRun(folder, seconds, error=str(error))


@contextmanager
def display(words: str) -> Iterator[Callable[[str], None]]:
    """Show on standard error which study runs, for how long, and its last line; only the first to what is no terminal.

    Args:
        words: which study runs.

    Yields:
        The function to call with each line it prints.
    """
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column

    console = Console(stderr=True)
    if not console.is_terminal:
        print(words, file=sys.stderr, flush=True)
        yield lambda line: None
        return
    last = TextColumn("{task.fields[line]}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn(), last)
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(words, total=None, line="")
        yield lambda line: progress.update(task, line=line)


def _state(path: Path) -> tuple[int, int] | None:
    """Return what differs when a file is replaced; None if there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns


def _stop(process: subprocess.Popen) -> None:
    """Interrupt a process and what it started; kill them if that takes too long, or at the second Ctrl-C."""
    if os.name != "posix":
        process.kill()
        return
    try:
        os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=_GRACE_SECONDS)
    except ProcessLookupError:
        pass
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        os.killpg(process.pid, signal.SIGKILL)


def _reason(status: int, lines: list[str]) -> str:
    """Return in one line why a process ended: the error of the last traceback, or the last line it printed."""
    if status < 0:
        return f"{SCRIPT} was ended by {signal.Signals(-status).name}"
    after = 1 + max((place for place, line in enumerate(lines) if line == _TRACEBACK), default=-1)
    filled = [line for line in lines[after:] if line.strip()]
    if after:
        # The frames of a traceback are indented.
        errors = [line for line in filled if not line.startswith(" ")]
        return (errors or filled or [f"exit status {status}"])[0]
    return filled[-1].strip() if filled else f"{SCRIPT} ended with status {status} and said nothing"
