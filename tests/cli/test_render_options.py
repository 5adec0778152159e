"""`warpfrag render`: samples, other outputs than the colour, the k-buffer; and `--device` of every command."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_scene import SCENE

from warpfrag.cli import main
from warpfrag.files.scene_file import load_scene
from warpfrag.render import render

STUDY = """
scene = "scene.toml"
device = "cuda:99"
[reference.true]
beta = 0.3
[parameters]
beta = 0.8
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder, with a scene and a study in it."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "study.toml").write_text(STUDY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (["--samples", "3"], {"samples": 3}),
        (["--resolve", "kbuffer", "--merge", "none"], {"resolve": "kbuffer", "merge": "none"}),
        (["--device", "cpu"], {}),
    ],
)
def test_options_are_those_of_render(folder, words, options):
    """The image is that of `render` with the same options."""
    assert main(["render", "scene.toml", "-o", "a.npy", *words]) == 0
    np.testing.assert_array_equal(np.load("a.npy"), render(load_scene("scene.toml"), **options))


@pytest.mark.parametrize("name", ["depth", "normal", "object_id", "count"])
def test_values_are_written_as_they_are(folder, capsys, name):
    """`.npy` holds an output to the bit, OpenEXR as float channels."""
    library = importlib.import_module("OpenEXR")
    expected = render(load_scene("scene.toml"), output=name)
    for suffix in (".npy", ".exr"):
        assert main(["render", "scene.toml", "-o", f"a{suffix}", "--show", name]) == 0
    assert capsys.readouterr().out == ""
    np.testing.assert_array_equal(np.load("a.npy"), expected)
    names = {"depth": ["Z"], "normal": ["N.X", "N.Y", "N.Z"]}.get(name, [name])
    with library.File("a.exr", separate_channels=True) as file:
        channels = file.channels()
        assert sorted(channels) == names
        stored = np.stack([np.array(channels[each].pixels) for each in names], axis=-1)
    np.testing.assert_array_equal(stored.reshape(expected.shape), expected.astype(np.float32))


def test_png_shows_values_and_tells_their_range(folder, capsys):
    """Grey from the least to the largest, transparent where nothing is; normals as colours."""
    scene = load_scene("scene.toml")
    depth = render(scene, output="depth")
    assert main(["render", "scene.toml", "-o", "a.png", "--show", "depth"]) == 0
    low, high = depth[depth > 0].min(), depth.max()
    assert capsys.readouterr().out == f"depth: from {low:.6g} (black) to {high:.6g} (white)\n"
    stored = np.asarray(Image.open("a.png")).astype(float)
    np.testing.assert_array_equal(stored[..., 3], np.where(depth > 0, 255, 0))
    grey = np.where(depth > 0, 255 * (depth - low) / (high - low), 0.0)
    np.testing.assert_allclose(stored[..., 0], grey, atol=0.51)
    assert main(["render", "scene.toml", "-o", "b.png", "--show", "normal"]) == 0
    assert "blue towards the eye" in capsys.readouterr().out
    seen = np.asarray(Image.open("b.png"))[depth > 0]
    normal = render(scene, output="normal")[depth > 0]
    np.testing.assert_allclose(seen[:, :3], 127.5 + 127.5 * normal * [1, -1, -1], atol=0.51)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["render", "scene.toml", "-o", "a.png", "--show", "dept"], '--show: got "dept", expected one of'),
        (["render", "scene.toml", "-o", "a.png", "--show", "layers"], '--show: got "layers", expected one of'),
        (["render", "scene.toml", "-o", "a.png", "--samples", "0"], "--samples: got 0, expected a whole number"),
        (["render", "scene.toml", "-o", "a.png", "--samples", "99"], "samples: got 99, expected a whole number"),
        (["render", "scene.toml", "-o", "a.png", "--resolve", "k"], 'resolve: got "k", expected "sorted" or "kbuffer"'),
        (["render", "scene.toml", "-o", "a.png", "--device", "gpu"], '--device: got "gpu", expected "cpu", "cuda" or'),
        (["inspect", "scene.toml", "--pixel", "1,1", "--device", "cuda:99"], '--device: got "cuda:99" on a machine'),
        (["fit", "study.toml", "--device", "mps"], '--device: got "mps", expected'),
        (["fit", "study.toml"], 'study.toml: device: got "cuda:99" on a machine'),
        (["fit", "--all", "--device", "cpu"], "--device: got it with --all"),
    ],
)
def test_mistakes_get_one_line(folder, capsys, words, message):
    """One line on standard error, status 2, and no image."""
    assert main(words) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert not list(folder.glob("**/*.png"))


def test_device_of_a_study_may_be_another_than_its_files(folder, capsys):
    """`--device` comes before what the study says; inspect takes one too."""
    assert main(["fit", "study.toml", "--device", "cpu", "--steps", "1"]) == 0
    assert main(["inspect", "scene.toml", "--pixel", "12,8", "--device", "cpu"]) == 0
    assert Path("results/study/result.json").is_file()
