"""The course of a fit: killed and resumed it ends at the same bits; what is another study."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scene import spheres
from small_study import Killed, kill_at, make_study, study_of_views

from warpfrag.fit import FitError, FitParameter, Reference, fit
from warpfrag.fit.problem import Problem
from warpfrag.fit.processes import Processes
from warpfrag.fit.session import Session, fingerprint


@pytest.mark.parametrize("method", ["least_squares", "adam", "lbfgs"])
def test_resumed_fit_equals_unbroken_one(tmp_path, method):
    """Killed twice, and resumed, a fit ends at the same bits as one that ran through."""
    study = make_study(method=method, steps=8, checkpoint_seconds=0.0)
    unbroken = fit(study)
    for step in (2, 5):
        with pytest.raises(Killed):
            fit(study, output=tmp_path, resume=step > 2, progress=kill_at(step))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.dat"]
    resumed = fit(study, output=tmp_path, resume=True)
    assert resumed.losses == unbroken.losses
    assert resumed.found == unbroken.found
    assert resumed.standard_errors == unbroken.standard_errors
    np.testing.assert_array_equal(resumed.after, unbroken.after)
    again = fit(study, output=tmp_path, resume=True)
    assert (again.found, again.losses) == (unbroken.found, unbroken.losses)


def test_resume_may_go_further(tmp_path):
    """A fit that ran out of steps goes on with more, as if it had had them from the start."""
    study = make_study(method="adam", steps=4)
    fit(study, output=tmp_path)
    longer = fit(replace(study, steps=7), output=tmp_path, resume=True)
    assert longer.losses == fit(replace(study, steps=7)).losses


def test_resume_is_refused(tmp_path):
    """Without a folder, without a checkpoint, with a broken one, and with that of another study."""
    study = make_study(method="adam", steps=2)
    with pytest.raises(FitError, match="without output"):
        fit(study, resume=True)
    with pytest.raises(FitError, match="no checkpoint"):
        fit(study, resume=True, output=tmp_path)
    fit(study, output=tmp_path)
    with pytest.raises(FitError, match="another study"):
        fit(replace(study, scene=spheres(beta=0.6)), resume=True, output=tmp_path)
    (tmp_path / "checkpoint.dat").write_bytes(b"nonsense")
    with pytest.raises(FitError, match="cannot be read"):
        fit(study, resume=True, output=tmp_path)


def _named(scene):
    scene.objects[2].name = "violet"
    return {}


def _moved(scene):
    scene.objects[0].matrix[0, 3] += 1e-3
    return {}


def _deformed(scene):
    scene.objects[0].vertices = scene.objects[0].vertices * np.float32(1.001)
    return {}


def _coloured(scene):
    scene.objects[0].color = (0.9, 0.1, 0.11)
    return {}


CHANGES = {
    "name": _named,
    "matrix": _moved,
    "vertices": _deformed,
    "color": _coloured,
    "start": lambda scene: {"parameters": {"beta": 0.9, "red.thickness": 0.81}},
    "bounds": lambda scene: {"parameters": {"beta": 0.9, "red.thickness": FitParameter(0.8, 0.1, 2.0)}},
    "method": lambda scene: {"method": "lbfgs"},
    "loss": lambda scene: {"loss": "l1"},
    "seed": lambda scene: {"seed": 1},
    "reference": lambda scene: {"reference": Reference(true={"beta": 0.6})},
    "learning rate": lambda scene: {"learning_rate": 0.03},
    "patience": lambda scene: {"patience": 20},
}


@pytest.mark.parametrize("change", CHANGES)
def test_fingerprint_tells_studies_apart(change):
    """Any change that makes another fit of it makes another fingerprint; more steps do not."""
    starts = {"beta": 0.9, "red.thickness": 0.8}
    study = make_study(starts, method="adam", steps=2)
    scene = spheres()
    changes = CHANGES[change](scene)
    other = replace(study, **({"scene": scene} | changes))
    prints = [fingerprint(s, [view.reference for view in Problem(s).views]) for s in (study, other)]
    assert prints[0] != prints[1]
    longer = replace(study, steps=5)
    assert fingerprint(longer, [view.reference for view in Problem(longer).views]) == prints[0]


def test_resumed_history_decides_the_end(tmp_path):
    """Resumed shortly before its patience ends, Adam stops where an unbroken fit does, with the same count."""
    options = {"method": "adam", "patience": 5, "steps": 200, "learning_rate": 0.2, "checkpoint_seconds": 0.0}
    study = make_study({"red.color": [0.9, 0.1, 0.1]}, **options)
    whole = fit(study)
    assert whole.converged

    def stop(progress):
        if progress.step == len(whole.losses) - 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(study, output=tmp_path, progress=stop)
    resumed = fit(study, output=tmp_path, resume=True)
    assert (resumed.converged, resumed.losses, resumed.evaluations) == (True, whole.losses, whole.evaluations)


def test_batches_visit_all_views_and_resume(tmp_path):
    """Adam on batches of views comes to the same bits when resumed, and ends with the loss of all views."""
    starts = {"red.color": [0.5, 0.5, 0.5], "green.opacity": 0.9}
    study = study_of_views(
        starts, method="adam", batch=2, count=5, steps=30, learning_rate=0.05, checkpoint_seconds=0.0
    )
    whole = fit(study)

    def stop(progress):
        if progress.step == 11:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(study, output=tmp_path, progress=stop)
    resumed = fit(study, output=tmp_path, resume=True)
    assert resumed.losses == whole.losses
    np.testing.assert_array_equal(resumed.found["red.color"], whole.found["red.color"])
    problem = Problem(study)
    values = {name: torch.as_tensor(value) for name, value in whole.found.items()}
    full = np.mean([float(view.loss(view.image(values))) for view in problem.views])
    assert whole.loss == pytest.approx(full, rel=1e-6)


def test_more_steps_of_batches_are_another_fit(tmp_path):
    """The last step looks at all views, which decides when to stop: a checkpoint of fewer steps is refused."""
    study = study_of_views({"red.color": [0.5, 0.5, 0.5]}, method="adam", batch=2, steps=2)
    fit(study, output=tmp_path)
    with pytest.raises(FitError, match="another study"):
        fit(replace(study, steps=4), output=tmp_path, resume=True)


def test_a_wish_to_stop_is_one_in_all_processes(tmp_path):
    """Ctrl-C in one of them stops each at the end of the same step, with a checkpoint."""

    class Two(Processes):
        """Two processes, the other of which has been interrupted."""

        def __init__(self):
            self.count, self.rank, self.device = 2, 0, "cpu"

        def sum(self, vector):
            return vector + 1.0

    study = study_of_views({"beta": 0.5})
    session = Session(study, "", tmp_path, None, 0.0, Two())
    with pytest.raises(KeyboardInterrupt):
        session.step(1.0, {"beta": 0.5}, lambda: {"coordinates": np.zeros(1)})
    assert (tmp_path / "checkpoint.dat").is_file()


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
