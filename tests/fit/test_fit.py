"""Fitting: the Jacobian, recovery, resuming, what is not determined, what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scene import spheres

from warpfrag.files.images import read_image, write_image
from warpfrag.fit import FitError, FitParameter, FitResult, Reference, Study, StudyError, fit
from warpfrag.fit import problem as problem_module
from warpfrag.fit.compression import triangle_of
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.problem import Problem, ViewProblem
from warpfrag.fit.saving import to_json
from warpfrag.fit.session import fingerprint
from warpfrag.render import render
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes.primitives import plane

STARTS = {"beta": 0.9, "red.thickness": 0.8, "green.thickness": 0.12, "blue.thickness": 0.6}
EVERYTHING = {"beta": 0.4, "red.thickness": 0.5, "green.opacity": 0.7, "blue.color": [0.3, 0.4, 0.5]}
EVERYTHING["blue.opacity"] = 0.5


def make_study(parameters=None, *, true=None, scene=None, **options) -> Study:
    """Return a study of the small scene against its own render."""
    return Study(scene or spheres(), Reference(true=true or {}), parameters or STARTS, **options)


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0, 0.0), (0.4, 0.3, 0.2, 0.5)])
def test_frozen_geometry_renders_the_same_image(background):
    """The scene captured once with ones, then scaled, is the scene rendered with the values, to rounding."""
    problem = Problem(make_study(EVERYTHING, scene=replace(spheres(), background=background)))
    values = problem.values(problem.start())
    whole = render(problem.views[0].scene, parameters={name: np.float32(value) for name, value in values.items()})
    view = problem.views[0]
    np.testing.assert_allclose(view.image(values), whole, atol=0.0)
    scaled = view.unit.scaled(view.unit.scales(view.parameters(values)))
    image = view.over_background(view.composite(scaled, np.float32(0.4)))
    np.testing.assert_allclose(image, whole, atol=2e-6)


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


@pytest.mark.parametrize("name", ["l2", "l1", "huber"])
def test_loss_is_the_named_one(name):
    """Square, absolute value and Huber's function, alike for arrays and tensors; weights are slopes."""
    residual = np.array([-0.5, -0.02, 0.0, 0.004, 0.3])
    loss = RobustLoss.named(name, 0.05)
    size = np.abs(residual)
    huber = np.where(size < 0.05, 0.5 * size**2, 0.05 * (size - 0.025))
    # The absolute value is rounded off below 1e-3, by half of that.
    expected = {"l2": size**2, "huber": huber, "l1": np.where(size > 0, size - 5e-4, 0.0)}[name]
    np.testing.assert_allclose(loss.rho(residual) * loss.factor, expected, rtol=1e-12)
    np.testing.assert_allclose(loss.rho(torch.tensor(residual)).numpy(), loss.rho(residual), rtol=1e-12)
    squares = residual**2
    slope = (loss.rho(np.sqrt(squares + 1e-9)) - loss.rho(np.sqrt(squares))) / 1e-9
    np.testing.assert_allclose(loss.weight(residual)[1:], slope[1:], rtol=1e-4)


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


def test_standard_errors_are_those_of_repeated_fits():
    """Found values scatter by the standard errors when the reference has noise."""
    study = make_study({"beta": 0.5, "red.thickness": 0.3})
    clean = Problem(study).views[0].reference
    generator = np.random.default_rng(5)
    found, predicted = [], []
    for _ in range(12):
        noisy = Reference(image=clean + generator.normal(0.0, 0.005, clean.shape).astype(np.float32))
        # Colour alone, as noise in the opacity counts as residual though nothing can follow it.
        result = fit(replace(study, reference=replace(noisy, image=noisy.image[..., :3])))
        found.append([result.found["beta"], result.found["red.thickness"]])
        predicted.append([result.standard_errors["beta"], result.standard_errors["red.thickness"]])
    # Twelve draws give the scatter to about 20 %; three times that is allowed.
    ratio = np.std(found, axis=0, ddof=1) / np.mean(predicted, axis=0)
    assert ((ratio > 0.4) & (ratio < 1.6)).all(), ratio


@pytest.mark.parametrize("options", [{"loss": "l2"}, {"loss": "l1"}, {"loss": "huber", "delta": 1e-3}, {"scales": 3}])
def test_certainty_is_that_of_what_objects_cover(options):
    """Whatever the loss and its scales, and whatever the reference has where no object is."""
    study = make_study({"beta": 0.5, "red.thickness": 0.3})
    clean = Problem(study).views[0].reference
    fragments = Problem(study).views[0].fragments
    covered = (np.diff(fragments.offsets) > 0).reshape(fragments.shape)
    generator = np.random.default_rng(6)
    noise = generator.normal(0.0, 0.005, clean.shape).astype(np.float32)
    beside = np.where(covered[..., None], noise, 0.4)
    # Opacity, which does not depend on them, is not compared.
    plain, other = (Reference(image=np.ascontiguousarray((clean + n)[..., :3])) for n in (noise, beside))
    expected = fit(replace(study, reference=plain)).standard_errors
    found = fit(replace(study, reference=other, **options)).standard_errors
    for name, value in expected.items():
        # Another loss ends elsewhere, by about such an error.
        assert found[name] == pytest.approx(value, rel=0.05)


def test_undetermined_parameters_are_named():
    """Spheres that stand apart tell nothing of beta and their thickness, but of opacity."""
    starts = {"beta": 0.2, "red.thickness": 0.1, "red.opacity": 0.5}
    result = fit(make_study(starts, scene=spheres(2, apart=0.8)))
    assert result.undetermined == ("beta", "red.thickness")
    assert result.standard_errors["beta"] > 1.0
    assert result.found["red.opacity"] == pytest.approx(0.6, rel=1e-3)
    assert any("not determined" in line for line in result.lines())


def test_parameters_out_of_sight_are_named():
    """What no pixel shows has an infinite standard error, null in JSON, and stays where it started."""
    scene = spheres(2)
    scene.objects[1].matrix[2, 3] = 100.0
    result = fit(make_study({"red.opacity": 0.5, "green.opacity": 0.3}, scene=scene))
    assert result.undetermined == ("green.opacity",)
    assert result.standard_errors["green.opacity"] == np.inf
    assert result.found["green.opacity"] == pytest.approx(0.3)
    assert result.found["red.opacity"] == pytest.approx(0.6, rel=1e-3)
    content = json.loads(json.dumps(to_json(result), allow_nan=False))
    assert content["standard_errors"]["green.opacity"] is None
    assert content["condition_number"] is None


def test_color_and_opacity_need_the_opacity_channel():
    """On black and without an opacity channel only their product counts: both are named."""
    mesh = plane()
    flat = SceneObject("flat", mesh.vertices, mesh.faces, color=(0.9, 0.2, 0.5), opacity=0.6)
    scene = replace(spheres(0), objects=[flat], background=(0.0, 0.0, 0.0, 1.0))
    starts = {"flat.opacity": 0.5, "flat.color": [0.9, 0.1, 0.1]}
    result = fit(Study(scene, Reference(image=render(scene)[..., :3]), starts))
    assert result.undetermined == ("flat.opacity", "flat.color[0]", "flat.color[1]", "flat.color[2]")
    clear = replace(scene, background=(0.0, 0.0, 0.0, 0.0))
    assert fit(make_study(starts, scene=clear)).undetermined == ()


def test_an_empty_view_determines_nothing():
    """Where no object is seen every parameter is named, and the fit ends."""
    scene = spheres(1)
    scene.objects[0].matrix[2, 3] = 100.0
    for method in ("least_squares", "adam", "lbfgs"):
        result = fit(make_study({"beta": 0.3, "red.thickness": 0.1}, scene=scene, method=method, steps=5))
        assert result.undetermined == ("beta", "red.thickness")
        assert result.found["red.thickness"] == pytest.approx(0.1)


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


class Killed(BaseException):
    """What ends a fit in these tests as suddenly as a signal."""


def kill_at(step: int):
    """Return a progress function that ends the fit after so many steps."""

    def progress(report) -> None:
        if report.step >= step:
            raise Killed

    return progress


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


def test_triangle_takes_all_rows():
    """However many whole blocks there are, and rows after them, RᵀR is that of all rows."""
    generator = np.random.default_rng(7)
    for count in (3, 500, 1300):
        rows = generator.normal(size=(count, 5))
        triangle = triangle_of([rows[: count // 2], rows[count // 2 :]])
        assert triangle.shape == (5, 5)
        np.testing.assert_allclose(triangle.T @ triangle, rows.T @ rows, rtol=1e-10, atol=1e-10)


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

    monkeypatch.setattr(problem_module, "composite", poisoned)
    with pytest.raises(FitError, match=r"step \d+: the loss is nan at beta 0\.\d+, red\.thickness"):
        fit(make_study(method=method))


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


def test_saved_folder(tmp_path):
    """The folder holds images, plots and result.json with start, found and true by name; nothing half-written."""
    (tmp_path / ".result.1-aa.partial.json").write_text("left behind by a killed process")
    result = fit(make_study(), output=tmp_path)
    names = {"reference.png", "before.png", "after.png", "error.png", "loss.png", "result.json", "checkpoint.dat"}
    assert {path.name for path in tmp_path.iterdir()} == names
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["start"] == STARTS
    assert content["found"]["beta"] == result.found["beta"]
    assert content["true"]["red.thickness"] == 0.3
    assert content["losses"] == list(result.losses)
    assert content["converged"] is True
    assert (tmp_path / "after.png").read_bytes() == (tmp_path / "reference.png").read_bytes()


def test_large_arrays_go_beside_the_result(tmp_path):
    """A map is described in result.json and stored in parameters.npz."""
    study = make_study({"green.thickness": FitParameter(0.2, per="pixel")}, steps=2)
    result = fit(study, output=tmp_path)
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["found"]["green.thickness"]["shape"] == [36, 40]
    with np.load(tmp_path / content["found"]["green.thickness"]["file"]) as arrays:
        np.testing.assert_array_equal(arrays["found.green.thickness"], result.found["green.thickness"])


def test_reference_from_a_file(tmp_path):
    """A 16-bit PNG without opacity, and an OpenEXR with it, serve as reference; another size is refused."""
    scene = spheres()
    image = render(scene)
    for name, shown in (("a.png", image[..., :3]), ("a.exr", image)):
        write_image(tmp_path / name, shown, bits=16)
        study = Study(scene, Reference(image=read_image(tmp_path / name)), STARTS)
        found = fit(study).found
        assert found["beta"] == pytest.approx(0.5, rel=0.01)
    with pytest.raises(StudyError, match="got 40 × 36 pixels, expected 20 × 18"):
        fit(study.resized((20, 18)))


def test_reference_with_opacity_is_laid_over_the_background():
    """A reference rendered without its background fits the scene that has one."""
    scene = spheres()
    image = render(scene, background=False)
    problem = Problem(Study(scene, Reference(image=image), STARTS))
    np.testing.assert_allclose(problem.views[0].reference, render(scene), atol=1e-6)


def test_supersampled_reference():
    """A supersampled reference is the mean of the larger render."""
    study = Study(spheres(), Reference(true={}, supersampling=2, merge="none"), STARTS)
    large = replace(spheres(size=(80, 72)), merge="none")
    mean = render(large).reshape(36, 2, 40, 2, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(Problem(study).views[0].reference, mean, atol=1e-6)


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
