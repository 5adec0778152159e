"""The images of a study and its references: what is rendered, what is compared."""

from dataclasses import replace

import numpy as np
import pytest
from small_scene import spheres
from small_study import EVERYTHING, STARTS, make_study, study_of_views

from warpfrag.files.images import read_image, write_image
from warpfrag.fit import Reference, Study, StudyError, fit
from warpfrag.fit.problem import Problem
from warpfrag.render import render


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


def test_each_view_has_its_own_reference():
    """The references are renders from the views' cameras; held-out ones come last."""
    study = study_of_views(held_out=1)
    problem = Problem(study)
    assert [view.view.name for view in problem.views] == ["view0", "view1"]
    for place, view in zip((*problem.views, *problem.held_out), study.views, strict=True):
        np.testing.assert_array_equal(place.reference, render(study.scene, view.camera))


def test_random_starts_are_spread():
    """They differ from one another, a colour's numbers too, and lie between the bounds."""
    starts = Problem(make_study({"red.color": [0.5] * 3, "red.thickness": 0.3}, restarts=3)).starts()[1:]
    lower, upper = Problem(make_study({"red.color": [0.5] * 3, "red.thickness": 0.3})).bounds()
    for start in starts:
        assert ((start > lower) & (start < upper)).all()
        assert np.ptp(start[:3]) > 0.01
    assert np.ptp(np.array(starts), axis=0).min() > 0.01
