"""Operators under torch: gradcheck, torch.compile, opcheck, no_grad, second derivatives, what is computed and kept."""

import subprocess
import sys
import textwrap
from importlib import import_module

import numpy as np
import pytest
import torch
import warp as wp
from fragment_arrays import array_of, fragments_of
from pixels import generic_pixels, random_pixels

import warpfrag as wf
from warpfrag import Fragments
from warpfrag.resolve.walk import walk_backward

PIXELS = generic_pixels(4, 6, 6, opaque=True)
OPACITY_SUM = np.linspace(1.0, 2.0, len(PIXELS.depth)) * PIXELS.rgba[:, 3]


def leaves(device: str = "cpu", dtype: str = "float64", pixels=PIXELS, opacity_sum=OPACITY_SUM) -> Fragments:
    """Return fragments, all of whose floating-point arrays require a gradient."""
    return fragments_of(
        pixels, dtype, kind="torch", device=device, opacity_sum=opacity_sum, requires_grad=True, shape=(2, 3)
    )


def floats(fragments: Fragments) -> list[torch.Tensor]:
    """Return the arrays that have a gradient."""
    return [fragments.rgba, fragments.depth, fragments.thickness, fragments.opacity_sum]


def rebuild(fragments: Fragments, arrays: list[torch.Tensor]) -> Fragments:
    """Return the fragments with other floating-point arrays."""
    return Fragments(*arrays[:3], fragments.offsets, fragments.shape, opacity_sum=arrays[3])


def outputs(layers: wf.Layers) -> list[torch.Tensor]:
    """Return the differentiable outputs of `resolve`."""
    return [layers.rgba, layers.depth, layers.thickness, layers.opacity_sum]


@pytest.mark.parametrize("merge", ["smooth", "order_independent"])
@pytest.mark.parametrize("beta_shape", [(), (1,), (2, 3)])
def test_gradcheck(device, merge, beta_shape):
    """All inputs and all outputs by differences in float64, opaque fragments and one layer for all included."""
    # Opacities must stay below 1 when they are stepped up.
    pixels = generic_pixels(0, 6, 5)
    opacity_sum = np.linspace(1.0, 2.0, len(pixels.depth)) * pixels.rgba[:, 3]
    fragments = leaves(device, pixels=pixels, opacity_sum=opacity_sum)
    beta = torch.full(beta_shape, 0.4, dtype=torch.float64, device=device, requires_grad=True)

    def layers(beta, *arrays):
        return outputs(wf.resolve(rebuild(fragments, arrays), beta, max_layers=2, merge=merge))

    def image(beta, *arrays):
        return wf.composite(rebuild(fragments, arrays), beta, max_layers=2, merge=merge)

    def layered(rgba):
        return wf.composite(
            wf.Layers(rgba, *[wf.resolve(fragments, max_layers=2).numpy().torch(device).depth] * 3, count)
        )

    count = wf.resolve(fragments, max_layers=2).count
    for function in (layers, image):
        assert torch.autograd.gradcheck(function, (beta, *floats(fragments)), fast_mode=function is layers)
    rgba = wf.resolve(fragments, max_layers=2).rgba.detach().requires_grad_()
    assert torch.autograd.gradcheck(layered, (rgba,))


def test_a_number_for_beta_needs_no_gradient(device):
    """And the other gradients are those with beta as a tensor."""
    fragments = leaves(device)
    expected = torch.autograd.grad(
        wf.composite(fragments, torch.tensor(0.3, dtype=torch.float64, device=device)).sum(), floats(fragments)
    )
    found = torch.autograd.grad(wf.composite(fragments, 0.3).sum(), floats(fragments))
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


def test_gradient_of_one_beta_is_the_sum_of_those_of_pixels(device):
    """In the shape that beta came in."""
    fragments = leaves(device)
    by_pixel = torch.full((2, 3), 0.3, dtype=torch.float64, device=device, requires_grad=True)
    wf.composite(fragments, by_pixel)[..., 0].sum().backward()
    for shape in ((), (1,)):
        beta = torch.full(shape, 0.3, dtype=torch.float64, device=device, requires_grad=True)
        wf.composite(fragments, beta)[..., 0].sum().backward()
        assert beta.grad.shape == shape
        torch.testing.assert_close(beta.grad.sum(), by_pixel.grad.sum(), rtol=1e-13, atol=0.0)


@pytest.mark.parametrize("used", ["rgba", "depth", "thickness", "opacity_sum"])
def test_outputs_that_are_not_used_count_as_zero(device, used):
    """A loss on one output of `resolve` has the gradient of that output with zero cotangents for the others."""
    fragments = leaves(device)
    layers = wf.resolve(fragments, 0.5, max_layers=3)
    found = torch.autograd.grad(getattr(layers, used).square().sum(), floats(fragments))
    layers = wf.resolve(fragments, 0.5, max_layers=3)
    total = sum(values.square().sum() * (values is getattr(layers, used)) for values in outputs(layers))
    for one, other in zip(found, torch.autograd.grad(total, floats(fragments)), strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0)
    assert any(gradient.abs().max() > 0.0 for gradient in found)


def test_no_output_used_is_no_gradient(device):
    """A count has none, and no kernel runs for it."""
    layers = wf.resolve(leaves(device))
    assert not layers.count.requires_grad
    assert layers.count.dtype == torch.int32
    assert all(values.requires_grad for values in outputs(layers))


@pytest.mark.parametrize("wanted", [(0,), (1,), (2,), (3,), (4,), (1, 4)])
@pytest.mark.parametrize("function", [wf.resolve, wf.composite])
@pytest.mark.parametrize("merge", ["smooth", "none"])
def test_only_wanted_gradients_are_computed(monkeypatch, wanted, function, merge):
    """Inputs that require no gradient get none, and the adjoint is told so."""
    asked = []

    def spy(kernel, inputs, options, grad_out, targets):
        asked.append({name for name, target in vars(targets).items() if target is not None})
        return walk_backward(kernel, inputs, options, grad_out, targets)

    for module in ("warpfrag.resolve.resolve", "warpfrag.composite"):
        monkeypatch.setattr(import_module(module), "walk_backward", spy)
    fragments = leaves()
    beta = torch.full((2, 3), 0.3, dtype=torch.float64)
    tensors = [fragments.rgba, fragments.depth, fragments.thickness, beta, fragments.opacity_sum]
    result = function(rebuild(fragments, [t.detach() for t in floats(fragments)]), beta, merge=merge)
    assert not (result if function is wf.composite else result.rgba).requires_grad
    expected_inputs = [t.detach().clone().requires_grad_() for t in tensors]
    inputs = [t.detach().clone().requires_grad_(index in wanted) for index, t in enumerate(tensors)]
    found = []
    for given in (expected_inputs, inputs):
        result = function(rebuild(fragments, [*given[:3], given[4]]), given[3], merge=merge)
        (result if function is wf.composite else result.rgba).square().sum().backward()
        found.append([t.grad for t in given])
    names = ("rgba", "depth", "thickness", "beta", "opacity_sum")
    assert asked[-1] == {names[index] for index in wanted}
    for index, (everything, some) in enumerate(zip(*found, strict=True)):
        if index in wanted:
            assert torch.equal(everything, some)
        else:
            assert some is None


def test_no_grad_and_inference_mode(device):
    """Nothing is recorded; values are the same."""
    fragments = leaves(device)
    expected = wf.composite(fragments)
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            image = wf.composite(fragments)
            layers = wf.resolve(fragments)
        assert not image.requires_grad
        assert not layers.rgba.requires_grad
        assert torch.equal(image, expected)


def test_gradients_accumulate(device):
    """A graph that is kept and run twice gives the double, and leaves no trace in between."""
    fragments = leaves(device)
    layers = wf.resolve(fragments, 0.5, max_layers=2)
    loss = wf.composite(layers).square().sum() + layers.depth.sum()
    loss.backward(retain_graph=True)
    once = [t.grad.clone() for t in floats(fragments)]
    loss.backward()
    for t, first in zip(floats(fragments), once, strict=True):
        assert torch.equal(t.grad, 2.0 * first)


def test_inputs_of_any_layout(device):
    """Transposed, strided, expanded inputs and cotangents: values and gradients are those of contiguous ones."""
    fragments = leaves(device)
    weights = torch.rand((4, 3, 2), dtype=torch.float64, device=device).permute(2, 1, 0)
    expected = torch.autograd.grad((wf.composite(fragments, 0.3) * weights).sum(), floats(fragments))
    bases = [
        t.detach().T.contiguous().requires_grad_() if t.ndim == 2 else t.detach().repeat_interleave(2).requires_grad_()
        for t in floats(fragments)
    ]
    views = [t.T if t.ndim == 2 else t[::2] for t in bases]
    assert not any(view.is_contiguous() for view in views)
    found = torch.autograd.grad((wf.composite(rebuild(fragments, views), 0.3) * weights).sum(), views)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)
    beta = torch.tensor(0.3, dtype=torch.float64, device=device, requires_grad=True)
    wf.composite(fragments, beta.expand(2, 3)).sum().backward()
    by_number = torch.tensor(0.3, dtype=torch.float64, device=device, requires_grad=True)
    wf.composite(fragments, by_number).sum().backward()
    torch.testing.assert_close(beta.grad, by_number.grad, rtol=1e-13, atol=0.0)


@pytest.mark.parametrize("shape", [(0, 4), (3, 0), (2, 3)])
def test_gradients_of_nothing(device, shape):
    """No pixels, or no fragments in them: gradients are empty, that of beta is zero."""
    empty = [torch.zeros(s, dtype=torch.float64, device=device, requires_grad=True) for s in ((0, 4), (0,), (0,), (0,))]
    offsets = torch.zeros(int(np.prod(shape)) + 1, dtype=torch.int32, device=device)
    for beta_shape in ((), shape):
        beta = torch.full(beta_shape, 0.5, dtype=torch.float64, device=device, requires_grad=True)
        fragments = Fragments(*empty[:3], offsets, shape, opacity_sum=empty[3])
        layers = wf.resolve(fragments, beta)
        for result in (wf.composite(fragments, beta), layers.depth, wf.composite(layers)):
            gradients = torch.autograd.grad(result.sum(), [*empty, beta], retain_graph=True)
            assert [g.shape for g in gradients] == [*[t.shape for t in empty], beta.shape]
            assert not any(g.any() for g in gradients)


def test_second_derivatives_are_refused(device):
    """By name and at the second backward only: `create_graph` by itself does no harm."""
    fragments = leaves(device)
    for name, function in (("composite", wf.composite), ("resolve", lambda f: wf.resolve(f).rgba)):
        (gradient,) = torch.autograd.grad(function(fragments).square().sum(), fragments.depth, create_graph=True)
        assert gradient.abs().max() > 0.0
        with pytest.raises(NotImplementedError, match=f"warpfrag.{name}: second derivatives .* are not supported"):
            gradient.sum().backward()
    layers = wf.resolve(fragments)
    rgba = layers.rgba.detach().requires_grad_()
    image = wf.composite(wf.Layers(rgba, layers.depth, layers.thickness, layers.opacity_sum, layers.count))
    (gradient,) = torch.autograd.grad(image.square().sum(), rgba, create_graph=True)
    with pytest.raises(NotImplementedError, match=r"warpfrag.composite_layers: second derivatives"):
        gradient.sum().backward()


def test_errors_of_values_pass_through_torch(device):
    """As the same ValueError that NumPy arrays get."""
    fragments = leaves(device)
    wrong = fragments.thickness.detach().clone()
    wrong[3] = -1.0
    with pytest.raises(ValueError, match=r"got .*thickness -1.0.* in fragment 3"):
        wf.composite(rebuild(fragments, [fragments.rgba, fragments.depth, wrong, fragments.opacity_sum]))
    with pytest.raises(TypeError, match="beta: got a numpy array, expected a torch array like the fragments"):
        wf.composite(fragments, np.array(0.5))
    with pytest.raises(TypeError, match="beta: got dtype float32, expected float64"):
        wf.composite(fragments, torch.tensor(0.5, device=device))


def test_memory_is_shared_with_warp(device):
    """Tensors are not copied on their way in, and inputs are not written to."""
    fragments = leaves(device)
    before = [t.detach().clone() for t in floats(fragments)]
    wf.composite(fragments).sum().backward()
    for t, values in zip(floats(fragments), before, strict=True):
        assert torch.equal(t.detach(), values)
    assert wp.from_torch(fragments.depth.detach()).ptr == fragments.depth.data_ptr()


# torch.compile.


def test_operators_obey_the_rules_of_torch():
    """Schema, fake tensors, autograd registration, and dynamic shapes under AOT dispatch."""
    fragments = leaves()
    beta = torch.full((6,), 0.5, dtype=torch.float64, requires_grad=True)
    wf.composite(fragments)
    arguments = (*floats(fragments)[:3], fragments.offsets, fragments.opacity_sum, beta, 2, "smooth", "opacity")
    torch.library.opcheck(torch.ops.warpfrag.composite.default, arguments)
    torch.library.opcheck(torch.ops.warpfrag.resolve.default, arguments)
    layers = wf.resolve(fragments)
    rgba = layers.rgba.detach().reshape(6, 8, 4).requires_grad_()
    torch.library.opcheck(torch.ops.warpfrag.composite_layers.default, (rgba, layers.count.reshape(6)))


@pytest.mark.parametrize("backend", ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_compiled_functions_are_the_eager_ones(backend):
    """One graph without breaks, forward and backward, also when the number of fragments changes."""

    def fused(rgba, depth, thickness, offsets, beta):
        fragments = Fragments(rgba * 1.0, depth, thickness, offsets, (2, 3))
        return wf.composite(fragments, beta.sigmoid(), max_layers=2).square().sum()

    def layered(rgba, depth, thickness, offsets, beta):
        layers = wf.resolve(Fragments(rgba * 1.0, depth, thickness, offsets, (2, 3)), beta.sigmoid(), max_layers=2)
        return wf.composite(layers).square().sum() + layers.depth.sum()

    for function in (fused, layered):
        compiled = torch.compile(function, fullgraph=True, backend=backend)
        for seed in (1, 2, 3):
            fragments = leaves(pixels=generic_pixels(seed, 6, 4), opacity_sum=None)
            beta = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
            inputs = [*floats(fragments)[:3], beta]
            results = []
            for variant in (function, compiled):
                value = variant(*inputs[:3], fragments.offsets, beta)
                results.append([value, *torch.autograd.grad(value, inputs)])
            for one, other in zip(*results, strict=True):
                torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_first_call_of_all_is_compiled():
    """A process that has not used an operator before may do so inside of `torch.compile(fullgraph=True)`."""
    program = """
        import torch
        import warpfrag as wf

        def loss(rgba, depth, thickness, offsets, beta):
            fragments = wf.Fragments(rgba, depth, thickness, offsets, (1, 2))
            image = wf.composite(fragments, beta, merge="none")
            return image.sum() + wf.resolve(fragments, beta, merge="none").depth.sum()

        rgba = torch.full((3, 4), 0.5, dtype=torch.float64, requires_grad=True)
        depth = torch.tensor([1.0, 1.5, 2.0], dtype=torch.float64, requires_grad=True)
        thickness = torch.ones(3, dtype=torch.float64)
        beta = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
        arguments = (rgba, depth, thickness, torch.tensor([0, 2, 3]), beta)
        compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(*arguments)
        eager = loss(*arguments)
        assert torch.equal(compiled, eager), (compiled, eager)
        for one, other in zip(torch.autograd.grad(compiled, [rgba, depth]), torch.autograd.grad(eager, [rgba, depth])):
            assert torch.equal(one, other), (one, other)
        print("same")
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=False)
    assert done.stdout.endswith("same\n"), done.stderr


def test_float32_stays_float32(device):
    """Gradients too; and Python numbers for beta are no doubles."""
    pixels = random_pixels(3, 30)
    fragments = fragments_of(pixels, "float32", kind="torch", device=device, requires_grad=True)
    beta = array_of(0.5, "float32", "torch", device, requires_grad=True)
    for value in (beta, 0.5, np.float64(0.5)):
        image = wf.composite(fragments, value)
        assert image.dtype == torch.float32
        (gradient,) = torch.autograd.grad(image.sum(), fragments.rgba)
        assert gradient.dtype == torch.float32


# torch.func.


def test_transforms_are_those_of_autograd():
    """`grad`, `jacrev` and `vmap` agree with backward and with a loop."""
    fragments = leaves()
    rgba = fragments.rgba.detach()

    def image(rgba):
        return wf.composite(rebuild(fragments, [rgba, *(t.detach() for t in floats(fragments)[1:])]), 0.4)

    expected = torch.autograd.functional.jacobian(image, rgba)
    torch.testing.assert_close(torch.func.jacrev(image)(rgba), expected, rtol=0.0, atol=0.0)
    total = torch.func.grad(lambda rgba: image(rgba).sum())(rgba)
    torch.testing.assert_close(total, expected.sum((0, 1, 2)), rtol=1e-13, atol=1e-13)
    batch = torch.stack([rgba, 0.5 * rgba])
    torch.testing.assert_close(torch.func.vmap(image)(batch), torch.stack([image(one) for one in batch]))


def test_transforms_of_several_outputs():
    """Layers have outputs of several types; a count has no gradient."""
    fragments = leaves()
    rest = [t.detach() for t in floats(fragments)[1:]]

    def depths(rgba):
        return wf.resolve(rebuild(fragments, [rgba, *rest]), max_layers=2).rgba

    rgba = fragments.rgba.detach()
    expected = torch.autograd.functional.jacobian(depths, rgba)
    torch.testing.assert_close(torch.func.jacrev(depths)(rgba), expected, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("transform", ["jvp", "jacfwd", "hessian", "dual"])
def test_forward_mode_is_refused(transform):
    """In our words, instead of a derivative of zero."""
    fragments = leaves()
    rgba = fragments.rgba.detach()

    def total(rgba):
        return wf.composite(rebuild(fragments, [rgba, *(t.detach() for t in floats(fragments)[1:])])).sum()

    def dual(rgba):
        with torch.autograd.forward_ad.dual_level():
            total(torch.autograd.forward_ad.make_dual(rgba, torch.ones_like(rgba)))

    calls = {
        "jvp": lambda: torch.func.jvp(total, (rgba,), (torch.ones_like(rgba),)),
        "jacfwd": lambda: torch.func.jacfwd(total)(rgba),
        "hessian": lambda: torch.func.hessian(total)(rgba),
        "dual": lambda: dual(rgba),
    }
    with pytest.raises(NotImplementedError, match=r"warpfrag\.composite: got a forward-mode derivative"):
        calls[transform]()
