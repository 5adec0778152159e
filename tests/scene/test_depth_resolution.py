"""The resolution of a depth buffer, P(z)."""

import numpy as np
import pytest
import torch
import warp as wp

from warpfrag.scene.depth_resolution import z_resolution


def expected(depth, near, far, bits=24):
    """Return what one step of an integer depth buffer is worth: eq. 9 by its definition, with cancellation."""
    b = near * far / (far - near)
    return depth - b / (b / depth + 2.0**-bits)


@pytest.mark.parametrize(
    ("depth", "near", "far", "bits"), [(1.0, 0.1, 10.0, 24), (7.0, 0.01, 1e3, 16), (0.3, 0.2, 9, 12)]
)
def test_is_the_step_of_a_depth_buffer(depth, near, far, bits):
    """P(z) is the distance between the depths of neighbouring integers."""
    # Eq. 9 itself loses digits: the two depths agree in all but P/z of them.
    assert z_resolution(depth, near, far, bits) == pytest.approx(expected(depth, near, far, bits), rel=1e-8)


def test_by_hand():
    """P(2) with near 1, far 2 (b = 2) and 1 bit is 4/2 / (2 + 2/2)."""
    assert z_resolution(2.0, 1.0, 2.0, 1) == pytest.approx(2 / 3)
    assert z_resolution(0.0, 1.0, 2.0) == 0.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_kind_precision_and_shape_are_kept(dtype):
    """NumPy, torch and Warp arrays of any shape give the same values in their own kind."""
    depth = np.random.default_rng(0).uniform(0.1, 10, (3, 4)).astype(dtype)
    found = z_resolution(depth, 0.1, 20.0)
    np.testing.assert_allclose(found, expected(depth.astype(float), 0.1, 20.0), rtol=1e-6)
    tensor = z_resolution(torch.tensor(depth), 0.1, 20.0)
    array = z_resolution(wp.array(depth, device="cpu"), 0.1, 20.0)
    assert found.dtype == dtype
    for other in (tensor.numpy(), array.numpy()):
        assert other.dtype == dtype
        np.testing.assert_allclose(other, found, rtol=1e-6)
    assert z_resolution(depth[:0], 0.1, 20.0).shape == (0, 4)


@pytest.mark.parametrize("kind", [float, np.asarray, torch.tensor, lambda z: wp.array(z, device="cpu")])
def test_orthographic_depth_buffer_is_linear(kind):
    """P = (far − near)·δ at every depth, and its gradient is zero."""
    for depth in ([0.5], [7.0]):
        found = z_resolution(kind(depth if kind is not float else depth[0]), 0.5, 20.0, 8, orthographic=True)
        value = found if kind is float else found.numpy()[0] if hasattr(found, "numpy") else found[0]
        assert value == pytest.approx(19.5 / 256)
    leaf = torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True)
    (grad,) = torch.autograd.grad(z_resolution(leaf, 0.5, 20.0, 8, orthographic=True).sum(), leaf)
    assert not grad.any()


def test_gradients():
    """A torch graph and a Warp tape give dP/dz, the tape twice its double."""
    depth = np.random.default_rng(0).uniform(0.1, 10, (3, 4))
    tensor = torch.tensor(depth, requires_grad=True)
    assert torch.autograd.gradcheck(lambda z: z_resolution(z, 0.5, 20.0, 8), (tensor,))
    (grad,) = torch.autograd.grad(z_resolution(tensor, 0.5, 20.0, 8).sum(), tensor)
    array = wp.array(depth, device="cpu", requires_grad=True)
    with wp.Tape() as tape:
        found = z_resolution(array, 0.5, 20.0, 8)
    for times in (1, 2):
        found.grad.fill_(1.0)
        tape.backward()
        np.testing.assert_allclose(array.grad.numpy(), times * grad.numpy(), rtol=1e-12)


def test_arguments_are_checked():
    """Wrong arguments are named."""
    for near, far in ((0.0, 1.0), (2.0, 1.0), (1.0, float("inf")), (float("nan"), 1.0)):
        with pytest.raises(ValueError, match=r"(near|far): got"):
            z_resolution(1.0, near, far)
    with pytest.raises(TypeError, match=r'near: got "0\.1", expected a number above 0'):
        z_resolution(1.0, "0.1", 1.0)
    with pytest.raises(ValueError, match="bits: got 0, expected a whole number from 1 to 64"):
        z_resolution(1.0, 0.1, 1.0, 0)
    with pytest.raises(ValueError, match="depth: got -1"):
        z_resolution(-1.0, 0.1, 1.0)
    with pytest.raises(TypeError, match="depth: got list"):
        z_resolution([1.0], 0.1, 1.0)
    with pytest.raises(TypeError, match="depth: got dtype int64"):
        z_resolution(np.array([1]), 0.1, 1.0)
