"""Gradients of resolving and of compositing fragments: those of the slow reference, which takes complex steps."""

import numpy as np
import pytest
import reference_gradient
from fragment_arrays import by_fragment, fragments_of, has_opaque, ties, torch_gradients, transmittance
from pixels import GRID, KINDS, Pixels, generic_pixels, join, random_pixels

import warpfrag as wf
from warpfrag import Layers

MERGES = ("none", "smooth", "order_independent")
MIXES = ("opacity", "average", "optical_depth")
NAMES = ("rgba", "depth", "thickness", "beta", "opacity_sum")
BETAS = (0.0, 0.3, 1.0)


def image_of(**options):
    """Return the function that composites fragments at once."""
    return lambda fragments, beta: [wf.composite(fragments, beta, **options)]


def layers_of(**options):
    """Return the function that resolves fragments, to its four differentiable outputs."""

    def function(fragments, beta):
        layers = wf.resolve(fragments, beta, **options)
        return [layers.rgba, layers.depth, layers.thickness, layers.opacity_sum]

    return function


def layer_cotangents(pixel_count: int, max_layers: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Draw cotangents for all outputs of `resolve`."""
    rng = np.random.default_rng(seed)
    return tuple(rng.normal(size=shape) for shape in ((pixel_count, max_layers, 4), *[(pixel_count, max_layers)] * 3))


def image_cotangent(pixel_count: int) -> np.ndarray:
    """Draw a cotangent for an image."""
    return np.random.default_rng(1).normal(size=(pixel_count, 4))


def compare(pixels, beta, tolerance, device, *, dtype="float64", opacity_sum=None, keep=None, max_layers=3, **options):
    """Compare the gradients of layers and of the fused image in every input with those of the reference.

    Args:
        pixels: what to differentiate at.
        beta: one value per pixel.
        tolerance: relative to gradients above 1, absolute below.
        device: where.
        dtype: precision of the operator; the reference has float64.
        opacity_sum: None for that of fresh fragments.
        keep: pixels to look at; None is all.
        max_layers: see `resolve`.
        options: of `resolve`.
    """
    options["max_layers"] = max_layers
    count = len(pixels.offsets) - 1
    keep = np.ones(count, bool) if keep is None else keep
    cotangents = layer_cotangents(count, max_layers)
    given = (*pixels, beta, opacity_sum)
    layered = reference_gradient.resolve_gradient(*given, cotangents=cotangents, **options)
    fused = reference_gradient.image_gradient(*given, cotangent=image_cotangent(count), **options)
    where = {"opacity_sum": opacity_sum, "dtype": dtype, "device": device}
    for expected, function, cotangent in (
        (layered, layers_of(**options), cotangents),
        (fused, image_of(**options), [image_cotangent(count)]),
    ):
        found = torch_gradients(function, pixels, beta, cotangent, **where)
        for name, actual, wanted in zip(NAMES, found, expected, strict=False):
            kept = keep if name == "beta" else by_fragment(keep, pixels)
            np.testing.assert_allclose(actual[kept], wanted[kept], tolerance, tolerance, err_msg=name)


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize("max_layers", [1, 4])
def test_gradients_in_general_position(device, merge, mix, max_layers):
    """Colour, opacity, depth, thickness, beta and opacity sum, for layers and image."""
    pixels = generic_pixels(20 + max_layers, 60)
    opacity_sum = np.random.default_rng(0).uniform(1.0, 2.0, len(pixels.depth)) * pixels.rgba[:, 3]
    # Thin parts divide by lengths of 1/64 and amplify rounding as much, a few times in a row.
    compare(
        pixels,
        np.resize(BETAS, 60),
        1e-9,
        device,
        opacity_sum=opacity_sum,
        max_layers=max_layers,
        merge=merge,
        mix=mix,
    )


@pytest.mark.parametrize("mix", MIXES)
def test_gradients_of_faint_slabs(device, mix):
    """Opacities of 0.001 to 0.024, where series replace quotients, or just do not yet."""
    pixels = generic_pixels(25, 60)
    pixels = pixels._replace(rgba=pixels.rgba / 40.0)
    compare(pixels, np.resize(BETAS, 60), 1e-10, device, mix=mix)


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("merge", ["smooth", "order_independent"])
def test_gradients_of_opaque_slabs(device, merge, mix):
    """A third of the opacities is exactly 1: nothing is divided by what passes them."""
    pixels = generic_pixels(30, 60, opaque=True)
    # Without a floor (1 - A)^r has no derivative at A = 1: by beta at 0 it is a matter of limits.
    beta = np.resize((0.1, 0.3, 1.0) if mix == "optical_depth" else BETAS, 60)
    compare(pixels, beta, 1e-9, device, merge=merge, mix=mix)


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("merge", MERGES)
def test_gradients_of_degenerate_pixels(device, merge, mix):
    """A = 0, with and without emission, A = 1, A = 1 - 1e-7, t = 0, nested, far apart, none at all."""
    pixels = random_pixels(40, 150, 5, without=("many",))
    beta = np.resize(BETAS, 150)
    # Where boundaries coincide there are two derivatives: the test after the next.
    keep = ~ties(pixels)
    if mix == "optical_depth":
        keep &= ~(has_opaque(pixels) & (beta == 0.0))
        # The reference knows a transmittance to 1e-16 alone.
        keep &= transmittance(pixels) > 1e-8
    assert keep.sum() > 50
    # Next to dense slabs derivatives are up to 13.8e6 and cancel in part.
    compare(pixels, beta, 1e-7, device, keep=keep, merge=merge, mix=mix)


@pytest.mark.parametrize("merge", ["none", "smooth"])
def test_gradients_in_single_precision(device, merge):
    """To rounding: depths of about 4 know a thin part of 1/64 to 2e-5."""
    pixels = generic_pixels(50, 60, margin=64 * GRID)
    beta = np.resize((0.0, 0.25, 1.0), 60)
    compare(pixels, beta, 2e-3, device, dtype="float32", merge=merge)


def tied_pairs(kind: str, opacities: list[tuple[float, float]]) -> Pixels:
    """Return pixels of two slabs that share a boundary, or two."""
    front, back = {
        "touching": ((1.0, 2.0), (2.0, 3.5)),
        "equal_depths": ((1.0, 1.5), (3.0, 3.0)),
        "equal_fronts": ((1.0, 1.0), (2.0, 3.0)),
        "identical": ((1.0, 1.0), (2.0, 2.0)),
    }[kind]
    colors = np.array([[0.6, 0.1, 0.0], [0.0, 0.3, 0.5]])
    pairs = np.array(opacities)[:, :, None]
    return join([(np.hstack([colors * pair, pair]), np.array(back), np.subtract(back, front)) for pair in pairs])


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("kind", ["touching", "equal_depths", "equal_fronts", "identical"])
def test_gradient_at_a_tie_is_that_of_one_side(device, kind, mix):
    """Of two slabs that share a boundary, moving it this or that way has either derivative; ours lies between."""
    opacities = [(0.5, 0.7), (0.0, 0.5), (1e-7, 0.9)]
    # A wall (1 - A)^r jumps where it begins: under optical depth there are no limits.
    opacities += [] if mix == "optical_depth" else [(1.0, 0.7), (0.5, 1.0), (1.0, 1.0)]
    pixels = tied_pairs(kind, opacities)
    cotangent = np.tile([[0.7, -1.0, 0.4, 0.0]], (len(opacities), 1))
    for beta in BETAS:
        here = torch_gradients(image_of(mix=mix), pixels, beta, [cotangent], device=device)
        sides = []
        # By hairs of all boundaries, that leave no two of them equal.
        for hairs in ((1, 2, 3, 4), (4, 3, 2, 1), (1, 4, 2, 3), (3, 2, 4, 1), (1, 2, 4, 3), (2, 1, 3, 4)):
            back, front = np.resize(1e-9 * np.array(hairs), (len(opacities), 2, 2)).transpose(1, 0, 2).reshape(2, -1)
            moved = pixels._replace(depth=pixels.depth + back, thickness=pixels.thickness + back - front)
            sides.append(reference_gradient.image_gradient(*moved, beta, cotangent=cotangent, mix=mix))
        for name, actual, *limits in zip(NAMES, here, *sides, strict=False):
            # A hair times second derivatives, of up to 1e3.
            assert (actual > np.min(limits, axis=0) - 1e-5).all(), (name, beta)
            assert (actual < np.max(limits, axis=0) + 1e-5).all(), (name, beta)


@pytest.mark.parametrize("kind", ["touching", "equal_depths", "equal_fronts", "identical"])
def test_wall_at_a_tie_has_bounded_gradients(device, kind):
    """Under optical depth an opaque slab is opaque from its front on: its extent as such has no derivative.

    Derivatives are then those of the other slab's parts, of the order of opacity over thickness, 1.
    """
    pixels = tied_pairs(kind, [(1.0, 0.7), (0.5, 1.0), (1.0, 1.0)])
    cotangent = np.tile([[0.7, -1.0, 0.4, 0.3]], (3, 1))
    for beta in BETAS:
        for values in torch_gradients(image_of(mix="optical_depth"), pixels, beta, [cotangent], device=device):
            assert np.abs(values).max() < 10.0


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("beta", BETAS)
def test_opacity_has_the_gradient_of_over_everywhere(device, beta, mix):
    """In opaque, transparent, thin or tied pixels: dA/dA_i is what the others let pass, and all else has no effect."""
    pixels = random_pixels(60, 100)
    cotangent = np.tile([0.0, 0.0, 0.0, 1.0], (100, 1))
    for merge in ("smooth", "order_independent"):
        by_rgba, *others = torch_gradients(image_of(merge=merge, mix=mix), pixels, beta, [cotangent], device=device)
        passed = 1.0 - pixels.rgba[:, 3]
        for begin, end in zip(pixels.offsets, pixels.offsets[1:], strict=False):
            expected = [np.prod(np.delete(passed[begin:end], fragment)) for fragment in range(end - begin)]
            np.testing.assert_allclose(by_rgba[begin:end, 3], expected, 0.0, 1e-14)
        for values in (by_rgba[:, :3], *others):
            np.testing.assert_array_equal(values, 0.0)


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("opacity", [0.5, 0.999, 1.0])
def test_hundreds_of_dense_slabs_have_gradients(device, opacity, mix):
    """What passes them underflows in single precision, and opacity sums would overflow: derivatives still agree."""
    rng = np.random.default_rng(1)
    rgba = np.column_stack([rng.uniform(0.0, opacity, (200, 3)), np.full(200, opacity)]).astype(np.float32)
    depth = np.sort(rng.choice(np.arange(4096, 8192), 200, replace=False)) / 4096.0
    pixel = Pixels(rgba.astype(np.float64), depth, np.full(200, 2048.5 / 4096.0), np.array([0, 200]))
    for merge, beta in (("smooth", 0.5), ("smooth", 0.0), ("order_independent", 0.5)):
        single, double = (
            torch_gradients(
                image_of(merge=merge, mix=mix), pixel, beta, [image_cotangent(1)], dtype=dtype, device=device
            )
            for dtype in ("float32", "float64")
        )
        for name, actual, wanted in zip(NAMES, single, double, strict=False):
            # Cuts are known to 1e-7 of lengths of 1e-3, and 200 of them follow upon one another.
            np.testing.assert_allclose(actual, wanted, 0.02, 0.02 * np.abs(wanted).max() + 1e-6, err_msg=name)


@pytest.mark.parametrize("mix", MIXES)
def test_opacities_that_underflow_have_gradients(device, mix):
    """A sigmoid of -90 is 8e-40: emission with that opacity is emission, and its colour's gradient that of A = 0."""
    none = np.array([[0.1, 0.2, 0.3, 0.0], [0.3, 0.2, 0.1, 0.0], [0.1, 0.1, 0.2, 0.4]])
    least = none + np.array([[0.0, 0.0, 0.0, 8e-40], [0.0, 0.0, 0.0, 1e-44], [0.0] * 4])
    for merge in ("smooth", "order_independent"):
        found = [
            torch_gradients(
                image_of(merge=merge, mix=mix),
                Pixels(rgba, np.array([1.0, 1.5, 1.75]), np.ones(3), np.array([0, 3])),
                0.25,
                [image_cotangent(1)],
                dtype="float32",
                device=device,
            )
            for rgba in (none, least)
        ]
        for name, actual, wanted in zip(NAMES, *found, strict=False):
            np.testing.assert_allclose(actual, wanted, 1e-6, 1e-6, err_msg=name)


def test_slab_too_thin_to_divide(device):
    """A thickness of 1e-40 at depth 0 has no reciprocal in single precision: it counts as none."""
    rgba = np.array([[0.1, 0.2, 0.3, 0.5], [0.3, 0.2, 0.1, 0.5]])
    thin = Pixels(rgba, np.zeros(2), np.array([2e-40, 1e-40]), np.array([0, 2]))
    surfaces = thin._replace(thickness=np.zeros(2))
    for pixel in (thin, surfaces):
        image = wf.composite(fragments_of(pixel, "float32", kind="warp", device=device), 0.5).numpy()[0, 0]
        np.testing.assert_allclose(image, rgba[0] + 0.5 * rgba[1], 1e-6)
    found = [
        torch_gradients(image_of(), pixel, 0.5, [image_cotangent(1)], dtype="float32", device=device)
        for pixel in (thin, surfaces)
    ]
    for actual, wanted in zip(*found, strict=True):
        np.testing.assert_array_equal(actual, wanted)


# Layers to image.


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_gradients_of_composited_layers(device, dtype):
    """By the product rule written out, opaque layers and unused room included."""
    import torch

    rng = np.random.default_rng(3)
    rgba, count = rng.uniform(0.0, 1.0, (20, 5, 4)), rng.integers(0, 6, 20).astype(np.int32)
    rgba[rng.random((20, 5)) < 0.3, 3] = 1.0
    rgba[rng.random((20, 5)) < 0.1, 3] = 0.0
    cotangent = rng.normal(size=(20, 4))
    rgba_tensor = torch.tensor(rgba, dtype=getattr(torch, dtype), device=device, requires_grad=True)
    other = torch.zeros_like(rgba_tensor[..., 0])
    image = wf.composite(Layers(rgba_tensor, other, other, other, torch.tensor(count, device=device)))
    image.backward(torch.tensor(cotangent).to(image))
    expected = np.zeros_like(rgba)
    for pixel in range(20):
        layers = rgba[pixel, : count[pixel]]
        for i in range(count[pixel]):
            before = np.prod(1.0 - layers[:i, 3])
            passed = [np.prod(1.0 - layers[i + 1 : j, 3]) for j in range(i + 1, count[pixel])]
            behind = sum((p * layer[:3] for p, layer in zip(passed, layers[i + 1 :], strict=True)), np.zeros(3))
            expected[pixel, i, :3] = before * cotangent[pixel, :3]
            expected[pixel, i, 3] = before * (
                np.prod(1.0 - layers[i + 1 :, 3]) * cotangent[pixel, 3] - behind @ cotangent[pixel, :3]
            )
    tolerance = 1e-13 if dtype == "float64" else 1e-5
    np.testing.assert_allclose(rgba_tensor.grad.cpu().numpy(), expected, 0.0, tolerance)


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("merge", MERGES)
def test_fused_gradients_are_the_layered_ones(device, merge, mix):
    """`composite(fragments)` and `composite(resolve(fragments))` in float64, degenerate pixels and many fragments."""
    pixels = random_pixels(70, 150)
    beta = np.resize(BETAS, 150)
    opacity_sum = np.random.default_rng(0).uniform(1.0, 3.0, len(pixels.depth)) * pixels.rgba[:, 3]
    options = {"max_layers": 3, "merge": merge, "mix": mix}
    cotangent = [image_cotangent(150)]
    fused, layered = (
        torch_gradients(function, pixels, beta, cotangent, opacity_sum=opacity_sum, device=device)
        for function in (image_of(**options), lambda f, b: [wf.composite(wf.resolve(f, b, **options))])
    )
    for name, one, other in zip(NAMES, fused, layered, strict=True):
        # Layers round their transmittance to 1e-16, times derivatives of 1e7 behind dense fronts.
        np.testing.assert_allclose(one, other, 1e-7, 1e-7, err_msg=name)


def test_kinds_of_pixels_are_all_differentiated():
    """The degenerate test above leaves no kind out but those with ties."""
    pixels = random_pixels(40, 150, 5, without=("many",))
    opacity = pixels.rgba[by_fragment(~ties(pixels), pixels), 3]
    assert {0.0, 1.0, float(np.float32(1.0 - 1e-7)), float(np.float32(1e-7))} <= set(opacity)
    assert (pixels.thickness[by_fragment(~ties(pixels), pixels)] == 0.0).any()
    assert len(KINDS) == 15
