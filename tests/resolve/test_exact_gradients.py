"""The adjoint of exact merging is that of the slow reference, and finite whatever comes in."""

from typing import Any

import numpy as np
import pytest
from extreme_pixels import extreme_pixels
from fragment_arrays import array_of, fragments_of, ties, torch_gradients
from pixels import KINDS, Pixels, generic_pixels, join, random_pixels
from reference_exact import exact_gradient
from test_exact import BLUE, GREEN, MIXES, NAMES, pixel_of

import warpfrag as wf
from warpfrag import Fragments


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
        wanted = [*expected[:3], np.reshape(by_beta, np.shape(beta))]
        wanted += [] if opacity_sum is None else [expected.opacity_sum]
        for actual, value in zip(torch.autograd.grad(loss, inputs), wanted, strict=True):
            np.testing.assert_allclose(actual.numpy(), value, 0.0, tolerance * max(1.0, np.abs(value).max()))


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


def finite_everywhere(seed: int, pixel_count: int, dtype: str, mix: str) -> None:
    """Resolve and composite extreme pixels, and pull gradients back: no NaN, no infinity anywhere."""
    import torch

    pixels, opacity_sum, beta = extreme_pixels(seed, pixel_count)
    for given in (None, opacity_sum):
        fragments = fragments_of(pixels, dtype, kind="torch", opacity_sum=given, requires_grad=True)
        leaves = [
            fragments.rgba,
            fragments.depth,
            fragments.thickness,
            array_of(beta, dtype, "torch", requires_grad=True),
        ]
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
