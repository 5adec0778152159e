"""Few rows that keep the normal equations."""

import numpy as np
import pytest
from small_study import EVERYTHING, make_study

from warpfrag.fit.compression import triangle_of
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.problem import Problem


@pytest.mark.parametrize("name", ["l2", "l1", "huber"])
def test_compressed_rows_keep_the_normal_equations(name):
    """|f|², JᵀJ and Jᵀf of the few rows are those of the whole image, weighted as the loss says."""
    problem = Problem(make_study(EVERYTHING))
    loss = RobustLoss.named(name, 0.05)
    evaluation = Evaluation(problem, loss, problem.start())
    compressed = evaluation.compress()
    view = evaluation.views[0]
    jacobian = np.concatenate([view.channel(channel) for channel in range(4)])
    residual = np.moveaxis(view.residual, 2, 0).reshape(-1)
    weight = loss.weight(residual)
    first = np.zeros(len(compressed.jacobian))
    first[0] = np.sqrt(compressed.cost)
    np.testing.assert_allclose(compressed.cost, loss.rho(residual).mean(), rtol=1e-12)
    gram = (jacobian.T * weight) @ jacobian / residual.size
    np.testing.assert_allclose(compressed.jacobian.T @ compressed.jacobian, gram, rtol=1e-9, atol=1e-15)
    gradient = jacobian.T @ (weight * residual) / residual.size
    np.testing.assert_allclose(compressed.jacobian.T @ first, gradient, rtol=1e-9, atol=1e-15)


def test_triangle_takes_all_rows():
    """However many whole blocks there are, and rows after them, RᵀR is that of all rows."""
    generator = np.random.default_rng(7)
    for count in (3, 500, 1300):
        rows = generator.normal(size=(count, 5))
        triangle = triangle_of([rows[: count // 2], rows[count // 2 :]])
        assert triangle.shape == (5, 5)
        np.testing.assert_allclose(triangle.T @ triangle, rows.T @ rows, rtol=1e-10, atol=1e-10)
