"""Reads the tables of a TOML file key by key and words what is wrong with them in one line."""

import math
import os
import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from warpfrag.colors import parse_hex
from warpfrag.errors import SceneError, check_choice, is_number, is_whole, range_wording, shorten, suggest
from warpfrag.files.source import read_regular, wording_of_path

# Files are written by hand; a larger one is something else.
_MOST_BYTES = 16 * 2**20
# The largest number that float32 holds, which is what arrays of a scene are made of.
LARGEST = 3.4028234663852886e38


def read_toml(path: str | os.PathLike) -> dict[str, Any]:
    """Read a TOML file; a UTF-8 byte order mark is let through.

    Raises:
        SceneError: the file is missing, unreadable, not UTF-8, or not TOML (with the line).
    """
    path, name = Path(path), wording_of_path(path)
    try:
        text = read_regular(path, "a TOML file", _MOST_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{name}: got a byte at {error.start} that is not UTF-8, expected a TOML file") from None
    except ValueError as error:
        # The file is named already.
        raise SceneError(f"{name}: {str(error).replace(f' at {name}', '')}") from None
    except OSError as error:
        raise SceneError(f"{name}: got {error.strerror or error}, expected a readable TOML file") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        match = re.search(r"^(.*) \(at (?:line (\d+), column (\d+)|end of document)\)$", str(error), re.DOTALL)
        reason, line = (match[1], match[2]) if match else (str(error), None)
        line = line or len(text.splitlines())
        raise SceneError(f"{name}: line {line}: got what is not TOML ({' '.join(reason.split())})") from None
    except (RecursionError, ValueError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else "a number of too many digits"
        raise SceneError(f"{name}: got what cannot be read ({reason}), expected a TOML file") from None


class Table:
    """One table of a file, asked by key, kind and range; every complaint names file, key and value.

    Args:
        data: the table as TOML gives it.
        file: name of the file, for messages.
        path: dotted place of the table in the file, `""` at the top.
        keys: the keys it may have; others are refused at once.
        label: name of what the table describes, if it has one.
        kind: what the keys belong to, for the message about an unknown one.

    Raises:
        SceneError: from every method, when the value is missing, of the wrong type, or out of range.
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
                raise SceneError(f"{self._place(shorten(key)[1:-1])}: got an unknown key{of}; {suggest(key, known)}")

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def error(self, key: str, got: object, expected: str) -> SceneError:
        """Word a complaint about a key."""
        return SceneError(f"{self._place(key)}: got {got}, expected {expected}")

    def prefixed(self, key: str, error: Exception) -> SceneError:
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
        """Return a finite number from `low` to `high`, greater than `above`, that float32 holds; None where absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if not is_number(value) or not low <= value <= high or (above is not None and value <= above):
            raise self.error(key, shorten(value), range_wording(low, high, above=above))
        if abs(value) > LARGEST:
            raise self.error(key, shorten(value), range_wording(-LARGEST, LARGEST))
        return float(value)

    def integer(self, key: str, low: int, high: int) -> int | None:
        """Return a whole number from `low` to `high`; None where it is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if not is_whole(value) or not low <= value <= high:
            raise self.error(key, shorten(value), range_wording(low, high, whole=True))
        return value

    def numbers(self, key: str, count: int, words: str, *, above: float = -math.inf) -> list[float] | None:
        """Return `count` finite numbers that float32 holds; None where the key is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if not is_numbers(value, count) or min(value) <= above:
            raise self.error(key, shorten(value), words)
        return [float(part) for part in value]

    def choice(self, key: str, choices: Sequence[str]) -> str | None:
        """Return one of `choices`; None where the key is absent."""
        if key not in self.data:
            return None
        check_choice(self._place(key), self.data[key], choices, SceneError)
        return self.data[key]

    def text(self, key: str) -> str | None:
        """Return a text that is not blank and has no control characters; None where the key is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, shorten(value), "a text that is not blank")
        if any(ord(letter) < 32 or ord(letter) == 127 for letter in value):
            raise self.error(key, ascii(value), "a text on one line, without control characters")
        return value

    def color(self, key: str, *counts: int) -> list[float] | None:
        """Return a colour, straight and linear, of one of `counts` numbers; None where the key is absent."""
        if key not in self.data:
            return None
        value = self.data[key]
        if isinstance(value, str):
            parsed = parse_hex(value)
            if parsed is not None and (len(value.strip()) == 7 or 4 in counts):
                return list(parsed[: max(counts)])
        elif any(is_numbers(value, count) for count in counts) and min(value) >= 0 and max(value) <= 1:
            return [float(part) for part in value]
        words = " or ".join(f"{count} numbers from 0 to 1" for count in counts)
        raise self.error(key, shorten(value), f'{words}, or "#rrggbb{"[aa]" if 4 in counts else ""}"')

    def _place(self, key: str) -> str:
        place = f"{self.path}.{key}" if self.path and key else self.path or key
        label = f" of {shorten(self.label)}" if self.label else ""
        file = wording_of_path(self.file)
        return f"{file}: {place}{label}" if place else file


def is_numbers(value: Any, count: int) -> bool:
    """Tell whether a value is a list of `count` finite numbers that float32 holds."""
    good = isinstance(value, list) and len(value) == count
    return good and all(is_number(part) and abs(part) <= LARGEST for part in value)
