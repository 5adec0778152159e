"""Losses: a mean over all pixels and channels of a function of the residual.

With the residual f, l2: f²; huber: f²/2 up to delta, then delta·(|f| − delta/2); l1: |f|, rounded off below 1e-3 like
Huber's, since least squares weighs each residual by 1/|f|.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

# A quarter of a step of an 8-bit image: absolute values are rounded off below it.
L1_ROUNDING = 1e-3


@dataclass(frozen=True)
class RobustLoss:
    """A loss as least squares sees it: `factor` times the mean of rho, where rho is f², or 2·delta·|f| − delta² beyond.

    Attributes:
        delta: where rho becomes linear; infinite for l2.
        factor: from the mean of rho to the loss.
    """

    delta: float
    factor: float

    @staticmethod
    def named(name: str, delta: float) -> "RobustLoss":
        """Return the loss of a study."""
        if name == "l2":
            return RobustLoss(np.inf, 1.0)
        return RobustLoss(L1_ROUNDING, 0.5 / L1_ROUNDING) if name == "l1" else RobustLoss(delta, 0.5)

    def rho(self, residual: Any) -> Any:
        """Return rho of each residual, an array or a tensor."""
        size = abs(residual)
        if np.isinf(self.delta):
            return size * size
        inner = size.clip(None, self.delta)
        return inner * (2.0 * size - inner)

    def weight(self, residual: np.ndarray) -> np.ndarray:
        """Return the weight of each residual in the normal equations, d rho / d f²."""
        if np.isinf(self.delta):
            return np.ones_like(residual)
        return self.delta / np.maximum(np.abs(residual), self.delta)
