"""Where an object stands: `scale`, `rotate` and `translate`, or `matrix`, of its table as one matrix."""

import numpy as np

from warpfrag.errors import is_number, shorten
from warpfrag.files.table import Table, is_numbers

PLACE = ("translate", "rotate", "scale")
PLACEMENT_KEYS = (*PLACE, "matrix")


def read_matrix(table: Table) -> np.ndarray:
    """Read from an object's own space to world space: scaled first, then turned, moved last.

    Returns:
        (4, 4) float64, for column vectors.

    Raises:
        SceneError: a key of the wrong type or out of its range, or `matrix` beside another.
    """
    if "matrix" in table:
        return _read_rows(table)
    matrix = np.eye(4)
    if "scale" in table:
        value = table.data["scale"]
        factors = [value] * 3 if is_number(value) else value
        if not is_numbers(factors, 3) or 0 in factors:
            raise table.error("scale", shorten(value), "a number other than 0, or 3 of them")
        matrix[:3, :3] = np.diag(factors)
    turns = table.data.get("rotate", [])
    for index, turn in enumerate(turns if isinstance(turns, list) else [turns]):
        place = f"rotate[{index}]" if isinstance(turns, list) else "rotate"
        given = Table(turn, table.file, f"{table.path}.{place}", ("axis", "degrees"), table.label)
        axis, degrees = given.numbers("axis", 3, "3 numbers"), given.number("degrees")
        if axis is None or degrees is None or not any(axis):
            raise given.error("", shorten(turn), "{axis = [x, y, z], degrees = …} with an axis other than 0")
        matrix[:3, :3] = _rotation(np.array(axis), np.radians(degrees)) @ matrix[:3, :3]
    matrix[:3, 3] = table.numbers("translate", 3, "3 numbers") or [0.0, 0.0, 0.0]
    return matrix


def _read_rows(table: Table) -> np.ndarray:
    others = [key for key in PLACE if key in table]
    if others:
        raise table.error("matrix", f"{', '.join(others)} as well", "either matrix or " + ", ".join(PLACE))
    rows = table.data["matrix"]
    if not isinstance(rows, list) or len(rows) != 4 or not all(is_numbers(row, 4) for row in rows):
        raise table.error("matrix", shorten(rows), "4 rows of 4 numbers")
    matrix = np.array(rows, dtype=np.float64)
    if not np.array_equal(matrix[3], [0, 0, 0, 1]) or np.linalg.matrix_rank(matrix[:3, :3]) < 3:
        raise table.error("matrix", shorten(rows), "an invertible matrix with the last row 0, 0, 0, 1")
    return matrix


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    # Rodrigues' formula; scaled by the largest part first, so that squares neither overflow nor underflow.
    axis = axis / np.abs(axis).max()
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
