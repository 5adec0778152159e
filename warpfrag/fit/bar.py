"""The progress bar of a fit on the terminal."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from warpfrag.fit.parameters import values_words
from warpfrag.fit.session import Progress

# More parameters than this do not fit on a line.
_MOST_SHOWN = 5


@contextmanager
def progress_bar(name: str) -> Iterator[Any]:
    """Show a bar with step, loss and parameters on standard error while the block runs.

    Args:
        name: what is being fitted.

    Yields:
        The function to call with each `Progress`.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[words]}", markup=False),
    )
    console = Console(stderr=True)
    with Bar(*columns, console=console) as bar:
        task = bar.add_task(name, total=None, words="preparing")

        def show(progress: Progress) -> None:
            words = progress.message
            if not words:
                shown = dict(list(progress.parameters.items())[:_MOST_SHOWN])
                words = f"loss {progress.loss:.3g}, {values_words(shown)}"
            bar.update(task, completed=progress.step, total=progress.steps or None, words=words)

        yield show
