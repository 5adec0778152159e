"""Values far from 1: images and gradients stay finite, and right as far as they can be told."""

import numpy as np
import pytest
import torch
from extreme_pixels import extreme_pixels
from pixels import random_pixels

import warpfrag as wf

MERGES = ["none", "smooth", "order_independent", "exact"]


def taken_back(pixels, function, opacity_sum=None):
    """What a function of float32 fragments and beta returns, and the gradients of a random mean of it."""
    given = {"rgba": pixels.rgba, "depth": pixels.depth, "thickness": pixels.thickness, "beta": 0.4}
    if opacity_sum is not None:
        given["opacity_sum"] = opacity_sum
    leaves = {name: torch.tensor(value, dtype=torch.float32, requires_grad=True) for name, value in given.items()}
    own = {name: leaf for name, leaf in leaves.items() if name != "beta"}
    count = len(pixels.offsets) - 1
    outputs = function(wf.Fragments(**own, offsets=torch.tensor(pixels.offsets), shape=(count,)), leaves["beta"])
    generator = torch.Generator().manual_seed(1)
    torch.autograd.backward(outputs, [torch.rand(output.shape, generator=generator) - 0.5 for output in outputs])
    return [output.detach().numpy() for output in outputs], {name: leaf.grad.numpy() for name, leaf in leaves.items()}


def scaled(pixels, scale):
    """Fragments so many times as far away and as thick."""
    return pixels._replace(depth=scale * pixels.depth, thickness=scale * pixels.thickness)


@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize("scale", [2.0**100, 2.0**-100])
def test_units_of_length_do_not_matter(merge, scale):
    """Scenes of 1e30 or 1e-30 times the size have the same image to the bit, and gradients in proportion."""

    def image(fragments, beta):
        return [wf.composite(fragments, beta, max_layers=3, merge=merge)]

    pixels = random_pixels(1, 300)
    (here,), right = taken_back(pixels, image)
    (there,), found = taken_back(scaled(pixels, scale), image)
    np.testing.assert_array_equal(there, here)
    for name in ("depth", "thickness"):
        # Gradients in lengths of 1e30 are so small that some of their terms have lost digits.
        np.testing.assert_allclose(found[name].astype(np.float64) * scale, right[name], rtol=1e-6, atol=1e-40 * scale)
    for name in ("rgba", "beta"):
        np.testing.assert_array_equal(found[name], right[name])


@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize("scale", [1.0, 1e14, 1e-30])
def test_gradients_stay_finite(merge, scale):
    """Whatever opacities, thicknesses and opacity sums are given, layers and gradients are numbers."""

    def layers(fragments, beta):
        found = wf.resolve(fragments, beta, max_layers=3, merge=merge)
        return [found.rgba, found.depth, found.thickness, found.opacity_sum]

    pixels, opacity_sum, _ = extreme_pixels(7, 1500)
    outputs, grads = taken_back(scaled(pixels, scale), layers, opacity_sum)
    assert all(np.isfinite(output).all() for output in outputs)
    assert all(np.isfinite(grad).all() for grad in grads.values())


@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize(("depth", "thickness"), [(3e38, 0.1), (-3e38, 0.1), (1.0, 3e38)])
def test_nearly_infinite_values_are_refused(merge, depth, thickness):
    """What leaves no room for a sum is named like an infinity."""
    pixel = [(0.5, 0.0, 0.0, 0.5, depth, thickness), (0.5, 0.0, 0.0, 0.5, 1.0, 0.1)]
    fragments = wf.Fragments.from_lists([pixel], (1,))
    for function in (wf.composite, wf.resolve):
        with pytest.raises(ValueError, match=r"in fragment 0, expected finite values up to 3.3e\+35, opacity"):
            function(fragments, merge=merge)
