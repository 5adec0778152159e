"""Several processes that fit together."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from small_study import VIEWS_SCENE, VIEWS_STUDY

from warpfrag.fit import fit


@pytest.mark.parametrize("method", [pytest.param("adam", marks=pytest.mark.slow), "least_squares"])
def test_two_processes_find_what_one_does(tmp_path, method):
    """Started by torchrun, two processes share the views and end where one does, to rounding; one of them writes."""
    (tmp_path / "scene.toml").write_text(VIEWS_SCENE)
    text = VIEWS_STUDY.format(batch=2)
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
