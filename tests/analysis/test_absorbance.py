"""Absorbance along a ray: values by hand, its limits, and that layers of every kind can be asked for it."""

import numpy as np
import pytest
import warp as wp
from pixels import random_pixels

import warpfrag as wf


def one_pixel(*rows, dtype=np.float64):
    """Fragments of one pixel from rows (opacity, depth, thickness)."""
    return wf.Fragments.from_lists([[(0.0, 0.0, 0.0, a, z, t) for a, z, t in rows]], (1, 1), dtype)


def test_surfaces_are_steps():
    """Fragments without thickness, in any order: a step at each depth, which counts at the depth itself."""
    curve = wf.absorbance(one_pixel((0.5, 2.0, 0.0), (0.2, 1.0, 0.0), (1.0, 4.0, 0.0)), (0, 0))
    np.testing.assert_allclose(curve.depth, [1, 1, 2, 2, 4, 4])
    np.testing.assert_allclose(curve.absorbance, [0, 0.2, 0.2, 0.6, 0.6, 1.0])
    np.testing.assert_allclose(curve.at([0.0, 1.0, 1.5, 2.0, 3.9, 4.0, 9.0]), [0, 0.2, 0.2, 0.6, 0.6, 1.0, 1.0])
    np.testing.assert_allclose(curve.slabs.depth, [1, 2, 4])


@pytest.mark.parametrize(("beta", "half"), [(0.0, 1.0 - 0.25**0.5), (1.0, 0.375), (0.5, 0.4375)])
def test_inside_a_slab(beta, half):
    """Half-way through a slab of opacity 0.75 the absorbance is that of eq. 4; the line follows the curve."""
    curve = wf.absorbance(one_pixel((0.75, 3.0, 2.0)), (0, 0), beta)
    np.testing.assert_allclose(curve.at([1.0, 2.0, 3.0]), [0.0, half, 0.75])
    depth = np.linspace(1.0, 3.0, 200)
    np.testing.assert_allclose(np.interp(depth, curve.depth, curve.absorbance), curve.at(depth), atol=1e-3)


def test_overlapping_slabs_multiply():
    """Where slabs overlap, what each lets through multiplies; one may be a surface inside of the other."""
    curve = wf.absorbance(one_pixel((0.5, 3.0, 2.0), (0.8, 2.0, 0.0), (0.4, 4.0, 2.0)), (0, 0), 1.0)
    np.testing.assert_allclose(1.0 - curve.at([1.5, 2.0, 2.5, 3.5]), [0.875, 0.15, 0.625 * 0.2 * 0.9, 0.1 * 0.7])
    assert np.all(np.diff(curve.absorbance) >= 0.0)
    assert np.all(np.diff(curve.depth) >= 0.0)


def test_opaque_slabs():
    """An opaque slab ends at 1; in optical-depth mixing it is opaque from its front on."""
    fragments = one_pixel((1.0, 2.0, 1.0))
    curve = wf.absorbance(fragments, (0, 0), 0.0)
    np.testing.assert_allclose(curve.at([1.0, 1.5, 2.0]), [0.0, 1.0 - 1e-3, 1.0])
    curve = wf.absorbance(fragments, (0, 0), 0.0, mix="optical_depth")
    np.testing.assert_array_equal(curve.at([0.99, 1.0, 1.5, 2.0]), [0.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(curve.absorbance[:2], [0.0, 1.0])


def test_ends_at_the_opacity_of_the_image():
    """Behind everything the absorbance is the image's opacity: of fragments, of layers, and merged on the way."""
    pixels = random_pixels(1, 40)
    fragments = wf.Fragments(*pixels, (5, 8))
    image = wf.composite(fragments)
    layers = wf.resolve(fragments, 0.5, max_layers=3)
    for row, column in np.ndindex(5, 8):
        opacity = image[row, column, 3]
        for curve in (
            wf.absorbance(fragments, (row, column), 0.5),
            wf.absorbance(layers, (row, column), 0.5),
            wf.absorbance(fragments, (row, column), 0.5, merge="smooth", max_layers=3),
        ):
            assert curve.at(1e6) == pytest.approx(opacity, abs=1e-12)
            assert curve.at(0.0) == 0.0
            assert np.all(np.diff(curve.absorbance) >= -1e-15)
            np.testing.assert_allclose(curve.at(curve.depth), np.maximum(curve.at(curve.depth), curve.absorbance))


def test_merging_on_the_way_is_resolving():
    """With `merge` the curve is that of the resolved layers, and their depths are those of the layers."""
    fragments = wf.Fragments(*random_pixels(2, 12), (3, 4))
    layers = wf.resolve(fragments, 0.3, max_layers=2)
    depth = np.linspace(0.0, 8.0, 50)
    for pixel in range(12):
        merged = wf.absorbance(fragments, pixel, 0.3, merge="smooth", max_layers=2)
        at = np.unravel_index(pixel, (3, 4))
        np.testing.assert_allclose(merged.at(depth), wf.absorbance(layers, tuple(at), 0.3).at(depth), atol=1e-12)
        np.testing.assert_allclose(merged.slabs.depth, layers.depth[at][: layers.count[at]])


def test_kinds_of_arrays():
    """NumPy, torch and Warp arrays give the same curve, in NumPy."""
    fragments = wf.Fragments(*random_pixels(3, 6), (2, 3))
    arrays = (wp.array(a) for a in (fragments.rgba, fragments.depth, fragments.thickness, fragments.offsets))
    expected = wf.absorbance(fragments, (1, 1), 0.5)
    tensors = fragments.torch()
    tensors.rgba.requires_grad_()
    for source in (tensors, wf.Fragments(*arrays, (2, 3))):
        found = wf.absorbance(source, (1, 1), 0.5)
        np.testing.assert_array_equal(found.absorbance, expected.absorbance)
        layers = wf.absorbance(wf.resolve(source), (1, 1))
        np.testing.assert_array_equal(layers.absorbance, wf.absorbance(wf.resolve(fragments), (1, 1)).absorbance)


def test_beta_per_pixel_and_fragment():
    """An array of beta counts by pixel or by fragment."""
    rows = [[(0, 0, 0, 0.5, 1.0, 1.0)], [(0, 0, 0, 0.5, 1.0, 1.0), (0, 0, 0, 0.5, 3.0, 1.0)]]
    fragments = wf.Fragments.from_lists(rows, (1, 2), np.float64)
    optical, linear = 1.0 - 0.5**0.5, 0.25
    per_pixel = np.array([[0.0, 1.0]])
    assert wf.absorbance(fragments, (0, 0), per_pixel).at(0.5) == pytest.approx(optical)
    assert wf.absorbance(fragments, (0, 1), per_pixel).at(0.5) == pytest.approx(linear)
    per_fragment = wf.absorbance(fragments, (0, 1), np.array([1.0, 1.0, 0.0]))
    assert per_fragment.at(0.5) == pytest.approx(linear)
    assert per_fragment.at(2.5) == pytest.approx(1.0 - 0.5 * (1.0 - optical))


def test_empty_pixel():
    """A pixel without fragments absorbs nothing, and has no breakpoint."""
    curve = wf.absorbance(one_pixel(), (0, 0))
    assert curve.depth.shape == curve.absorbance.shape == (0,)
    np.testing.assert_array_equal(curve.at([0.0, 1.0]), [0.0, 0.0])
    assert wf.absorbance(wf.resolve(one_pixel()), (0, 0)).at(1.0) == 0.0
    assert wf.absorbance(one_pixel(), (0, 0), merge="smooth").at(1.0) == 0.0


@pytest.mark.parametrize(
    ("pixel", "options", "error", "message"),
    [
        ((1, 0), {}, ValueError, r"pixel: got \(1, 0\), expected a place in the grid of 1×1 pixels"),
        ((0,), {}, ValueError, r"pixel: got \(0,\)"),
        (1, {}, ValueError, "pixel: got 1"),
        ((0.0, 0), {}, ValueError, "pixel: got"),
        ((0, 0), {"beta": 2.0}, ValueError, "beta: got 2.0"),
        ((0, 0), {"beta": np.zeros(3)}, ValueError, r"beta: got shape \(3,\)"),
        ((0, 0), {"mix": "sum"}, ValueError, 'mix: got "sum"'),
        ((0, 0), {"merge": "sum"}, ValueError, 'merge: got "sum"'),
    ],
)
def test_mistakes(pixel, options, error, message):
    """What cannot be is named."""
    with pytest.raises(error, match=message):
        wf.absorbance(one_pixel((0.5, 1.0, 0.0), (0.5, 2.0, 0.0)), pixel, **options)


def test_layers_are_merged():
    """Layers take no way to merge, and other things are no source."""
    with pytest.raises(TypeError, match="merge: got it with Layers, expected Fragments"):
        wf.absorbance(wf.resolve(one_pixel((0.5, 1.0, 0.0))), (0, 0), merge="smooth")
    with pytest.raises(TypeError, match="source: got int"):
        wf.absorbance(1, (0, 0))
