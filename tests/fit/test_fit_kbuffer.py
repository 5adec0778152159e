"""Fitting images that a k-buffer resolves: its Jacobian, recovery, what does not go with it."""

from dataclasses import replace

import numpy as np
import pytest
from small_scene import spheres

import warpfrag as wf
from warpfrag.capture.bounded import capture_kbuffer
from warpfrag.fit import FitParameter, Reference, Study, StudyError, fit
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.problem import Problem

START = {"red.opacity": 0.3, "green.color": [0.4, 0.4, 0.4], "blue.opacity": 0.8}


def make_study(parameters=None, layers=3, merge="order_independent", **options) -> Study:
    """Return a study of the small scene against its own k-buffer."""
    scene = replace(spheres(), layers=layers, merge=merge)
    return Study(scene, Reference(true={}), parameters or START, resolve="kbuffer", **options)


def test_image_is_that_of_the_bounded_capture():
    """The frozen scene gives what the bounded capture does, and not what sorting does."""
    study = make_study()
    problem = Problem(study)
    values = {name: np.float32(value) for name, value in problem.values(problem.start()).items()}
    layers = capture_kbuffer(study.scene, slots=3, parameters=values)
    view = problem.views[0]
    image = view.over_background(wf.composite(layers))
    np.testing.assert_allclose(view.image(values), image, atol=2e-6)
    assert np.abs(image - wf.render(study.scene, parameters=values)).max() > 0.01


@pytest.mark.parametrize("merge", ["order_independent", "none"])
def test_jacobian_is_that_of_differences(merge):
    """Colour and opacity change no merge tree: every column is the central difference of the image."""
    problem = Problem(make_study(merge=merge))
    loss, start = RobustLoss.named("l2", 1.0), problem.start()
    middle = Evaluation(problem, loss, start).views[0]
    jacobian = np.stack([middle.channel(channel) for channel in range(4)], axis=1)
    jacobian = jacobian.reshape(*middle.residual.shape, -1)
    for column in range(start.size):
        shift = 2e-3 * np.eye(start.size)[column]
        up, down = (Evaluation(problem, loss, start + sign * shift).views[0].residual for sign in (1, -1))
        assert np.abs(jacobian[..., column]).max() > 0.02
        # Rounding of float32 over the step, and its square.
        np.testing.assert_allclose(jacobian[..., column], (up - down) / 4e-3, atol=2e-4)


def test_least_squares_finds_opacity_and_colour():
    """Through the k-buffer as through the sorted pass."""
    found = fit(make_study()).found
    np.testing.assert_allclose([found["red.opacity"], found["blue.opacity"]], 0.6, atol=1e-3)
    np.testing.assert_allclose(found["green.color"], (0.1, 0.8, 0.2), atol=1e-3)


def test_descent_takes_values_by_vertex():
    """Many parameters: the scene is captured in every step, with the gradient through the bounded capture."""
    vertex_count = len(spheres().objects[0].vertices)
    start = FitParameter(np.full(vertex_count, 0.3))
    result = fit(make_study({"red.opacity": start}, method="adam", steps=30, learning_rate=0.05))
    assert result.loss < 0.1 * result.losses[0]


def test_what_does_not_go_together_is_refused():
    """Merging by depth, other mixes and beta have no place in a k-buffer."""
    with pytest.raises(StudyError, match='merge: got "smooth" with resolve "kbuffer"'):
        make_study(merge="smooth")
    with pytest.raises(StudyError, match='parameters: got beta with resolve "kbuffer"'):
        make_study({"beta": 0.5})
    with pytest.raises(StudyError, match="resolve: got"):
        Study(spheres(), Reference(true={}), START, resolve="bins")
