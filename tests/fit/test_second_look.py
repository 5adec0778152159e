"""What is said at the end of a fit: that it is none yet, that outlines tell more than gradients, that merging jumps."""

from dataclasses import replace

import numpy as np
import pytest
from small_scene import spheres
from small_study import make_study

from warpfrag.fit import FitParameter, StudyError, fit
from warpfrag.fit.descent import LBFGS
from warpfrag.fit.least_squares import LeastSquares
from warpfrag.fit.problem import Problem
from warpfrag.fit.second_look import falling_steps
from warpfrag.fit.session import Session


@pytest.mark.parametrize("method", ["least_squares", "lbfgs", "adam"])
@pytest.mark.parametrize(
    ("start", "true"),
    [({"beta": 0.0}, {"beta": 0.3}), ({"red.opacity": 0.0}, {}), ({"red.color": [0.0, 0.0, 0.0]}, {})],
    ids=["beta", "opacity", "color"],
)
def test_starts_on_a_bound_move(method, start, true):
    """From 0 every method comes to the truth; where it has to begin inside, it says so."""
    result = fit(make_study(start, true=true, method=method, learning_rate=0.05))
    assert max(result.relative_errors().values()) < 0.01
    assert ("lies on a bound" in " ".join(result.notes)) == (method != "adam")
    assert all(np.max(value) == 0.0 for value in result.start.values())


@pytest.mark.parametrize("method", [LeastSquares, LBFGS])
def test_an_end_where_a_small_step_helps_is_none(method):
    """Away from the minimum a step of a thousandth of the range lowers the loss, at the minimum none does."""
    study = make_study({"beta": 0.8, "red.opacity": 0.6})
    problem = Problem(study)
    session = Session(study, "", None, None, 0.0)
    for start, expected in (([0.8, 0.6], ["beta"]), ([0.5, 0.6], [])):
        coordinates = np.array(start)
        ended = method(problem, session)
        assert falling_steps(problem, ended, coordinates, ended.loss_at(coordinates)) == expected


def test_a_fit_that_stops_too_early_is_not_called_converged():
    """With a tolerance that ends it at once the fit names what still lowers the loss."""
    result = fit(make_study({"beta": 0.9}, tolerance=0.5))
    assert not result.converged
    assert "a step of a thousandth of its range lowers the loss in beta" in result.reason


@pytest.mark.parametrize("name", ["red.translation", "camera.translation"])
def test_what_moves_outlines_is_told_apart(name):
    """Of an unlit sphere the image shows the place, though this gradient does not see it."""
    result = fit(make_study({name: FitParameter([0.1, 0.0, 0.0])}, scene=spheres(1)))
    assert f"{name}[0]" in result.unseen
    assert result.undetermined == ()
    assert "its outlines move; this gradient holds coverage fixed" in result.lines()[0]


def test_jumps_of_merging_are_told():
    """Opaque spheres in one another of which smooth merging shows now one and now the other; exact merging does not."""
    scene = spheres(size=(64, 56), apart=0.1)
    for item in scene.objects:
        item.opacity = 1.0
    told = {
        merge: fit(make_study({"thickness": 0.06}, scene=replace(scene, merge=merge), steps=1)).notes
        for merge in ("smooth", "exact")
    }
    assert told["exact"] == ()
    assert 'merge = "exact" has no jumps' in told["smooth"][0]


@pytest.mark.parametrize("name", ["gpu", "mps", "cpu ", "cuda:", 0, "cuda:99"])
def test_devices_that_are_not_there(name):
    """One line at once, before anything is computed."""
    with pytest.raises(StudyError, match=r"^device: got [^\n]+$"):
        make_study({"beta": 0.5}, device=name)
