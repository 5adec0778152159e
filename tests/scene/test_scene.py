"""Scenes: their parameters by name, what they check, how they are worded, compared and copied."""

import copy
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
from two_objects import CAMERA, TRIANGLE, two_objects

from warpfrag.scene.assemble import assemble
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject


def test_parameters_round_trip():
    """`parameters()` has every name, copies its arrays, and put back changes nothing."""
    scene = two_objects()
    parameters = scene.parameters()
    keys = ("thickness", "color", "opacity", "vertices", "translation", "rotation")
    names = {f"{name}.{key}" for name in ("tri", "square") for key in keys}
    cameras = {f"camera.{key}" for key in ("translation", "rotation", "fov", "principal")}
    assert set(parameters) == {"beta", *cameras, *names}
    assert parameters["tri.opacity"] == 0.5
    same = assemble(scene, parameters)
    for name in ("vertices", "rgba", "thickness"):
        np.testing.assert_array_equal(getattr(same, name), getattr(assemble(scene), name))
        assert getattr(same, name).dtype == getattr(assemble(scene), name).dtype
    parameters["tri.vertices"][:] = 9
    assert scene.objects[0].vertices.max() == 1


@pytest.mark.parametrize(
    "change",
    [{"beta": 2.0}, {"layers": 0}, {"merge": "smoth"}, {"mix": 1}, {"background": (1, 1, 1)}],
)
def test_refused_scenes(change):
    """A scene checks its globals, and that names are unique."""
    with pytest.raises(ValueError, match=next(iter(change))):
        Scene(CAMERA, **change)
    item = SceneObject("x", TRIANGLE, [[0, 1, 2]])
    with pytest.raises(ValueError, match='got the name "x" more than once'):
        Scene(CAMERA, [item, item])
    with pytest.raises(ValueError, match='got the name "camera", expected another'):
        Scene(CAMERA, [SceneObject("camera", TRIANGLE, [[0, 1, 2]])])


def test_scenes_compare_copy_and_pickle():
    """By all their values; the wording is short."""
    scene = two_objects()
    for other in (copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        assert other == scene
    assert scene != replace(scene, beta=0.3)
    changed = copy.deepcopy(scene)
    changed.objects[0].vertices[0, 0] += 1
    assert changed != scene
    assert repr(scene) == "Scene(4 × 3, objects: tri, square)"


VALUES = {
    "beta": 0.25,
    "tri.color": [1.0, 0.5, 0.0],
    "tri.opacity": 0.125,
    "square.thickness": 0.75,
    "tri.translation": [0.5, 0.0, -1.0],
    "tri.rotation": [10.0, 20.0, -5.0],
    "camera.translation": [0.1, -0.2, 0.3],
    "camera.rotation": [0.0, 5.0, 0.0],
}


def test_values_can_be_built_in():
    """A scene with parameters built in stands and looks as with these parameters."""
    scene = two_objects()
    built = scene.with_parameters(VALUES)
    one, other = assemble(built), assemble(scene, VALUES)
    np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-12)
    for name in ("rgba", "thickness"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert built.beta == 0.25
    assert scene.objects[0].opacity == 0.5
    np.testing.assert_allclose(built.camera.eye, [0.1, 0.2, 2.7])


def test_texts_are_values():
    """A colour, a thickness with its unit, three numbers; in parameters as well as built in."""
    scene = two_objects()
    texts = {"tri.color": "#ff0000", "thickness": "3P", "square.thickness": "0.5", "tri.rotation": "0,0,90"}
    built = scene.with_parameters(texts)
    assert [(item.thickness, item.thickness_unit) for item in built.objects] == [(3.0, "P"), (0.5, "scene")]
    geometry = assemble(scene, texts)
    np.testing.assert_array_equal(geometry.thickness_in_p, [True, False])
    np.testing.assert_array_equal(geometry.thickness, [3.0] * 3 + [0.5] * 4)
    np.testing.assert_allclose(geometry.vertices, assemble(built).vertices, atol=1e-12)
    np.testing.assert_array_equal(geometry.rgba[0, :3], [1, 0, 0])


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"tri.opacity": 2.0}, ValueError, "tri.opacity: got 2, expected numbers from 0 to 1"),
        ({"tri.colour": "#ffffff"}, ValueError, 'unknown name "tri.colour"; did you mean "tri.color"?'),
        ({"tri.rotation": "0,90"}, ValueError, 'tri.rotation: got "0,90", expected x,y,z'),
        ({"tri.opacity": "half"}, ValueError, 'tri.opacity: got "half", expected a number from 0 to 1'),
        ({"tri.vertices": "1"}, ValueError, "tri.vertices: got"),
        ({"beta": None}, TypeError, "beta: got"),
    ],
)
def test_refused_values(values, error, words):
    """Names, ranges and texts are checked."""
    with pytest.raises(error, match=re.escape(words)):
        two_objects().with_parameters(values)
