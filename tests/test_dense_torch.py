"""The dense PyTorch composite of the benchmarks gives the values and gradients of the slow reference."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from pixels import Pixels, generic_pixels, random_pixels
from reference import composite, resolve
from reference_gradient import image_gradient

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def dense():
    """The benchmark's module, which is no part of the package."""
    path = Path(__file__).parents[1] / "experiments" / "bench" / "dense_torch.py"
    specification = importlib.util.spec_from_file_location("dense_torch", path)
    module = importlib.util.module_from_spec(specification)
    sys.modules["dense_torch"] = module
    specification.loader.exec_module(module)
    yield module
    del sys.modules["dense_torch"]


def reference_image(pixels: Pixels, beta: float, **options) -> np.ndarray:
    """Resolve and composite by the slow reference."""
    layers = resolve(*pixels, beta, **options)
    return composite(layers.rgba, layers.count)


@pytest.mark.parametrize("beta", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("max_layers", [1, 3, 64])
def test_values_are_those_of_the_reference(dense, beta, max_layers):
    """Every degenerate case included."""
    pixels = random_pixels(7, 150)
    image = dense.composite(
        *dense.pack(*pixels, dtype=torch.float64), torch.tensor(beta, dtype=torch.float64), max_layers
    )
    # A - A(r) is taken as it stands: behind a front part that passes 1e-6 it is good to 1e-10.
    np.testing.assert_allclose(image.numpy(), reference_image(pixels, beta, max_layers=max_layers), 0.0, 1e-10)


def test_over_is_that_of_the_reference(dense):
    """The cumulative product composites sorted fragments."""
    pixels = random_pixels(8, 100)
    image = dense.over(dense.pack(*pixels, dtype=torch.float64)[0])
    np.testing.assert_allclose(image.numpy(), reference_image(pixels, 1.0, merge="none"), 0.0, 1e-13)


@pytest.mark.parametrize("opaque", [False, True])
@pytest.mark.parametrize("beta", [0.0, 0.6, 1.0])
def test_gradients_are_those_of_the_reference(dense, beta, opaque):
    """By colour, opacity, depth, thickness and β, in general position."""
    pixels = generic_pixels(9, 12, 6, opaque=opaque)
    cotangent = np.random.default_rng(0).normal(size=(12, 4))
    expected = image_gradient(*pixels, beta, cotangent=cotangent, max_layers=3)
    inputs = [tensor.requires_grad_() for tensor in dense.pack(*pixels, dtype=torch.float64)]
    beta = torch.tensor(beta, dtype=torch.float64, requires_grad=True)
    (dense.composite(*inputs, beta, 3) * torch.as_tensor(cotangent)).sum().backward()
    for tensor, values in zip(inputs, expected[:3], strict=True):
        # Packing the reference's gradients as a colour puts them in the same places.
        rgba = np.column_stack([values] * 4) if values.ndim == 1 else values
        packed = dense.pack(rgba, *pixels[1:], dtype=torch.float64)[0].numpy()
        packed = packed[..., 0] if values.ndim == 1 else packed
        real = dense.pack(np.ones_like(rgba), *pixels[1:])[0].numpy()[..., 0] == 1.0
        np.testing.assert_allclose(tensor.grad.numpy()[real], packed[real], 1e-6, 1e-8)
    assert beta.grad.item() == pytest.approx(expected.beta.sum(), rel=1e-6)


def test_gradients_of_degenerate_pixels_are_finite_and_keep_opacity(dense):
    """The image's opacity has the gradient of over by A and none by extent, where anything is tied, thin or opaque."""
    pixels = random_pixels(10, 100, without=("many", "nearly_opaque"))
    rgba, depth, thickness = (tensor.requires_grad_() for tensor in dense.pack(*pixels, dtype=torch.float64))
    dense.composite(rgba, depth, thickness, torch.tensor(0.5, dtype=torch.float64), 3)[:, 3].sum().backward()
    (by_over,) = torch.autograd.grad(dense.over(rgba)[:, 3].sum(), rgba)
    real = rgba[..., 3] > 0.0
    np.testing.assert_allclose(rgba.grad[real].numpy(), by_over[real].numpy(), 0.0, 1e-7)
    np.testing.assert_allclose(depth.grad.numpy(), 0.0, 0.0, 1e-7)
    np.testing.assert_allclose(thickness.grad.numpy(), 0.0, 0.0, 1e-7)


@pytest.mark.slow
def test_compiled_composite_is_the_eager_one(dense):
    """`torch.compile` takes it as one graph, forward and backward."""
    inputs = [tensor.requires_grad_() for tensor in dense.pack(*generic_pixels(11, 64, 4), dtype=torch.float64)]
    beta = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    compiled = torch.compile(dense.composite, fullgraph=True)
    results = []
    for function in (dense.composite, compiled):
        image = function(*inputs, beta, 3)
        results.append([image.detach(), *torch.autograd.grad(image.square().sum(), [*inputs, beta])])
    for eager, other in zip(*results, strict=True):
        torch.testing.assert_close(eager, other, rtol=1e-9, atol=1e-10)
