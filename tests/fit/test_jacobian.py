"""The Jacobian of the images: by differences, by autograd, over views and scales."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scene import spheres
from small_study import EVERYTHING, FEWER_STARTS, around, make_study, study_of_views

from warpfrag.fit import Reference, Study
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.problem import Problem


def test_jacobian_is_that_of_differences():
    """Where the image is smooth, every column is the central difference of the image, in all four channels."""
    scene = replace(spheres(), background=(0.4, 0.3, 0.2, 0.5))
    problem = Problem(make_study(EVERYTHING, scene=scene))
    loss = RobustLoss.named("l2", 1.0)
    start = problem.start()
    middle = Evaluation(problem, loss, start).views[0]
    jacobian = np.stack([middle.channel(channel) for channel in range(4)], axis=1).reshape(36, 40, 4, -1)
    # Rounding of float32 (1e-7) over the step, and the square of the step, both stay below the tolerance.
    step, tolerance = 2e-3, 5e-4
    for column in range(start.size):
        shift = step * np.eye(start.size)[column]
        up, down = (Evaluation(problem, loss, start + sign * shift).views[0].residual for sign in (1, -1))
        ahead, behind = (up - middle.residual) / step, (middle.residual - down) / step
        # Where slabs begin to overlap SFM has kinks and jumps: there differences mean nothing.
        smooth = np.abs(ahead - behind) < 5e-3
        assert smooth.mean() > 0.95
        assert np.abs(jacobian[..., column]).max() > 0.02
        np.testing.assert_allclose(jacobian[..., column][smooth], 0.5 * (ahead + behind)[smooth], atol=tolerance * 5)


def test_cost_is_the_mean_over_views():
    """Cost, JᵀJ and Jᵀf are the means of those of single views, whatever their sizes."""
    scene, loss = spheres(), RobustLoss.named("huber", 0.05)
    views = around(2, scene)
    views = (views[0], replace(views[1], camera=views[1].camera.resized((30, 24))))
    whole = Study(scene, Reference(true={}), FEWER_STARTS, views=views)
    parts = [Study(scene, Reference(true={}), FEWER_STARTS, views=(view,)) for view in views]
    both, *single = [
        (evaluation.cost, evaluation.compress().jacobian)
        for evaluation in (Evaluation(Problem(s), loss, Problem(s).start()) for s in (whole, *parts))
    ]
    np.testing.assert_allclose(both[0], np.mean([cost for cost, _ in single]), rtol=1e-12)
    gram = np.mean([jacobian.T @ jacobian for _, jacobian in single], axis=0)
    np.testing.assert_allclose(both[1].T @ both[1], gram, rtol=1e-9, atol=1e-15)


def test_multi_scale_jacobian_is_that_of_the_pyramid():
    """With scales the cost is the mean over levels, and Jᵀf its gradient as torch has it."""
    study = study_of_views({"beta": 0.4, "red.thickness": 0.5, "blue.opacity": 0.5}, scales=3, loss="huber", delta=0.05)
    problem = Problem(study)
    evaluation = Evaluation(problem, study.prepared.image_loss.robust, problem.start())
    compressed = evaluation.compress()
    leaves = {n: torch.tensor(v, requires_grad=True) for n, v in problem.values(problem.start()).items()}
    loss = sum(view.loss(view.image(leaves)) for view in problem.views) / 3
    loss.backward()
    factor = study.prepared.image_loss.robust.factor
    np.testing.assert_allclose(evaluation.cost * factor, float(loss.detach()), rtol=1e-6)
    gradient = 2.0 * factor * np.sqrt(compressed.cost) * compressed.jacobian[0]
    values = problem.values(problem.start())
    # A thickness's coordinate is its logarithm.
    expected = [float(leaf.grad) * (values[n] if "thickness" in n else 1.0) for n, leaf in leaves.items()]
    np.testing.assert_allclose(gradient, expected, rtol=2e-4)


MOTIONS = {
    "red.translation": [0.02, -0.01, 0.05],
    "red.rotation": [3.0, -5.0, 8.0],
    "camera.translation": [0.01, 0.02, -0.03],
    "camera.rotation": [0.5, -0.4, 1.0],
}


@pytest.mark.parametrize(("per_vertex", "opacity"), [(False, True), (True, False), (True, True)])
@pytest.mark.parametrize("name", MOTIONS)
def test_motion_columns_are_autograd(name, per_vertex, opacity):
    """The columns of transforms and cameras are what torch says for each pixel, with coverage held fixed.

    Per vertex, what moves with its surface is colour, opacity and a thickness in P(z) that is fitted.
    """
    scene = replace(spheres(), background=(0.4, 0.3, 0.2, 0.5))
    parameters = {**MOTIONS, "beta": 0.5, "red.thickness": 0.4} | ({"red.opacity": 0.7} if opacity else {})
    if per_vertex:
        for item in scene.objects:
            waves = np.sin(4.0 * item.vertices).astype(np.float32)
            item.color, item.opacity = 0.5 + 0.4 * waves, 0.5 + 0.3 * waves[:, 0]
            item.thickness, item.thickness_unit = 3e5, "P"
        parameters["red.thickness"] = 2e5
    else:
        parameters["green.color"] = [0.3, 0.4, 0.5]
    problem = Problem(study_of_views(parameters, scene=scene, count=1))
    view, start = problem.views[0], problem.start()
    evaluation = Evaluation(problem, RobustLoss.named("l2", 1.0), start).views[0]
    variables = problem.study.parameters
    first = sum(v.start.size for v in variables[: [v.name for v in variables].index(name)])
    generator = np.random.default_rng(2)
    for channel in range(4):
        columns = evaluation.channel(channel)[:, first : first + 3]
        weights = generator.uniform(size=len(columns))
        leaves = {n: torch.tensor(v, requires_grad=True) for n, v in problem.values(start).items()}
        image = view.image(leaves)[..., channel].double().reshape(-1)
        (image @ torch.tensor(weights)).backward()
        unit = next(v.unit for v in variables if v.name == name)
        # A sphere of one opacity: that of the image is the same wherever it is.
        assert (channel == 3 and (opacity or not per_vertex)) or np.abs(columns).max() > 1e-3
        np.testing.assert_allclose(weights @ columns, leaves[name].grad.numpy() * unit, rtol=2e-3, atol=2e-4)
