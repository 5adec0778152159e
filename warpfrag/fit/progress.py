"""The progress of a fit on the terminal."""

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from warpfrag.fit.parameters import values_wording
from warpfrag.fit.session import Progress

# More parameters than this do not fit on a line.
_MOST_SHOWN = 5
# Where standard error is no terminal, such as a log file: a line so often.
_SECONDS_PER_LINE = 10.0


@contextmanager
def progress_bar(name: str) -> Iterator[Any]:
    """Show step, loss and parameters on standard error while the block runs: a bar, or now and then a line.

    Args:
        name: what is being fitted.

    Yields:
        The function to call with each `Progress`.
    """
    from rich.console import Console, RenderableType
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar
    from rich.text import Text

    class TwoLines(Bar):
        """The bar, and below it loss and parameters on a line of their own."""

        def get_renderables(self) -> Iterable[RenderableType]:
            yield self.make_tasks_table(self.tasks)
            for task in self.tasks:
                yield Text(task.fields["wording"], overflow="ellipsis", no_wrap=True)

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(name)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with TwoLines(*columns, console=console) as bar:
        task = bar.add_task(name, total=None, wording="preparing")

        def show(progress: Progress) -> None:
            bar.update(task, completed=progress.step, total=progress.steps or None, wording=_wording(progress))

        try:
            yield show
        except Exception:
            # The line that tells what went wrong is to stand alone.
            bar.live.transient = True
            raise
        done = bar.tasks[0].completed
        bar.update(task, total=done)


def _lines(name: str) -> Any:
    told = time.monotonic()

    def show(progress: Progress) -> None:
        nonlocal told
        if time.monotonic() - told >= _SECONDS_PER_LINE:
            told = time.monotonic()
            print(f"{name}: step {progress.step}/{progress.steps}, {_wording(progress)}", file=sys.stderr, flush=True)

    return show


def _wording(progress: Progress) -> str:
    if progress.message:
        return progress.message
    shown = dict(list(progress.parameters.items())[:_MOST_SHOWN])
    return f"loss {progress.loss:.3g}, {values_wording(shown)}"
