"""Fits from the first step to the result: restarts, progress, several views, what stops them."""

import json
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from small_scene import spheres
from small_study import FEWER_STARTS, STARTS, make_study, study_of_views

import warpfrag as wf
from warpfrag.fit import FitError, FitParameter, FitResult, Reference, StudyError, fit
from warpfrag.fit import problem as problem_module
from warpfrag.fit.saving import to_json


@pytest.mark.parametrize("method", ["least_squares", "adam", "lbfgs"])
def test_nan_in_the_loss_stops(method, monkeypatch):
    """A loss that is not finite stops with the step and the parameters there."""
    calls = []
    original = problem_module.composite

    def poisoned(fragments, beta, **options):
        calls.append(beta)
        image = original(fragments, beta, **options)
        if len(calls) > 3:
            image.fill_(float("nan")) if hasattr(image, "fill_") else image.fill(np.nan)
        return image

    for module in (problem_module, import_module("warpfrag.renderer")):
        monkeypatch.setattr(module, "composite", poisoned)
    with pytest.raises(FitError, match=r"step \d+: the loss is nan at beta 0\.\d+, red\.thickness"):
        fit(make_study(method=method))


def test_restarts_keep_the_best(monkeypatch):
    """With restarts the best end counts, and the same seed gives the same fit."""
    study = make_study({"beta": 0.9, "red.thickness": 0.8}, restarts=2, seed=3)
    first, second = fit(study), fit(study)
    assert first.losses == second.losses
    assert first.loss <= fit(replace(study, restarts=0)).loss


def test_progress_is_told():
    """Every step is reported with its loss and parameters."""
    told = []
    result = fit(make_study(steps=3, method="adam"), progress=told.append)
    assert [report.step for report in told] == [1, 2, 3]
    assert tuple(report.loss for report in told) == result.losses
    assert told[0].parameters.keys() == STARTS.keys()
    assert isinstance(result, FitResult)


@pytest.mark.parametrize("method", ["least_squares", "adam", "lbfgs"])
def test_several_views_are_fitted_together(method, tmp_path):
    """What one view determines badly several determine well; held-out views get their error too."""
    starts = FEWER_STARTS if method == "least_squares" else {"red.color": [0.5, 0.5, 0.5], "green.opacity": 0.9}
    result = fit(study_of_views(starts, method=method, held_out=1, learning_rate=0.03), output=tmp_path)
    assert max(result.relative_errors().values()) < 0.01
    assert [view.held_out for view in result.views] == [False, False, True]
    assert min(view.psnr for view in result.views) > 50.0
    content = json.loads((tmp_path / "result.json").read_text())
    assert [view["name"] for view in content["views"]] == ["view0", "view1", "view2"]
    assert (tmp_path / "view2" / "error.png").is_file()
    assert any("held out" in line for line in result.lines())


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
