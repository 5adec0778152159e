"""The methods to compare with: what each of them promises, on pixels where that can be told."""

from functools import partial

import numpy as np
import pytest
import torch
import warp as wp
from pixels import random_pixels

import warpfrag as wf
from warpfrag import baselines
from warpfrag.baselines.moments import BIAS, BIAS_TARGET

METHODS = {
    "weighted 7": baselines.weighted_blended,
    "weighted 8": partial(baselines.weighted_blended, equation=8),
    "weighted 9": partial(baselines.weighted_blended, equation=9),
    "weighted 10": partial(baselines.weighted_blended, equation=10),
    "moments 4": baselines.moment_based,
    "moments 6": partial(baselines.moment_based, moments=6),
    "moments 8": partial(baselines.moment_based, moments=8),
    "multi layer": baselines.multi_layer_alpha_blending,
    "adaptive": baselines.adaptive_transparency,
    "adaptive, near half kept": partial(baselines.adaptive_transparency, keep_near=True),
    "hybrid": baselines.hybrid_transparency,
    "hybrid, product": partial(baselines.hybrid_transparency, tail_opacity="product"),
    "stochastic": partial(baselines.stochastic_transparency, samples=64),
}
SMOOTH = [name for name in METHODS if name.startswith(("weighted", "moments"))]
STREAMED = [name for name in METHODS if name not in SMOOTH]

# An opaque fragment's absorbance is cut at 10, and the bias moves up to 5e-5 of the absorbance elsewhere.
MOMENT_ERROR = 1.5e-4


def drawn(seed, count, pixel_count=40, *, least=0.05, most=0.95):
    """Draw NumPy float64 fragments, `count` a pixel, with distinct depths in random order; shape (pixel_count, 1)."""
    rng = np.random.default_rng(seed)
    total = pixel_count * count
    opacity = rng.uniform(least, most, (total, 1))
    rgba = np.concatenate([opacity * rng.random((total, 3)), opacity], 1)
    offsets = np.arange(0, total + 1, max(count, 1), dtype=np.int32)[: pixel_count + 1]
    depth = rng.uniform(1.0, 5.0, total)
    return wf.Fragments(rgba, depth, np.zeros(total), offsets, (pixel_count, 1))


def exact(fragments):
    """The image of the full sorted list."""
    return wf.composite(fragments, merge="none")


def reordered(fragments, sort):
    """Submit every pixel's fragments in the order that `sort` makes of their depths."""
    order = np.concatenate(
        [
            begin + sort(fragments.depth[begin:end])
            for begin, end in np.column_stack([fragments.offsets[:-1], fragments.offsets[1:]])
        ]
    )
    return wf.Fragments(
        fragments.rgba[order], fragments.depth[order], fragments.thickness, fragments.offsets, fragments.shape
    )


@pytest.mark.parametrize("name", METHODS)
def test_one_fragment_is_itself(name):
    """A pixel with one fragment shows it, an empty pixel nothing."""
    rows = [[(0.4, 0.2, 0.1, 0.5, 2.0, 0.1)], [], [(0.3, 0.6, 0.9, 1.0, 3.0, 0.0)], []]
    fragments = wf.Fragments.from_lists(rows, (2, 2), np.float64)
    expected = np.array([[0.4, 0.2, 0.1, 0.5], [0, 0, 0, 0], [0.3, 0.6, 0.9, 1.0], [0, 0, 0, 0]]).reshape(2, 2, 4)
    tolerance = MOMENT_ERROR if name.startswith("moments") else 1e-12
    np.testing.assert_allclose(METHODS[name](fragments), expected, atol=tolerance)


@pytest.mark.parametrize("name", METHODS)
def test_no_fragment_at_all(name):
    """An image without fragments is transparent black."""
    fragments = wf.Fragments.from_lists([[], []], (1, 2))
    np.testing.assert_array_equal(METHODS[name](fragments), np.zeros((1, 2, 4), np.float32))


@pytest.mark.parametrize("name", METHODS)
def test_equal_color(name):
    """However fragments of one colour are weighted, the image has that colour, and where it promises so the opacity."""
    fragments = drawn(1, 5)
    color = np.array([0.7, 0.2, 0.4])
    rgba = np.concatenate([fragments.rgba[:, 3:] * color, fragments.rgba[:, 3:]], 1)
    fragments = wf.Fragments(rgba, fragments.depth, fragments.thickness, fragments.offsets, fragments.shape)
    image = METHODS[name](fragments)
    if name.startswith("adaptive"):
        # Its visibility is too low where nodes were removed; with as many nodes as fragments it is not.
        image = baselines.adaptive_transparency(fragments, nodes=5)
    np.testing.assert_allclose(image[..., :3], image[..., 3:] * color, rtol=1e-12)
    if name != "hybrid":
        np.testing.assert_allclose(image[..., 3], exact(fragments)[..., 3], atol=1e-10)


@pytest.mark.parametrize("name", METHODS)
def test_kinds_and_precisions(name):
    """Every kind of array gives the same image, in its own kind; Warp arrays may be refused in words."""
    fragments = drawn(2, 4, 6)
    image = METHODS[name](fragments)
    assert image.dtype == np.float64
    as_torch = METHODS[name](fragments.torch())
    assert isinstance(as_torch, torch.Tensor)
    np.testing.assert_allclose(as_torch.numpy(), image, rtol=1e-9, atol=1e-12)
    single = wf.Fragments(
        *(a.astype(np.float32) for a in (fragments.rgba, fragments.depth, fragments.thickness)),
        fragments.offsets.astype(np.int64),
        fragments.shape,
    )
    assert METHODS[name](single).dtype == np.float32
    if "stochastic" not in name:
        np.testing.assert_allclose(METHODS[name](single), image, atol=1e-5)
    arrays = (wp.array(a) for a in (fragments.rgba, fragments.depth, fragments.thickness, fragments.offsets))
    as_warp = wf.Fragments(*arrays, fragments.shape)
    if name in SMOOTH:
        with pytest.raises(TypeError, match=r"fragments: got Warp arrays, expected NumPy or torch"):
            METHODS[name](as_warp)
    else:
        np.testing.assert_array_equal(METHODS[name](as_warp).numpy(), image)


@pytest.mark.parametrize("name", METHODS)
def test_degenerate_pixels(name):
    """Every degenerate case gives numbers between nothing and all of the light that there is."""
    pixels = random_pixels(3, 300)
    fragments = wf.Fragments(*pixels, (300,))
    image = METHODS[name](fragments)
    light = np.zeros((300, 3))
    np.add.at(light, np.repeat(np.arange(300), np.diff(pixels.offsets)), pixels.rgba[:, :3])
    assert np.all(image >= 0.0)
    assert np.all(image[:, 3] <= 1.0)
    # No fragment counts for more than all of it, but that averages make one count for another.
    assert np.all(image[:, :3] <= np.maximum(light, 1.0) + 1e-9)


@pytest.mark.parametrize("name", STREAMED)
def test_opaque_fragments_hide(name):
    """Nothing shows from behind an opaque nearest fragment, whenever it was submitted."""
    fragments = drawn(4, 7)
    nearest = np.array([begin + np.argmin(fragments.depth[begin : begin + 7]) for begin in fragments.offsets[:-1]])
    fragments.rgba[nearest, 3] = 1.0
    np.testing.assert_allclose(METHODS[name](fragments)[:, 0], fragments.rgba[nearest], atol=1e-12)


# Weighted blended.


def test_weights_of_the_paper():
    """Two fragments, with weights worked out by hand: 10 m in front of 40 m, opacities 0.5 and 0.25."""
    rows = [[(0.5, 0.0, 0.0, 0.5, 10.0, 0.0), (0.0, 0.25, 0.0, 0.25, 40.0, 0.0)]]
    fragments = wf.Fragments.from_lists(rows, (1,), np.float64)
    falloff = {
        7: (10.0 / (1e-5 + 4.0 + 0.05**6), 10.0 / (1e-5 + 64.0 + 0.2**6)),
        8: (10.0 / (1e-5 + 1.0 + 0.05**6), 10.0 / (1e-5 + 64.0 + 0.2**6)),
        9: (0.03 / (1e-5 + 0.05**4), 0.03 / (1e-5 + 0.2**4)),
        # Planes at 5 and 80: d = (1/5 - 1/z)/(1/5 - 1/80) = 8/15 and 14/15.
        10: (3e3 * (7.0 / 15.0) ** 3, 3e3 * (1.0 / 15.0) ** 3),
    }
    for equation, (first, second) in falloff.items():
        image = baselines.weighted_blended(fragments, equation=equation, depth_range=(5.0, 80.0))[0]
        w1, w2 = 0.5 * first, 0.25 * second
        share = 0.5 * w1 / (0.5 * w1 + 0.25 * w2)
        np.testing.assert_allclose(image, 0.625 * np.array([share, 1.0 - share, 0.0, 1.0 / 1.0]), rtol=1e-12)


@pytest.mark.parametrize("equation", [7, 8, 9, 10])
@pytest.mark.parametrize(("least", "most"), [(-38.0, 35.0), (8.0, 35.0), (-37.0, -30.0), (0.0, 3.0)])
def test_weighted_gradients_at_any_depth(equation, least, most):
    """From the smallest depth to the largest that fragments may have, gradients are those that float64 finds."""
    fragments = drawn(6, 4)
    depth = np.float32(10.0 ** np.random.default_rng(6).uniform(least, most, fragments.count))
    found = {}
    for dtype in (torch.float64, torch.float32):
        rgba, z = (torch.tensor(values, dtype=dtype, requires_grad=True) for values in (fragments.rgba, depth))
        lists = wf.Fragments(rgba, z, torch.zeros_like(z), torch.tensor(fragments.offsets), fragments.shape)
        image = baselines.weighted_blended(lists, equation=equation)
        (image * torch.arange(1.0, 5.0, dtype=dtype)).sum().backward()
        # In relative depth, in which gradients are of the size of the image.
        found[dtype] = image.detach(), rgba.grad, z.grad.double() * torch.tensor(depth)
    for right, single in zip(found[torch.float64], found[torch.float32], strict=True):
        # Powers of depth take six times its rounding; near an opacity of 1 that of its transmittance counts.
        np.testing.assert_allclose(single, right, rtol=1e-4, atol=1e-5)


def test_weighted_opaque_gradient():
    """The gradient at opacity 1 is that of a difference from below."""
    fragments = drawn(5, 3, 4)
    fragments.rgba[::3, 3] = 1.0

    def loss(rgba):
        image = baselines.weighted_blended(wf.Fragments(rgba, *rest))
        return (image * torch.arange(1, 17).reshape(4, 1, 4)).sum()

    tensors = fragments.torch()
    rest = (tensors.depth, tensors.thickness, tensors.offsets, tensors.shape)
    rgba = tensors.rgba.clone().requires_grad_()
    loss(rgba).backward()
    for fragment in (0, 3):
        step = torch.zeros_like(rgba)
        step[fragment, 3] = 1e-5
        with torch.no_grad():
            # Second order, from one side.
            difference = (3 * loss(rgba) - 4 * loss(rgba - step) + loss(rgba - 2 * step)) / 2e-5
        assert rgba.grad[fragment, 3].item() == pytest.approx(difference.item(), rel=1e-5)


# Moments.


def shader_transmittance(total, b, z, overestimation):
    """Transmittance as the paper's shaders compute it: roots of a polynomial, then weights of an interpolation."""
    size = (len(b) - 1) // 2
    hankel = np.array([[b[i + j] for j in range(size + 1)] for i in range(size + 1)])
    coefficients = np.linalg.solve(hankel, z ** np.arange(size + 1))
    points = np.array([z, *np.roots(coefficients[::-1]).real])
    weights = np.linalg.solve(np.vander(points, increasing=True).T, b[: size + 1])
    share = weights[1:][points[1:] < z].sum() + overestimation * weights[0]
    return np.exp(-total * np.clip(share, 0.0, 1.0))


@pytest.mark.parametrize("count", [4, 6, 8])
def test_moments_as_the_paper_computes_them(count):
    """Eigenvalues give the transmittance that roots and a linear system give, for many layers, at many depths."""
    fragments = drawn(6, 9, 5)
    depth = np.linspace(1.0, 5.0, 23)
    found = [
        baselines.moment_transmittance(fragments, (p, 0), depth, moments=count, depth_range=(1, 5)) for p in range(5)
    ]
    z = 2.0 * np.log(fragments.depth) / np.log(5.0) - 1.0
    for pixel in range(5):
        own = slice(9 * pixel, 9 * pixel + 9)
        absorbance = -np.log1p(-fragments.rgba[own, 3])
        b = np.array([np.sum(absorbance * z[own] ** k) for k in range(count + 1)]) / absorbance.sum()
        b = (1 - BIAS[count]) * b + BIAS[count] * np.array([1.0, *BIAS_TARGET[count]])
        at = 2.0 * np.log(depth) / np.log(5.0) - 1.0
        expected = [shader_transmittance(absorbance.sum(), b, x, 0.25) for x in at]
        np.testing.assert_allclose(found[pixel], expected, atol=1e-7)


@pytest.mark.parametrize("count", [4, 6, 8])
def test_moments_reproduce_few_layers(count):
    """Up to n/2 layers have n/2 points, which n moments determine: the image is the sorted one, but for the bias."""
    rng = np.random.default_rng(count)
    for layers in range(1, count // 2 + 1):
        fragments = drawn(layers, layers)
        slots = rng.permuted(np.tile(np.arange(layers), (40, 1)), axis=1).ravel()
        fragments.depth[:] = slots + rng.uniform(1.0, 1.5, len(slots))
        options = {"moments": count, "overestimation": 0.0}
        image = baselines.moment_based(fragments, **options)
        np.testing.assert_allclose(image, exact(fragments), atol=5.0 * BIAS[count])
        image = baselines.moment_based(fragments, bias=1e-9, **options)
        np.testing.assert_allclose(image, exact(fragments), atol=5e-9)
        fragments.rgba[::layers, 3] = 1.0
        image = baselines.moment_based(fragments, **options)
        np.testing.assert_allclose(image, exact(fragments), atol=MOMENT_ERROR)


@pytest.mark.parametrize("count", [4, 6, 8])
def test_moments_reproduce_the_transmittance_of_few_layers(count):
    """Between up to n/2 layers the reconstructed transmittance is the true one, for any overestimation."""
    rows = [(0.0, 0.0, 0.0, 0.5, z, 0.0) for z in (1.0, 2.0, 3.0, 4.0)[: count // 2]]
    fragments = wf.Fragments.from_lists([rows], (1, 1), np.float64)
    depth = np.array([0.8, 1.3, 1.7, 2.3, 2.7, 3.3, 3.7, 4.5])
    truth = 1.0 - wf.absorbance(fragments, (0, 0)).at(depth)
    for beta in (0.0, 0.25, 1.0):
        options = {"moments": count, "overestimation": beta, "bias": 1e-9, "depth_range": (0.5, 5.0)}
        found = baselines.moment_transmittance(fragments, (0, 0), depth, **options)
        # Between layers the point at z itself takes a weight of about the bias over the squared products of distances.
        np.testing.assert_allclose(found, truth, atol=5e-5)


def test_moments_bound_the_transmittance():
    """Overestimation 0 and 1 enclose the truth at every depth, whatever the fragments."""
    fragments = drawn(7, 12, 6)
    depth = np.linspace(1.0, 5.0, 60)
    for count in (4, 6, 8):
        for pixel in range(6):
            low, high = (
                baselines.moment_transmittance(fragments, (pixel, 0), depth, moments=count, overestimation=beta)
                for beta in (1.0, 0.0)
            )
            truth = 1.0 - wf.absorbance(fragments, (pixel, 0)).at(depth)
            assert np.all(low <= truth + 1e-3)
            assert np.all(high >= truth - 1e-3)


def test_more_moments_are_nearer():
    """The error against the sorted image falls with the number of moments, and stays below that of averages."""
    fragments = drawn(8, 10, 200)
    errors = [np.abs(baselines.moment_based(fragments, moments=n) - exact(fragments)).mean() for n in (4, 6, 8)]
    assert sorted(errors, reverse=True) == errors
    assert errors[0] < np.abs(baselines.weighted_blended(fragments, equation=9) - exact(fragments)).mean()


def test_moments_in_pieces(monkeypatch):
    """How many fragments are reconstructed at a time makes no difference."""
    fragments = drawn(9, 6, 20)
    whole = baselines.moment_based(fragments)
    monkeypatch.setattr("warpfrag.baselines.moments.CHUNK", 7)
    np.testing.assert_allclose(baselines.moment_based(fragments), whole, rtol=1e-13)


@pytest.mark.parametrize("name", SMOOTH)
def test_gradients(name):
    """Gradients in colour, opacity and depth are those of differences."""
    fragments = drawn(10, 4, 2, least=0.1).torch()

    def image(rgba, depth):
        moved = wf.Fragments(rgba, depth, fragments.thickness, fragments.offsets, fragments.shape)
        # A fixed range: the default one follows the depths without being differentiated.
        options = {} if name in ("weighted 7", "weighted 8", "weighted 9") else {"depth_range": (0.5, 6.0)}
        return METHODS[name](moved, **options)

    inputs = (fragments.rgba.clone().requires_grad_(), fragments.depth.clone().requires_grad_())
    # The bias lets transmittances bend on a scale of 1e-4 around other fragments: smaller steps than usual.
    assert torch.autograd.gradcheck(image, inputs, eps=1e-7, atol=1e-5, rtol=1e-3)


# Multi-layer alpha blending.


def test_multi_layer_is_exact_from_front_to_back():
    """What arrives behind all nodes merges into the last in order; so do lists that fit, in any order."""
    fragments = drawn(11, 9)
    in_order = reordered(fragments, np.argsort)
    for nodes in (1, 3, 4, 9):
        image = baselines.multi_layer_alpha_blending(in_order, nodes=nodes)
        np.testing.assert_allclose(image, exact(fragments), atol=1e-14)
    np.testing.assert_allclose(baselines.multi_layer_alpha_blending(fragments, nodes=9), exact(fragments), atol=1e-14)


def test_multi_layer_merges_out_of_order():
    """A fragment that arrives between two that have been merged goes behind both: by hand, with two nodes."""
    rows = [[(0.5, 0, 0, 0.5, z, 0.0) for z in (1.0, 2.0, 4.0)] + [(0, 0, 0.5, 0.5, 3.0, 0.0)]]
    image = baselines.multi_layer_alpha_blending(wf.Fragments.from_lists(rows, (1,), np.float64), nodes=2)
    # Nodes: (1), (2 over 4); blue at 3 comes behind the merged node's depth, 2.
    np.testing.assert_allclose(image[0], [0.5 + 0.25 + 0.125, 0.0, 0.0625, 0.9375])


# Adaptive transparency.


def test_adaptive_is_exact_with_enough_nodes():
    """With a node for each fragment nothing is compressed."""
    fragments = drawn(12, 7)
    np.testing.assert_allclose(baselines.adaptive_transparency(fragments, nodes=7), exact(fragments), atol=1e-14)


def test_adaptive_underestimates_visibility():
    """Compression lowers visibility only: no channel gets brighter than it is, and opacity stays exact."""
    fragments = drawn(13, 20)
    errors = []
    for nodes in (1, 2, 4, 8, 16):
        image = baselines.adaptive_transparency(fragments, nodes=nodes)
        assert np.all(image[..., :3] <= exact(fragments)[..., :3] + 1e-14)
        np.testing.assert_allclose(image[..., 3], exact(fragments)[..., 3], atol=1e-14)
        errors.append(np.abs(image - exact(fragments)).mean())
    assert sorted(errors, reverse=True) == errors


def test_adaptive_removes_the_smallest_area():
    """By hand, with two nodes: of the steps at 1, 2 and 9, that at 2 goes; what is at 2 is seen through 1 and 2."""
    rows = [[(0.5, 0, 0, 0.5, 1.0, 0.0), (0, 0.5, 0, 0.5, 2.0, 0.0), (0, 0, 0.5, 0.5, 9.0, 0.0)]]
    image = baselines.adaptive_transparency(wf.Fragments.from_lists(rows, (1,), np.float64), nodes=2)
    np.testing.assert_allclose(image[0], [0.5, 0.125, 0.125, 0.875])


# Hybrid transparency.


def test_hybrid_is_exact_when_the_core_holds_all():
    """A core as large as the list composites it."""
    fragments = drawn(14, 6)
    np.testing.assert_allclose(baselines.hybrid_transparency(fragments, core=6), exact(fragments), atol=1e-14)


@pytest.mark.parametrize("core", [0, 1, 4])
def test_hybrid_does_not_depend_on_the_order(core):
    """Core and tail are sets: any submission order gives the same image."""
    fragments = drawn(15, 10)
    rng = np.random.default_rng(0)
    image = baselines.hybrid_transparency(fragments, core=core)
    shuffled = reordered(fragments, lambda depth: rng.permutation(len(depth)))
    np.testing.assert_allclose(baselines.hybrid_transparency(shuffled, core=core), image, atol=1e-14)


def test_hybrid_tail():
    """By hand: a core of one, and a tail of opacities 0.5 and 1: average 0.75, twice."""
    rows = [[(0, 0.5, 0, 0.5, 3.0, 0.0), (0.5, 0, 0, 0.5, 1.0, 0.0), (0, 0, 1.0, 1.0, 2.0, 0.0)]]
    fragments = wf.Fragments.from_lists(rows, (1,), np.float64)
    average = baselines.hybrid_transparency(fragments, core=1)[0]
    tail = 1.0 - 0.25**2
    np.testing.assert_allclose(average, [0.5, 0.5 * tail * 0.5 / 1.5, 0.5 * tail / 1.5, 0.5 + 0.5 * tail])
    product = baselines.hybrid_transparency(fragments, core=1, tail_opacity="product")[0]
    np.testing.assert_allclose(product, [0.5, 0.5 * 0.5 / 1.5, 0.5 / 1.5, 1.0])


# Stochastic transparency.


def test_stochastic_is_unbiased():
    """The mean over many draws is the sorted image, for any number of samples; its error falls like their root."""
    draws = 40_000
    one = drawn(16, 5, 1)
    offsets = np.arange(0, 5 * draws + 1, 5, dtype=np.int32)
    many = wf.Fragments(
        np.tile(one.rgba, (draws, 1)), np.tile(one.depth, draws), np.zeros(5 * draws), offsets, (draws,)
    )
    deviations = []
    for samples in (1, 4, 16):
        images = baselines.stochastic_transparency(many, samples=samples, alpha_correction=False)
        deviation = images.std(axis=0)
        # Five standard deviations of the mean.
        assert np.all(np.abs(images.mean(axis=0) - exact(one)[0, 0]) < 5.0 * deviation / np.sqrt(draws) + 1e-12)
        deviations.append(deviation[:3].mean())
    assert deviations[1] < 0.55 * deviations[0]
    assert deviations[2] < 0.55 * deviations[1]


def test_stochastic_alpha_correction():
    """It makes the opacity exact and the image less noisy."""
    fragments = drawn(17, 5, 400)
    plain, corrected = (
        baselines.stochastic_transparency(fragments, samples=8, alpha_correction=on) for on in (False, True)
    )
    np.testing.assert_allclose(corrected[..., 3], exact(fragments)[..., 3], atol=1e-14)
    error = [np.square(image - exact(fragments))[..., :3].mean() for image in (plain, corrected)]
    assert error[1] < error[0]


def test_stochastic_seeds(monkeypatch):
    """A seed stands for one image, whatever the number of threads; another seed for another."""
    fragments = drawn(18, 5, 3000)
    image = baselines.stochastic_transparency(fragments, seed=7)
    monkeypatch.setenv("WARPFRAG_THREADS", "1")
    np.testing.assert_array_equal(baselines.stochastic_transparency(fragments, seed=7), image)
    assert np.mean(baselines.stochastic_transparency(fragments, seed=8) != image) > 0.5


# What is refused.


@pytest.mark.parametrize(
    ("method", "options", "error", "message"),
    [
        (baselines.weighted_blended, {"equation": 6}, ValueError, "equation: got 6"),
        (baselines.weighted_blended, {"equation": 10, "depth_range": (0, 1)}, ValueError, r"depth_range: got \(0, 1\)"),
        (baselines.moment_based, {"moments": 5}, ValueError, "moments: got 5"),
        (baselines.moment_based, {"overestimation": 2}, ValueError, "overestimation: got 2"),
        (baselines.moment_based, {"bias": 0.0}, ValueError, "bias: got 0.0"),
        (baselines.moment_based, {"depth_range": (3.0, 2.0)}, ValueError, "depth_range: got"),
        (baselines.multi_layer_alpha_blending, {"nodes": 0}, ValueError, "nodes: got 0"),
        (baselines.adaptive_transparency, {"nodes": 1.5}, TypeError, "nodes: got 1.5"),
        (baselines.hybrid_transparency, {"core": -1}, ValueError, "core: got -1"),
        (baselines.hybrid_transparency, {"tail_opacity": "sum"}, ValueError, 'tail_opacity: got "sum"'),
        (baselines.stochastic_transparency, {"samples": 0}, ValueError, "samples: got 0"),
        (baselines.stochastic_transparency, {"seed": -1}, ValueError, "seed: got -1"),
    ],
)
def test_options_are_checked(method, options, error, message):
    """An option out of range is named, with what it got."""
    with pytest.raises(error, match=message):
        method(drawn(19, 2, 2), **options)


@pytest.mark.parametrize("name", METHODS)
def test_values_are_checked(name):
    """Fragments with values out of range are refused by all of them, and so is what has no fragments."""
    fragments = drawn(20, 2, 2)
    fragments.rgba[1, 3] = np.nan
    with pytest.raises(ValueError, match=r"got rgba .* in fragment 1"):
        METHODS[name](fragments)
    layers = wf.resolve(drawn(20, 2, 2))
    with pytest.raises(TypeError, match="got Layers, expected Fragments"):
        METHODS[name](layers)


def test_streamed_methods_are_detached():
    """A method without gradient says so by a result that requires none."""
    fragments = drawn(21, 3, 2).torch()
    fragments.rgba.requires_grad_()
    for name in STREAMED:
        assert not METHODS[name](fragments).requires_grad
