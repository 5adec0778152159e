"""Adam and L-BFGS: what they find, stages, batches, priors, where they stop."""

import numpy as np
import pytest
import torch
from small_scene import spheres
from small_study import make_study, study_of_views

import warpfrag as wf
from warpfrag.fit import FitError, FitParameter, fit
from warpfrag.fit.descent import Adam
from warpfrag.fit.problem import Problem, ViewProblem
from warpfrag.fit.session import Session


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
def test_first_order_methods_recover_what_is_well_conditioned(method):
    """Colours and an opacity come back by torch's optimisers."""
    starts = {"red.color": [0.5, 0.5, 0.5], "green.opacity": 0.9}
    result = fit(make_study(starts, method=method, steps=250, learning_rate=0.03))
    assert max(result.relative_errors().values()) < 0.01
    assert result.standard_errors is not None


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
def test_maps_and_vertices(method):
    """A thickness map, colours per vertex and vertices go down in loss and stay within their bounds."""
    scene = spheres(2)
    moved = scene.parameters()["red.vertices"] + np.float32([0.0, 0.0, 0.03])
    parameters = {
        "green.thickness": FitParameter(0.2, 0.1, 0.35, per="pixel"),
        "red.color": FitParameter([0.5, 0.5, 0.5], per="vertex"),
        "red.vertices": FitParameter(learning_rate=0.002),
    }
    study = make_study(parameters, scene=scene, true={"red.vertices": moved}, method=method, steps=12)
    result = fit(study)
    assert result.loss < 0.5 * result.losses[0]
    found = result.found["green.thickness"]
    assert found.shape == scene.camera.shape
    assert found.min() >= 0.1
    assert found.max() <= 0.35
    assert found.std() > 0.0
    assert result.found["red.color"].shape == moved.shape
    assert np.abs(result.found["red.vertices"] - scene.parameters()["red.vertices"]).max() > 0.0
    assert result.standard_errors is None


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
def test_nan_in_a_gradient_stops(method, monkeypatch):
    """A gradient that is not finite stops with the step and the parameter's name."""
    original = ViewProblem.image

    def poisoned(self, values):
        image, value = original(self, values), values["green.thickness"]
        if not isinstance(value, torch.Tensor):
            return image
        # The slope of the root at 0 is infinite, and 0 times infinity is NaN.
        return image + (value - value.detach()).sqrt() * 0.0

    monkeypatch.setattr(ViewProblem, "image", poisoned)
    with pytest.raises(FitError, match=r"step 1: the gradient in green\.thickness is not finite"):
        fit(make_study(method=method))


def test_batches_are_parts_of_rounds():
    """In each round every view has its turn once, in an order of its own; a batch's loss is the mean of its views'."""
    study = study_of_views({"red.color": [0.5, 0.5, 0.5]}, method="adam", batch=2, count=5, steps=9)
    problem = Problem(study)
    adam = Adam(problem, Session(study, "", None, None, 0.0))
    seen, losses = [], []
    original = adam.evaluate

    def evaluate(views):
        seen.append(views)
        losses.append(original(views))
        alone = [original([view]) for view in views]
        assert losses[-1] == pytest.approx(np.mean(alone), rel=1e-12)
        return original(views)

    adam.evaluate = evaluate
    adam.run(problem.start())
    rounds = [seen[first : first + 3] for first in (0, 3, 6)]
    for each in rounds:
        assert sorted(view for batch in each for view in batch) == list(range(5))
    assert rounds[0] != rounds[1]


def test_gradient_of_a_loss_with_a_prior():
    """What Adam steps by is the slope of the loss, prior included, in the coordinates of a coarse map."""
    scene = spheres()
    generator = np.random.default_rng(3)
    start = generator.uniform(0.1, 0.3, (36, 40))
    parameters = {"thickness": FitParameter(start, 0.05, 0.8, smoothness=0.3, levels=2), "beta": 0.6}
    study = make_study(parameters, scene=scene, method="adam", steps=4)
    problem = Problem(study)
    adam = Adam(problem, Session(study, "", None, None, 0.0))
    adam.begin(problem.start())
    loss = adam.evaluate([0])
    leaf = adam.coordinates[0].leaf
    slopes = leaf.grad.clone()
    assert loss == pytest.approx(adam.full_loss(), rel=1e-12)
    # A step in which float32's rounding of the image, 1e-7, is small beside the prior's and the image's change.
    step, direction = 1e-3, torch.tensor(generator.normal(size=leaf.shape))
    ends = []
    for sign in (1.0, -1.0):
        leaf.data += sign * step * direction
        ends.append(adam.full_loss())
        leaf.data -= sign * step * direction
    assert float((slopes * direction).sum()) == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=1e-2)
    # The prior is most of it.
    _, priors = adam._values_and_priors()
    assert float(priors[0].detach()) > 0.5 * loss


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
def test_prior_makes_maps_smooth(method):
    """A map with the prior is smoother than one without, and the prior counts in the loss."""
    rough, smooth = (
        fit(make_study({"thickness": FitParameter(0.1, 0.05, 0.8, "pixel", smoothness=s)}, method=method, steps=25))
        for s in (0.0, 1e-2)
    )
    difference = [np.abs(np.diff(np.log(r.found["thickness"]), axis=0)).mean() for r in (rough, smooth)]
    assert difference[1] < 0.5 * difference[0]
    for result in (rough, smooth):
        assert result.loss < result.losses[0]
    after = np.mean((smooth.after.astype(np.float64) - smooth.reference) ** 2)
    assert smooth.loss > after


def test_a_map_of_beta_is_found():
    """Beta that varies over the image comes back where slabs overlap, from coarse to fine."""
    scene = spheres()
    for item in scene.objects:
        item.opacity = 0.97
    ramp = np.broadcast_to(np.linspace(0.1, 0.9, 40), (36, 40)).copy()
    parameter = FitParameter(0.5, per="pixel", levels=4, smoothness=1e-6)
    study = make_study({"beta": parameter}, scene=scene, true={"beta": ramp}, method="lbfgs", steps=80)
    result = fit(study)
    fragments = wf.capture(scene)
    # Only where fragments merge does beta matter.
    matters = np.abs(wf.composite(fragments, 0.1) - wf.composite(fragments, 0.9)).max(axis=2) > 0.02
    assert matters.sum() > 60
    assert np.abs(result.found["beta"] - ramp)[matters].mean() < 0.03
    assert result.relative_errors()["beta"] >= 0.0


def test_each_parameter_may_have_its_learning_rate():
    """Adam's first step has the length of the parameter's own rate."""
    parameters = {"red.color": FitParameter([0.5] * 3, learning_rate=0.1), "green.color": [0.5] * 3}
    study = make_study(parameters, method="adam", steps=2, learning_rate=0.01)
    seen = []
    fit(study, progress=lambda progress: seen.append(progress.parameters))
    for name, rate in (("red.color", 0.1), ("green.color", 0.01)):
        np.testing.assert_allclose(np.abs(seen[1][name] - seen[0][name]).max(), rate, rtol=1e-3)


def test_patience_stops_early():
    """Adam ends when so many steps brought nothing better."""
    study = make_study({"red.color": [0.9, 0.1, 0.1]}, method="adam", patience=5, steps=200, learning_rate=0.2)
    result = fit(study)
    assert result.converged
    assert len(result.losses) < 60
    assert "5 steps" in result.reason


def test_structural_similarity_is_fitted():
    """Colours come back by SSIM and absolute values together, over several scales."""
    study = make_study({"red.color": [0.5, 0.5, 0.5]}, loss={"l1": 0.8, "ssim": 0.2}, scales=2, steps=200)
    assert study.prepared.method == "adam"
    result = fit(study)
    np.testing.assert_allclose(result.found["red.color"], (0.9, 0.1, 0.1), atol=0.02)
    assert result.setting["loss_name"] == "0.8 l1 + 0.2 ssim"
