"""`Fragments` and `Layers` refuse what does not fit together, and come and go as any kind of array."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp
from fragment_arrays import fragments_of
from pixels import random_pixels

import warpfrag as wf
from warpfrag import Fragments, Layers


def valid(**changed) -> dict:
    """Return the arguments of three fragments in 1 x 2 pixels, but for some."""
    arrays = {
        "rgba": np.full((3, 4), 0.5, np.float32),
        "depth": np.ones(3, np.float32),
        "thickness": np.zeros(3, np.float32),
        "offsets": np.array([0, 1, 3], np.int32),
        "shape": (1, 2),
    }
    return arrays | changed


def valid_layers(**changed) -> dict:
    """Return the arguments of layers of 2 x 3 pixels with room for four, but for some."""
    arrays = {name: np.zeros((2, 3, 4), np.float32) for name in ("depth", "thickness", "opacity_sum")}
    return {"rgba": np.zeros((2, 3, 4, 4), np.float32), **arrays, "count": np.zeros((2, 3), np.int32)} | changed


def test_what_they_say_about_themselves():
    """Count, pixels, kind and shape."""
    fragments = Fragments(**valid())
    assert (fragments.count, fragments.pixel_count, fragments.kind, fragments.shape) == (3, 2, "numpy", (1, 2))
    assert Fragments(**valid(shape=[np.int64(1), 2])).shape == (1, 2)
    assert Fragments(**valid(shape=2)).shape == (2,)
    layers = Layers(**valid_layers())
    assert (layers.shape, layers.max_layers) == ((2, 3), 4)
    with pytest.raises(dataclasses.FrozenInstanceError):
        fragments.depth = None


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"rgba": [[0.0] * 4] * 3}, TypeError, "rgba: got list, expected a torch.Tensor, wp.array or NumPy array"),
        ({"rgba": None}, TypeError, "rgba: got NoneType, expected a torch.Tensor, wp.array or NumPy array"),
        ({"depth": None}, TypeError, "depth: got NoneType, expected a torch.Tensor, wp.array or NumPy array"),
        ({"offsets": None}, TypeError, "offsets: got NoneType, expected a torch.Tensor, wp.array or NumPy array"),
        ({"depth": torch.ones(3)}, TypeError, "depth: got a torch array, expected a numpy array like rgba"),
        ({"offsets": torch.tensor([0, 1, 3])}, TypeError, "offsets: got a torch array, expected a numpy array"),
        ({"rgba": np.zeros((3, 4), np.float16)}, TypeError, "rgba: got dtype float16, expected float32 or float64"),
        ({"rgba": np.zeros((3, 4), np.uint8)}, TypeError, "rgba: got dtype uint8, expected float32 or float64"),
        ({"rgba": np.zeros((3, 4), ">f4")}, TypeError, "rgba: got dtype >f4, expected float32 or float64"),
        ({"depth": np.ones(3)}, TypeError, "depth: got dtype float64, expected float32 like rgba"),
        ({"opacity_sum": np.ones(3)}, TypeError, "opacity_sum: got dtype float64, expected float32 like rgba"),
        ({"offsets": np.array([0.0, 1.0, 3.0])}, TypeError, "offsets: got dtype float64, expected int32 or int64"),
        ({"object_id": np.zeros(3)}, TypeError, "object_id: got dtype float64, expected int32 or int64"),
        ({"rgba": np.zeros((3, 3), np.float32)}, ValueError, r"rgba: got shape \(3, 3\), expected \(3, 4\)"),
        ({"rgba": np.zeros(12, np.float32)}, ValueError, r"rgba: got shape \(12,\), expected \(12, 4\)"),
        ({"rgba": np.array(1.0, np.float32)}, ValueError, r"rgba: got shape \(\), expected \('F', 4\)"),
        ({"depth": np.ones(2, np.float32)}, ValueError, r"depth: got shape \(2,\), expected \(3,\)"),
        ({"thickness": np.ones((3, 1), np.float32)}, ValueError, r"thickness: got shape \(3, 1\), expected \(3,\)"),
        ({"opacity_sum": np.ones(4, np.float32)}, ValueError, r"opacity_sum: got shape \(4,\), expected \(3,\)"),
        ({"primitive_id": np.zeros(4, np.int32)}, ValueError, r"primitive_id: got shape \(4,\), expected \(3,\)"),
        ({"offsets": np.array([0, 3])}, ValueError, r"offsets: got shape \(2,\), expected \(3,\)"),
        ({"shape": (2, 2)}, ValueError, r"offsets: got shape \(3,\), expected \(5,\)"),
        ({"shape": (-1, -2)}, ValueError, r"shape: got \(-1, -2\), expected whole numbers of at least 0"),
        ({"shape": (1.0, 2)}, ValueError, r"shape: got \(1.0, 2\), expected whole numbers of at least 0"),
        ({"shape": None}, ValueError, "shape: got None, expected whole numbers of at least 0"),
        ({"shape": "12"}, ValueError, "shape: got '12', expected whole numbers of at least 0"),
    ],
)
def test_fragments_are_checked(changed, error, message):
    """In one line that names the argument, what was found and what is expected."""
    with pytest.raises(error, match=message):
        Fragments(**valid(**changed))


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        (
            {"rgba": np.zeros((2, 3, 4), np.float32)},
            ValueError,
            r"rgba: got shape \(2, 3, 4\), expected \(2, 3, 'M', 4\)",
        ),
        ({"rgba": np.zeros((2, 3, 4, 3), np.float32)}, ValueError, r"rgba: got shape \(2, 3, 4, 3\)"),
        ({"rgba": np.zeros((3, 2, 4, 4), np.float32)}, ValueError, r"expected \(2, 3, 4, 4\)"),
        ({"depth": np.zeros((2, 3, 5), np.float32)}, ValueError, r"depth: got shape \(2, 3, 5\), expected \(2, 3, 4\)"),
        ({"count": np.zeros((2, 3))}, TypeError, "count: got dtype float64, expected int32 or int64"),
        ({"count": None}, TypeError, "count: got NoneType, expected a torch.Tensor, wp.array or NumPy array"),
        ({"opacity_sum": np.zeros((2, 3, 4))}, TypeError, "opacity_sum: got dtype float64, expected float32"),
        ({"opacity_sum": None}, TypeError, "opacity_sum: got NoneType"),
        ({"depth": torch.zeros((2, 3, 4))}, TypeError, "depth: got a torch array, expected a numpy array like rgba"),
    ],
)
def test_layers_are_checked(changed, error, message):
    """Layers likewise."""
    with pytest.raises(error, match=message):
        Layers(**valid_layers(**changed))


def test_devices_must_be_the_same():
    """Torch's "meta" device stands in for a second one."""
    arrays = valid()
    tensors = {name: torch.from_numpy(arrays[name]) for name in ("rgba", "depth", "thickness", "offsets")}
    with pytest.raises(ValueError, match="thickness: got it on meta, expected cpu like rgba"):
        Fragments(**(tensors | {"thickness": tensors["thickness"].to("meta")}), shape=(1, 2))


def test_vectors_of_warp_are_not_taken_for_arrays_of_numbers():
    """An array of vec4 has another dtype and another shape."""
    numbers = {name: wp.array(valid()[name]) for name in ("depth", "thickness", "offsets")}
    with pytest.raises(TypeError, match="rgba: got dtype vec4f, expected float32 or float64"):
        Fragments(wp.zeros(3, dtype=wp.vec4f), **numbers, shape=(1, 2))


def test_from_lists():
    """One list per pixel, row by row; colours are premultiplied already."""
    near, far = (0.5, 0.0, 0.0, 0.5, 1.0, 0.1), (0.0, 0.2, 0.0, 1.0, 2.0, 0.0)
    fragments = Fragments.from_lists([[far, near], [], [near], []], (2, 2))
    np.testing.assert_array_equal(fragments.rgba, np.float32([far[:4], near[:4], near[:4]]))
    np.testing.assert_array_equal(fragments.depth, np.float32([2.0, 1.0, 1.0]))
    np.testing.assert_array_equal(fragments.thickness, np.float32([0.0, 0.1, 0.1]))
    np.testing.assert_array_equal(fragments.offsets, [0, 2, 2, 3, 3])
    assert fragments.rgba.dtype == np.float32
    assert Fragments.from_lists([[near]], (1, 1), np.float64).depth.dtype == np.float64
    empty = Fragments.from_lists([[], []], (1, 2))
    assert (empty.count, empty.rgba.shape, empty.offsets.tolist()) == (0, (0, 4), [0, 0, 0])
    with pytest.raises(ValueError, match=r"offsets: got shape \(3,\), expected \(5,\)"):
        Fragments.from_lists([[near], []], (2, 2))


@pytest.mark.parametrize("tuples", [[(0.1, 0.2, 0.3, 1.0)], [(0.1,) * 6, (0.1,) * 5], [(0.1,) * 7]])
def test_from_lists_checks_its_tuples(tuples):
    """Six numbers make a fragment: three fragments of four are no two of six."""
    with pytest.raises(ValueError, match=r"pixels: pixel 0 has a fragment of . values, expected 6: r, g, b, opacity"):
        Fragments.from_lists([tuples * 3, []], (1, 2))


def test_pixel_of_each_fragment():
    """Whatever the kind of arrays, NumPy; pixels without fragments are passed over."""
    one = (0.1, 0.2, 0.3, 0.5, 1.0, 0.0)
    fragments = Fragments.from_lists([[one], [], [one, one]], shape=(1, 3), dtype=np.float32)
    for kind in (fragments, fragments.torch()):
        assert kind.pixel.tolist() == [0, 2, 2]


def test_conversions_keep_everything(device):
    """NumPy to torch to Warp and back, optional arrays included, or left out."""
    ids = {"object_id": np.array([0, 1, 1], np.int32), "primitive_id": np.array([5, 6, 7], np.int32)}
    for optional in ({}, {"opacity_sum": np.ones(3, np.float32), **ids}):
        fragments = Fragments(**valid(**optional))
        tensors = fragments.torch(device)
        assert tensors.kind == "torch"
        assert tensors.rgba.device == torch.device(device)
        back = tensors.numpy()
        assert back.kind == "numpy"
        assert back.shape == (1, 2)
        for name, value in vars(fragments).items():
            np.testing.assert_array_equal(getattr(back, name), value)
        arrays = (back.rgba, back.depth, back.thickness, back.offsets)
        warp = Fragments(*(wp.array(values, device=device) for values in arrays), (1, 2))
        np.testing.assert_array_equal(warp.torch().numpy().rgba, fragments.rgba)
        np.testing.assert_array_equal(warp.numpy().offsets, fragments.offsets)


def test_conversions_share_memory_and_let_gradients_go():
    """`torch()` makes no copy on the same device, `numpy()` detaches."""
    fragments = Fragments(**valid())
    tensors = fragments.torch()
    tensors.depth[1] = 7.0
    assert fragments.depth[1] == 7.0
    assert tensors.torch().rgba is tensors.rgba
    leaf = fragments_of(random_pixels(0, 4), kind="torch", requires_grad=True)
    assert leaf.numpy().rgba.shape == tuple(leaf.rgba.shape)
    layers = wf.resolve(leaf, 0.5)
    assert layers.rgba.requires_grad
    assert isinstance(layers.numpy().rgba, np.ndarray)
    assert layers.numpy().torch().count.dtype == torch.int32
