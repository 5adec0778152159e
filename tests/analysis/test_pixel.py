"""`warpfrag inspect`: the table agrees with the fragments, the plot is there, mistakes are one line."""

from dataclasses import replace

import numpy as np
import pytest
from small_scene import SCENE, spheres

import warpfrag as wf
from warpfrag.analysis.pixel import inspect_pixel
from warpfrag.cli import main
from warpfrag.files.images import read_image


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder, with a scene in it."""
    (tmp_path / "scene.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_pixel_that_was_asked_for():
    """Fragments and layers are those of `capture` and `resolve` at that column and row; the curves end as the image."""
    scene = spheres()
    column, row = 17, 21
    inspection = inspect_pixel(scene, column, row)
    fragments = wf.capture(scene)
    own = slice(*fragments.offsets[row * 40 + column :][:2])
    np.testing.assert_array_equal(inspection.fragments.depth, fragments.depth[own])
    layers = wf.resolve(fragments, scene.beta)
    count = layers.count[row, column]
    assert 1 < count < inspection.fragments.count
    np.testing.assert_allclose(inspection.merged.slabs.depth, layers.depth[row, column, :count], rtol=1e-6)
    opacity = wf.composite(layers)[row, column, 3]
    for curve in (inspection.every, inspection.merged):
        assert curve.absorbance[-1] == pytest.approx(opacity, abs=1e-6)


def test_the_table_has_a_line_for_each_fragment():
    """Each line names object, face, place, colour and layer."""
    inspection = inspect_pixel(spheres(), 17, 21)
    title, head, *lines = inspection.lines()
    count, layer_count = inspection.fragments.count, inspection.merged.slabs.count
    assert title == f"pixel 17,21: {count} fragments, {layer_count} layers"
    assert head.split() == ["object", "face", "depth", "thickness", "opacity", "red", "green", "blue", "layer"]
    assert len(lines) == count
    first = lines[0].split()
    # The nearest fragment by its back belongs to the first layer.
    assert (first[0], first[-1]) == ("1", "1")
    assert first[1] in ("red", "green", "blue")
    assert [float(text) for text in first[3:6]] == pytest.approx(
        [inspection.fragments.depth[0], inspection.fragments.thickness[0], 0.6], rel=1e-3
    )
    assert int(lines[-1].split()[-1]) == layer_count


def test_long_lists_are_cut(monkeypatch):
    """A table of many fragments says how many it leaves out."""
    monkeypatch.setattr("warpfrag.analysis.pixel.MOST_LINES", 2)
    inspection = inspect_pixel(spheres(), 17, 21)
    lines = list(inspection.lines())
    assert len(lines) == 5
    assert lines[-1] == f"... {inspection.fragments.count - 2} more fragments"


@pytest.mark.parametrize("thickness", [0.3, 0.0])
def test_plots(folder, thickness):
    """Slabs, surfaces and empty pixels can be drawn; what absorbs is in the plot in its colour."""
    scene = spheres(1)
    scene = replace(scene, objects=[replace(scene.objects[0], thickness=thickness, color=(1.0, 0.0, 0.0))])
    reddest = []
    for column, row in ((12, 14), (0, 0)):
        inspect_pixel(scene, column, row).draw(folder / "plot.png")
        image = read_image(folder / "plot.png")
        assert image.shape[1] == 1400
        reddest.append(np.max(image[: image.shape[0] // 3, :, 0] - image[: image.shape[0] // 3, :, 1]))
    assert reddest[0] > 0.5
    assert reddest[1] < 0.1


def test_command(folder, capsys):
    """It prints the table and names the plot; options change what is resolved."""
    assert main(["inspect", "scene.toml", "--pixel", "12,8"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("pixel 12,8: ")
    assert out[-1] == "plot in scene_12_8.png"
    assert (folder / "scene_12_8.png").is_file()
    words = ["inspect", "scene.toml", "--pixel", "12, 8", "-o", "a.png", "--layers", "1", "--merge", "none"]
    assert main([*words, "--set", "ball.opacity=0.5", "--beta", "0", "--size", "24x16"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].endswith(", 1 layer")
    assert (folder / "a.png").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--pixel", "12"], '--pixel: got "12", expected column and row such as 320,240'),
        (["--pixel", "5000,8"], "pixel: got 5000,8, expected a column below"),
        (["--pixel", "1,1", "-o", "a.jpg"], "a.jpg: got the suffix .jpg, expected .png"),
        (["--pixel", "1,1", "-o", "no/a.png"], "got no folder no"),
        (["--pixel", "1,1", "--set", "bal.opacity=1"], "ball.opacity"),
        ([], "Missing option"),
    ],
)
def test_mistakes_get_one_line(folder, capsys, words, message):
    """One line on standard error, status 2, and no plot."""
    assert main(["inspect", "scene.toml", *words]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert not list(folder.glob("**/*.png"))
