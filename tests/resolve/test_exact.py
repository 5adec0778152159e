"""Exact merging gives the slow reference, knows no order, has no jumps, and agrees with SFM and deep images."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import reference
from fragment_arrays import array_of, fragments_of, torch_gradients, transmittance
from pixels import Pixels, generic_pixels, join, random_pixels
from reference_exact import resolve_exactly

import warpfrag as wf
from warpfrag import Fragments

MIXES = ("opacity", "optical_depth")
NAMES = ("rgba", "depth", "thickness", "opacity_sum")
RED, GREEN, BLUE = np.eye(3)


def pixel_of(*slabs: tuple) -> Pixels:
    """Put slabs of (straight colour, opacity, front, back) into one pixel."""
    rgba = np.array([[*(np.asarray(color) * opacity), opacity] for color, opacity, _, _ in slabs])
    front, back = (np.array([slab[i] for slab in slabs], float) for i in (2, 3))
    return Pixels(rgba, back, back - front, np.array([0, len(slabs)], np.int32))


def image_of(pixels: Pixels, beta: Any = 0.0, **options: Any) -> np.ndarray:
    """Return the image of pixels, float64, by exact merging unless told."""
    return wf.composite(fragments_of(pixels), beta, **{"merge": "exact", **options})[0]


def layers_of(pixels: Pixels, beta: Any = 0.0, **options: Any) -> wf.Layers:
    """Return the layers of pixels, float64, by exact merging."""
    return wf.resolve(fragments_of(pixels), beta, merge="exact", **options)


# The reference.


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("max_layers", [1, 3, 64])
def test_layers_and_image_are_those_of_the_reference(device, dtype, mix, max_layers):
    """Every degenerate pixel, each fragment with its own beta."""
    pixels = random_pixels(40 + max_layers, 300)
    beta = np.random.default_rng(0).choice([0.0, 0.25, 0.75, 1.0], len(pixels.depth))
    fragments = fragments_of(pixels, dtype, kind="warp", device=device)
    beta_array = array_of(beta, dtype, "warp", device)
    layers = wf.resolve(fragments, beta_array, merge="exact", mix=mix, max_layers=max_layers).numpy()
    image = wf.composite(fragments, beta_array, merge="exact", mix=mix).numpy()
    expected = resolve_exactly(*pixels, beta, max_layers=max_layers, mix=mix)
    # Values are multiples of float32's step; what passes a dense part is known to 1e-16 of 1e-6, or 1e-7 of 1e-2.
    tolerance = 1e-9 if dtype == "float64" else 1e-4
    np.testing.assert_array_equal(layers.count[0], expected.count)
    for name in NAMES:
        np.testing.assert_allclose(getattr(layers, name)[0], getattr(expected, name), tolerance, tolerance)
    np.testing.assert_allclose(image[0], reference.composite(expected.rgba, expected.count), 0.0, tolerance)
    opacity = 1.0 - np.array([math.prod(1.0 - pixel[:, 3]) for pixel in np.split(pixels.rgba, pixels.offsets[1:-1])])
    np.testing.assert_allclose(image[0, :, 3], opacity, 0.0, 1e-6 if dtype == "float32" else 1e-15)


# By hand.


def test_three_equal_slabs_by_hand():
    """A = 1/2 each in one place: A = 7/8, S = 3/2, and each colour 1/2 · (7/8) / (3/2) = 7/24."""
    pixels = pixel_of((RED, 0.5, 0, 1), (GREEN, 0.5, 0, 1), (BLUE, 0.5, 0, 1))
    for beta in (0.0, 0.4, 1.0):
        np.testing.assert_allclose(image_of(pixels, beta), [[7 / 24, 7 / 24, 7 / 24, 7 / 8]], 1e-14)


def test_surfaces_inside_a_slab_by_hand():
    """Red slab 0 … 2, A = 3/4, β = 0: halves of A = 1/2. Two surfaces, A = 1/2, at 1 are mixed: A = 3/4, 3/8 of each.

    C = red 1/2 + 1/2 · ((0, 3/8, 3/8) + 1/4 · red 1/2) = (9/16, 3/16, 3/16).
    """
    pixels = pixel_of((GREEN, 0.5, 1, 1), (RED, 0.75, 0, 2), (BLUE, 0.5, 1, 1))
    np.testing.assert_allclose(image_of(pixels), [[9 / 16, 3 / 16, 3 / 16, 15 / 16]], 1e-14)


def test_surface_lies_behind_what_ends_and_before_what_begins_there():
    """Where two slabs touch, a surface is between them, and a layer of its own."""
    pixels = pixel_of((RED, 0.5, 1, 2), (GREEN, 0.5, 1, 1), (BLUE, 0.5, 0, 1))
    layers = layers_of(pixels)
    np.testing.assert_array_equal(layers.count, [[3]])
    np.testing.assert_allclose(layers.rgba[0, 0, :3, :3], 0.5 * np.array([BLUE, GREEN, RED]))


def test_layers_are_connected_runs_and_the_tail_takes_the_rest():
    """Slabs 0 … 2, 1 … 3, 2.5 … 4 hang together though the outer two are apart; touching ones and 6 … 7 do not."""
    slabs = [(RED, 0.5, 0, 2), (GREEN, 0.5, 1, 3), (BLUE, 0.5, 2.5, 4), (RED, 0.5, 4, 5), (GREEN, 0.5, 6, 7)]
    pixels = pixel_of(*slabs)
    layers = layers_of(pixels, 0.5)
    assert layers.count == 3
    np.testing.assert_array_equal(layers.depth[0, 0, :3], [4, 5, 7])
    np.testing.assert_array_equal(layers.thickness[0, 0, :3], [4, 1, 1])
    few = layers_of(pixels, 0.5, max_layers=2)
    assert few.count == 2
    np.testing.assert_array_equal(few.thickness[0, 0], [4, 3])
    np.testing.assert_allclose(few.rgba[0, 0, 1], [0.5, 0.25, 0, 0.75])
    for source in (layers, few):
        np.testing.assert_allclose(wf.composite(source)[0], image_of(pixels, 0.5), 1e-14)


def test_thickness_lost_in_rounding_is_none():
    """A slab of 1e-16 at depth 1 is a surface, and nothing divides by its length."""
    pixels = Pixels(
        np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5]]), np.ones(2), np.array([1e-16, 0.0]), np.array([0, 2])
    )
    fragments = fragments_of(pixels, "float32")
    layers = wf.resolve(fragments, merge="exact")
    assert layers.count == 1
    np.testing.assert_allclose(layers.rgba[0, 0, 0], [0.375, 0.375, 0, 0.75], 1e-6)


# What it is for.


def same_surface(pixels: Pixels) -> bool:
    """Tell whether a pair lies at one depth without thickness, which SFM leaves apart."""
    return bool((pixels.thickness == 0.0).all() and pixels.depth[0] == pixels.depth[1])


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("beta", [0.0, 0.6, 1.0])
def test_one_pair_is_that_of_smooth_merging(mix, beta):
    """Layers of any two fragments, degenerate or not; and all gradients where they have one."""
    many = random_pixels(21, 500, 2, without=("many", "empty"))
    split = [np.split(values, many.offsets[1:-1]) for values in many[:3]]
    pairs = [pair for pair in zip(*split, strict=True) if len(pair[1]) == 2]
    pairs = [pair for pair in pairs if not same_surface(Pixels(*pair, np.array([0, 2])))]
    assert len(pairs) > 100
    pixels = join(pairs)
    exact, smooth = (wf.resolve(fragments_of(pixels), beta, merge=merge, mix=mix) for merge in ("exact", "smooth"))
    np.testing.assert_array_equal(exact.count, smooth.count)
    known = transmittance(pixels) > 1e-6 if mix == "optical_depth" else slice(None)
    for name in NAMES:
        np.testing.assert_allclose(getattr(exact, name)[0][known], getattr(smooth, name)[0][known], 1e-9, 1e-9)
    pytest.importorskip("torch")
    pixels = generic_pixels(5, 30, 2)
    cotangent = np.random.default_rng(0).normal(size=(30, 4))
    by_exact, by_smooth = (
        torch_gradients(lambda f, b, m=merge: [wf.composite(f, b, merge=m, mix=mix)], pixels, beta, [cotangent])
        for merge in ("exact", "smooth")
    )
    for one, other in zip(by_exact, by_smooth, strict=True):
        np.testing.assert_allclose(one, other, 1e-9, 1e-11)


def test_no_jump_where_a_third_slab_is_near():
    """A slab 0 … 3 behind which one from 0 … 1 and one from 1 ± ε … 2 begin to overlap: SFM jumps, exact does not."""

    def image(hair: float, merge: str) -> np.ndarray:
        return image_of(pixel_of((RED, 0.7, 0, 3), (GREEN, 0.7, 0, 1), (BLUE, 0.7, 1.0 - hair, 2)), 0.5, merge=merge)

    jumps = {merge: np.abs(image(1e-9, merge) - image(-1e-9, merge)).max() for merge in ("smooth", "exact")}
    assert jumps["smooth"] > 0.05
    assert jumps["exact"] < 1e-8


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_no_order_of_submission(dtype):
    """Permuted fragments give the same bits, and to rounding where two share both boundaries."""
    rng = np.random.default_rng(0)

    def permuted(pixels: Pixels) -> Pixels:
        lists = np.split(np.arange(len(pixels.depth)), pixels.offsets[1:-1])
        order = np.concatenate([rng.permutation(own) for own in lists])
        return Pixels(*(values[order] for values in pixels[:3]), pixels.offsets)

    generic, tied = generic_pixels(1, 100, 12, opaque=True), random_pixels(1, 200)
    for pixels, tolerance in ((generic, 0.0), (tied, 1e-12 if dtype == "float64" else 1e-5)):
        for mix in MIXES:
            images = [
                wf.composite(fragments_of(p, dtype), 0.3, merge="exact", mix=mix) for p in (pixels, permuted(pixels))
            ]
            np.testing.assert_allclose(images[0], images[1], 0.0, tolerance)


def deep_flatten(samples: list[tuple[np.ndarray, float, float, float]]) -> np.ndarray:
    """Tidy and flatten deep samples (colour, alpha, z front, z back), from "Interpreting OpenEXR Deep Pixels"."""
    cuts = sorted({z for sample in samples for z in sample[2:]})
    pieces = []
    for color, alpha, front, back in samples:
        inner = [z for z in cuts if front < z < back]
        for begin, end in zip([front, *inner], [*inner, back], strict=True):
            share = (end - begin) / (back - front) if back > front else 1.0
            part = -math.expm1(share * math.log1p(-alpha)) if alpha < 1.0 else 1.0
            pieces.append(((begin, end), color * (part / alpha if alpha > 0.0 else share), part))
    # A point at z comes after what ends at z and before what begins there: by back, then by front from the rear.
    flat, passed = np.zeros(3), 1.0
    for extent in sorted({piece[0] for piece in pieces}, key=lambda e: (e[0] + e[1], e[0])):
        merged, alpha = None, 0.0
        for _, color, part in (piece for piece in pieces if piece[0] == extent):
            if merged is None:
                merged, alpha = color, part
                continue
            if alpha == 1.0 or part == 1.0:
                merged = (merged + color) / 2.0 if alpha == part else merged if alpha == 1.0 else color
                alpha = 1.0
                continue
            u1, u2 = -math.log1p(-alpha), -math.log1p(-part)
            v1, v2 = u1 / alpha if alpha > 0.0 else 1.0, u2 / part if part > 0.0 else 1.0
            both = alpha + part - alpha * part
            merged = (merged * v1 + color * v2) * (both / (u1 + u2) if u1 + u2 > 0.0 else 1.0)
            alpha = both
        flat, passed = flat + passed * merged, passed * (1.0 - alpha)
    return np.append(flat, 1.0 - passed)


def test_deep_images_flatten_the_same():
    """β = 0 with mix "optical_depth" is the flatten of OpenEXR, volumes and points, of up to two opaque ones."""
    pixels = random_pixels(31, 300, without=("many", "identical", "nearly_opaque"))
    image = image_of(pixels, 0.0, mix="optical_depth")
    compared = 0
    for index, (begin, end) in enumerate(zip(pixels.offsets, pixels.offsets[1:], strict=False)):
        opacity = pixels.rgba[begin:end, 3]
        if (opacity == 1.0).sum() > 2:
            continue
        own = (values[begin:end] for values in pixels[:3])
        fragments = [(row[:3], row[3], z - t, z) for row, z, t in zip(*own, strict=True)]
        np.testing.assert_allclose(image[index], deep_flatten(fragments), 0.0, 1e-9)
        compared += 1
    assert compared > 200


# Anything goes in.


def test_empty_images():
    """Of no pixels, of pixels without fragments."""
    for shape in ((0, 3), (2, 2)):
        empty = Fragments.from_lists([[]] * math.prod(shape), shape)
        assert wf.composite(empty, merge="exact").shape == (*shape, 4)
        assert not wf.resolve(empty, merge="exact").rgba.any()


def test_thousands_of_fragments_in_a_pixel():
    """As many as come; their opacity is that of over."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(1.0, 2.0, 3000)
    rgba = np.column_stack([rng.uniform(0.0, 1e-3, (3000, 3)), np.full(3000, 1e-3)])
    pixels = Pixels(rgba, depth, rng.uniform(0.0, 0.02, 3000), np.array([0, 3000], np.int32))
    image = image_of(pixels, 0.5)[0]
    assert image[3] == pytest.approx(-math.expm1(3000 * math.log1p(-1e-3)), abs=1e-12)
    assert (image[:3] < image[3]).all()


# Errors.


def both(**options: Any) -> list[Callable[[Fragments], Any]]:
    """Return the two functions with options."""
    return [lambda fragments, f=function: f(fragments, **options) for function in (wf.resolve, wf.composite)]


def test_average_is_refused():
    """It is not associative."""
    fragments = fragments_of(generic_pixels(0, 2))
    for function in both(merge="exact", mix="average"):
        with pytest.raises(ValueError, match='mix: got "average" with merge "exact", expected "opacity" or'):
            function(fragments)


def test_beta_of_fragments_is_checked():
    """Its shape, its range, and that no other way of merging takes it."""
    fragments = fragments_of(generic_pixels(0, 4))
    beta = np.full(fragments.count, 0.5)
    for function in both(beta=beta):
        with pytest.raises(ValueError, match='one per fragment goes with merge "exact"'):
            function(fragments)
    for function in both(beta=beta[1:], merge="exact"):
        with pytest.raises(ValueError, match=rf"beta: got shape .* or \({fragments.count},\)"):
            function(fragments)
    beta[3] = 1.5
    for function in both(beta=beta, merge="exact"):
        with pytest.raises(ValueError, match=r"beta: got 1\.5 in fragment 3, expected numbers from 0 to 1"):
            function(fragments)


@pytest.mark.parametrize("name", ["rgba", "depth", "thickness"])
def test_invalid_values_are_named(name):
    """Nothing hangs on a NaN; the first bad fragment is named."""
    pixels = generic_pixels(0, 9)
    getattr(pixels, name)[5] = np.nan
    for function in both(merge="exact"):
        with pytest.raises(ValueError, match="in fragment 5, expected"):
            function(fragments_of(pixels))


def test_fits_take_it():
    """A fit of beta and thicknesses to a render by exact merging finds them."""
    pytest.importorskip("scipy")
    from small_scene import spheres

    from warpfrag.fit import Reference, Study, fit

    scene = spheres(size=(24, 20))
    scene.merge = "exact"
    starts = {"beta": 0.9, "red.thickness": 0.8, "green.thickness": 0.12, "blue.thickness": 0.6}
    result = fit(Study(scene, Reference(true={}), starts))
    # Single precision: residuals are known to 1e-7.
    assert max(result.relative_errors().values()) < 1e-3
