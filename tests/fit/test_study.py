"""Studies: what cannot be fitted is refused."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from small_scene import spheres

from warpfrag.fit import FitParameter, Reference, Study, StudyError, study


def test_nothing_to_fit():
    """A study without parameters, or with both an image and true values, is refused."""
    with pytest.raises(StudyError, match="got none"):
        Study(spheres(), Reference(true={}), {})
    with pytest.raises(StudyError, match="got neither"):
        Study(spheres(), Reference(), {"beta": 0.5})
    with pytest.raises(StudyError, match="options of a render"):
        Study(spheres(), Reference(image=np.zeros((36, 40, 3)), supersampling=2), {"beta": 0.5})


@pytest.mark.parametrize("key", ["restarts", "scales"])
def test_absurd_numbers_are_refused(key):
    """More restarts or scales than any fit has are a slip of the keyboard."""
    with pytest.raises(StudyError, match=rf"{key}: got 1000000000, expected a whole number from . to \d+$"):
        Study(spheres(), Reference(true={}), {"beta": 0.5}, **{key: 10**9})


def test_sizes_beyond_memory_are_refused(monkeypatch):
    """What a fit keeps of each view at least has to have room; so do the samples of a reference."""
    scene = spheres()
    monkeypatch.setattr(study, "allowed_memory", lambda limit, device: 3 * 16.0 * 40 * 36)
    Study(scene, Reference(true={}), {"beta": 0.5})
    with pytest.raises(StudyError, match=r"size: got views of up to 41 × 36 pixels, which take .* GiB at least"):
        Study(scene, Reference(true={}), {"beta": 0.5}).resized((41, 36))
    with pytest.raises(StudyError, match="size: got views"):
        Study(scene, Reference(true={}), {"beta": FitParameter(0.5, per="pixel")})
    monkeypatch.undo()
    with pytest.raises(StudyError, match=r"supersampling: got 64 with 8192 × 8192 pixels, expected up to 268435456"):
        Study(scene, Reference(true={}, supersampling=64), {"beta": 0.5}).resized((8192, 8192))


def test_studies_compare_copy_and_pickle():
    """By all that was asked; the wording is short."""
    asked = Study(spheres(), Reference(true={"beta": 0.4}), {"beta": FitParameter(0.9), "red.thickness": "2P"})
    for other in (copy.copy(asked), copy.deepcopy(asked), pickle.loads(pickle.dumps(asked))):
        assert other == asked
        assert other.prepared.method == "least_squares"
    assert asked != replace(asked, seed=1)
    assert repr(asked) == "Study('study', Scene(40 × 36, objects: red, green, blue), parameters: beta, red.thickness)"
    assert repr(Reference(image=np.zeros((3, 4, 3)))) == "Reference(image of shape (3, 4, 3))"
