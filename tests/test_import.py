"""Importing the package is cheap: heavy libraries are imported where they are used."""

import subprocess
import sys

import pytest

HEAVY = ("torch", "matplotlib", "trimesh", "pxr", "scipy", "PIL", "OpenEXR", "pyrender", "rich", "typer")

LOADED = f"import sys; print(sorted(set({HEAVY}) & set(sys.modules)))"


def loaded_by(program: str) -> str:
    """Run a program in a new process and return which of the heavy modules it has loaded, as printed."""
    done = subprocess.run([sys.executable, "-c", f"{program}\n{LOADED}"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_import_loads_no_heavy_library():
    """Nor does it start Warp, which looks for devices and prints about them."""
    assert loaded_by("import warpfrag, warp\nassert warp._src.context.runtime is None, 'Warp was started'") == "[]"


@pytest.mark.parametrize("kind", ["numpy", "warp"])
def test_composite_needs_no_heavy_library(kind):
    """Neither with NumPy nor with Warp arrays, whether torch is installed or not."""
    program = f"""
import sys
sys.modules["torch"] = None
import numpy as np, warp as wp, warpfrag as wf
arrays = [np.full((1, 4), 0.5), np.ones(1), np.zeros(1), np.array([0, 1], np.int32)]
arrays = [wp.array(a) for a in arrays] if {kind!r} == "warp" else arrays
image = wf.composite(wf.Fragments(*arrays, (1, 1)), merge="none")
assert (image if {kind!r} == "numpy" else image.numpy()).tolist() == [[[0.5] * 4]]
del sys.modules["torch"]"""
    assert loaded_by(program) == "[]"


def test_public_names_exist():
    """Every name that is offered can be had, and `dir` knows them."""
    import warpfrag

    for name in warpfrag.__all__:
        assert getattr(warpfrag, name) is not None
        assert name in dir(warpfrag)
