"""Operators on a `wp.Tape`: values and gradients are those of torch, between kernels of the user's own."""

import numpy as np
import pytest
import torch
import warp as wp
from fragment_arrays import array_of, fragments_of
from pixels import generic_pixels, random_pixels

import warpfrag as wf
from warpfrag import Fragments

PIXELS = generic_pixels(4, 6, 6, opaque=True)
OPACITY_SUM = np.linspace(1.0, 2.0, len(PIXELS.depth)) * PIXELS.rgba[:, 3]
NAMES = ("rgba", "depth", "thickness", "opacity_sum")
SHAPE = (2, 3)


@wp.kernel
def scale(values: wp.array(dtype=wp.float64), factor: wp.array(dtype=wp.float64), scaled: wp.array(dtype=wp.float64)):
    """A user's kernel before: depth in other units."""
    item = wp.tid()
    scaled[item] = values[item] * factor[0]


@wp.kernel
def sum_of_squares(image: wp.array3d(dtype=wp.float64), loss: wp.array(dtype=wp.float64)):
    """A user's kernel after: a loss."""
    row, column, channel = wp.tid()
    wp.atomic_add(loss, 0, image[row, column, channel] * image[row, column, channel])


def on(kind: str, device: str = "cpu") -> Fragments:
    """Return the fragments in torch's or Warp's arrays, all with gradients."""
    return fragments_of(PIXELS, kind=kind, device=device, opacity_sum=OPACITY_SUM, requires_grad=True, shape=SHAPE)


def cotangent(shape: tuple[int, ...]) -> np.ndarray:
    """Draw a cotangent."""
    return np.random.default_rng(0).normal(size=shape)


def compare(fragments: Fragments, beta, expected: Fragments, expected_beta, times: float = 1.0) -> None:
    """Compare gradients on a tape with those of torch."""
    pairs = [(getattr(fragments, name), getattr(expected, name)) for name in NAMES] + [(beta, expected_beta)]
    for found, wanted in pairs:
        # The same kernels: the same bits, but for the order in which sums are taken.
        np.testing.assert_allclose(found.grad.numpy(), times * wanted.grad.cpu().numpy(), 1e-13, 1e-15)


@pytest.mark.parametrize("beta_shape", [(1,), SHAPE])
@pytest.mark.parametrize("merge", ["smooth", "order_independent"])
def test_image_and_gradients_are_those_of_torch(device, beta_shape, merge):
    """Every input; a second backward over the same tape adds the same again; `zero` starts afresh."""
    tensors, arrays = on("torch", device), on("warp", device)
    values = np.full(beta_shape, 0.3)
    beta_tensor, beta = (array_of(values, "float64", kind, device, requires_grad=True) for kind in ("torch", "warp"))
    expected = wf.composite(tensors, beta_tensor, max_layers=2, merge=merge)
    expected.backward(torch.tensor(cotangent(expected.shape), device=device))
    with wp.Tape() as tape:
        image = wf.composite(arrays, beta, max_layers=2, merge=merge)
    assert isinstance(image, wp.array)
    assert image.shape == (*SHAPE, 4)
    np.testing.assert_array_equal(image.numpy(), expected.detach().cpu().numpy())
    seed = wp.array(cotangent(image.shape), device=device)
    tape.backward(grads={image: seed})
    compare(arrays, beta, tensors, beta_tensor)
    if merge == "smooth":
        assert all(getattr(arrays, name).grad.numpy().any() for name in NAMES)
        assert beta.grad.numpy().any()
        tape.backward(grads={image: seed})
        compare(arrays, beta, tensors, beta_tensor, times=2.0)
        tape.zero()
        tape.backward(grads={image: seed})
        compare(arrays, beta, tensors, beta_tensor)


@pytest.mark.parametrize("used", [("rgba",), ("depth",), ("thickness", "opacity_sum"), NAMES])
def test_layers_and_gradients_are_those_of_torch(device, used):
    """All outputs of `resolve` or some of them."""
    tensors, arrays = on("torch", device), on("warp", device)
    beta_tensor, beta = (array_of([0.3], "float64", kind, device, requires_grad=True) for kind in ("torch", "warp"))
    expected = wf.resolve(tensors, beta_tensor, max_layers=2)
    with wp.Tape() as tape:
        layers = wf.resolve(arrays, beta, max_layers=2)
    for name in (*NAMES, "count"):
        np.testing.assert_array_equal(getattr(layers, name).numpy(), getattr(expected, name).detach().cpu().numpy())
    seeds = {name: cotangent(getattr(layers, name).shape) for name in used}
    torch.autograd.backward(
        [getattr(expected, name) for name in used], [torch.tensor(seeds[name], device=device) for name in used]
    )
    tape.backward(grads={getattr(layers, name): wp.array(seed, device=device) for name, seed in seeds.items()})
    for name in NAMES:
        wanted = getattr(tensors, name).grad.cpu().numpy()
        np.testing.assert_allclose(getattr(arrays, name).grad.numpy(), wanted, 1e-13, 1e-15)
    np.testing.assert_allclose(beta.grad.numpy(), beta_tensor.grad.cpu().numpy(), 1e-13, 1e-15)


def test_resolve_and_composite_chain_on_one_tape(device):
    """With a loss that also looks at the layers, so that gradients of two uses meet; twice is the double."""
    tensors, arrays = on("torch", device), on("warp", device)
    beta_tensor, beta = (array_of([0.3], "float64", kind, device, requires_grad=True) for kind in ("torch", "warp"))
    expected = wf.resolve(tensors, beta_tensor, max_layers=2)
    image_tensor = wf.composite(expected)
    weights, layer_weights = cotangent((*SHAPE, 4)), cotangent((*SHAPE, 2, 4))
    torch.autograd.backward(
        [image_tensor, expected.rgba], [torch.tensor(w, device=device) for w in (weights, layer_weights)]
    )
    with wp.Tape() as tape:
        layers = wf.resolve(arrays, beta, max_layers=2)
        image = wf.composite(layers)
    np.testing.assert_array_equal(image.numpy(), image_tensor.detach().cpu().numpy())
    grads = {image: wp.array(weights, device=device), layers.rgba: wp.array(layer_weights, device=device)}
    for times in (1.0, 2.0):
        tape.backward(grads=grads)
        compare(arrays, beta, tensors, beta_tensor, times)


def test_between_kernels_of_the_users_own(device):
    """Depth and thickness come out of a kernel, the image goes into another; derivatives are those of differences."""
    fragments = on("warp", device)

    def loss_at(factor: float) -> tuple[float, float]:
        unit = wp.array([factor], dtype=wp.float64, device=device, requires_grad=True)
        loss = wp.zeros(1, dtype=wp.float64, device=device, requires_grad=True)
        with wp.Tape() as tape:
            scaled = [wp.zeros_like(values, requires_grad=True) for values in (fragments.depth, fragments.thickness)]
            wp.launch(scale, fragments.count, [fragments.depth, unit, scaled[0]], device=device)
            wp.launch(scale, fragments.count, [fragments.thickness, unit, scaled[1]], device=device)
            # One factor alone would change nothing: the ratio of depth and thickness is what the image sees.
            thick = wp.zeros_like(scaled[1], requires_grad=True)
            wp.launch(scale, fragments.count, [scaled[1], unit, thick], device=device)
            image = wf.composite(Fragments(fragments.rgba, scaled[0], thick, fragments.offsets, SHAPE), 0.4)
            wp.launch(sum_of_squares, image.shape, [image, loss], device=device)
        tape.backward(loss=loss)
        return loss.numpy()[0], unit.grad.numpy()[0]

    _, gradient = loss_at(1.0)
    difference = (loss_at(1.0 + 1e-6)[0] - loss_at(1.0 - 1e-6)[0]) / 2e-6
    # 1e-16 / 1e-6 of rounding.
    assert abs(difference) > 1e-3
    assert gradient == pytest.approx(difference, rel=1e-6)


def test_only_wanted_gradients_are_computed():
    """Arrays without `requires_grad` get none; if none has it nothing is recorded."""
    plain = fragments_of(PIXELS, kind="warp", shape=SHAPE)
    with wp.Tape() as tape:
        image = wf.composite(plain)
    assert not image.requires_grad
    assert len(tape.launches) == 0
    depth = wp.array(PIXELS.depth, requires_grad=True)
    with wp.Tape() as tape:
        image = wf.composite(Fragments(plain.rgba, depth, plain.thickness, plain.offsets, SHAPE))
    tape.backward(grads={image: wp.ones_like(image)})
    assert np.abs(depth.grad.numpy()).max() > 0.0
    assert plain.rgba.grad is None
    tensors = on("torch")
    (wanted,) = torch.autograd.grad(
        wf.composite(Fragments(*[getattr(tensors, n) for n in NAMES[:3]], tensors.offsets, SHAPE)).sum(), tensors.depth
    )
    np.testing.assert_allclose(depth.grad.numpy(), wanted.numpy(), 1e-13)


def test_no_tape_is_no_record():
    """Outside of a tape arrays with gradients are values; a tape that is paused or over is none."""
    arrays = on("warp")
    before = arrays.depth.grad.numpy().copy()
    with wp.Tape() as tape:
        pass
    image = wf.composite(arrays, 0.3)
    assert len(tape.launches) == 0
    np.testing.assert_array_equal(arrays.depth.grad.numpy(), before)
    np.testing.assert_array_equal(image.numpy(), wf.composite(arrays.numpy(), 0.3))


def test_strided_arrays_on_a_tape():
    """Gradients arrive in every other element of an array's base, and nowhere else."""
    base = wp.array(np.repeat(PIXELS.depth, 2), requires_grad=True)
    plain = fragments_of(PIXELS, kind="warp", shape=SHAPE)
    with wp.Tape() as tape:
        image = wf.composite(Fragments(plain.rgba, base[::2], plain.thickness, plain.offsets, SHAPE))
    tape.backward(grads={image: wp.ones_like(image)})
    depth = wp.array(PIXELS.depth, requires_grad=True)
    with wp.Tape() as tape:
        image = wf.composite(Fragments(plain.rgba, depth, plain.thickness, plain.offsets, SHAPE))
    tape.backward(grads={image: wp.ones_like(image)})
    np.testing.assert_array_equal(base.grad.numpy()[::2], depth.grad.numpy())
    assert not base.grad.numpy()[1::2].any()


@pytest.mark.parametrize("shape", [(0, 4), (2, 3)])
def test_nothing_on_a_tape(shape):
    """Images without pixels, or pixels without fragments."""
    count = int(np.prod(shape))
    empty = [wp.zeros(s, dtype=wp.float64, requires_grad=True) for s in ((0, 4), (0,), (0,))]
    offsets = wp.zeros(count + 1, dtype=wp.int32)
    beta = wp.array([0.5], dtype=wp.float64, requires_grad=True)
    with wp.Tape() as tape:
        layers = wf.resolve(Fragments(*empty, offsets, shape), beta)
        image = wf.composite(layers)
        fused = wf.composite(Fragments(*empty, offsets, shape), beta)
    assert image.shape == fused.shape == (*shape, 4)
    tape.backward(grads={image: wp.ones_like(image), fused: wp.ones_like(fused)})
    assert beta.grad.numpy().tolist() == [0.0]


def test_float32_on_a_tape_is_that_of_torch():
    """Degenerate pixels too."""
    pixels = random_pixels(5, 60)
    tensors, arrays = (fragments_of(pixels, "float32", kind=kind, requires_grad=True) for kind in ("torch", "warp"))
    image = wf.composite(tensors, 0.25)
    weights = cotangent(tuple(image.shape)).astype(np.float32)
    image.backward(torch.tensor(weights))
    with wp.Tape() as tape:
        image = wf.composite(arrays, 0.25)
    tape.backward(grads={image: wp.array(weights)})
    for name in NAMES[:3]:
        np.testing.assert_array_equal(getattr(arrays, name).grad.numpy(), getattr(tensors, name).grad.numpy())
