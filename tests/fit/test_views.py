"""Views and their references: what they take, and the one line each mistake gets."""

from dataclasses import replace

import numpy as np
import pytest
from small_scene import spheres
from small_study import study_of_views

from warpfrag.fit import FitParameter, Reference, Study, StudyError


def test_held_out_views_share_the_references_values():
    """True values stacked by view say nothing of a view that is held out."""
    with pytest.raises(StudyError, match=r"reference\.true\.camera\.rotation: got one value per view"):
        study_of_views({"beta": 0.5}, true={"camera.rotation": np.ones((2, 3))}, held_out=1)


def test_held_out_views_cannot_have_their_own_values():
    """A map or a camera per view says nothing of a view that is not fitted."""
    for name, parameter in (("beta", FitParameter(per="pixel")), ("camera.rotation", FitParameter(per="view"))):
        with pytest.raises(StudyError, match="held out"):
            study_of_views({name: parameter}, held_out=1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"merge": "bogus"}, 'reference.merge: got "bogus", expected one of "none"'),
        ({"mix": "bogus"}, 'reference.mix: got "bogus"'),
        ({"layers": 0}, "reference.layers: got 0, expected a whole number of at least 1"),
    ],
)
def test_options_of_a_reference_are_checked(options, words):
    """With the study, not when the reference is rendered."""
    with pytest.raises(StudyError, match=words):
        Study(spheres(), Reference(true={}, **options), {"beta": 0.5})


def test_a_k_buffers_reference_takes_what_a_k_buffer_does():
    """Smooth merging is none of it."""
    scene = replace(spheres(), merge="order_independent")
    options = {"parameters": {"red.thickness": 0.5}, "resolve": "kbuffer"}
    with pytest.raises(StudyError, match=r'reference\.merge: got "smooth", .* with resolve "kbuffer"'):
        Study(scene, Reference(true={}, merge="smooth"), **options)
