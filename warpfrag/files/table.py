"""Reads the tables of a TOML file key by key and words what is wrong with them in one line."""

import math
import os
import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from warpfrag.errors import SceneError, shorten, suggest


def read_toml(path: str | os.PathLike) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        SceneError: The file is missing, unreadable, not UTF-8, or not TOML (with the line).
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise SceneError(f"{path}: found no such file, expected a TOML file") from None
    except OSError as error:
        raise SceneError(f"{path}: found {error.strerror or error}, expected a readable TOML file") from None
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: found a byte at {error.start} that is not UTF-8, expected a TOML file") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        match = re.search(r"^(.*) \(at (?:line (\d+), column (\d+)|end of document)\)$", str(error), re.DOTALL)
        reason, line = (match[1], match[2]) if match else (str(error), None)
        line = line or len(text.splitlines())
        raise SceneError(f"{path}: line {line}: found what is not TOML: {' '.join(reason.split())}") from None


class Table:
    """One table of a file, asked by key, kind and range; every complaint names file, key and value.

    Args:
        data: The table as TOML gives it.
        file: Name of the file, for messages.
        path: Dotted place of the table in the file, ``""`` at the top.
        keys: The keys it may have; others are refused at once.
        label: Name of what the table describes, if it has one.
        kind: What the keys belong to, for the message about an unknown one.

    Raises:
        SceneError: From every method, when the value is missing, of the wrong type, or out of range.
    """

    def __init__(
        self, data: Any, file: str | os.PathLike, path: str, keys: Iterable[str], label: str = "", kind: str = ""
    ) -> None:
        self.file, self.path, self.label = file, path, label
        if not isinstance(data, dict):
            raise self.error("", shorten(data), "a table")
        self.data = data
        for key in data:
            if key not in (known := list(keys)):
                of = f" of {kind}" if kind else ""
                raise SceneError(f"{self._place(key)}: found an unknown key{of}; {suggest(key, known)}")

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def error(self, key: str, found: object, expected: str) -> SceneError:
        """Word a complaint about a key."""
        return SceneError(f"{self._place(key)}: found {found}, expected {expected}")

    def wrap(self, key: str, error: Exception) -> SceneError:
        """Put file and key before a complaint that has its own words."""
        return SceneError(f"{self._place(key)}: {' '.join(str(error).split())}")

    def table(self, key: str, keys: Iterable[str], kind: str = "") -> "Table | None":
        """Return a table inside this one; None where it is absent."""
        if key not in self.data:
            return None
        path = f"{self.path}.{key}" if self.path else key
        return Table(self.data[key], self.file, path, keys, self.label, kind)

    def number(
        self, key: str, low: float = -math.inf, high: float = math.inf, *, above: float | None = None
    ) -> float | None:
        """Return a finite number from ``low`` to ``high``, greater than ``above``; None where it is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if not is_number(value) or not low <= value <= high or (above is not None and value <= above):
            raise self.error(key, shorten(value), number_words(low, high, above))
        return float(value)

    def integer(self, key: str, low: int, high: int) -> int | None:
        """Return a whole number from ``low`` to ``high``; None where it is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.error(key, shorten(value), f"a whole number from {low} to {high}")
        return value

    def numbers(self, key: str, count: int, words: str, *, above: float = -math.inf) -> list[float] | None:
        """Return ``count`` finite numbers; None where the key is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if not is_numbers(value, count) or min(value) <= above:
            raise self.error(key, shorten(value), words)
        return [float(part) for part in value]

    def choice(self, key: str, choices: Sequence[str]) -> str | None:
        """Return one of ``choices``; None where the key is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if value not in choices:
            expected = "one of " + ", ".join(f'"{choice}"' for choice in choices)
            hint = suggest(value, choices) if isinstance(value, str) else ""
            raise self.error(key, shorten(value), expected + (f" ({hint})" if hint.startswith("did") else ""))
        return value

    def text(self, key: str) -> str | None:
        """Return a text that is not blank; None where the key is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, shorten(value), "a text that is not blank")
        return value

    def _place(self, key: str) -> str:
        place = f"{self.path}.{key}" if self.path and key else self.path or key
        label = f' of "{self.label}"' if self.label else ""
        return f"{self.file}: {place}{label}" if place else str(self.file)


def is_number(value: object) -> bool:
    """Whether a value is a finite number and not a boolean."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def is_numbers(value: object, count: int) -> bool:
    """Whether a value is a list of ``count`` finite numbers."""
    return isinstance(value, list) and len(value) == count and all(is_number(part) for part in value)


def number_words(low: float, high: float, above: float | None) -> str:
    """Word a range."""
    if above is not None:
        return f"a number above {above:g}" + (f" up to {high:g}" if high < math.inf else "")
    if low > -math.inf and high < math.inf:
        return f"a number from {low:g} to {high:g}"
    return f"a number from {low:g}" if low > -math.inf else "a finite number"
