"""The README's pictures are what their commands make."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))

import make_images  # noqa: E402

from warpfrag.cli import main  # noqa: E402
from warpfrag.fit.study_file import load_study  # noqa: E402


def levels(path):
    """An image file as it is stored."""
    return np.asarray(Image.open(path)).astype(int)


def differing(one, other):
    """Share of the pixels of two image files that differ by more than 2 levels: on another machine outlines may."""
    return np.mean(np.abs(levels(one) - levels(other)).max(axis=-1) > 2)


@pytest.mark.parametrize("name", make_images.RENDERS)
def test_renders_are_up_to_date(tmp_path, name, monkeypatch):
    """A picture is what its command renders, to the rounding of another machine; else run docs/make_images.py."""
    monkeypatch.chdir(ROOT)
    assert main([*make_images.RENDERS[name].split(), "-o", str(tmp_path / name)]) == 0
    assert differing(tmp_path / name, make_images.IMAGES / name) < 1e-3


def test_pictures_of_the_fit_are_up_to_date(tmp_path, monkeypatch):
    """Reference and start of the fit are renders with the study's true values and starts."""
    pytest.importorskip("pxr", reason="usd-core is not installed")
    monkeypatch.chdir(ROOT)
    study = load_study(make_images.STUDY)
    values = {"fit_reference.png": study.reference.true}
    values["fit_before.png"] = {name: fitted.start for name, fitted in study.parameters.items()}
    for name, given in values.items():
        words = [f"--set={key}={value}" for key, value in given.items()]
        assert main(["render", "scenes/bunny_in_sphere.toml", "-o", str(tmp_path / name), *words]) == 0
        assert differing(tmp_path / name, make_images.IMAGES / name) < 1e-3


def test_pictures_show_what_merging_and_beta_do():
    """Each of the three pictures differs from the others by more than 8 levels in a tenth of its pixels."""
    images = [levels(make_images.IMAGES / name) for name in make_images.RENDERS]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert np.mean(np.abs(images[first] - images[second]).max(axis=-1) > 8) > 0.1


def test_no_picture_is_left_over():
    """All pictures in the folder are made by the script."""
    assert {path.name for path in make_images.IMAGES.iterdir()} == {*make_images.RENDERS, *make_images.FIT}
