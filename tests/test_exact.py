"""Exact merging gives the slow reference, knows no order, has no jumps, and agrees with SFM and deep images."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import reference
from extreme_pixels import extreme_pixels
from fragment_arrays import array_of, fragments_of, ties, torch_gradients, transmittance
from pixels import KINDS, Pixels, generic_pixels, join, random_pixels
from reference_exact import exact_gradient, resolve_exactly

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


def assert_gradients(pixels: Pixels, beta: Any, dtype: str, tolerance: float, opacity_sum=None, **options: Any) -> None:
    """Compare the gradients of random cotangents, of the layers and of the image, with those of the reference."""
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    max_layers, pixel_count = options.pop("max_layers", 3), len(pixels.offsets) - 1
    cotangents = [rng.normal(size=(pixel_count, max_layers, *extra)) for extra in ((4,), (), (), ())]
    tensors = fragments_of(pixels, dtype, kind="torch", opacity_sum=opacity_sum, requires_grad=True)
    beta_tensor = array_of(beta, dtype, "torch", requires_grad=True)
    inputs = [tensors.rgba, tensors.depth, tensors.thickness, beta_tensor]
    inputs += [] if opacity_sum is None else [tensors.opacity_sum]
    layers = wf.resolve(tensors, beta_tensor, merge="exact", max_layers=max_layers, **options)
    image = wf.composite(tensors, beta_tensor, merge="exact", **options)
    layer_loss = sum(
        (getattr(layers, name)[0] * torch.as_tensor(c)).sum() for name, c in zip(NAMES, cotangents, strict=True)
    )
    image_loss = (image[0] * torch.as_tensor(cotangents[0][:, 0])).sum()
    flat_beta = beta.reshape(-1) if np.shape(beta) == (1, pixel_count) else beta
    losses = (
        (layer_loss, {"cotangents": cotangents, "max_layers": max_layers}),
        (image_loss, {"image_cotangent": cotangents[0][:, 0], "max_layers": 1}),
    )
    for loss, given in losses:
        expected = exact_gradient(*pixels, flat_beta, opacity_sum, **given, **options)
        by_beta = expected.beta
        if np.ndim(beta) != 1:
            by_beta = np.add.reduceat(by_beta, pixels.offsets[:-1]) if np.ndim(beta) else by_beta.sum()
        wanted = [*expected[:3], np.reshape(by_beta, np.shape(beta)), expected.opacity_sum]
        for name, actual, value in zip((*NAMES[:3], "beta", NAMES[3]), torch.autograd.grad(loss, inputs), wanted[:len(inputs)], strict=False):  # fmt: skip
            scale = max(1.0, np.abs(value).max())
            np.testing.assert_allclose(actual.numpy(), value, 0.0, tolerance * scale, err_msg=name)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("opaque", [False, True])
@pytest.mark.parametrize("beta", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("mix", MIXES)
def test_gradients_are_those_of_the_reference(mix, beta, opaque, dtype):
    """By every input in general position, opaque slabs and given opacity sums included."""
    if opaque and beta == 0.0 and mix == "optical_depth":
        pytest.skip("an infinitely dense slab has no derivative in A")
    pixels = generic_pixels(3, 8, 6, opaque=opaque)
    opacity_sum = pixels.rgba[:, 3] * np.random.default_rng(1).uniform(1.0, 2.0, len(pixels.depth))
    # Rounding of float32; in double precision what is left of 1e-16 behind parts that pass 1e-6 of the light.
    assert_gradients(pixels, beta, dtype, 1e-5 if dtype == "float32" else 1e-10, opacity_sum, mix=mix)


@pytest.mark.parametrize("of", ["pixel", "fragment"])
def test_beta_of_pixels_and_of_fragments_has_a_gradient(of):
    """Each pixel's, or each fragment's own."""
    pixels = generic_pixels(4, 8, 6)
    beta = np.random.default_rng(2).uniform(0.1, 0.9, len(pixels.depth) if of == "fragment" else (1, 8))
    assert_gradients(pixels, beta, "float64", 1e-12)


def test_gradients_of_thin_dense_and_emissive_fragments():
    """Wherever no two boundaries coincide."""
    kinds = {"transparent", "emissive", "opaque", "nearly_opaque", "nearly_transparent", "thin", "far_apart"}
    pixels = random_pixels(12, 200, 5, without=tuple(set(KINDS) - kinds))
    untied = ~ties(pixels)
    assert untied.sum() > 150
    split = [np.split(values, pixels.offsets[1:-1]) for values in pixels[:3]]
    chosen = [pixel for pixel, keep in zip(zip(*split, strict=True), untied, strict=True) if keep and len(pixel[1])]
    opacity_sum = None
    # Derivatives reach 13.8e6 behind a part that passes 1e-7, and are known to 1e-16 of what cancels in them.
    assert_gradients(join(chosen), 0.4, "float64", 1e-8, opacity_sum)


def test_gradcheck():
    """Torch's own differences."""
    torch = pytest.importorskip("torch")
    pixels = generic_pixels(6, 4, 5)
    tensors = [array_of(a, "float64", "torch", requires_grad=True) for a in pixels[:3]]
    beta = torch.linspace(0.1, 0.9, len(pixels.depth), dtype=torch.float64, requires_grad=True)
    offsets = torch.as_tensor(pixels.offsets)

    def resolved(*leaves):
        layers = wf.resolve(Fragments(*leaves[:3], offsets, (4,)), leaves[3], max_layers=2, merge="exact")
        return tuple(getattr(layers, name) for name in NAMES)

    assert torch.autograd.gradcheck(resolved, (*tensors, beta), eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_gradient_at_zero_thickness_is_the_one_from_thicker(mix, weight):
    """A surface inside two slabs that grows a thickness: the derivative at 0 is the limit from small thickness."""

    def at(thickness: float) -> list[np.ndarray]:
        pixels = pixel_of((GREEN, 0.5, 1.0 - thickness, 1.0), ((0.5, 0.2, 0), 0.7, 0.0, 2.0), (BLUE, 0.4, 0.5, 3.0))
        opacity_sum = pixels.rgba[:, 3] * np.array([weight, 1.0, 1.5])
        options = {"merge": "exact", "mix": mix}
        return torch_gradients(
            lambda f, beta: [wf.composite(f, beta, **options)], pixels, 0.3, [np.array([1.0, -0.5, 0.25, 0.0])],
            opacity_sum=opacity_sum,
        )  # fmt: skip

    pytest.importorskip("torch")
    for limit, close in zip(at(0.0), at(1e-9), strict=True):
        np.testing.assert_allclose(limit, close, 1e-6, 1e-6)


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
    """In single precision a slab of 1e-9 at depth 1 is a surface, and nothing divides by its length."""
    pixels = Pixels(np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5]]), np.ones(2), np.array([1e-9, 0.0]), np.array([0, 2]))
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
        return image_of(
            pixel_of((RED, 0.7, 0, 3), (GREEN, 0.7, 0, 1), (BLUE, 0.7, 1.0 - hair, 2)), 0.5, merge=merge
        )

    jumps = {merge: np.abs(image(1e-9, merge) - image(-1e-9, merge)).max() for merge in ("smooth", "exact")}
    assert jumps["smooth"] > 0.05
    assert jumps["exact"] < 1e-8


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_no_order_of_submission(dtype):
    """Permuted fragments give the same bits, and to rounding where two share both boundaries."""
    rng = np.random.default_rng(0)

    def permuted(pixels: Pixels) -> Pixels:
        order = np.concatenate([b + rng.permutation(e - b) for b, e in zip(pixels.offsets, pixels.offsets[1:], strict=False)])  # fmt: skip
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
    """β = 0 with mix "optical_depth" is the flatten of OpenEXR, volumes and points, up to two opaque ones in a place."""
    pixels = random_pixels(31, 300, without=("many", "identical", "nearly_opaque"))
    image = image_of(pixels, 0.0, mix="optical_depth")
    compared = 0
    for index, (begin, end) in enumerate(zip(pixels.offsets, pixels.offsets[1:], strict=False)):
        opacity = pixels.rgba[begin:end, 3]
        if (opacity == 1.0).sum() > 2:
            continue
        fragments = [
            (row[:3], row[3], z - t, z)
            for row, z, t in zip(pixels.rgba[begin:end], pixels.depth[begin:end], pixels.thickness[begin:end], strict=True)
        ]  # fmt: skip
        np.testing.assert_allclose(image[index], deep_flatten(fragments), 0.0, 1e-9)
        compared += 1
    assert compared > 200


# Anything goes in.


def finite_everywhere(seed: int, pixel_count: int, dtype: str, mix: str) -> None:
    """Resolve and composite extreme pixels, and pull gradients back: no NaN, no infinity anywhere."""
    import torch

    pixels, opacity_sum, beta = extreme_pixels(seed, pixel_count)
    for given in (None, opacity_sum):
        fragments = fragments_of(pixels, dtype, kind="torch", opacity_sum=given, requires_grad=True)
        leaves = [fragments.rgba, fragments.depth, fragments.thickness, array_of(beta, dtype, "torch", requires_grad=True)]
        leaves += [] if given is None else [fragments.opacity_sum]
        layers = wf.resolve(fragments, leaves[3], max_layers=3, merge="exact", mix=mix)
        image = wf.composite(fragments, leaves[3], merge="exact", mix=mix)
        values = [getattr(layers, name) for name in NAMES] + [image]
        losses = (sum(value.sum() for value in values[:4]), (image * torch.tensor([1.0, -0.5, 2.0, 0.7])).sum())
        grads = [grad for loss in losses for grad in torch.autograd.grad(loss, leaves, allow_unused=True)]
        for array in [*values, *(grad for grad in grads if grad is not None)]:
            assert bool(torch.isfinite(array).all())


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_everything_is_finite(dtype, mix):
    """10⁴ pixels of extreme values: empty, opaque, denormal, thin, huge, coincident."""
    pytest.importorskip("torch")
    finite_everywhere(0, 10_000, dtype, mix)


@pytest.mark.slow
@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_million_pixels_are_finite(dtype, mix):
    """10⁶ of them."""
    for seed in range(10):
        finite_everywhere(seed + 1, 100_000, dtype, mix)


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


@pytest.mark.parametrize("threads", [2, 3])
def test_bits_do_not_depend_on_threads(threads, monkeypatch):
    """Layers and gradients."""
    pytest.importorskip("torch")
    pixels = random_pixels(8, 3000, without=("many",))
    cotangents = [np.random.default_rng(0).normal(size=(3000, 4, *extra)) for extra in ((4,), (), (), ())]

    def layers(fragments: Fragments, beta: Any) -> list:
        resolved = wf.resolve(fragments, beta, max_layers=4, merge="exact")
        return [getattr(resolved, name) for name in NAMES]

    def run(count: int) -> list[np.ndarray]:
        monkeypatch.setenv("WARPFRAG_THREADS", str(count))
        return [*layers(fragments_of(pixels), 0.4), *torch_gradients(layers, pixels, 0.4, cotangents)]

    for one, other in zip(run(1), run(threads), strict=True):
        np.testing.assert_array_equal(one, other)


def test_two_passes_over_a_tape_double():
    """Warp arrays record on tapes, and gradients add up."""
    import warp as wp

    fragments = fragments_of(generic_pixels(2, 6), kind="warp", requires_grad=True)
    beta = wp.full(fragments.count, 0.4, dtype=wp.float64, requires_grad=True)
    with wp.Tape() as tape:
        image = wf.composite(fragments, beta, merge="exact")
    seed = wp.full(image.shape, 1.0, dtype=wp.float64)
    grads = []
    for _ in range(2):
        tape.backward(grads={image: seed})
        grads.append([a.grad.numpy().copy() for a in (fragments.rgba, fragments.depth, fragments.thickness, beta)])
    for once, twice in zip(*grads, strict=True):
        assert once.any()
        np.testing.assert_allclose(twice, 2.0 * once, 1e-15)


# Errors.


def both(**options: Any) -> list[Callable[[Fragments], Any]]:
    """Return the two functions with options."""
    return [lambda fragments, f=function: f(fragments, **options) for function in (wf.resolve, wf.composite)]


def test_average_is_refused():
    """It is not associative."""
    fragments = fragments_of(generic_pixels(0, 2))
    for function in both(merge="exact", mix="average"):
        with pytest.raises(ValueError, match="mix: got 'average' with merge 'exact', expected 'opacity' or"):
            function(fragments)


def test_beta_of_fragments_is_checked():
    """Its shape, its range, and that no other way of merging takes it."""
    fragments = fragments_of(generic_pixels(0, 4))
    beta = np.full(fragments.count, 0.5)
    for function in both(beta=beta):
        with pytest.raises(ValueError, match="one per fragment goes with merge 'exact'"):
            function(fragments)
    for function in both(beta=beta[1:], merge="exact"):
        with pytest.raises(ValueError, match=rf"beta: got shape .* or \({fragments.count},\)"):
            function(fragments)
    beta[3] = 1.5
    for function in both(beta=beta, merge="exact"):
        with pytest.raises(ValueError, match="beta: got 1.5 in fragment 3, expected values from 0 to 1"):
            function(fragments)


@pytest.mark.parametrize("name", ["rgba", "depth", "thickness"])
def test_invalid_values_are_named(name):
    """Nothing hangs on a NaN; the first bad fragment is named."""
    pixels = generic_pixels(0, 9)
    getattr(pixels, name)[5] = np.nan
    for function in both(merge="exact"):
        with pytest.raises(ValueError, match="fragment 5 has"):
            function(fragments_of(pixels))
