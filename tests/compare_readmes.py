"""Whether a study run again comes to what its README says: numbers by name, and those in the README's text.

How long something took is not compared: in the text a number with a unit of time behind it ("3.2 s", "4 min").
"""

import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path

from warpfrag.studies.summary import NUMBERS, SummaryError, read_parts

# A minus after a letter or digit is a hyphen or a range.
_NUMBER = re.compile(r"((?:(?<![\w.])[-−+])?(?:[0-9]{1,3}(?:,[0-9]{3})+|[0-9]+)(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?)")
_TIME = re.compile(r"\s?(µs|ms|s|min|h)(?![\w/])")
_RULE = re.compile(r"\|[\s|:-]+\|")


def read_numbers(folder: str | os.PathLike) -> dict[str, float]:
    """Read the numbers of a study's README, by name.

    Args:
        folder: the study's folder.

    Raises:
        SummaryError: its numbers.json is missing or damaged.
    """
    path = Path(folder) / NUMBERS
    try:
        numbers = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SummaryError(f"{path}: got no file that can be read, expected the study's numbers") from error
    except ValueError as error:
        raise SummaryError(f"{path}: got no JSON ({error}), expected the study's numbers") from error
    if not isinstance(numbers, dict) or not all(type(value) in (int, float) for value in numbers.values()):
        raise SummaryError(f"{path}: got something else, expected numbers by name")
    return numbers


def differences(
    committed: Mapping[str, float], regenerated: Mapping[str, float], tolerance: float, *, floor: float = 0.0
) -> list[str]:
    """Return a line for each number that is missing, new, or not the same within a tolerance.

    Args:
        committed: the numbers as they were.
        regenerated: the numbers of the new run.
        tolerance: largest difference relative to the larger of the two, such as 0.02.
        floor: a difference that is too small to matter whatever the number, such as rounding where one is 0.

    Example:
        >>> differences({"error": 0.10, "found": 8}, {"error": 0.12, "found": 8}, 0.05)
        ['error: got 0.12, expected 0.1 within 5 %']
    """
    lines = []
    for name in sorted({*committed, *regenerated}):
        if name not in regenerated:
            lines.append(f"{name}: got none, expected {committed[name]:g}")
        elif name not in committed:
            lines.append(f"{name}: got {regenerated[name]:g}, expected no such number")
        elif not math.isclose(committed[name], regenerated[name], rel_tol=tolerance, abs_tol=floor):
            lines.append(
                f"{name}: got {regenerated[name]:g}, expected {committed[name]:g} within {100 * tolerance:g} %"
            )
    return lines


def text_differences(committed: str, regenerated: str, tolerance: float) -> list[str]:
    """Compare two texts line by line: their words, and their numbers within a tolerance.

    A number with a point or an exponent has been rounded: off by one in the last digit shown, it is the same. Spaces
    and the rules of tables do not count, and neither do times.

    Args:
        committed: the text as it was.
        regenerated: the text of the new run.
        tolerance: largest difference relative to the larger of the two numbers.
    """
    old, new = _lines(committed), _lines(regenerated)
    if len(old) != len(new):
        return [f"text: got {len(new)} lines, expected {len(old)}"]
    lines = []
    for before, after in zip(old, new, strict=True):
        words_before, words_after = _NUMBER.split(before), _NUMBER.split(after)
        # Split by a group, words stand at even places, and numbers at odd ones.
        if [word.split() for word in words_before[::2]] != [word.split() for word in words_after[::2]]:
            lines.append(f'text: got "{after}", expected "{before}"')
            continue
        for place in range(1, len(words_before), 2):
            if _TIME.match(words_before[place + 1]):
                continue
            if not _same(words_before[place], words_after[place], tolerance):
                expected = f"{words_before[place]} within {100 * tolerance:g} %"
                lines.append(f'text: got {words_after[place]}, expected {expected} in "{before}"')
    return lines


def study_differences(
    committed: str | os.PathLike, regenerated: str | os.PathLike, tolerance: float, *, floor: float = 0.0
) -> list[str]:
    """Compare a study's folder with a copy of it in which the study was run again.

    Args:
        committed: the study's folder.
        regenerated: the copy.
        tolerance: see `differences`; also for the numbers in the README's text.
        floor: see `differences`.

    Returns:
        A line for each difference of numbers.json and of the README; none if they agree.

    Raises:
        SummaryError: one of the files is missing or damaged.
    """
    lines = differences(read_numbers(committed), read_numbers(regenerated), tolerance, floor=floor)
    return lines + text_differences(read_parts(committed)[1], read_parts(regenerated)[1], tolerance)


def _lines(text: str) -> list[str]:
    lines = (" ".join(line.split()) for line in text.splitlines())
    return [line for line in lines if line and not _RULE.fullmatch(line)]


def _same(before: str, after: str, tolerance: float) -> bool:
    shown = max(_last_digit(before), _last_digit(after))
    # One in the last digit, and the error of writing it in binary.
    return math.isclose(_value(before), _value(after), rel_tol=tolerance, abs_tol=1.0001 * shown)


def _value(word: str) -> float:
    return float(word.replace("−", "-").replace(",", ""))


def _last_digit(word: str) -> float:
    """Return what one in the last digit of a rounded number is worth; 0 for a whole number."""
    if word.lstrip("-−+").replace(",", "").isdigit():
        return 0.0
    digits, _, exponent = word.lower().partition("e")
    return 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))
