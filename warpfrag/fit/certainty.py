"""What the Jacobian at the end of a fit tells about how well the parameters are known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpfrag.fit.compression import Compressed
from warpfrag.fit.parameters import FittedParameter, component_names

# The least that a reference's values scatter by: rounding of a few float32 operations.
SMALLEST_NOISE = 1e-6
# Directions in which the image changes this much less than in the steepest are flat: float32 derivatives are not exact
# to more digits.
FLAT = 1e-6
# A parameter is undetermined if its standard error is larger than this, in coordinates where the whole range of a beta,
# an opacity or a colour is 1 and a thickness is a logarithm: the interval of ± 2 standard errors then covers that whole
# range, or a factor of e.
UNDETERMINED = 0.25


@dataclass(frozen=True, eq=False)
class Certainty:
    """How well the image determines the parameters.

    Attributes:
        standard_errors: in a method's coordinates (relative for a thickness); inf where the image is flat.
        condition_number: largest over smallest singular value of the Jacobian in these coordinates.
        undetermined: names of the parameters the image does not determine.
    """

    standard_errors: np.ndarray
    condition_number: float
    undetermined: tuple[str, ...]


def assess(
    compressed: Compressed,
    fitted: Sequence[FittedParameter],
    residual_count: int,
    covered_count: int,
    covered_squares: float,
) -> Certainty:
    """Return how well an image determines parameters.

    Standard errors are the square roots of the diagonal of s²·(JᵀJ)⁻¹, with s² the residuals' variance where any object
    covers the image (that of float32 rounding at least): what no parameter can change says nothing of them. A parameter
    counts as undetermined when its standard error exceeds `UNDETERMINED`, which it does without limit when the image is
    flat along a direction in which the parameter takes part.

    Args:
        compressed: residuals and Jacobian at the end, of the mean square.
        fitted: the parameters.
        residual_count: number of all residuals.
        covered_count: number of residuals in pixels that any object covers.
        covered_squares: sum of their squares.
    """
    jacobian = compressed.jacobian * np.sqrt(residual_count)
    count = jacobian.shape[1]
    freedom = max(1, covered_count - count)
    variance = max(covered_squares / freedom, SMALLEST_NOISE**2)
    _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf
    # Columns scaled alike first, so that a weak but independent parameter is not taken for a flat direction.
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > 0.0, norms, 1.0)
    _, singular, rows = np.linalg.svd(jacobian / scale, full_matrices=False)
    flat = singular <= FLAT * singular[0] if singular[0] > 0.0 else np.ones(count, bool)
    inverse = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, singular))
    errors = np.sqrt(variance) * np.linalg.norm(rows * inverse[:, None], axis=0) / scale
    involved = np.abs(rows[flat]).max(axis=0, initial=0.0) > 1e-3
    errors = np.where(involved | (norms == 0.0), np.inf, errors)
    names = component_names(fitted)
    undetermined = tuple(name for name, error in zip(names, errors, strict=True) if not error <= UNDETERMINED)
    return Certainty(errors, condition, undetermined)
