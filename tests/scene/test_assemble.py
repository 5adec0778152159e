"""Scenes as flat arrays: what stands where, overrides, precision, gradients."""

import subprocess
import sys

import numpy as np
import pytest
from two_objects import CAMERA, SQUARE, TRIANGLE, two_objects

from warpfrag.scene.assemble import assemble
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject


def test_flat_arrays():
    """Two objects one after the other: world space, shaded colours, ids, texture places."""
    geometry = assemble(two_objects())
    np.testing.assert_array_equal(geometry.vertices, np.concatenate([TRIANGLE, 2 * SQUARE + [0, 0, 5]]))
    np.testing.assert_array_equal(geometry.faces, [[0, 1, 2], [3, 4, 5], [3, 5, 6]])
    np.testing.assert_array_equal(geometry.object_id, [0, 1, 1])
    np.testing.assert_array_equal(geometry.first_face, [0, 1, 3])
    np.testing.assert_allclose(geometry.rgba[:3], [[0.1, 0.2, 0.3, 0.5]] * 3, rtol=1e-6)
    np.testing.assert_array_equal(
        geometry.rgba[3:], [[1, 0, 0, 0], [0, 0.5, 0, 0.25], [0, 0, 0.25, 0.5], [0, 0, 0, 1.0]]
    )
    np.testing.assert_array_equal(geometry.thickness, [0.25] * 3 + [2.0] * 4)
    np.testing.assert_array_equal(geometry.thickness_in_p, [False, True])
    np.testing.assert_array_equal(geometry.texture_id, [-1, 0, 0])
    np.testing.assert_array_equal(geometry.uv, np.concatenate([np.zeros((3, 2)), SQUARE[:, :2]]))
    assert (len(geometry.textures), geometry.thickness_maps) == (1, {})
    assert geometry.rgba.dtype == geometry.thickness.dtype == np.float32
    assert (geometry.vertices.dtype, geometry.precision) == (np.float64, "float32")
    assert geometry.faces.dtype == geometry.object_id.dtype == geometry.first_face.dtype == np.int32


def test_several_textures_and_none():
    """Faces of one object may take different images, or none; without any image there is no uv."""
    images = [np.ones((1, 1, 4)), np.zeros((2, 1, 4))]
    scene = two_objects(texture=images, texture_index=[1, -1])
    scene.objects.append(SceneObject("third", SQUARE, [[0, 1, 2]], uv=SQUARE[:, :2], texture=np.ones((3, 3, 4))))
    geometry = assemble(scene)
    np.testing.assert_array_equal(geometry.texture_id, [-1, 1, -1, 2])
    assert [image.shape[0] for image in geometry.textures] == [1, 2, 3]
    assert assemble(two_objects(texture=None)).uv is None


def test_empty_scene():
    """A scene without objects has arrays of length 0."""
    geometry = assemble(Scene(CAMERA))
    assert geometry.vertices.shape == (0, 3)
    assert geometry.rgba.shape == (0, 4)
    assert geometry.faces.shape == (0, 3)
    np.testing.assert_array_equal(geometry.first_face, [0])


def test_overrides():
    """Numbers, lists and arrays replace the scene's own values and leave the scene alone."""
    scene = two_objects()
    overrides = {"tri.opacity": 0.75, "tri.color": [1, 0, 0], "square.thickness": np.arange(4), "beta": 0.3}
    geometry = assemble(scene, overrides)
    np.testing.assert_array_equal(geometry.rgba[:3], [[1, 0, 0, 0.75]] * 3)
    np.testing.assert_array_equal(geometry.thickness[3:], [0, 1, 2, 3])
    assert scene.objects[0].opacity == 0.5
    assert assemble(scene, {"tri.opacity": np.array(0.75)}).rgba.dtype == np.float64


def test_thickness_map():
    """A thickness of the image's shape goes to the maps; the object's own entries are 0 then."""
    scene, values = two_objects(), np.arange(12.0).reshape(3, 4)
    geometry = assemble(scene, {"square.thickness": values})
    np.testing.assert_array_equal(geometry.thickness_maps[1], values)
    np.testing.assert_array_equal(geometry.thickness, [0.25] * 3 + [0] * 4)
    large = {"square.thickness": np.ones((6, 8))}
    assert assemble(scene, large, camera=CAMERA.resized((8, 6))).thickness_maps[1].shape == (6, 8)
    with pytest.raises(ValueError, match=r"got shape \(6, 8\), expected shape \(\), \(4,\) or a map of shape \(3, 4\)"):
        assemble(scene, large)


def test_one_thickness_for_all_objects():
    """`"thickness"` holds for every object without an own override, as a number or a map that is there once."""
    scene = two_objects()
    geometry = assemble(scene, {"thickness": 3.0})
    np.testing.assert_array_equal(geometry.thickness, [3.0] * 7)
    np.testing.assert_array_equal(geometry.thickness_in_p, [False, True])
    geometry = assemble(scene, {"tri.thickness": 0.5, "thickness": 3.0})
    np.testing.assert_array_equal(geometry.thickness, [0.5] * 3 + [3.0] * 4)
    values = np.arange(12.0).reshape(3, 4)
    maps = assemble(scene, {"thickness": values}).thickness_maps
    assert maps[0] is maps[1]
    np.testing.assert_array_equal(maps[0], values)
    assert list(assemble(scene, {"tri.thickness": 0.5, "thickness": values}).thickness_maps) == [1]


@pytest.mark.parametrize(
    ("overrides", "error", "words"),
    [
        ({"squar.color": 1.0}, ValueError, 'unknown name "squar.color"; did you mean "square.color"?'),
        ({"tri.opacity": 1.5}, ValueError, "tri.opacity: got 1.5, expected numbers from 0 to 1"),
        ({"tri.opacity": float("nan")}, ValueError, "tri.opacity: got nan"),
        ({"tri.thickness": -1}, ValueError, "tri.thickness: got -1, expected numbers from 0"),
        ({"tri.thickness": np.inf}, ValueError, "tri.thickness: got inf"),
        ({"tri.color": [1, 2]}, ValueError, r"tri.color: got shape \(2,\), expected shape \(3,\) or \(3, 3\)"),
        ({"tri.color": [0, -1, 0]}, ValueError, "tri.color: got -1"),
        ({"tri.color": "red"}, ValueError, 'tri.color: got "red", expected 3 numbers or "#rrggbb"'),
        ({"tri.color": [[1], 2]}, ValueError, "tri.color: .*expected numbers"),
        ({"tri.opacity": True}, TypeError, "tri.opacity: got builtins.bool"),
        ({"tri.vertices": SQUARE}, ValueError, r"tri.vertices: got shape \(4, 3\), expected shape \(3, 3\)"),
        ({"tri.vertices": TRIANGLE + np.inf}, ValueError, "tri.vertices: got inf"),
        ([("tri.color", 1)], TypeError, "expected a mapping"),
        ({"tri.rotation": 1.0}, ValueError, r"tri.rotation: got shape \(\), expected shape \(3,\)"),
        (
            {"tri.translation": [0, np.nan, 0]},
            ValueError,
            "tri.translation: got nan, expected numbers that are finite",
        ),
        ({"camera.rotation": [1, 2]}, ValueError, r"camera.rotation: got shape \(2,\), expected shape \(3,\)"),
        ({"camera.turn": [1, 2]}, ValueError, 'unknown name "camera.turn"'),
        ({"thickness": [1, 2, 3]}, ValueError, r"thickness: got shape \(3,\), expected shape \(\) or a map of shape"),
        ({"thickness": -1}, ValueError, "thickness: got -1, expected numbers from 0, finite"),
        ({"thicknes": 1}, ValueError, 'unknown name "thicknes"; did you mean "thickness"?'),
    ],
)
def test_refused_overrides(overrides, error, words):
    """Names, kinds, shapes and ranges are checked, with what was got and what is expected."""
    with pytest.raises(error, match=words):
        assemble(two_objects(), overrides, bounds="error")


def test_torch_overrides_keep_their_precision():
    """Any tensor makes all float arrays tensors; float64 stays float64, and equals the NumPy arrays."""
    torch = pytest.importorskip("torch")
    scene = two_objects()
    for dtype in (torch.float32, torch.float64):
        geometry = assemble(scene, {"tri.opacity": torch.tensor(0.5, dtype=dtype)})
        for name in ("vertices", "rgba", "thickness"):
            assert getattr(geometry, name).dtype == (torch.float64 if name == "vertices" else dtype)
            np.testing.assert_allclose(getattr(geometry, name).numpy(), getattr(assemble(scene), name), rtol=1e-7)
        assert isinstance(geometry.faces, np.ndarray)
    assert isinstance(assemble(scene, {"beta": torch.tensor(0.5)}).vertices, torch.Tensor)
    with pytest.raises(ValueError, match=r"tri.opacity: got a torch.Tensor of float16"):
        assemble(scene, {"tri.opacity": torch.tensor(0.5, dtype=torch.float16)})
    with pytest.raises(ValueError, match=r"tri.opacity: got 2, expected numbers from 0 to 1"):
        assemble(scene, {"tri.opacity": torch.tensor(2.0)}, bounds="error")


def test_values_out_of_range_are_clamped():
    """Their gradient leads back in, and not farther out; what is not finite is refused all the same."""
    torch = pytest.importorskip("torch")
    for high in (1.5, torch.tensor(1.5)):
        np.testing.assert_array_equal(np.asarray(assemble(two_objects(), {"tri.opacity": high}).rgba[:3, 3]), [1.0] * 3)
    values = {"tri.color": [-0.25, 0.5, 3.0], "tri.opacity": 1.5, "square.thickness": -1.0}
    leaves = {name: torch.tensor(value, requires_grad=True) for name, value in values.items()}
    geometry = assemble(two_objects(), leaves)
    np.testing.assert_array_equal(geometry.rgba[0].detach(), [0.0, 0.5, 3.0, 1.0])
    for sign in (1.0, -1.0):
        total = sign * (geometry.rgba[:3].sum() + geometry.thickness[3:].sum())
        found = torch.autograd.grad(total, list(leaves.values()), retain_graph=True)
        # Downhill is against the gradient: up for sign -1, down for sign 1.
        inwards = {1.0: [[0, 3, 3], 3, 0], -1.0: [[-3, -3, -3], 0, -4]}[sign]
        for grad, expected in zip(found, inwards, strict=True):
            np.testing.assert_array_equal(grad, expected)
    with pytest.raises(ValueError, match=r"tri\.thickness: got inf"):
        assemble(two_objects(), {"tri.thickness": torch.tensor(np.inf)})


@pytest.mark.parametrize("thickness", ["one", "vertex", "map"])
def test_torch_gradients(thickness):
    """The flat arrays are differentiable in every override (gradcheck, float64)."""
    torch = pytest.importorskip("torch")
    generator = torch.Generator().manual_seed(0)
    scene = two_objects()
    shape = {"one": (), "vertex": (4,), "map": (3, 4)}[thickness]
    shapes = {"square.vertices": (4, 3), "square.color": (3,), "square.opacity": (4,), "square.thickness": shape}
    values = [torch.rand(s, dtype=torch.float64, generator=generator).mul(0.8).add(0.1) for s in shapes.values()]

    def flat(*values):
        geometry = assemble(scene, dict(zip(shapes, values, strict=True)))
        return geometry.vertices, geometry.rgba, geometry.thickness, *geometry.thickness_maps.values()

    assert torch.autograd.gradcheck(flat, [value.requires_grad_() for value in values])


def test_no_heavy_imports():
    """Importing the room and assembling a scene loads neither torch nor any file reader."""
    code = (
        "import sys; from warpfrag.scene.assemble import assemble; from warpfrag.scene.camera import Camera\n"
        "from warpfrag.scene.scene import Scene; from warpfrag.scene.surface import SceneObject\n"
        "from warpfrag.shapes import primitives as p\n"
        "m = p.cube(); c = Camera(eye=(0, 0, 3), target=(0, 0, 0), fov=45)\n"
        "assemble(Scene(c, [SceneObject('a', m.vertices, m.faces)]), {'a.opacity': 0.5})\n"
        "heavy = {'torch', 'trimesh', 'pxr', 'PIL', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
