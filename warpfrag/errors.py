"""What is raised about bad input, and how its one line is worded: `name: got …, expected …`.

The checks raise `TypeError` for a value of the wrong kind and `ValueError` for one out of its range, and return it in
Python's own type. Readers of files word the same line with the file's name before it.
"""

import difflib
import math
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any


class SceneError(ValueError):
    """A scene file that cannot be used, in one line: file, key, what was got, what is expected."""


def is_number(value: Any) -> bool:
    """Tell whether a value is a finite number, Python's or NumPy's, and not a boolean."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    # Whole numbers of hundreds of digits are beyond what a float holds.
    except OverflowError:
        return False


def is_whole(value: object) -> bool:
    """Tell whether a value is a whole number, Python's or NumPy's, and not a boolean."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def range_wording(
    low: float = -math.inf, high: float = math.inf, *, above: float | None = None, whole: bool = False
) -> str:
    """Word what a number has to be.

    Example:
        >>> range_wording(0.0, 1.0)
        'a number from 0 to 1'
    """
    number = "a whole number" if whole else "a number"
    if above is not None:
        return f"{number} above {above:g}" + (f", at most {high:g}" if high < math.inf else "")
    if low > -math.inf and high < math.inf:
        return f"{number} from {low:.10g} to {high:.10g}"
    if low > -math.inf:
        return f"{number} of at least {low:g}"
    return number if whole else "a finite number"


def check_number(
    name: str, value: Any, low: float = -math.inf, high: float = math.inf, *, above: float | None = None
) -> float:
    """Return a finite number from `low` to `high`, and greater than `above`, as a float."""
    expected = range_wording(low, high, above=above)
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name}: got {shorten(value)}, expected {expected}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not (math.isfinite(number) and low <= number <= high and (above is None or number > above)):
        raise ValueError(f"{name}: got {shorten(value)}, expected {expected}")
    return number


def check_whole(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> int:
    """Return a whole number from `low` to `high` as an int."""
    expected = range_wording(low, high, whole=True)
    if not is_whole(value):
        raise TypeError(f"{name}: got {shorten(value)}, expected {expected}")
    if not low <= value <= high:
        raise ValueError(f"{name}: got {shorten(value)}, expected {expected}")
    return int(value)


def check_choice(name: str, value: Any, choices: Sequence[str], error: type[ValueError] = ValueError) -> None:
    """Raise `error` unless a value is one of `choices`."""
    if not isinstance(value, str) or value not in choices:
        expected = " or ".join(f'"{choice}"' for choice in choices)
        if len(choices) > 2:
            expected = "one of " + ", ".join(f'"{choice}"' for choice in choices)
        near = suggest(value, choices) if isinstance(value, str) else ""
        hint = f" ({near})" if near.startswith("did") else ""
        raise error(f"{name}: got {shorten(value)}, expected {expected}{hint}")


def suggest(word: str, choices: Iterable[str]) -> str:
    """Word the choice nearest to a misspelt word, or all of them where none is near.

    Example:
        >>> suggest("spere", ["sphere", "cube"])
        'did you mean "sphere"?'
    """
    known = sorted(choices)
    near = difflib.get_close_matches(word.lower(), known, n=1, cutoff=0.6)
    if near:
        return f'did you mean "{near[0]}"?'
    return "known are " + ", ".join(known)


def shorten(value: Any, limit: int = 60) -> str:
    """Word a value as a file would write it, on one line and cut off when long."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, (Real, str)) or value is None or isinstance(value, (list, tuple)):
        # NumPy's numbers without their types.
        given: Any = value
        plain = given.item() if hasattr(given, "item") else given
        # Python refuses to write whole numbers of thousands of digits.
        if isinstance(plain, int) and abs(plain) >= 10**limit:
            return f"a whole number of about {round(math.log10(abs(plain)))} digits"
        if isinstance(plain, str):
            text = '"' + plain.replace("\n", "\\n").replace("\0", "\\0") + '"'
        else:
            try:
                text = " ".join(repr(plain).split())
            except (ValueError, RecursionError):
                return f"a {type(plain).__name__} that is too long to show"
        return text if len(text) <= limit else text[: limit - 1] + "…"
    shape = getattr(value, "shape", None)
    return type(value).__name__ + ("" if shape is None else f" of shape {tuple(shape)}")
