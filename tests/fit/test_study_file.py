"""Study files: what they mean, and the one line each mistake gets."""

from dataclasses import replace

import numpy as np
import pytest
from small_scene import SCENE
from small_study import VIEWS_SCENE, VIEWS_STUDY

from warpfrag.errors import SceneError
from warpfrag.files.images import ImageError, write_image
from warpfrag.fit import FitParameter, Study, StudyError, load_study


def test_views_from_a_file(tmp_path):
    """Cameras take what they do not give from the scene's; images are read, sizes changed together."""
    (tmp_path / "scene.toml").write_text(VIEWS_SCENE)
    (tmp_path / "study.toml").write_text(VIEWS_STUDY.format(batch=2))
    study = load_study(tmp_path / "study.toml", size=(16, 12))
    assert [view.name for view in study.views] == ["front", "left", "right"]
    assert study.views[1].camera == replace(study.scene.camera, eye=(-2.0, 0.3, 1.5))
    assert study.views[1].camera.size == (16, 12)
    broken = VIEWS_STUDY.format(batch=2).replace('name = "left"', 'name = "front"')
    (tmp_path / "study.toml").write_text(broken)
    with pytest.raises(StudyError, match='got the name "front" more than once'):
        load_study(tmp_path / "study.toml")


STUDY = """
scene = "scene.toml"
[reference.true]
beta = 0.4
ball.thickness = 0.3
ball.color = "#ffffff"
[parameters]
beta = 0.9
ball.thickness = {start = 0.1, lower = 0.01, upper = 1.5}
"disc.thickness" = "5P"
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with the scene."""
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path


def load(folder, text: str, **options) -> Study:
    """Write a study file and load it."""
    (folder / "study.toml").write_text(text)
    return load_study(folder / "study.toml", **options)


def test_values_and_defaults(folder):
    """Names may be dotted or quoted; bounds and method have their defaults."""
    study = load(folder, STUDY)
    by_name = {each.name: each for each in study.prepared.parameters}
    assert list(by_name) == ["beta", "ball.thickness", "disc.thickness"]
    assert (by_name["beta"].lower, by_name["beta"].upper) == (0.0, 1.0)
    assert (by_name["ball.thickness"].lower, by_name["ball.thickness"].upper) == (0.01, 1.5)
    assert by_name["disc.thickness"].start == 5.0
    assert by_name["disc.thickness"].lower < 1.0 < 1e4 < by_name["disc.thickness"].upper
    assert (study.prepared.method, study.loss, study.prepared.steps, study.name) == (
        "least_squares",
        "l2",
        100,
        "study",
    )
    assert study.prepared.true is not None
    assert study.prepared.true["beta"] == 0.4
    assert study.prepared.true["disc.thickness"] == 2.0


def test_overrides(folder):
    """Size, merge, mix and layers take the place of the scene's; a size that is passed goes first."""
    text = 'size = [8, 6]\nmerge = "none"\nmix = "average"\nlayers = 3\n' + STUDY
    study = load(folder, text)
    assert study.scene.camera.size == (8, 6)
    assert (study.scene.merge, study.scene.mix, study.scene.layers) == ("none", "average", 3)
    assert load(folder, text, size=(10, 9)).scene.camera.size == (10, 9)
    assert study.resized((5, 4)).scene.camera.size == (5, 4)


def test_maps_default_to_adam(folder):
    """A parameter that is not global makes Adam the default, and starts from one number everywhere."""
    parameters = "[parameters]\nball.thickness = {start = 0.1, per = 'pixel'}\nball.color = {per = 'vertex'}\n"
    study = load(folder, STUDY.partition("[parameters]")[0] + parameters)
    assert (study.prepared.method, study.prepared.steps) == ("adam", 300)
    thickness, color = study.prepared.parameters
    assert thickness.start.shape == (16, 24)
    assert (thickness.start == 0.1).all()
    assert color.start.shape == (len(study.scene.objects[0].vertices), 3)


def test_reference_image(folder):
    """An image is read at once, relative to the study file, with its opacity if it has one."""
    write_image(folder / "photo.png", np.full((16, 24, 3), 0.5))
    text = STUDY.replace('[reference.true]\nbeta = 0.4\nball.thickness = 0.3\nball.color = "#ffffff"\n', "")
    study = load(folder, text + '[reference]\nimage = "photo.png"\n')
    assert study.reference.image is not None
    assert study.reference.image.shape == (16, 24, 3)
    assert study.prepared.true is None
    with pytest.raises(ImageError, match=r"none\.png: got no such file"):
        load(folder, text + '[reference]\nimage = "none.png"\n')


MISTAKES = [
    ('scene = "scene.toml"', 'scen = "scene.toml"', 'scen: got an unknown key; did you mean "scene"?'),
    ('scene = "scene.toml"', "", "scene: got none, expected the path"),
    ("scene.toml", "other.toml", "scene: got no such file at"),
    ("scene = ", 'loss = "l3"\nscene = ', 'loss: got "l3", expected one of "l2", "l1", "huber"'),
    ("scene = ", 'method = "newton"\nscene = ', 'method: got "newton"'),
    ("scene = ", "steps = 0\nscene = ", "steps: got 0, expected a whole number from 1 to 1000000000"),
    ("scene = ", "steps = 1.5\nscene = ", "steps: got 1.5"),
    ("scene = ", "size = [0, 4]\nscene = ", "size: got [0, 4]"),
    ("scene = ", "tolerance = -1\nscene = ", "tolerance: got -1"),
    ("scene = ", "seed = true\nscene = ", "seed: got true"),
    ("scene = ", "restarts = -1\nscene = ", "restarts: got -1"),
    ("scene = ", "scales = 0\nscene = ", "scales: got 0"),
    ("scene = ", "patience = 0\nscene = ", "patience: got 0"),
    ("scene = ", 'method = "adam"\nbatch = 2\nscene = ', "batch: got 2, expected up to 1"),
    ("scene = ", "loss = {ssim = 0}\nscene = ", "loss.ssim: got 0"),
    ("scene = ", 'method = "least_squares"\nloss = "ssim"\nscene = ', 'with "least_squares"'),
    ("beta = 0.4", "beta = 1.4", "reference.true.beta: got 1.4"),
    ("beta = 0.4", "bta = 0.4", 'unknown name "bta"; did you mean "beta"?'),
    ("ball.thickness = 0.3", "ball.thickness = -0.3", "ball.thickness: got -0.3"),
    ('"#ffffff"', '"white"', 'expected 3 numbers or "#rrggbb"'),
    ("beta = 0.9", "beta = 1.9", "parameters.beta.start: got 1.9, expected from 0 to 1"),
    ("beta = 0.9", "beta = nan", "parameters.beta.start: got nan, expected a number"),
    ("beta = 0.9", "beta = [0.9, 0.8]", "parameters.beta.start: got shape (2,)"),
    ("beta = 0.9", "beta = {start = 0.9, uper = 1}", 'unknown key; did you mean "upper"?'),
    ("beta = 0.9", "beta = {start = 0.9, per = 'vertex'}", 'parameters.beta.per: got "vertex"'),
    ("beta = 0.9", "beta = {start = 0.9, upper = 2}", "expected them from 0 to 1"),
    ("beta = 0.9", "bal.thickness = 1", 'unknown name "bal"'),
    ("beta = 0.9", "ball.thicknes = 1", 'did you mean "ball.thickness"?'),
    ("start = 0.1, lower = 0.01", "start = 0.001, lower = 0.01", "start: got 0.001, expected from 0.01"),
    ("lower = 0.01", "lower = 0", "expected a number above 0 (its logarithm is fitted)"),
    ("start = 0.1", "start = '5Q'", 'start: got "5Q"'),
    ("start = 0.1", "start = 0.1, smoothness = 1", "got it with one value per object"),
    ("start = 0.1", "start = 0.1, levels = 2", "levels: got 2 with one value per object"),
    ("upper = 1.5", "per = 'vertex'", 'got "least_squares" for ball.thickness'),
    ("[parameters]", "[parameters.beta]", "unknown key"),
    ("[reference.true]", "[reference]\nimage = 'a.png'\n[reference.true]", "got both image and true"),
    ("[reference.true]", "[reference]\nsuper = 4\n[reference.true]", "unknown key"),
    ("[reference.true]", "[reference]\nsupersampling = 0\n[reference.true]", "reference.supersampling: got 0"),
    ("[reference.true]", "[reference", "not TOML"),
]


@pytest.mark.parametrize(("old", "new", "words"), MISTAKES)
def test_mistakes_get_one_line(folder, old, new, words):
    """The line names the file, the key, what was got and what is expected."""
    text = STUDY.replace(old, new, 1)
    assert text != STUDY
    if "per = 'vertex'" in new and "beta" not in new:
        text = 'method = "least_squares"\n' + text
    with pytest.raises(StudyError) as caught:
        load(folder, text)
    message = str(caught.value)
    assert words in message
    assert message.startswith(str(folder / "study.toml"))
    assert "\n" not in message


def test_mistakes_of_the_scene_keep_their_own_line(folder):
    """What is wrong in the scene file is told about the scene file."""
    (folder / "scene.toml").write_text(SCENE.replace("fov", "fow"))
    with pytest.raises(SceneError, match=r"scene\.toml: camera\.fow"):
        load(folder, STUDY)


def test_one_value_may_be_asked_for(folder):
    """Per object, a number stays a number."""
    study = load(folder, STUDY)
    variables = replace(study, parameters={"beta": FitParameter(0.5, per="object")}).prepared.parameters
    assert variables[0].start.shape == ()


def test_true_values_are_those_of_the_same_kind_of_render(folder):
    """A reference merged in another way was not made by what a fit is to find."""
    study = load(folder, STUDY)
    assert study.prepared.true is not None
    assert replace(study, reference=replace(study.reference, merge="none")).prepared.true is None
