"""Where boundaries coincide there are two derivatives: every returned one lies between them."""

import numpy as np
import pytest
import torch

import warpfrag as wf

STEP = 1e-6
SLACK = 1e-4


def lattice(seed: int, pixel_count: int, count: int, opaque: bool) -> list[np.ndarray]:
    """Draw pixels of slabs whose fronts and backs lie on few depths; no two slabs are the same surface."""
    rng = np.random.default_rng(seed)
    depth = rng.integers(4, 8, (pixel_count, count)) / 4.0
    thickness = rng.integers(1, 4, (pixel_count, count)) / 4.0
    opacity = rng.uniform(0.2, 0.9, (pixel_count, count))
    if opaque:
        opacity[rng.uniform(size=opacity.shape) < 0.3] = 1.0
    color = rng.uniform(0.0, 1.0, (pixel_count, count, 3)) * opacity[..., None]
    return [np.concatenate([color, opacity[..., None]], -1), depth, thickness]


def values(rgba, depth, thickness, cotangent, beta=0.4, **options) -> np.ndarray:
    """Return <cotangent, pixel> of each pixel."""
    pixel_count, count = depth.shape
    offsets = np.arange(pixel_count + 1, dtype=np.int32) * count
    arrays = (rgba.reshape(-1, 4), depth.reshape(-1), thickness.reshape(-1))
    image = wf.composite(wf.Fragments(*arrays, offsets, (1, pixel_count)), beta, **options)
    return (image[0] * cotangent).sum(-1)


def gradients(rgba, depth, thickness, cotangent, beta=0.4, **options) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradients in depth and thickness, (P, N) each."""
    pixel_count, count = depth.shape
    offsets = torch.arange(pixel_count + 1, dtype=torch.int32) * count
    leaves = [torch.tensor(array.reshape(-1), requires_grad=True) for array in (depth, thickness)]
    fragments = wf.Fragments(torch.tensor(rgba.reshape(-1, 4)), *leaves, offsets, (1, pixel_count))
    (wf.composite(fragments, beta, **options)[0] * torch.tensor(cotangent)).sum().backward()
    return tuple(leaf.grad.numpy().reshape(depth.shape) for leaf in leaves)


def outside_share(arrays, **options) -> float:
    """Return the share of derivatives in depth and thickness that lie between neither one-sided difference."""
    rgba, depth, thickness = arrays
    cotangent = np.random.default_rng(9).normal(size=(len(depth), 4))
    found = gradients(rgba, depth, thickness, cotangent, **options)
    here = values(rgba, depth, thickness, cotangent, **options)
    outside = total = 0
    for which, gradient in enumerate(found):
        for slot in range(depth.shape[1]):
            sides = []
            for sign in (1.0, -1.0):
                moved = [depth.copy(), thickness.copy()]
                moved[which][:, slot] += sign * STEP
                sides.append(sign * (values(rgba, *moved, cotangent, **options) - here) / STEP)
            # Where the function jumps there is no difference to compare with.
            smooth = np.abs(sides).max(axis=0) < 1e3
            low, high = np.min(sides, axis=0) - SLACK, np.max(sides, axis=0) + SLACK
            own = gradient[:, slot]
            outside += int((smooth & ((own < low) | (own > high))).sum())
            total += int(smooth.sum())
    return outside / total


@pytest.mark.parametrize("mix", ["opacity", "optical_depth"])
@pytest.mark.parametrize("count", [2, 3])
def test_exact_merging(count, mix):
    """Of pairs all; of three slabs all but few, in which three boundaries coincide."""
    share = outside_share(lattice(1, 300, count, opaque=False), merge="exact", mix=mix)
    assert share <= (0.0 if count == 2 else 0.01)


@pytest.mark.parametrize("mix", ["opacity", "average", "optical_depth"])
def test_smooth_merging_of_pairs(mix):
    """Equal fronts and equal backs."""
    assert outside_share(lattice(2, 300, 2, opaque=False), merge="smooth", mix=mix) == 0.0


@pytest.mark.parametrize("opaque", [False, True])
def test_smooth_merging_of_three(opaque):
    """But few, where the sequence of merges changes."""
    assert outside_share(lattice(3, 300, 3, opaque), merge="smooth", mix="opacity") < 0.06


def test_identical_slabs_where_the_function_is_smooth():
    """Both derivatives in thickness are that of the difference; the first slab does not take it all."""
    rgba = np.array([[[0.5, 0.1, 0.0, 0.6], [0.0, 0.3, 0.4, 0.5]]])
    depth, thickness = np.array([[2.0, 2.0]]), np.array([[0.5, 0.5]])
    cotangent = np.array([[1.0, -0.5, 0.3, 0.0]])
    options = {"merge": "exact", "mix": "optical_depth", "beta": 0.0}
    _, found = gradients(rgba, depth, thickness, cotangent, **options)
    for slot in range(2):
        sides = []
        for sign in (1.0, -1.0):
            moved = thickness.copy()
            moved[0, slot] += sign * STEP
            sides.append(values(rgba, depth, moved, cotangent, **options)[0])
        np.testing.assert_allclose(found[0, slot], (sides[0] - sides[1]) / (2.0 * STEP), atol=1e-5)


def test_contiguous_slabs_have_layers_of_their_own():
    """A layer's depth and thickness depend on its own slab alone, where the next begins at its back."""
    depth = torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True)
    thickness = torch.tensor([0.5, 1.0], dtype=torch.float64, requires_grad=True)
    rgba = torch.tensor([[0.2, 0.1, 0.0, 0.5], [0.0, 0.3, 0.1, 0.6]], dtype=torch.float64)
    fragments = wf.Fragments(rgba, depth, thickness, torch.tensor([0, 2]), (1, 1))
    layers = wf.resolve(fragments, merge="exact")
    by_depth = torch.autograd.grad(layers.depth[0, 0, 0], [depth], retain_graph=True)[0]
    assert by_depth.tolist() == [1.0, 0.0]
    found = torch.autograd.grad(layers.thickness[0, 0, 0], [depth, thickness])
    assert [gradient.tolist() for gradient in found] == [[0.0, 0.0], [1.0, 0.0]]


@pytest.mark.parametrize("merge", ["smooth", "exact"])
def test_single_precision_knows_thin_slabs_far_away(merge):
    """At a thousandth of a millionth of their depth gradients in depth and thickness are good to four digits."""
    rng = np.random.default_rng(0)
    pixel_count, count, far, thin = 100, 5, 1e4, 1e-1
    depth = (far + rng.uniform(0.0, 2.0 * thin, (pixel_count, count))).astype(np.float32)
    thickness = rng.uniform(0.5 * thin, thin, (pixel_count, count)).astype(np.float32)
    opacity = rng.uniform(0.2, 0.9, (pixel_count, count, 1)).astype(np.float32)
    rgba = np.concatenate([rng.uniform(0.0, 1.0, (pixel_count, count, 3)).astype(np.float32) * opacity, opacity], -1)
    cotangent = rng.normal(size=(pixel_count, 4)).astype(np.float32)
    single = gradients(rgba, depth, thickness, cotangent, merge=merge)
    double = gradients(*(array.astype(np.float64) for array in (rgba, depth, thickness, cotangent)), merge=merge)
    for one, other in zip(single, double, strict=True):
        error = np.linalg.norm(one - other, axis=1) / np.linalg.norm(other, axis=1).clip(1e-9)
        assert np.median(error) < 1e-5
        assert np.quantile(error, 0.95) < 1e-3


@pytest.mark.parametrize("merge", ["smooth", "order_independent", "exact"])
def test_the_mean_of_opaque_fragments_knows_no_order(merge):
    """Of three in one place each counts a third, whichever comes first."""
    colors = np.eye(3)
    for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        pixel = [(*colors[k], 1.0, 2.0, 0.5) for k in order]
        image = wf.composite(wf.Fragments.from_lists([pixel], (1, 1), np.float64), merge=merge, mix="optical_depth")
        np.testing.assert_allclose(image[0, 0], [1 / 3, 1 / 3, 1 / 3, 1.0], rtol=1e-12)
