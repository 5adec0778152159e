"""Fragments held out by others: by hand, against exact merging, gradients."""

from dataclasses import replace

import numpy as np
import pytest
from fragment_arrays import fragments_of
from pixels import generic_pixels, random_pixels

import warpfrag as wf


def pixel(*fragments):
    """Build one pixel of fragments (colour, opacity, depth, thickness), grey, float64."""
    return wf.Fragments.from_lists([[(c, c, c, a, z, t) for c, a, z, t in fragments]], (1, 1), np.float64)


def held(own, holder):
    """Return colour, opacity, depth and thickness of what remains."""
    found = wf.holdout(own, holder)
    return np.column_stack([found.rgba[:, 0], found.rgba[:, 3], found.depth, found.thickness]).tolist()


HALF = 1.0 - np.sqrt(0.5)


@pytest.mark.parametrize(
    ("own", "holder", "expected"),
    [
        # A surface before, behind, at an opaque or a translucent one.
        ((0.4, 0.5, 1.0, 0.0), (9.0, 1.0, 2.0, 0.0), [(0.4, 0.5, 1.0, 0.0)]),
        ((0.4, 0.5, 3.0, 0.0), (9.0, 1.0, 2.0, 0.0), []),
        ((0.4, 0.5, 3.0, 0.0), (9.0, 0.25, 2.0, 0.0), [(0.3, 0.375, 3.0, 0.0)]),
        ((0.4, 1.0, 2.0, 0.0), (9.0, 1.0, 2.0, 0.0), [(0.2, 0.5, 2.0, 0.0)]),
        ((0.4, 0.5, 2.0, 0.0), (9.0, 1.0, 2.0, 0.0), []),
        ((0.4, 0.5, 2.0, 0.0), (9.0, 0.5, 2.0, 0.0), [(0.3, 0.375, 2.0, 0.0)]),
        # A surface half-way into a slab, and at its ends.
        ((0.4, 0.5, 2.5, 0.0), (9.0, 0.75, 3.0, 1.0), [(0.2, 0.25, 2.5, 0.0)]),
        ((0.4, 0.5, 2.0, 0.0), (9.0, 1.0, 3.0, 1.0), [(0.4, 0.5, 2.0, 0.0)]),
        ((0.4, 0.5, 3.0, 0.0), (9.0, 0.5, 3.0, 1.0), [(0.2, 0.25, 3.0, 0.0)]),
        # A slab is cut at a surface, and at a slab's front; opaque slabs hide from there on.
        ((0.5, 0.5, 3.0, 2.0), (9.0, 0.5, 2.0, 0.0), [(HALF, HALF, 2.0, 1.0), (HALF / 2, HALF / 2, 3.0, 1.0)]),
        ((0.5, 0.5, 3.0, 2.0), (9.0, 1.0, 4.0, 2.0), [(HALF, HALF, 2.0, 1.0)]),
        ((0.5, 1.0, 3.0, 2.0), (9.0, 1.0, 4.0, 2.0), [(0.5, 1.0, 2.0, 1.0), (0.25, 0.5, 3.0, 1.0)]),
        # The same slab twice: what both hide is divided.
        ((0.5, 0.5, 3.0, 2.0), (9.0, 0.5, 3.0, 2.0), [(0.375, 0.375, 3.0, 2.0)]),
    ],
)
def test_by_hand(own, holder, expected):
    """What remains is cut, dimmed, or gone."""
    np.testing.assert_allclose(held(pixel(own), pixel(holder)), np.array(expected).reshape(-1, 4).tolist(), rtol=1e-12)


def test_without_holders_nothing_changes():
    """Every bit stays, and ids and opacity sums do."""
    own = fragments_of(random_pixels(1, without=("transparent",)), "float32")
    own = replace(own, opacity_sum=2.0 * own.rgba[:, 3], object_id=np.arange(own.count, dtype=np.int32))
    nothing = wf.Fragments.from_lists([[]] * own.pixel_count, own.shape)
    found = wf.holdout(own, nothing)
    for name, array in vars(own).items():
        np.testing.assert_array_equal(getattr(found, name), array)


@pytest.mark.parametrize("seed", range(3))
def test_faint_fragments_shine_as_in_exact_merging(seed):
    """Too faint to hide one another, they give the image that they have part in when both are merged exactly."""
    own = fragments_of(random_pixels(seed, without=("opaque", "nearly_opaque")))
    own = replace(own, rgba=np.concatenate([own.rgba[:, :3], 1e-7 * own.rgba[:, 3:]], axis=1))
    holder = fragments_of(random_pixels(seed + 10, without=("opaque", "nearly_opaque", "identical")))
    black = replace(holder, rgba=holder.rgba * [0, 0, 0, 1])
    options = {"merge": "exact", "mix": "optical_depth", "beta": 0.0}
    expected = wf.composite(wf.concat(own, black), **options)
    found = wf.composite(wf.holdout(own, holder), **options)
    np.testing.assert_allclose(found[..., :3], expected[..., :3], rtol=1e-4, atol=1e-7)


def test_gradients():
    """Those in both images agree with finite differences."""
    torch = pytest.importorskip("torch")
    own, holder = (fragments_of(generic_pixels(seed, 6, 3), kind="torch") for seed in (5, 6))
    names = ("rgba", "depth", "thickness")

    def values(*arrays):
        first = replace(own, **dict(zip(names, arrays[:3], strict=True)))
        found = wf.holdout(first, replace(holder, **dict(zip(names, arrays[3:], strict=True))))
        return found.rgba, found.depth, found.thickness

    arrays = [getattr(each, name).clone().requires_grad_() for each in (own, holder) for name in names]
    assert torch.autograd.gradcheck(values, arrays, atol=1e-4)


def test_warp_arrays_come_out_without_gradient(device):
    """The values are those of NumPy; nothing is recorded."""
    own, holder = (random_pixels(seed) for seed in (7, 8))
    expected = wf.holdout(fragments_of(own, "float32"), fragments_of(holder, "float32"))
    found = wf.holdout(*(fragments_of(each, "float32", kind="warp", device=device) for each in (own, holder)))
    assert found.kind == "warp"
    np.testing.assert_array_equal(found.rgba.numpy(), expected.rgba)


def test_what_does_not_fit_is_refused():
    """Grids that differ, and opacities out of range."""
    with pytest.raises(ValueError, match=r"opacity: got 1\.5"):
        wf.holdout(pixel((0.5, 0.5, 1.0, 0.0)), pixel((0.5, 1.5, 1.0, 0.0)))
    with pytest.raises(ValueError, match="holder: got a grid of 1×1 pixels, expected 1×2 like the first"):
        wf.holdout(wf.Fragments.from_lists([[], []], (1, 2)), wf.Fragments.from_lists([[]], (1, 1)))
