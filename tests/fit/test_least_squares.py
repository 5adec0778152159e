"""Least squares: parameters come back from starts that are far off."""

from dataclasses import replace

import numpy as np
import pytest
from small_scene import spheres
from small_study import make_study, study_of_views, textured

from warpfrag.fit import FitParameter, fit


@pytest.mark.parametrize("loss", ["l2", "l1", "huber"])
def test_least_squares_recovers(loss):
    """Beta and three thicknesses come back to 1 % from starts that are far off, by every loss."""
    result = fit(make_study(loss=loss, delta=0.02))
    assert result.converged
    assert max(result.relative_errors().values()) < 0.01
    assert result.undetermined == ()
    assert 1.0 < result.condition_number < 1e4
    assert result.loss <= min(result.losses)


def test_least_squares_recovers_opacity_and_color():
    """Opacity, colour, beta and thickness together, with a thickness in multiples of P(z) among them."""
    scene = spheres()
    scene.objects[0] = replace(scene.objects[0], thickness=3e5, thickness_unit="P")
    starts = {"beta": 0.8, "red.thickness": 1e5, "green.opacity": 0.8, "blue.color": [0.5, 0.5, 0.5]}
    result = fit(make_study(starts, scene=scene))
    assert max(result.relative_errors().values()) < 0.01


@pytest.mark.parametrize("loss", ["l1", "huber"])
def test_least_squares_finds_a_transform(loss):
    """Place and turn of an object come back from several views, together with its thickness.

    Losses that grow linearly: outlines that do not fit leave large residuals, of which the gradient knows nothing.
    """
    true = {"red.translation": [0.03, -0.02, 0.02], "red.rotation": [2.0, -3.0, 4.0], "red.thickness": 0.3}
    starts = {"red.translation": None, "red.rotation": None, "red.thickness": 0.4}
    study = study_of_views({n: FitParameter(v) for n, v in starts.items()}, scene=textured(), true=true, loss=loss)
    result = fit(replace(study, delta=0.02))
    np.testing.assert_allclose(result.found["red.translation"], true["red.translation"], atol=2e-4)
    np.testing.assert_allclose(result.found["red.rotation"], true["red.rotation"], atol=0.05)


@pytest.mark.parametrize("per", ["object", "view"])
def test_least_squares_finds_the_camera(per):
    """The camera's own motion comes back, one for all views or one for each."""
    turn = np.array([0.6, -0.8, 1.0]) if per == "object" else np.array([[0.6, -0.8, 1.0], [0.2, 0.9, -0.5]])
    parameters = {"camera.rotation": FitParameter(per=per), "camera.translation": FitParameter(per=per)}
    study = study_of_views(parameters, scene=textured(), true={"camera.rotation": turn}, count=2)
    result = fit(study)
    assert result.found["camera.rotation"].shape == turn.shape
    np.testing.assert_allclose(result.found["camera.rotation"], turn, atol=0.05)
    np.testing.assert_allclose(result.found["camera.translation"], 0.0, atol=5e-3)
