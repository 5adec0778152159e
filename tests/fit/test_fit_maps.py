"""Maps: from coarse to fine, the prior of smoothness, beta per pixel, thickness in multiples of P; restarts."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scene import spheres

import warpfrag as wf
from warpfrag.fit import FitError, FitParameter, FitResult, Reference, Study, StudyError, fit
from warpfrag.fit.descent import Adam
from warpfrag.fit.maps import Smoothness, coarsen, level_of, refine
from warpfrag.fit.problem import Problem
from warpfrag.fit.saving import to_json
from warpfrag.fit.session import Session


def make_study(parameters, *, true=None, scene=None, **options) -> Study:
    """Return a study of the small scene against its own render."""
    return Study(scene or spheres(), Reference(true=true or {}), parameters, **options)


def smoothness(name: str, parameter: FitParameter) -> Smoothness:
    """Return the prior on a parameter of the small scene."""
    study = make_study({name: parameter}, method="adam")
    return Smoothness(study.prepared.parameters[0], study.scene, "cpu")


def test_grids_go_there_and_back():
    """A constant stays what it is, a refined grid stays within the coarse one's values, sizes are rounded up."""
    grid = torch.arange(35.0, dtype=torch.float64).reshape(5, 7)
    assert coarsen(grid, 0) is grid
    # Means of what each coarse pixel covers; in between linear, and constant beyond the outer middles.
    torch.testing.assert_close(coarsen(grid[:4, :4], 1), torch.tensor([[4.0, 6.0], [18.0, 20.0]]).double())
    torch.testing.assert_close(
        refine(torch.tensor([[0.0, 4.0]]).double(), (1, 4))[0], torch.tensor([0, 1, 3, 4]).double()
    )
    assert coarsen(grid, 1).shape == (3, 4)
    assert coarsen(grid, 9).shape == (1, 1)
    assert refine(coarsen(grid, 1), (5, 7)).shape == (5, 7)
    assert refine(coarsen(grid, 1), (5, 7)).max() <= grid.max()
    ones = torch.ones(2, 5, 7, dtype=torch.float64)
    torch.testing.assert_close(refine(coarsen(ones, 2), (2, 5, 7)), ones)


def test_levels_go_down_by_stages():
    """The coarsest first, the finest from then on."""
    variable = make_study({"beta": FitParameter(per="pixel", levels=3)}).prepared.parameters[0]
    assert [level_of(variable, stage) for stage in range(5)] == [2, 1, 0, 0, 0]


def test_smoothness_of_a_map():
    """The mean squared difference of pixels side by side, by hand."""
    prior = smoothness("beta", FitParameter(per="pixel", smoothness=3.0))
    grid = torch.tensor([[0.0, 1.0], [0.0, 3.0]], dtype=torch.float64, requires_grad=True)
    # Differences: 0 and 2 down, 1 and 3 across.
    assert prior(grid).item() == pytest.approx(3.0 * (0 + 4 + 1 + 9) / 4)
    assert torch.autograd.gradcheck(prior, grid)


def test_smoothness_of_vertices():
    """Along edges, each once; of positions it is the displacement that counts."""
    prior = smoothness("red.vertices", FitParameter(smoothness=2.0))
    start = prior.origin.clone()
    assert prior(start + 0.3).item() == pytest.approx(0.0, abs=1e-20)
    moved = start.clone()
    moved[0] += torch.tensor([1.0, 0.0, 0.0])
    ends = int((prior.edges == 0).sum())
    assert prior(moved).item() == pytest.approx(2.0 * ends / (3 * len(prior.edges)))
    assert len({tuple(edge) for edge in prior.edges.tolist()}) == len(prior.edges)


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


def test_thickness_of_all_objects():
    """One thickness for the whole scene is that of every object without one of its own."""
    scene = spheres()
    true = {"thickness": 0.3, "green.thickness": 0.5}
    study = make_study({"thickness": 0.7, "green.thickness": 0.2, "beta": 0.9}, scene=scene, true=true)
    assert study.prepared.method == "least_squares"
    result = fit(study)
    assert max(result.relative_errors().values()) < 0.01


def test_thickness_in_multiples_of_p():
    """A start such as "2P" has the thickness fitted in that unit, and the reference keeps the scene's own."""
    scene = spheres()
    study = make_study({"red.thickness": FitParameter("200000P")}, scene=scene)
    assert study.scene.objects[0].thickness_unit == "scene"
    assert study.prepared.scene.objects[0].thickness_unit == "P"
    assert study.prepared.true is None
    result = fit(study)
    # P(z) varies by a few percent over the sphere, so that one multiple cannot be one length.
    middle = float(np.linalg.norm(np.subtract(scene.camera.eye, scene.objects[0].middle())))
    length = result.found["red.thickness"] * float(wf.z_resolution(middle, 0.1, 10.0))
    assert length == pytest.approx(0.3, rel=0.25)
    known = replace(study, reference=Reference(true={"red.thickness": "300000P"}))
    assert known.prepared.true["red.thickness"] == 3e5
    assert fit(known).found["red.thickness"] == pytest.approx(3e5, rel=0.01)
    for name, start in (("beta", "2P"), ("red.thickness", "much")):
        with pytest.raises(StudyError, match=f"{name}: got"):
            make_study({name: FitParameter(start)})


class Killed(BaseException):
    """What stops a fit as a kill would: nothing is caught or cleaned up."""


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
@pytest.mark.parametrize("step", [3, 11, 17])
def test_resumed_stages_and_restarts_equal_unbroken_ones(tmp_path, method, step):
    """Killed in whichever stage or run, a resumed fit ends at the same bits, with all runs."""
    parameters = {"thickness": FitParameter(0.1, 0.05, 0.8, "pixel", levels=3, smoothness=1e-4), "beta": 0.9}
    study = make_study(parameters, method=method, steps=9, restarts=1, seed=4, checkpoint_seconds=0.0)
    whole = fit(study)

    def kill(progress):
        if progress.step == step:
            raise Killed

    with pytest.raises(Killed):
        fit(study, output=tmp_path, progress=kill)
    resumed = fit(study, output=tmp_path, resume=True)
    assert [run.losses for run in resumed.runs] == [run.losses for run in whole.runs]
    np.testing.assert_array_equal(resumed.found["thickness"], whole.found["thickness"])
    with pytest.raises(FitError, match="another study"):
        fit(replace(study, steps=12), output=tmp_path, resume=True)


@pytest.mark.parametrize("method", ["least_squares", "adam", "lbfgs"])
def test_all_restarts_are_reported(method):
    """Every start with its end; the best one is the result; the same seed draws the same starts."""
    study = make_study({"beta": 0.9, "red.thickness": 0.8}, restarts=2, seed=3, method=method, steps=8)
    first, second = fit(study), fit(study)
    assert isinstance(first, FitResult)
    assert [run.losses for run in first.runs] == [run.losses for run in second.runs]
    assert len(first.runs) == 3
    assert first.runs[0].start == first.start
    assert first.runs[1].start["beta"] != first.runs[2].start["beta"]
    assert first.loss == min(run.loss for run in first.runs)
    assert first.found == next(run.found for run in first.runs if run.loss == first.loss)
    assert to_json(first)["runs"][2]["loss"] == first.runs[2].loss
    assert any("3 starts" in line for line in first.lines())


def test_random_starts_are_spread():
    """They differ from one another, a colour's numbers too, and lie between the bounds."""
    starts = Problem(make_study({"red.color": [0.5] * 3, "red.thickness": 0.3}, restarts=3)).starts()[1:]
    lower, upper = Problem(make_study({"red.color": [0.5] * 3, "red.thickness": 0.3})).bounds()
    for start in starts:
        assert ((start > lower) & (start < upper)).all()
        assert np.ptp(start[:3]) > 0.01
    assert np.ptp(np.array(starts), axis=0).min() > 0.01


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
