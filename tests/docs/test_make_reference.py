"""The reference of scene and study files says what their readers take: its keys, defaults, ranges and examples."""

import inspect
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from warpfrag.files import placement, scene_file, scene_objects
from warpfrag.files.images import write_image
from warpfrag.files.scene_file import load_scene
from warpfrag.fit import study_file
from warpfrag.fit.study import Study
from warpfrag.fit.study_file import load_study
from warpfrag.fit.views import RENDER_OPTIONS

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))

import make_reference  # noqa: E402
from reference_keys import SECTIONS  # noqa: E402

CAMERA = {"eye": [0, 0, 3], "target": [0, 0, 0], "fov": 45.0, "size": [16, 12]}
BALL = {"name": "ball", "primitive": "sphere"}
# Documents in which every key has its place: those that load without it.
SCENE = {"": {}, "camera": CAMERA, "light": {}, "object": {"primitive": "sphere"}}
STUDY = {"": {"scene": "scene.toml"}, "reference": {"true": {"beta": 0.5}}, "view": {"name": "front"}}
STUDY |= {"parameters": {"ball": {"thickness": {"start": 0.2}}}}
KEYS = [(section, key) for section in SECTIONS for key in section.keys]
NAMES = [f"{section.file} {section.place} {key.name}" for section, key in KEYS]


def as_toml(value):
    """A Python value as TOML; texts that begin with "=" are TOML already."""
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {as_toml(part)}' for key, part in value.items()) + "}"
    if isinstance(value, str) and value.startswith("="):
        return value[1:]
    return make_reference.toml(value)


def written(folder, section, key, text):
    """Write the files around a key with this value, and load them."""
    documents = SCENE if section.file == "scene" else STUDY
    document = {place: dict(table) for place, table in documents.items()}
    given = {**key.beside, key.name: f"={text}"}
    for name, value in given.items():
        where = document[section.place]
        if section.place == "parameters":
            where["ball"] = {"thickness": {**where["ball"]["thickness"], name: value}}
        elif section.place == "" and name in document:
            document[name] = value
        else:
            where[name] = value
    lines = []
    for place, table in document.items():
        heading = {"": "", "object": "[[object]]", "view": "[[view]]"}.get(place, f"[{place}]")
        lines += [heading, *(f'"{name}" = {as_toml(value)}' for name, value in table.items() if value is not None)]
    path = folder / "studies" / "study.toml" if section.file == "study" else folder / "scene.toml"
    path.write_text("\n".join(lines))
    return load_study(path) if section.file == "study" else load_scene(path)


@pytest.fixture
def folder(tmp_path):
    """A folder with a scene, and with the files that the examples name."""
    shutil.copytree(ROOT / "scenes" / "assets", tmp_path / "assets")
    (tmp_path / "studies").mkdir()
    lines = ["[camera]", *(f"{name} = {as_toml(value)}" for name, value in CAMERA.items())]
    lines += ["[[object]]", *(f"{name} = {as_toml(value)}" for name, value in BALL.items()), "segments = 8"]
    for file in ("studies/scene.toml", "three_spheres.toml"):
        (tmp_path / file).write_text("\n".join(lines))
    write_image(tmp_path / "studies" / "photo.png", np.ones((12, 16, 4)))
    return tmp_path


def test_page_is_up_to_date():
    """The page is what the script makes of the keys; if not, run `uv run python docs/make_reference.py`."""
    assert make_reference.PAGE.read_text(encoding="utf-8") == make_reference.page()


@pytest.mark.parametrize(
    ("file", "place", "known"),
    [
        ("scene", "", {*scene_file._TOP} - {"camera", "light", "object"}),
        ("scene", "camera", {*scene_file.CAMERA_KEYS}),
        ("scene", "light", {"direction", "ambient"}),
        (
            "scene",
            "object",
            {*scene_objects._SHAPES, "split", *scene_objects._OBJECT, *placement.PLACEMENT_KEYS}
            | {size for sizes in scene_objects.PRIMITIVES.values() for size in sizes}
            | {*scene_objects._POINTS},
        ),
        ("study", "", {*study_file._TOP} - {"reference", "view", "parameters"}),
        ("study", "reference", {"image", "true", "supersampling", *RENDER_OPTIONS}),
        ("study", "view", {"name", "image", "held_out", *scene_file.CAMERA_KEYS}),
        ("study", "parameters", {*study_file._PARAMETER}),
    ],
)
def test_all_keys_are_described(file, place, known):
    """The reference has the keys that the readers know, and no others."""
    described = {key.name for section, key in KEYS if (section.file, section.place) == (file, place)}
    assert described == known


def test_every_option_of_a_study_is_a_key():
    """What a `Study` takes in Python a file can say, but for its name."""
    options = set(inspect.signature(Study).parameters) - {"name", "views", "reference", "parameters"}
    assert options <= {key.name for section, key in KEYS if (section.file, section.place) == ("study", "")}


@pytest.mark.parametrize(("section", "key"), KEYS, ids=NAMES)
def test_examples_load(folder, section, key):
    """The example of a key is taken by the reader, and so is its default."""
    written(folder, section, key, key.example)
    default = make_reference.default_of(key)
    # Paths and names of defaults that are words are said elsewhere.
    if not isinstance(key.default, str) or (default.startswith("`") and default.count("`") == 2):
        written(folder, section, key, default.strip("`"))


@pytest.mark.parametrize(("section", "key"), KEYS, ids=NAMES)
def test_values_out_of_range_are_refused(folder, section, key):
    """A value beyond the range that the page states is refused in one line that names file and key."""
    for text in key.refused:
        with pytest.raises(ValueError, match=r"\.toml: |: got ") as caught:
            written(folder, section, key, text)
        assert key.name in str(caught.value), text
        assert "got " in str(caught.value), text
        assert "\n" not in str(caught.value)
