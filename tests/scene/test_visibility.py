"""Why an image is empty: said in one line, with both numbers."""

import warnings

import numpy as np
import pytest
from small_scene import spheres

from warpfrag.fit import Reference, Study, fit
from warpfrag.render import render
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.scene.visibility import EmptyImageWarning, why_empty


def seen_from(**changes) -> Scene:
    """Return the small scene from another camera: it lies 3 to 4.2 before the eye else."""
    given = {"eye": (0.0, 0.0, 3.6), "target": (0.0, 0.0, 0.0), "fov": 40.0, "size": (16, 12), **changes}
    return Scene(Camera(**given), spheres().objects)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"far": 2.0}, "no object of the scene lies between near and far: depths from 2.9.* expected from 0.01 to 2"),
        ({"near": 50.0}, "between near and far"),
        ({"target": (0.0, 0.0, 9.0)}, "between near and far: depths from -4"),
        ({"target": (9.0, 0.0, 3.0)}, "no object of the scene covers the centre of a pixel"),
    ],
)
def test_empty_images_are_named(changes, words):
    """As a warning when it is rendered, and among the notes of a fit."""
    scene = seen_from(**changes)
    with pytest.warns(EmptyImageWarning, match=words) as told:
        assert not render(scene).any()
    # It points to the line that asked for the image.
    assert told[0].filename == __file__
    assert why_empty(Scene(scene.camera)) == "the scene has no triangles"
    with pytest.warns(EmptyImageWarning, match=words):
        result = fit(Study(scene, Reference(true={}), {"red.opacity": 0.3}))
    assert any(note.startswith("view: no object of the scene") for note in result.notes)


def test_images_that_show_something_say_nothing():
    """Nor does a scene without triangles."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert render(seen_from()).any()
        assert not np.asarray(render(Scene(seen_from().camera))).any()
