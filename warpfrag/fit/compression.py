"""Residuals and Jacobian of any number of images in few rows.

Least squares needs of residuals f and Jacobian J only |f|², JᵀJ and Jᵀf. A QR decomposition of [f J] keeps these in as
many rows as there are columns, without squaring the condition number: an evaluation of any number of images fits in a
few hundred bytes, and processes exchange no more.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from warpfrag.arrays.launch import share, thread_count

# A QR decomposition of so many rows at a time stays in the cache: four to seven times as fast as all at once.
QR_ROWS = 512


@dataclass(frozen=True, eq=False)
class Compressed:
    """Residuals and Jacobian in few rows, scaled by 1/sqrt(number of residuals).

    The residuals are (sqrt(mean rho), 0, 0, …); `jacobian` is such that JᵀJ and Jᵀf are those of the whole images,
    weighted as the loss says.

    Attributes:
        cost: mean of rho over all residuals.
        jacobian: (P + 2, P).
    """

    cost: float
    jacobian: np.ndarray

    @property
    def gradient(self) -> np.ndarray:
        """The derivative of the cost in each coordinate, (P,)."""
        return 2.0 * np.sqrt(self.cost) * self.jacobian[0]


def triangle_of(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the triangle R of a QR decomposition of rows, square."""
    rows = np.concatenate(parts) if len(parts) > 1 else parts[0]
    columns = rows.shape[1]
    block = max(QR_ROWS, 2 * columns)
    whole = len(rows) // block * block
    if whole > block:
        blocks = np.array_split(rows[:whole].reshape(-1, block, columns), thread_count())
        triangles = share(partial(np.linalg.qr, mode="r"), blocks)
        rows = np.concatenate([*(triangle.reshape(-1, columns) for triangle in triangles), rows[whole:]])
    # With at least as many rows as columns it is square.
    padded = np.concatenate([rows, np.zeros((columns, columns))]) if len(rows) < columns else rows
    return np.asarray(np.linalg.qr(padded, mode="r"))


def compress(triangle: np.ndarray, cost: float) -> Compressed:
    """Turn the triangle of [f J] so that all of the residual is in the first row.

    The residual's share outside of the triangle (uncovered pixels, and what a robust rho has more than its weighted
    square) is orthogonal to all columns; a rotation of it with the first row moves its norm there and keeps JᵀJ and
    Jᵀf.

    Args:
        triangle: of [f J], scaled by 1/sqrt(number of residuals), (P + 1, P + 1).
        cost: mean of rho over all residuals.
    """
    inside, cross = triangle[0, 0], triangle[0, 1:]
    # The sign of a triangle's row is arbitrary: that of the cosine goes with it.
    total = max(np.sqrt(cost), abs(inside))
    cosine = inside / total if total > 0.0 else 1.0
    sine = np.sqrt(max(0.0, 1.0 - cosine**2))
    return Compressed(cost, np.concatenate([cosine * cross[None], triangle[1:, 1:], sine * cross[None]]))
