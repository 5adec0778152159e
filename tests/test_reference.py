"""The slow reference obeys every invariant of its operators, and some values worked by hand."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pixels import KINDS, Pixels, generic_pixels, random_pixels
from reference import (
    Fragment,
    Piece,
    composite,
    composite_pixel,
    mix_pieces,
    ofm,
    over,
    overlap,
    part,
    resolve,
    resolve_pixel,
    sfm,
    tail,
    z_resolution,
)
from reference_gradient import gradient, image_gradient, resolve_gradient

MERGES = ("none", "smooth", "order_independent")
MIXES = ("opacity", "average", "optical_depth")

opacities = st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 1e-12, 1e-7, 1.0 - 1e-7, 1.0 - 1e-12, 1.0]))
shares = st.floats(0.0, 1.0)
colors = st.tuples(*[st.floats(0.0, 1.0)] * 3).map(np.array)
mixes = st.sampled_from(MIXES)
merges = st.sampled_from(MERGES)
# A grid of depths makes equal, touching and nested slabs frequent.
slabs = st.builds(
    lambda color, opacity, depth, thickness: Fragment(color * (opacity or 1.0), opacity, depth, thickness, opacity),
    colors,
    opacities,
    st.integers(8, 16).map(float),
    st.one_of(st.integers(0, 8).map(float), st.floats(0.0, 8.0)),
)
pieces = slabs.map(lambda slab: Piece(slab.color, slab.opacity, slab.opacity_sum))


def slab(color, opacity, depth, thickness):
    """Make a fragment from a straight colour."""
    return Fragment(np.array(color, dtype=float) * opacity, opacity, depth, thickness, opacity)


def assert_same(actual, expected, tolerance=1e-14):
    """Compare colour and opacity; the tolerance is absolute, a few roundings of numbers up to 1."""
    np.testing.assert_allclose([*actual.color, actual.opacity], [*expected.color, expected.opacity], 0.0, tolerance)


# Inside a slab.


@given(slabs, shares, shares, mixes)
def test_front_over_back_is_the_whole(fragment, r, beta, mix):
    """Cutting a slab anywhere and compositing the halves restores it, opaque or not."""
    whole = over(part(fragment, 0.0, r, beta, mix), part(fragment, r, 1.0, beta, mix))
    assert_same(whole, fragment)


@given(slabs, shares, shares, shares, mixes)
def test_one_more_cut_changes_nothing(fragment, r0, r1, beta, mix):
    """The part up to r1 is the part up to r0 over the part between."""
    r0, r1 = sorted((r0, r1))
    cut = over(part(fragment, 0.0, r0, beta, mix), part(fragment, r0, r1, beta, mix))
    assert_same(cut, part(fragment, 0.0, r1, beta, mix))


@given(slabs, shares, shares, mixes)
def test_parts_are_within_range_and_keep_the_weight(fragment, r0, beta, mix):
    """The opacity of a part lies in 0 … 1 and S / A, C / A are those of the slab."""
    piece = part(fragment._replace(opacity_sum=2.0 * fragment.opacity), r0, 1.0, beta, mix)
    assert 0.0 <= piece.opacity <= 1.0
    # 1 - Q1 / Q0 is exact to one rounding of 1, here at least 1e-10 of the opacity.
    if piece.opacity > 1e-6:
        np.testing.assert_allclose(piece.opacity_sum, 2.0 * piece.opacity, 1e-9)
        np.testing.assert_allclose(piece.color * fragment.opacity, fragment.color * piece.opacity, 1e-9)


def test_part_of_no_length_is_nothing_and_of_full_length_the_slab():
    """The two ends of the definition, also for an opaque slab."""
    fragment = slab((1.0, 0.5, 0.0), 1.0, 2.0, 1.0)
    for mix in MIXES:
        for r in (0.0, 0.3, 1.0):
            assert_same(part(fragment, r, r, 0.0, mix), Piece(np.zeros(3), 0.0, 0.0), 0.0)
        assert_same(part(fragment, 0.0, 1.0, 0.0, mix), fragment, 0.0)


@pytest.mark.parametrize("opacity", [0.0, 1e-12, 1e-7, 0.3, 1.0 - 1e-12, 1.0])
@pytest.mark.parametrize("beta", [0.0, 0.4, 1.0])
@pytest.mark.parametrize(("r0", "r1"), [(0.0, 0.25), (0.25, 0.75), (0.25, 1.0), (0.875, 1.0)])
@pytest.mark.parametrize("floor", [1e-6, 0.0])
def test_parts_agree_with_the_formula_in_sixty_digits(opacity, beta, r0, r1, floor):
    """Neither thin nor dense slabs lose digits to cancellation."""
    if floor == 0.0 and opacity == 1.0:
        pytest.skip("the limit is a definition, tested below")
    with localcontext(prec=60):
        a, b, one = Decimal(opacity or 1e-30), Decimal(beta), Decimal(1)
        floored = max(one - a, Decimal(floor))
        before, after = (
            b * Decimal(r) * a + (one - b) * (one - floored ** Decimal(r)) if r % 1 else a * int(r) for r in (r0, r1)
        )
        expected = (after - before) / (one - before)
        share = float(expected / a)
        expected = float(expected)
    mix = "opacity" if floor else "optical_depth"
    piece = part(Fragment(np.ones(3), opacity, 1.0, 1.0, opacity), r0, r1, beta, mix)
    # 1 - A = 1e-12 knows its own digits to 1e-4, and so does the share of the last part in the slab.
    np.testing.assert_allclose(piece.color, share, 1e-13)
    np.testing.assert_allclose(piece.opacity, expected if opacity else 0.0, 1e-13)


def test_infinitely_dense_slab_is_opaque_from_its_front_on():
    """Without a floor an opaque slab at β = 0 is a wall: its front part is all of it, nothing shows behind."""
    fragment = slab((1.0, 0.5, 0.25), 1.0, 2.0, 1.0)
    assert_same(part(fragment, 0.0, 0.01, 0.0, "optical_depth"), fragment, 0.0)
    assert part(fragment, 0.01, 0.5, 0.0, "optical_depth").opacity == 0.0


# Mix.


@given(pieces, pieces, mixes)
def test_mix_is_commutative_and_adds_opacity_as_over_does(a, b, mix):
    """Mixing knows no order; its opacity is that of over, its S the sum."""
    mixed = mix_pieces(a, b, mix)
    assert_same(mixed, mix_pieces(b, a, mix), 2e-15)
    assert mixed.opacity == pytest.approx(over(a, b).opacity, abs=1e-15)
    assert mixed.opacity_sum == a.opacity_sum + b.opacity_sum


@given(pieces, pieces, pieces, st.sampled_from(["opacity", "optical_depth"]))
def test_mix_is_associative(a, b, c, mix):
    """Any grouping gives the same, but for the mean of three opaque ones, where the grouping is visible."""
    # Optical depths live in 1 - A, of which few digits are left in a merged opacity near 1.
    if mix == "optical_depth":
        assume((1.0 - a.opacity) * (1.0 - b.opacity) * (1.0 - c.opacity) > 1e-7)
    left = mix_pieces(mix_pieces(a, b, mix), c, mix)
    assert_same(left, mix_pieces(a, mix_pieces(b, c, mix), mix), 1e-9 if mix == "optical_depth" else 1e-14)


def test_average_is_the_mean_of_the_two_overs():
    """ZSlab eq. 4.4."""
    a, b = Piece(np.array([0.1, 0.2, 0.3]), 0.4, 0.4), Piece(np.array([0.5, 0.1, 0.0]), 0.6, 0.6)
    np.testing.assert_allclose(mix_pieces(a, b, "average").color, (over(a, b).color + over(b, a).color) / 2.0)


def test_optical_depth_mix_is_the_deep_image_formula():
    """OpenEXR, "Interpreting Deep Pixels": weights v = -log1p(-a) / a; opaque samples alone count, as their mean."""
    (c1, a1), (c2, a2) = (np.array([0.2, 0.1, 0.0]), 0.3), (np.array([0.0, 0.5, 0.7]), 0.8)
    u1, u2 = -math.log1p(-a1), -math.log1p(-a2)
    a = a1 + a2 - a1 * a2
    expected = (c1 * u1 / a1 + c2 * u2 / a2) * a / (u1 + u2)
    np.testing.assert_allclose(mix_pieces(Piece(c1, a1, a1), Piece(c2, a2, a2), "optical_depth").color, expected)
    opaque, other = Piece(c2, 1.0, 1.0), Piece(c1, 1.0, 1.0)
    np.testing.assert_array_equal(mix_pieces(Piece(c1, a1, a1), opaque, "optical_depth").color, c2)
    np.testing.assert_array_equal(mix_pieces(opaque, other, "optical_depth").color, (c1 + c2) / 2.0)


def test_emission_without_opacity_adds_up():
    """Of two pieces with A = 0 the factor A / S is 1."""
    a, b = Piece(np.array([0.1, 0.2, 0.3]), 0.0, 0.0), Piece(np.array([0.5, 0.1, 0.0]), 0.0, 0.0)
    for mix in MIXES:
        np.testing.assert_allclose(mix_pieces(a, b, mix).color, a.color + b.color)


# Merging two.


def test_smooth_merge_by_hand():
    """Red slab 0 … 2 and green slab 1 … 3, both A = 1/2, β = 1.

    Red's front half has A = 1/4; what is left (1/2 - 1/4) / (3/4) = 1/3. Green's front half has A = 1/4, the rest 1/3.
    The mix of red's rest and green's front: A = 1 - 2/3 · 3/4 = 1/2, S = 7/12, C = (1/3, 1/4) · 6/7 = (2/7, 3/14).
    C = (1/4, 0) + 3/4 · ((2/7, 3/14) + 1/2 · (0, 1/3)) = (13/28, 2/7); S = 1/4 + 7/12 + 1/3 = 7/6.
    With the average: C = (1/3, 1/4) - (1, 1)/24 = (7/24, 5/24), and in all (15/32, 9/32).
    """
    red, green = slab((1, 0, 0), 0.5, 2.0, 2.0), slab((0, 1, 0), 0.5, 3.0, 2.0)
    merged = sfm(red, green, 1.0)
    np.testing.assert_allclose([*merged.color, *merged[1:5]], [13 / 28, 2 / 7, 0.0, 0.75, 3.0, 3.0, 7 / 6], 1e-14)
    np.testing.assert_allclose(sfm(red, green, 1.0, "average").color, [15 / 32, 9 / 32, 0.0], 1e-14)


def test_optical_smooth_merge_by_hand():
    """The same two slabs at β = 0: each half has A = p = 1 - 1/√2; equal halves mix to A = 1/2, half red, half green.

    C = (p, 0) + (1 - p) · ((1/4, 1/4) + 1/2 · (0, p)).
    """
    p = 1.0 - math.sqrt(0.5)
    for mix in ("opacity", "optical_depth"):
        merged = sfm(slab((1, 0, 0), 0.5, 2.0, 2.0), slab((0, 1, 0), 0.5, 3.0, 2.0), 0.0, mix)
        np.testing.assert_allclose(merged.color[:2], [p + (1 - p) / 4, (1 - p) * (0.25 + p / 2)], 1e-14)


def test_surface_inside_a_slab_by_hand():
    """A green surface, A = 1/2, t = 0, halfway in a red slab, A = 1/2, β = 1: red 1/4, green, red 1/3.

    C = (1/4, 0) + 3/4 · ((0, 1/2) + 1/2 · (1/3, 0)) = (3/8, 3/8).
    """
    merged = sfm(slab((0, 1, 0), 0.5, 1.0, 0.0), slab((1, 0, 0), 0.5, 2.0, 2.0), 1.0)
    np.testing.assert_allclose([*merged.color, *merged[1:4]], [3 / 8, 3 / 8, 0.0, 0.75, 2.0, 2.0], 1e-14)


def test_nested_opaque_slabs_by_hand():
    """An opaque red slab 0 … 4 with an opaque green one 1 … 2 inside, β = 1: red 1/4, then a mix that is opaque."""
    merged = sfm(slab((0, 1, 0), 1.0, 2.0, 1.0), slab((1, 0, 0), 1.0, 4.0, 4.0), 1.0)
    # Red's part has A = 1/3 where green's has 1: the mix weights them 1 : 3.
    np.testing.assert_allclose([*merged.color, *merged[1:4]], [1 / 4 + 3 / 16, 9 / 16, 0.0, 1.0, 4.0, 4.0], 1e-14)


@given(slabs, slabs, shares, mixes)
def test_any_merge_of_two_has_the_opacity_of_over(a, b, beta, mix):
    """Merging keeps transmittance, whatever the extents, β and the weighting."""
    first, second = sorted((a, b), key=lambda fragment: (fragment.depth, fragment.front))
    expected = pytest.approx(a.opacity + (1.0 - a.opacity) * b.opacity, abs=1e-14)
    assert tail(first, second).opacity == expected
    assert ofm(a, b, mix).opacity == expected
    if overlap(first, second):
        merged = sfm(first, second, beta, mix)
        assert merged.opacity == expected
        assert (merged.depth, merged.front) == (second.depth, pytest.approx(min(a.front, b.front), abs=1e-14))


@given(slabs, slabs, shares, mixes)
def test_a_pair_is_continuous_where_its_overlap_begins(a, b, beta, mix):
    """With a hair of overlap SFM is plain over to within that hair; order-independent merging jumps there."""
    hair = 1e-9
    first, second = a._replace(depth=10.0, thickness=1.0), b._replace(depth=12.0, thickness=2.0 + hair)
    # The weighting of dense parts is steep, and with no floor an opaque slab has no thin part at all.
    assume(max(a.opacity, b.opacity) < 1.0 - 1e-6)
    assert overlap(first, second)
    assert_same(sfm(first, second, beta, mix), over(first, second), 100 * hair)


def test_touching_slabs_do_not_overlap():
    """Boundaries in common are not enough, and a surface on a boundary is outside."""
    assert not overlap(slab((1, 0, 0), 0.5, 2.0, 1.0), slab((1, 0, 0), 0.5, 3.0, 1.0))
    assert not overlap(slab((1, 0, 0), 0.5, 3.0, 1.0), slab((1, 0, 0), 0.5, 3.0, 0.0))
    assert not overlap(slab((1, 0, 0), 0.5, 2.0, 0.0), slab((1, 0, 0), 0.5, 2.0, 0.0))


# The resolve pass.


@given(st.lists(slabs, max_size=8), shares, st.integers(1, 9), merges, mixes)
def test_opacity_of_the_image_depends_on_opacities_alone(fragments, beta, max_layers, merge, mix):
    """It is 1 - ∏(1 - A), and layers stay in depth order, at most M of them."""
    layers = resolve_pixel(fragments, beta, max_layers, merge, mix)
    assert len(layers) <= max_layers
    assert [layer.depth for layer in layers] == sorted(layer.depth for layer in layers)
    expected = 1.0 - math.prod(1.0 - fragment.opacity for fragment in fragments)
    image = composite_pixel(layers)
    assert image[3] == pytest.approx(expected, abs=1e-14)
    assert np.all(np.isfinite(image))
    assert np.all(image >= 0.0)


@given(st.lists(slabs, max_size=8), st.integers(0, 3), merges, mixes)
def test_surfaces_give_plain_over(fragments, spare, merge, mix):
    """With t = 0 everywhere and M ≥ N the layers are the sorted fragments, and fewer layers give the same image."""
    surfaces = [fragment._replace(thickness=0.0) for fragment in fragments]
    layers = resolve_pixel(surfaces, 0.5, max(len(surfaces), 1) + spare, merge, mix)
    expected = sorted(surfaces, key=lambda fragment: fragment.depth)
    assert all(layer is fragment for layer, fragment in zip(layers, expected, strict=True))
    few = composite_pixel(resolve_pixel(surfaces, 0.5, 2, merge, mix))
    np.testing.assert_allclose(few, composite_pixel(expected), 0.0, 1e-14)


def test_tail_by_hand():
    """Of surfaces at 1, 2, 4 two layers remain: the first, and the others over one another from 2 to 4, S = 1."""
    surfaces = [slab((1, 1, 1), 0.5, depth, 0.0) for depth in (4.0, 1.0, 2.0)]
    near, rest = resolve_pixel(surfaces, max_layers=2)
    assert near is surfaces[1]
    assert tuple(rest[1:5]) == (0.75, 4.0, 2.0, 1.0)


def test_arrays_hold_the_layers_and_zeros():
    """A ragged array with an empty pixel, β per pixel and a given opacity sum."""
    rgba = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0.1, 0.1, 0.1, 0.2]])
    depth, thickness, offsets = np.array([2.0, 3.0, 1.0]), np.array([2.0, 2.0, 0.0]), np.array([0, 2, 2, 3])
    layers = resolve(rgba, depth, thickness, offsets, np.array([1.0, 0.5, 0.0]), max_layers=3)
    np.testing.assert_array_equal(layers.count, [1, 0, 1])
    np.testing.assert_allclose(layers.rgba[0, 0], [13 / 28, 2 / 7, 0.0, 0.75])
    np.testing.assert_array_equal(layers.rgba[2, 0], rgba[2])
    assert not layers.rgba[1].any()
    assert not layers.depth[:, 1:].any()
    np.testing.assert_allclose(composite(layers.rgba, layers.count)[:, 3], [0.75, 0.0, 0.2])
    given_sum = resolve(rgba, depth, thickness, offsets, opacity_sum=np.array([0.5, 1.5, 0.7]), max_layers=3)
    # Green weighs three times as much: S = 1/4 + (1/3 + 3/4) + 1.
    np.testing.assert_allclose(given_sum.opacity_sum[:, 0], [1 / 4 + 1 / 3 + 3 / 4 + 1.0, 0.0, 0.7])


def test_z_resolution_is_the_negative_of_equation_9():
    """The paper's b is negative: its P = b / (b / z - 1 / 2^n) - z, at 12 bits for its cancellation."""
    z, near, far = np.array([0.1, 0.5, 3.0, 10.0]), 0.1, 10.0
    b = near * far / (near - far)
    np.testing.assert_allclose(z_resolution(z, near, far, 12), -(b / (b / z - 2.0**-12) - z), 1e-9)
    np.testing.assert_allclose(z_resolution(2.0, 1.0, 2.0, 1), 4 * 0.5 / (2.0 + 1.0))


# Random pixels and gradients.


def test_random_pixels_are_seeded_and_exact_in_single_precision():
    """The same seed gives the same pixels, every boundary is a float32, and each kind occurs."""
    pixels = random_pixels(3, 200)
    for first, second in zip(pixels, random_pixels(3, 200), strict=True):
        np.testing.assert_array_equal(first, second)
    for values in (*pixels[:3], pixels.depth - pixels.thickness):
        np.testing.assert_array_equal(values, values.astype(np.float32))
    count, opacity = np.diff(pixels.offsets), pixels.rgba[:, 3]
    assert count.min() == 0
    assert count.max() > 40
    assert {0.0, 1.0, float(np.float32(1.0 - 1e-7)), float(np.float32(1e-7))} <= set(opacity)
    assert (pixels.thickness == 0.0).any()
    assert random_pixels(3, 200, without=KINDS).rgba[:, 3].max() < 0.96


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("merge", MERGES)
def test_complex_steps_agree_with_differences(merge, mix):
    """Two unrelated derivatives of all inputs, β and S included."""
    pixels = generic_pixels(5, 4, 5)
    rng = np.random.default_rng(0)
    weight = rng.uniform(1.0, 2.0, len(pixels.depth))
    inputs = [*pixels[:3], np.full(4, 0.4), weight * pixels.rgba[:, 3]]
    cotangents = tuple(rng.normal(size=shape) for shape in ((4, 3, 4), (4, 3), (4, 3), (4, 3)))
    options = {"max_layers": 3, "merge": merge, "mix": mix}

    def layers(rgba, depth, thickness, beta, opacity_sum):
        return tuple(resolve(rgba, depth, thickness, pixels.offsets, beta, opacity_sum, **options)[:4])

    exact = resolve_gradient(*pixels, 0.4, inputs[4], cotangents=cotangents, **options)
    for by_step, by_difference in zip(exact, gradient(layers, inputs, cotangents), strict=True):
        # Differences over 2.5e-4 round at 1e-12; their scale is the largest derivative.
        np.testing.assert_allclose(by_step, by_difference, 1e-7, 1e-9 * np.abs(by_step).max())


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0])
def test_gradient_of_opacity_is_that_of_over_everywhere(beta, mix):
    """Opaque, transparent, thin or tied: dA/dA_i is the transmittance of the others, all else has no effect."""
    pixels = random_pixels(1, 12, 5, without=("many",))
    cotangent = np.tile([0.0, 0.0, 0.0, 1.0], (12, 1))
    exact = image_gradient(*pixels, beta, cotangent=cotangent, max_layers=3, mix=mix)
    passed = 1.0 - pixels.rgba[:, 3]
    for begin, end in zip(pixels.offsets, pixels.offsets[1:], strict=False):
        for fragment in range(begin, end):
            others = np.delete(passed[begin:end], fragment - begin)
            assert exact.rgba[fragment, 3] == pytest.approx(np.prod(others), abs=1e-7)
    # Derivatives are as large as 13.8 · 1e6 behind a dense front (A = 1 - 1e-7) and cancel to rounding.
    for values in (exact.rgba[:, :3], exact.depth, exact.thickness, exact.beta):
        np.testing.assert_allclose(values, 0.0, 0.0, 1e-7)


@pytest.mark.parametrize("mix", MIXES)
def test_gradient_at_zero_thickness_is_the_one_from_thicker(mix):
    """A surface inside a slab that grows a thickness: the derivative at 0 is the limit of those at small thickness.

    With the default mix it is 0: a thin part mixed with a surface looks, to first order, like that part in front of it.
    """
    cotangent = np.array([[1.0, -0.5, 0.25, 0.0]])
    rgba = np.array([[0.0, 0.4, 0.1, 0.5], [0.6, 0.1, 0.0, 0.7]])

    def at(thickness: float) -> np.ndarray:
        pixels = Pixels(rgba, np.array([1.0, 2.0]), np.array([thickness, 2.0]), np.array([0, 2]))
        return image_gradient(*pixels, 0.3, cotangent=cotangent, mix=mix)

    for limit, close in zip(at(0.0)[:4], at(1e-9)[:4], strict=True):
        np.testing.assert_allclose(limit, close, 1e-6, 1e-7)
    assert (abs(at(0.0).thickness[0]) > 1e-2) == (mix != "opacity")
