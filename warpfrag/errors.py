"""What is raised about a scene, and how its one line is worded."""

import difflib
from collections.abc import Iterable


class SceneError(ValueError):
    """A scene file that cannot be used, in one line: file, key, what was found, what is expected."""


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


def shorten(value: object, limit: int = 60) -> str:
    """Word a value found in a file as that file would write it, on one line and cut off when long."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a table"
    text = '"' + value.replace("\n", "\\n") + '"' if isinstance(value, str) else " ".join(repr(value).split())
    return text if len(text) <= limit else text[: limit - 1] + "…"
