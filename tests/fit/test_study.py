"""Studies: what cannot be fitted is refused."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from small_scene import spheres

from warpfrag.fit import FitParameter, Reference, Study, StudyError


def test_nothing_to_fit():
    """A study without parameters, or with both an image and true values, is refused."""
    with pytest.raises(StudyError, match="got none"):
        Study(spheres(), Reference(true={}), {})
    with pytest.raises(StudyError, match="got neither"):
        Study(spheres(), Reference(), {"beta": 0.5})
    with pytest.raises(StudyError, match="options of a render"):
        Study(spheres(), Reference(image=np.zeros((36, 40, 3)), supersampling=2), {"beta": 0.5})


def test_studies_compare_copy_and_pickle():
    """By all that was asked; the wording is short."""
    study = Study(spheres(), Reference(true={"beta": 0.4}), {"beta": FitParameter(0.9), "red.thickness": "2P"})
    for other in (copy.copy(study), copy.deepcopy(study), pickle.loads(pickle.dumps(study))):
        assert other == study
        assert other.prepared.method == "least_squares"
    assert study != replace(study, seed=1)
    assert repr(study) == "Study('study', Scene(40 × 36, objects: red, green, blue), parameters: beta, red.thickness)"
    assert repr(Reference(image=np.zeros((3, 4, 3)))) == "Reference(image of shape (3, 4, 3))"
