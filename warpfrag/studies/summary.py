"""What a study has found: its answer, tables, figures and numbers, and the README they are written to.

A study ends by saving its `Summary`. The part of the study's README between two marker lines is rewritten from it, so
that no number there is typed by hand, and `numbers.json` beside the README holds them for tests to compare.
"""

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from warpfrag.files.saving import replacing

BEGIN, END = "<!-- results: begin (written by study.py) -->", "<!-- results: end -->"
# Opens the folded part of a README.
FURTHER = "<details>\n<summary>Further numbers</summary>"
README, NUMBERS, SUMMARY = "README.md", "numbers.json", "summary.json"
RESULTS = Path("results") / "fit"
# Significant digits of a number in a table or in numbers.json: fewer than float32 has.
DIGITS = 6

Cell = str | int | float

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
# What counts as a number when a column is aligned: "3", "<1e-06", "98 %", "32.1 dB", "± 0.2", "2P".
_NUMBER_CELL = re.compile(r"[<>≤≥≈±]?\s*[-+−]?[0-9][0-9.,]*(e[-+]?[0-9]+)?(\s*[^\s0-9]{1,4})?")
_EMPTY_CELLS = ("", "–", "—", "-")


class SummaryError(ValueError):
    """A summary that cannot be made, saved or loaded; the message is one line."""


@dataclass(frozen=True)
class Table:
    """A table of results.

    Attributes:
        columns: heads of the columns.
        rows: cells by row; text may hold inline Markdown, and floats are shown to 6 significant digits.
        caption: a sentence that stands above the table; may be empty.
        further: whether it stands with others of its kind in a part that is folded until somebody wants it.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""
    further: bool = False

    def __post_init__(self):
        columns = tuple(str(column) for column in self.columns)
        rows = tuple(tuple(_cell(cell) for cell in row) for row in self.rows)
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "rows", rows)
        for number, row in enumerate(rows, start=1):
            if len(row) != len(columns):
                raise SummaryError(f"table: got {len(row)} cells in row {number}, expected {len(columns)}")

    def markdown(self) -> str:
        """Return the table as Markdown, numbers to the right, its source aligned too."""
        lines = [[_escape(column) for column in self.columns]]
        lines += [[_escape(cell) for cell in row] for row in self.rows]
        columns = list(zip(*lines, strict=True))
        right = [_is_numeric(column[1:]) for column in columns]
        widths = [max(3, *(len(cell) for cell in column)) for column in columns]
        rule = ["-" * (width - to_right) + ":" * to_right for width, to_right in zip(widths, right, strict=True)]
        rows = [
            " | ".join(
                cell.rjust(width) if to_right else cell.ljust(width)
                for cell, width, to_right in zip(line, widths, right, strict=True)
            )
            for line in (lines[0], rule, *lines[1:])
        ]
        table = "\n".join(f"| {row} |" for row in rows)
        return f"{self.caption}\n\n{table}" if self.caption else table


@dataclass(frozen=True)
class Figure:
    """A picture a study has drawn.

    Attributes:
        path: the file, relative to the study's folder.
        caption: what it shows, one sentence; may hold inline Markdown.
    """

    path: str
    caption: str


@dataclass(frozen=True)
class Summary:
    """What a study has found.

    Attributes:
        name: of the study: letters, digits, "_" and "-"; that of its folder.
        title: a few words.
        question: one sentence.
        answer: a few sentences with the numbers measured; its first paragraph stands for it in overviews.
        tables: in the order of the README.
        figures: those of the study; the README shows them where it likes.
        numbers: by name, what a check compares when the study is run again; finite.
        command: what regenerates all of it.
    """

    name: str
    title: str
    question: str
    answer: str
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)
    command: str = ""

    def __post_init__(self):
        if not _NAME.fullmatch(self.name):
            raise SummaryError(f'name: got {self.name!r}, expected letters, digits, "_" and "-"')
        object.__setattr__(self, "tables", tuple(self.tables))
        object.__setattr__(self, "figures", tuple(self.figures))
        object.__setattr__(self, "numbers", {name: _number(name, value) for name, value in self.numbers.items()})

    @property
    def headline(self) -> str:
        """The first paragraph of the answer."""
        return self.answer.strip().split("\n\n")[0]

    def markdown(self) -> str:
        """Return what the README shows between its markers: the answer and the tables, some of them folded."""
        parts = [self.answer.strip(), *(table.markdown() for table in self.tables if not table.further)]
        further = [table.markdown() for table in self.tables if table.further]
        if further:
            parts += [FURTHER, *further, "</details>"]
        return "\n\n".join(parts)

    def save(self, folder: str | os.PathLike, *, results: str | os.PathLike = RESULTS) -> None:
        """Write `numbers.json` and the README's marked part, and `summary.json` to the results: all or nothing.

        Args:
            folder: the study's folder, with its README.md and its figures.
            results: the folder of all studies' results; this one's are in a folder of its name, made if need be.

        Raises:
            SummaryError: the README is missing or lacks the markers, or a figure is missing.
            OSError: a file cannot be written.
        """
        folder, target = Path(folder), Path(results) / self.name
        before, _, after = read_parts(folder)
        for figure in self.figures:
            if not (folder / figure.path).is_file():
                raise SummaryError(f"{folder / figure.path}: got no such file, expected a figure the study has drawn")
        numbers = json.dumps(dict(sorted(self.numbers.items())), indent=2, ensure_ascii=False)
        target.mkdir(parents=True, exist_ok=True)
        # The first is renamed last: that it is new says that the others are.
        contents = {
            target / SUMMARY: msgspec.json.format(msgspec.json.encode(self), indent=2).decode() + "\n",
            folder / README: f"{before}{BEGIN}\n\n{self.markdown()}\n\n{END}{after}",
            folder / NUMBERS: numbers + "\n",
        }
        with ExitStack() as stack:
            partials = {path: stack.enter_context(replacing(path)) for path in contents}
            for path, text in contents.items():
                partials[path].write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Summary":
        """Read a `summary.json`.

        Raises:
            SummaryError: it is missing, or no summary.
        """
        try:
            return msgspec.json.decode(Path(path).read_bytes(), type=cls)
        except OSError as error:
            raise SummaryError(f"{path}: got no file that can be read, expected a study's {SUMMARY}") from error
        except (msgspec.DecodeError, SummaryError) as error:
            raise SummaryError(f"{path}: got no summary ({error}), expected one saved by a study") from error


def read_parts(folder: str | os.PathLike) -> tuple[str, str, str]:
    """Return what a study's README holds before its markers, between and after them.

    Raises:
        SummaryError: it is missing, or does not have each marker once and in order.
    """
    path = Path(folder) / README
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise SummaryError(f"{path}: got no file that can be read, expected the study's README") from error
    except UnicodeDecodeError as error:
        raise SummaryError(f"{path}: got text that is not UTF-8, expected the study's README") from error
    for marker in (BEGIN, END):
        if text.count(marker) != 1:
            raise SummaryError(f'{path}: got "{marker}" {text.count(marker)} times, expected it once')
    before, rest = text.split(BEGIN)
    if END not in rest:
        raise SummaryError(f'{path}: got "{END}" before "{BEGIN}", expected it after')
    results, after = rest.split(END)
    return before, results, after


def _number(name: str, value: object) -> int | float:
    """Return a finite number as Python's own, a float rounded as far as it is written."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise SummaryError(f"{name}: got {value!r}, expected a number")
    if not math.isfinite(value):
        raise SummaryError(f"{name}: got {value}, expected a finite number")
    return int(value) if isinstance(value, (int, np.integer)) else float(f"{value:.{DIGITS}g}")


def _cell(cell: object) -> Cell:
    return cell if isinstance(cell, str) else _number("table", cell)


def _escape(cell: Cell) -> str:
    """Return a cell as text that stays in its cell."""
    text = cell if isinstance(cell, str) else f"{cell:.{DIGITS}g}" if isinstance(cell, float) else str(cell)
    return " ".join(text.split()).replace("|", "\\|")


def _is_numeric(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell not in _EMPTY_CELLS]
    return bool(filled) and all(_NUMBER_CELL.fullmatch(cell) for cell in filled)
