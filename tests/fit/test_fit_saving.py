"""The folder of a fit."""

import json

import numpy as np
from small_study import STARTS, make_study

from warpfrag.fit import FitParameter, fit


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
