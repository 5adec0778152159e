"""Deep images on the command line: rendered, merged, flattened; one line for whatever goes wrong."""

from pathlib import Path

import numpy as np
import pytest
from small_scene import SCENE

import warpfrag as wf
from warpfrag.cli import main
from warpfrag.deep import split
from warpfrag.files.deep_exr import read_attributes

pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder, with a scene in it, a deep image of each of its objects, and one of another size."""
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    for name, part in zip(("a.exr", "b.exr"), split(wf.capture(wf.load_scene("scene.toml"))).values(), strict=True):
        wf.write_deep(name, part, attributes={"owner": name})
    wf.write_deep("small.exr", wf.Fragments.from_lists([[]] * 6, (2, 3)))
    return tmp_path


def test_render_merge_flatten(folder):
    """A scene as a deep image is its objects' merged; flattened it is the image without background."""
    assert main(["render", "scene.toml", "-o", "scene.deep.exr"]) == 0
    assert main(["render", "scene.toml", "-o", "same.exr", "--deep"]) == 0
    assert main(["merge", "a.exr", "b.exr", "-o", "both.exr"]) == 0
    expected = wf.capture(wf.load_scene("scene.toml"))
    for name in ("scene.deep.exr", "same.exr", "both.exr"):
        found = wf.read_deep(name)
        np.testing.assert_array_equal(found.rgba, expected.rgba)
        np.testing.assert_array_equal(found.object_id, expected.object_id)
    assert read_attributes("both.exr")["owner"] == "a.exr"
    assert main(["flatten", "both.exr", "-o", "flat.exr"]) == 0
    image = wf.composite(expected, merge="exact", mix="optical_depth", beta=0.0)
    np.testing.assert_allclose(wf.read_image("flat.exr"), image, atol=1e-6)
    words = ["--merge", "smooth", "--mix", "opacity", "--beta", "0.5", "--background", "#ffffff"]
    assert main(["flatten", "both.exr", "-o", "flat.npy", *words]) == 0
    np.testing.assert_allclose(np.load("flat.npy"), wf.render(wf.load_scene("scene.toml")), atol=1e-6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["merge", "a.exr", "small.exr", "-o", "c.exr"], "small.exr: got 3 × 2 pixels, expected 24 × 16 like a.exr"),
        (["merge", "a.exr", "none.exr", "-o", "c.exr"], "none.exr: got no such file"),
        (["merge", "a.exr", "scene.toml", "-o", "c.exr"], "scene.toml: got a file of another kind, expected OpenEXR"),
        (["merge", "a.exr", "-o", "c.png"], "c.png: got the suffix .png, expected .exr"),
        (["merge", "-o", "c.exr"], "Missing argument"),
        (["flatten", "a.exr", "-o", "c.jpg"], "c.jpg: got the suffix .jpg"),
        (["flatten", "a.exr", "-o", "c.png", "--mix", "average"], 'mix: got "average" with merge "exact"'),
        (["flatten", "a.exr", "-o", "c.png", "--beta", "2"], "--beta: got 2, expected a number from 0 to 1"),
        (["render", "scene.toml", "-o", "c.deep.exr", "--beta", "0"], "--beta: got it with a deep image"),
        (["render", "scene.toml", "-o", "c.png", "--deep"], "c.png: got the suffix .png, expected .exr"),
    ],
)
def test_mistakes_get_one_line(folder, capsys, words, message):
    """One line on standard error, status 2, and no file."""
    assert main(words) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.startswith("warpfrag: ")
    assert told.count("\n") == 1
    assert not list(folder.glob("c.*"))
