"""Rotation vectors: along the axis, as long as the angle.

A rotation vector v [degrees] points along the axis, its length is the angle θ. With [v]× the matrix of v × ·, and in
radians:

    R(v) = I + sin θ/θ [v]× + (1 − cos θ)/θ² [v]×²                   (Rodrigues)
    J(v) = I + (1 − cos θ)/θ² [v]× + (θ − sin θ)/θ³ [v]×²            R(v + dv) = R(J dv) R(v), to first order in dv

R − I is what is computed, so that a rotation of zero changes no bit.
"""

import math
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import NUMPY, kind_of

RADIANS = math.pi / 180.0
# Below an angle of 1 the ratios are power series, of as many terms as float64 can tell.
_SERIES_TERMS = 10


def rotation_matrix(vector: Any) -> Any:
    """Return the rotation R of a rotation vector.

    Differentiable in torch, at zero too.

    Args:
        vector: along the axis, as long as the angle [degrees], (3,): NumPy array or torch tensor.

    Returns:
        (3, 3) float64, of the kind of the vector.

    Example:
        >>> rotation_matrix(np.array([0.0, 0.0, 90.0])).round(6) @ [1, 0, 0]
        array([0., 1., 0.])
    """
    change = rotation_change(vector)
    return (kind_of(change) or NUMPY).asarray(np.eye(3), change) + change


def rotation_change(vector: Any) -> Any:
    """Return R − I, exactly zero at zero, (3, 3) float64 of the kind of the vector [degrees]."""
    kind = kind_of(vector) or NUMPY
    turn = kind.astype(vector, "float64") * RADIANS
    x, y, z = turn[0], turn[1], turn[2]
    square = x * x + y * y + z * z
    first, second, _ = _ratios(square, kind.xp)
    entries = [
        *(-second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y),
        *(second * x * y + first * z, -second * (x * x + z * z), second * y * z - first * x),
        *(second * x * z - first * y, second * y * z + first * x, -second * (x * x + y * y)),
    ]
    return kind.xp.stack(entries).reshape(3, 3)


def left_jacobian(vector: np.ndarray) -> np.ndarray:
    """Return J with R(v + dv) = R(J dv) R(v) to first order in dv, both rotation vectors in degrees.

    Args:
        vector: the rotation vector v [degrees], (3,).

    Returns:
        (3, 3) float64; the identity at zero.
    """
    turn = np.asarray(vector, dtype=np.float64) * RADIANS
    square = turn @ turn
    _, second, third = _ratios(square, np)
    return np.eye(3) + second * cross_matrix(turn) + third * (np.outer(turn, turn) - square * np.eye(3))


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the matrix [v]× with [v]× w = v × w, (3, 3)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _ratios(square: Any, xp: Any) -> list[Any]:
    """Return sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³ of θ², smooth at 0."""
    small = square < 1.0
    one = xp.ones_like(square)
    # Each branch gets what it can take: a gradient flows through both, and through none may it be infinite.
    near, far = xp.where(small, square, 0.0 * one), xp.where(small, one, square)
    angle = xp.sqrt(far)
    half = xp.sin(0.5 * angle)
    closed = [xp.sin(angle) / angle, 2.0 * half * half / far, (angle - xp.sin(angle)) / (angle * far)]
    ratios = []
    for order, value in enumerate(closed, start=1):
        # Σ (−θ²)^k order!/(2k + order)!, nested, over order!.
        series = one
        for k in range(_SERIES_TERMS, 0, -1):
            series = one - near / ((2 * k + order - 1) * (2 * k + order)) * series
        ratios.append(xp.where(small, series / math.factorial(order), value))
    return ratios
