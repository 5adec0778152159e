"""Objects: what they check, how they are worded, compared, copied and moved."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject

CAMERA = Camera(eye=(0, 0, 3), target=(0, 0, 0), fov=45, size=(4, 3))
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": " "}, "name"),
        ({"faces": [[0, 1, 3]]}, "x.faces: got indices 0 to 3, expected indices from 0 to 2"),
        ({"faces": [[0.0, 1.0, 2.0]]}, "x.faces: got float64"),
        ({"vertices": TRIANGLE + np.nan}, "x.vertices: got nan"),
        ({"matrix": np.zeros((4, 4))}, "x.matrix"),
        ({"opacity": 2}, "x.opacity: got 2"),
        ({"thickness_unit": "m"}, "x.thickness_unit"),
        ({"texture": np.ones((2, 2, 4))}, "x.texture: got an image but no uv"),
        ({"texture": np.ones((2, 2, 3)), "uv": np.zeros((3, 2))}, r"x.texture: got shape \(2, 2, 3\)"),
        ({"uv": np.zeros((2, 2))}, r"x.uv: got shape \(2, 2\)"),
        ({"shade": np.zeros(2)}, r"x.shade: got shape \(2,\)"),
    ],
)
def test_refused_objects(change, words):
    """An object checks its own arrays."""
    with pytest.raises(ValueError, match=words):
        SceneObject(**{"name": "x", "vertices": TRIANGLE, "faces": [[0, 1, 2]], **change})


def square(**look) -> SceneObject:
    """Return a square with some look."""
    return SceneObject("square", SQUARE, [[0, 1, 2], [0, 2, 3]], **look)


def test_thicknesses_may_be_texts():
    """A text says its unit: a number is scene units, "2P" multiples of P(z)."""
    assert (square(thickness="3P").thickness, square(thickness="3P").thickness_unit) == (3.0, "P")
    assert (square(thickness="0.3").thickness, square(thickness="0.3").thickness_unit) == (0.3, "scene")
    with pytest.raises(ValueError, match=r"square\.thickness: got \"3Q\", expected a number, or multiples of P\(z\)"):
        square(thickness="3Q")


def test_float64_vertices_stay():
    """An array of float64 keeps its digits (far from the origin), a list and an array of float32 are float32."""
    far = SQUARE.astype(np.float64) + np.array([5e5, 4e6, 0.001])
    item = SceneObject("far", far, [[0, 1, 2]])
    np.testing.assert_array_equal(item.vertices, far)
    assert square().vertices.dtype == SceneObject("x", SQUARE.tolist(), [[0, 1, 2]]).vertices.dtype == np.float32
    scene = Scene(CAMERA, [item])
    np.testing.assert_array_equal(assemble(scene).vertices, far)
    geometry = assemble(scene, scene.parameters())
    assert (geometry.precision, geometry.rgba.dtype) == ("float32", np.float32)
    np.testing.assert_array_equal(geometry.vertices, far)


def test_objects_compare_copy_and_pickle():
    """By all their values, arrays included; the wording is short."""
    one = square(color=np.eye(4, 3), uv=SQUARE[:, :2], texture=np.ones((2, 2, 4)))
    for other in (copy.copy(one), copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        assert other == one
    assert one != replace(one, color=(1, 0, 0))
    assert one != "square"
    assert repr(one) == "SceneObject('square', 4 vertices, 2 faces)"


def test_arrays_with_a_gradient_are_sent_to_parameters():
    """A tensor that is to be differentiated is refused with the way that it is done."""
    torch = pytest.importorskip("torch")
    with pytest.raises(ValueError, match=r"m\.vertices: got Parameter of shape \(3, 3\), .*given as `parameters`"):
        SceneObject("m", torch.nn.Parameter(torch.zeros(3, 3)), [[0, 1, 2]])
