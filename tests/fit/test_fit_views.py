"""Fits of several views: losses over views, batches, transforms, cameras, what is held out, several processes."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scene import spheres

from warpfrag.fit import FitError, FitParameter, Reference, Study, StudyError, View, fit, load_study
from warpfrag.fit.descent import Adam
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.problem import Problem
from warpfrag.fit.processes import Processes
from warpfrag.fit.session import Session
from warpfrag.render import render
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene

STARTS = {"beta": 0.9, "red.thickness": 0.8, "green.thickness": 0.12}


def around(count: int, scene: Scene, held_out: int = 0) -> tuple[View, ...]:
    """Return views from places around a scene, the last few held out."""
    views = []
    for index in range(count):
        angle = 2.0 * np.pi * index / count
        eye = (3.0 * np.sin(angle), 0.4, 3.0 * np.cos(angle))
        camera = Camera(eye, (0.0, 0.0, 0.0), fov=40.0, size=scene.camera.size)
        views.append(View(camera, name=f"view{index}", held_out=index >= count - held_out))
    return tuple(views)


def make_study(parameters=None, *, true=None, scene=None, count=3, held_out=0, **options) -> Study:
    """Return a study of the small scene from several views, against its own renders."""
    scene = scene or spheres()
    views = around(count, scene, held_out)
    return Study(scene, Reference(true=true or {}), parameters or STARTS, views=views, **options)


def test_each_view_has_its_own_reference():
    """The references are renders from the views' cameras; held-out ones come last."""
    study = make_study(held_out=1)
    problem = Problem(study)
    assert [view.view.name for view in problem.views] == ["view0", "view1"]
    for place, view in zip((*problem.views, *problem.held_out), study.views, strict=True):
        np.testing.assert_array_equal(place.reference, render(study.scene, view.camera))


def test_cost_is_the_mean_over_views():
    """Cost, JᵀJ and Jᵀf are the means of those of single views, whatever their sizes."""
    scene, loss = spheres(), RobustLoss.named("huber", 0.05)
    views = around(2, scene)
    views = (views[0], replace(views[1], camera=views[1].camera.resized((30, 24))))
    whole = Study(scene, Reference(true={}), STARTS, views=views)
    parts = [Study(scene, Reference(true={}), STARTS, views=(view,)) for view in views]
    both, *single = [
        (evaluation.cost, evaluation.compress().jacobian)
        for evaluation in (Evaluation(Problem(s), loss, Problem(s).start()) for s in (whole, *parts))
    ]
    np.testing.assert_allclose(both[0], np.mean([cost for cost, _ in single]), rtol=1e-12)
    gram = np.mean([jacobian.T @ jacobian for _, jacobian in single], axis=0)
    np.testing.assert_allclose(both[1].T @ both[1], gram, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("method", ["least_squares", "adam", "lbfgs"])
def test_several_views_are_fitted_together(method, tmp_path):
    """What one view determines badly several determine well; held-out views get their error too."""
    starts = STARTS if method == "least_squares" else {"red.color": [0.5, 0.5, 0.5], "green.opacity": 0.9}
    result = fit(make_study(starts, method=method, held_out=1, learning_rate=0.03), output=tmp_path)
    assert max(result.relative_errors().values()) < 0.01
    assert [view.held_out for view in result.views] == [False, False, True]
    assert min(view.psnr for view in result.views) > 50.0
    content = json.loads((tmp_path / "result.json").read_text())
    assert [view["name"] for view in content["views"]] == ["view0", "view1", "view2"]
    assert (tmp_path / "view2" / "error.png").is_file()
    assert any("held out" in line for line in result.lines())


def test_multi_scale_jacobian_is_that_of_the_pyramid():
    """With scales the cost is the mean over levels, and Jᵀf its gradient as torch has it."""
    study = make_study({"beta": 0.4, "red.thickness": 0.5, "blue.opacity": 0.5}, scales=3, loss="huber", delta=0.05)
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
    problem = Problem(make_study(parameters, scene=scene, count=1))
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


def textured(size=(64, 56)) -> Scene:
    """Return the small scene with smooth colours by vertex: what moves is seen inside of outlines."""
    scene = spheres(size=size)
    for item in scene.objects:
        item.color = (0.5 + 0.45 * np.sin(9.0 * item.vertices + np.arange(3.0))).astype(np.float32)
    return scene


@pytest.mark.parametrize("loss", ["l1", "huber"])
def test_least_squares_finds_a_transform(loss):
    """Place and turn of an object come back from several views, together with its thickness.

    Losses that grow linearly: outlines that do not fit leave large residuals, of which the gradient knows nothing.
    """
    true = {"red.translation": [0.03, -0.02, 0.02], "red.rotation": [2.0, -3.0, 4.0], "red.thickness": 0.3}
    starts = {"red.translation": None, "red.rotation": None, "red.thickness": 0.4}
    study = make_study({n: FitParameter(v) for n, v in starts.items()}, scene=textured(), true=true, loss=loss)
    result = fit(replace(study, delta=0.02))
    np.testing.assert_allclose(result.found["red.translation"], true["red.translation"], atol=2e-4)
    np.testing.assert_allclose(result.found["red.rotation"], true["red.rotation"], atol=0.05)


@pytest.mark.parametrize("per", ["object", "view"])
def test_least_squares_finds_the_camera(per):
    """The camera's own motion comes back, one for all views or one for each."""
    turn = np.array([0.6, -0.8, 1.0]) if per == "object" else np.array([[0.6, -0.8, 1.0], [0.2, 0.9, -0.5]])
    parameters = {"camera.rotation": FitParameter(per=per), "camera.translation": FitParameter(per=per)}
    study = make_study(parameters, scene=textured(), true={"camera.rotation": turn}, count=2)
    result = fit(study)
    assert result.found["camera.rotation"].shape == turn.shape
    np.testing.assert_allclose(result.found["camera.rotation"], turn, atol=0.05)
    np.testing.assert_allclose(result.found["camera.translation"], 0.0, atol=5e-3)


def test_batches_visit_all_views_and_resume(tmp_path):
    """Adam on batches of views comes to the same bits when resumed, and ends with the loss of all views."""
    starts = {"red.color": [0.5, 0.5, 0.5], "green.opacity": 0.9}
    study = make_study(starts, method="adam", batch=2, count=5, steps=30, learning_rate=0.05, checkpoint_seconds=0.0)
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


def test_batches_are_parts_of_rounds():
    """In each round every view has its turn once, in an order of its own; a batch's loss is the mean of its views'."""
    study = make_study({"red.color": [0.5, 0.5, 0.5]}, method="adam", batch=2, count=5, steps=9)
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


def test_more_steps_of_batches_are_another_fit(tmp_path):
    """The last step looks at all views, which decides when to stop: a checkpoint of fewer steps is refused."""
    study = make_study({"red.color": [0.5, 0.5, 0.5]}, method="adam", batch=2, steps=2)
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

    study = make_study({"beta": 0.5})
    session = Session(study, "", tmp_path, None, 0.0, Two())
    with pytest.raises(KeyboardInterrupt):
        session.step(1.0, {"beta": 0.5}, lambda: {"coordinates": np.zeros(1)})
    assert (tmp_path / "checkpoint.dat").is_file()


def test_held_out_views_share_the_references_values():
    """True values stacked by view say nothing of a view that is held out."""
    with pytest.raises(StudyError, match=r"reference\.true\.camera\.rotation: got one value per view"):
        make_study({"beta": 0.5}, true={"camera.rotation": np.ones((2, 3))}, held_out=1)


def test_held_out_views_cannot_have_their_own_values():
    """A map or a camera per view says nothing of a view that is not fitted."""
    for name, parameter in (("beta", FitParameter(per="pixel")), ("camera.rotation", FitParameter(per="view"))):
        with pytest.raises(StudyError, match="held out"):
            make_study({name: parameter}, held_out=1)


STUDY = """
scene = "scene.toml"
method = "adam"
steps = 12
batch = {batch}
[reference]
true = {{a.opacity = 0.4}}
[parameters]
a.opacity = 0.8
b.thickness = {{start = 0.3, lower = 0.05, upper = 1.0}}
beta = 0.9
[[view]]
name = "front"
[[view]]
name = "left"
eye = [-2.0, 0.3, 1.5]
[[view]]
name = "right"
eye = [2.0, 0.3, 1.5]
"""
SCENE = """
beta = 0.5
[camera]
eye = [0.0, 0.0, 3.0]
target = [0.0, 0.0, 0.0]
fov = 40.0
near = 0.1
far = 10.0
size = [32, 24]
[[object]]
name = "a"
primitive = "sphere"
radius = 0.5
opacity = 0.6
thickness = 0.2
[[object]]
name = "b"
primitive = "cube"
scale = [0.8, 0.3, 0.7]
opacity = 0.5
thickness = 0.2
"""


def test_views_from_a_file(tmp_path):
    """Cameras take what they do not give from the scene's; images are read, sizes changed together."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "study.toml").write_text(STUDY.format(batch=2))
    study = load_study(tmp_path / "study.toml", size=(16, 12))
    assert [view.name for view in study.views] == ["front", "left", "right"]
    assert study.views[1].camera == replace(study.scene.camera, eye=(-2.0, 0.3, 1.5))
    assert study.views[1].camera.size == (16, 12)
    broken = STUDY.format(batch=2).replace('name = "left"', 'name = "front"')
    (tmp_path / "study.toml").write_text(broken)
    with pytest.raises(StudyError, match='got the name "front" more than once'):
        load_study(tmp_path / "study.toml")


@pytest.mark.parametrize("method", ["adam", "least_squares"])
def test_two_processes_find_what_one_does(tmp_path, method):
    """Started by torchrun, two processes share the views and end where one does, to rounding; one of them writes."""
    (tmp_path / "scene.toml").write_text(SCENE)
    text = STUDY.format(batch=2)
    if method == "least_squares":
        text = text.replace("batch = 2", "").replace('"adam"', '"least_squares"')
    (tmp_path / "study.toml").write_text(text)
    environment = {**os.environ, "WARPFRAG_THREADS": "1", "OMP_NUM_THREADS": "1"}
    environment.pop("PYTEST_CURRENT_TEST", None)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    arguments = ["-m", "warpfrag", "fit", str(tmp_path / "study.toml"), "-o", str(tmp_path / "out")]
    done = subprocess.run([*command, *arguments], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("results in") == 1
    together = json.loads((tmp_path / "out" / "result.json").read_text())
    assert together["processes"] == 2
    alone = fit(tmp_path / "study.toml")
    # Sums in another order: rounding of float64 in the loss, which Adam's first steps divide by its own size.
    np.testing.assert_allclose(together["losses"], alone.losses, rtol=1e-9, atol=1e-16)
    for name, value in alone.found.items():
        np.testing.assert_allclose(together["found"][name], value, rtol=1e-7)
