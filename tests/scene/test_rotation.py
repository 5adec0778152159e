"""Rotation vectors: the exponential, its derivative, at zero and away from it."""

import numpy as np
import pytest
import torch

from warpfrag.scene.rotation import cross_matrix, left_jacobian, rotation_matrix

VECTORS = {
    "zero": (0.0, 0.0, 0.0),
    "tiny": (1e-7, -2e-7, 1e-7),
    "small": (1.0, 2.0, -3.0),
    "below one radian": (30.0, -40.0, 28.0),
    "above one radian": (30.0, -40.0, 29.0),
    "large": (100.0, 50.0, -120.0),
    "more than a turn": (300.0, -300.0, 100.0),
}


def exponential(matrix: np.ndarray) -> np.ndarray:
    """Return the exponential of a small matrix as its power series, of the matrix / 2^6, squared six times."""
    total = term = np.eye(3)
    for k in range(1, 20):
        term = term @ matrix / 64.0 / k
        total = total + term
    for _ in range(6):
        total = total @ total
    return total


@pytest.mark.parametrize(
    ("vector", "point", "expected"),
    [
        ((0, 0, 90), (1, 0, 0), (0, 1, 0)),
        ((90, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, -90, 0), (0, 0, 1), (-1, 0, 0)),
        ((0, 180, 0), (1, 2, 3), (-1, 2, -3)),
        (np.full(3, 120 / np.sqrt(3)), (1, 2, 3), (3, 1, 2)),
    ],
)
def test_rotations_by_hand(vector, point, expected):
    """Angles are degrees, and turn from x to y about z."""
    np.testing.assert_allclose(rotation_matrix(np.array(vector)) @ point, expected, atol=1e-15)


@pytest.mark.parametrize("vector", VECTORS.values(), ids=VECTORS)
def test_rotation_is_the_exponential(vector):
    """The matrix is exp([v]×), for NumPy and torch alike, whichever series or closed form is used."""
    expected = exponential(cross_matrix(np.radians(vector)))
    # Rounding of squaring six times.
    np.testing.assert_allclose(rotation_matrix(np.array(vector)), expected, rtol=0, atol=1e-14)
    tensor = rotation_matrix(torch.tensor(vector, dtype=torch.float32))
    assert tensor.dtype == torch.float64
    # The vector's own rounding, in radians.
    np.testing.assert_allclose(tensor.numpy(), expected, rtol=0, atol=5e-7)


@pytest.mark.parametrize("vector", VECTORS.values(), ids=VECTORS)
def test_rotation_is_differentiable(vector):
    """Its gradient equals differences everywhere, zero included."""
    leaf = torch.tensor(vector, dtype=torch.float64, requires_grad=True)
    # Steps in degrees: an entry's second derivative is below 4e-4.
    assert torch.autograd.gradcheck(rotation_matrix, leaf, eps=1e-4, atol=1e-8, rtol=0.0)


@pytest.mark.parametrize("vector", VECTORS.values(), ids=VECTORS)
def test_left_jacobian(vector):
    """R(v + dv) = R(J dv) R(v) to first order."""
    vector, step = np.array(vector), 1e-4 * np.array([0.3, -0.5, 0.8])
    turned = rotation_matrix(left_jacobian(vector) @ step) @ rotation_matrix(vector)
    still = rotation_matrix(step) @ rotation_matrix(vector)
    expected = rotation_matrix(vector + step)
    # Second order in a step of 1.7e-6 radians.
    np.testing.assert_allclose(turned, expected, rtol=0, atol=1e-11)
    assert np.abs(vector).max() < 1e-3 or np.abs(still - expected).max() > 1e-8
