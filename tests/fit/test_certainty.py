"""How well parameters are known: standard errors, and what images do not determine."""

import json
from dataclasses import replace

import numpy as np
import pytest
from small_scene import spheres
from small_study import make_study

from warpfrag.fit import Reference, Study, fit
from warpfrag.fit.problem import Problem
from warpfrag.fit.saving import to_json
from warpfrag.render import render
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes.primitives import plane


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
