"""The command line: `warpfrag render`, `merge`, `flatten`, `fit`, `inspect` and `examples`.

Whatever goes wrong is one line on standard error and exit status 2; Ctrl-C is 130. `WARPFRAG_TRACEBACK=1` lets Python's
traceback through. Everything heavy is imported by the command that needs it, so that `--help` is quick.
"""

import os
import sys
from collections.abc import Callable, Sequence
from errno import EIO, ENOSPC, EPIPE
from importlib.metadata import version
from typing import Annotated, Any

import typer

from warpfrag.cli.examples import examples
from warpfrag.cli.fit import fit
from warpfrag.cli.flatten import flatten
from warpfrag.cli.merge import merge
from warpfrag.cli.pixel import inspect
from warpfrag.cli.render import render
from warpfrag.cli.streams import close_output, complain, open_streams, warnings_on_one_line

__all__ = ["app", "main"]

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="A differentiable multi-fragment compositor: renders scenes and fits their parameters to images.",
)
for _command in (render, merge, flatten, fit, inspect, examples):
    app.command()(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status.

    Args:
        arguments: the words after the program's name; None takes those of the process.
    """
    open_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with warnings_on_one_line():
            status = int(_program()(words or ["--help"]) or 0)
        return close_output() or status
    except KeyboardInterrupt:
        return complain("stopped", 130)
    except Exception as error:
        if os.environ.get("WARPFRAG_TRACEBACK"):
            raise
        if isinstance(error, OSError) and error.filename is None and error.errno in (ENOSPC, EPIPE, EIO):
            return close_output(error)
        # Typer's own errors word themselves without their class.
        words_of = getattr(error, "format_message", None)
        text = words_of() if callable(words_of) else str(error) or type(error).__name__
        expected = isinstance(error, (ValueError, TypeError, ImportError, OSError, MemoryError)) or callable(words_of)
        return complain(text if expected else f"{type(error).__name__}: {text}", 2)


def _program() -> Callable[[list[str]], Any]:
    command = typer.main.get_command(app)
    return lambda words: command.main(words, prog_name="warpfrag", standalone_mode=False)


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
