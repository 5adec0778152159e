"""torch: operators as its custom operators, so that autograd and `torch.compile(fullgraph=True)` know them."""

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import torch.autograd.forward_ad as forward_ad
import warp as wp

from warpfrag.arrays.kinds import Kind
from warpfrag.arrays.operators import LISTENERS, OPERATORS, Operator, named

_LIBRARY = "warpfrag"
_SCHEMA_TYPES = {int: "int", float: "float", str: "str", bool: "bool"}


class _Clip(torch.autograd.Function):
    """Clamping whose gradient outside of the range leads back into it; see `Kind.clip`."""

    generate_vmap_rule = True

    @staticmethod
    def forward(array: torch.Tensor, low: float, high: float) -> torch.Tensor:
        """Return the clamped array."""
        return array.clamp(low, high)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        """Keep where the array was."""
        array, ctx.low, ctx.high = inputs
        ctx.save_for_backward(array)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        """Return the gradient in the array; zero where it is outside and downhill leads farther."""
        (array,), grad = ctx.saved_tensors, grads[0]
        farther = ((array > ctx.high) & (grad < 0.0)) | ((array < ctx.low) & (grad > 0.0))
        return grad.masked_fill(farther, 0.0), None, None


class TorchKind(Kind):
    """torch tensors, with autograd."""

    name, type_name, xp = "torch", "torch.Tensor", torch

    def owns(self, array: Any) -> bool:
        return isinstance(array, torch.Tensor)

    def to_warp(self, array: Any) -> wp.array:
        wp.init()
        # Detached first: for a leaf that requires a gradient, from_torch would allocate one.
        return wp.from_torch(array.detach().contiguous())

    def from_warp(self, array: wp.array) -> torch.Tensor:
        return wp.to_torch(array)

    def to_numpy(self, array: Any) -> np.ndarray:
        return array.detach().cpu().numpy()

    def astype(self, array: Any, dtype: str) -> Any:
        return array.to(getattr(torch, dtype))

    def asarray(self, values: Any, like: Any) -> Any:
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)

    def detach(self, array: Any) -> Any:
        return array.detach()

    def clip(self, array: Any, low: float, high: float) -> Any:
        return _Clip.apply(array, low, high)

    def records(self, arrays: Iterable[Any]) -> bool:
        return torch.is_grad_enabled() and any(array is not None and array.requires_grad for array in arrays)

    def in_order(self, array: Any) -> AbstractContextManager[Any]:
        return _stream(array.device)

    def call(self, operator: Operator, inputs: SimpleNamespace, options: Any) -> SimpleNamespace:
        arrays = [wp.to_torch(a) if isinstance(a, wp.array) else a for a in vars(inputs).values()]
        # A custom operator would drop a tangent without a word.
        if any(array is not None and forward_ad.unpack_dual(array).tangent is not None for array in arrays):
            raise _no_forward_mode(operator.name)
        values = [getattr(options, name) for name in operator.option_names]
        if torch._C._are_functorch_transforms_active():
            outputs = _Transformed.apply(operator.name, *arrays, *values)
        else:
            outputs = getattr(torch.ops.warpfrag, operator.name)(*arrays, *values)
        return named(operator.outputs, outputs if isinstance(outputs, tuple) else (outputs,))


KIND = TorchKind()
# What torch was told, by the operator's name.
_REGISTERED: "dict[str, _Registration]" = {}


class _Registration:
    """What torch is told about an operator: what it computes, its shapes, its gradient."""

    def __init__(self, operator: Operator):
        self.operator = operator
        self.argument_count, self.output_count = len(operator.arguments), len(operator.outputs)

    def schema(self) -> str:
        """Return the arguments in torch's schema language."""
        arrays = [f"Tensor? {each.name}" for each in self.operator.arguments]
        options = [f"{_SCHEMA_TYPES[option.type]} {option.name}" for option in fields(self.operator.options)]  # type: ignore[index]
        return ", ".join(arrays + options)

    def split(self, arguments: Sequence[Any]) -> tuple[SimpleNamespace, Any]:
        """Return the tensors by name, and the options."""
        tensors = named(self.operator.arguments, arguments[: self.argument_count])
        return tensors, self.operator.options(*arguments[self.argument_count :])

    def allocate(self, *arguments: Any) -> Any:
        """Return the outputs, not filled."""
        tensors, options = self.split(arguments)
        first = next(
            t for e, t in zip(self.operator.inputs, arguments, strict=False) if e.dtype == "float" and t is not None
        )
        outputs = tuple(
            first.new_empty(shape, dtype=first.dtype if output.dtype == "float" else torch.int32)
            for output, shape in zip(self.operator.outputs, self.operator.output_shapes(tensors, options), strict=True)
        )
        return outputs if self.output_count > 1 else outputs[0]

    def forward(self, *arguments: Any) -> Any:
        """Return the outputs."""
        tensors, options = self.split(arguments)
        outputs = self.allocate(*arguments)
        listed = outputs if self.output_count > 1 else (outputs,)
        with _stream(listed[0].device):
            self.operator.forward(_shared(tensors), _shared(named(self.operator.outputs, listed)), options)
        return outputs

    def allocate_grads(self, *arguments: Any) -> list[torch.Tensor]:
        """Return the gradients that are needed, not filled: arguments are those of `backward`."""
        needed, inputs = arguments[self.output_count], arguments[self.output_count + 1 :]
        return [
            torch.empty_like(tensor, memory_format=torch.contiguous_format)
            for tensor, need in zip(inputs, needed, strict=False)
            if need
        ]

    def backward(self, *arguments: Any) -> list[torch.Tensor]:
        """Return the gradients that are needed, given those of the outputs, which are needed, and the inputs."""
        grads = self.allocate_grads(*arguments)
        tensors, options = self.split(arguments[self.output_count + 1 :])
        filled = iter(grads)
        targets = named(self.operator.inputs, [next(filled) if need else None for need in arguments[self.output_count]])
        grad_outputs = named(self.operator.outputs, arguments[: self.output_count])
        assert self.operator.backward is not None
        with _stream(grads[0].device):
            self.operator.backward(_shared(tensors), _shared(grad_outputs), _shared(targets), options)
        return grads

    def remember(self, ctx: Any, inputs: Sequence[Any], output: Any) -> None:
        """Keep what the way back takes."""
        ctx.set_materialize_grads(False)
        ctx.options = inputs[self.argument_count :]
        ctx.save_for_backward(*inputs[: self.argument_count])

    def differentiate(self, backward_op: Any, wanted: Sequence[bool], ctx: Any, *grads: Any) -> tuple[Any, ...]:
        """Return the gradient of every argument, None where there is none or it is not wanted."""
        nothing: list[Any] = [None] * (len(self.operator.tables) + len(self.operator.option_names))
        needed = [bool(need) and each.gradient for each, need in zip(self.operator.inputs, wanted, strict=False)]
        if self.operator.backward is None or not any(needed) or all(grad is None for grad in grads):
            return (*[None] * len(needed), *nothing)
        found = iter(backward_op(*grads, needed, *ctx.saved_tensors, *ctx.options))
        return (*(next(found) if need else None for need in needed), *nothing)

    def refuse(self, ctx: Any, *grads: Any) -> None:
        """Raise for a second derivative."""
        raise NotImplementedError(
            f"warpfrag.{self.operator.name}: second derivatives (double backward) are not supported"
        )


def register(operator: Operator) -> None:
    """Define `torch.ops.warpfrag.<name>` and `<name>_backward`: what they compute, their shapes, their gradient."""
    told = _REGISTERED[operator.name] = _Registration(operator)
    outputs = ", ".join(["Tensor"] * told.output_count)
    grads = ", ".join(f"Tensor? grad_{each.name}" for each in operator.outputs)
    forward_op = torch.library.custom_op(
        f"{_LIBRARY}::{operator.name}", told.forward, mutates_args=(), schema=f"({told.schema()}) -> ({outputs})"
    )
    forward_op.register_fake(told.allocate)
    backward_op = torch.library.custom_op(
        f"{_LIBRARY}::{operator.name}_backward",
        told.backward,
        mutates_args=(),
        schema=f"({grads}, bool[] needed, {told.schema()}) -> Tensor[]",
    )
    backward_op.register_fake(told.allocate_grads)
    backward_op.register_autograd(told.refuse)

    def differentiate(ctx: Any, *grads: Any) -> tuple[Any, ...]:
        return told.differentiate(backward_op, ctx.needs_input_grad, ctx, *grads)

    forward_op.register_autograd(differentiate, setup_context=told.remember)
    for op in (forward_op, backward_op):
        op.register_vmap(lambda info, in_dims, *arguments, op=op: _one_by_one(op, info, in_dims, arguments))


def _no_forward_mode(name: str) -> NotImplementedError:
    return NotImplementedError(
        f"warpfrag.{name}: got a forward-mode derivative, expected a gradient (backward, torch.func.grad or jacrev)"
    )


def _one_by_one(call: Any, info: Any, in_dims: Any, arguments: Sequence[Any]) -> Any:
    """Return what an operator gives for each entry of a batch, stacked, and in which dimension."""
    results = []
    for entry in range(info.batch_size):
        picked = [
            argument.select(dim, entry) if isinstance(argument, torch.Tensor) and dim is not None else argument
            for argument, dim in zip(arguments, in_dims, strict=True)
        ]
        results.append(call(*picked))
    if isinstance(results[0], (tuple, list)):
        return type(results[0])(map(torch.stack, zip(*results, strict=True))), type(results[0])([0] * len(results[0]))
    return torch.stack(results), 0


class _Transformed(torch.autograd.Function):
    """An operator inside of `torch.func`'s transforms (grad, jacrev, vmap), which a custom operator does not take."""

    @staticmethod
    def forward(name: str, *arguments: Any) -> Any:
        with torch._C._AutoDispatchBelowAutograd():
            outputs = getattr(torch.ops.warpfrag, name)(*arguments)
        return tuple(outputs) if isinstance(outputs, list) else outputs

    @staticmethod
    def setup_context(ctx: Any, inputs: Sequence[Any], output: Any) -> None:
        name, *arguments = inputs
        ctx.name = name
        if name in _REGISTERED:
            _REGISTERED[name].remember(ctx, arguments, output)
            ctx.mark_non_differentiable(
                *(o for o in output if not o.is_floating_point()) if isinstance(output, tuple) else ()
            )

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        if ctx.name not in _REGISTERED:
            _REGISTERED[ctx.name.removesuffix("_backward")].refuse(ctx)
        told = _REGISTERED[ctx.name]

        def backward_op(*arguments: Any) -> Any:
            found = _Transformed.apply(f"{ctx.name}_backward", *arguments)
            return found if isinstance(found, tuple) else (found,)

        needed = ctx.needs_input_grad[1:]
        return (None, *told.differentiate(backward_op, needed, ctx, *grads))

    @staticmethod
    def vmap(info: Any, in_dims: Any, *arguments: Any) -> Any:
        return _one_by_one(_Transformed.apply, info, in_dims, arguments)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise _no_forward_mode(ctx.name)


def _shared(tensors: SimpleNamespace) -> SimpleNamespace:
    """Return tensors as Warp arrays that share their memory."""
    return SimpleNamespace(**{name: None if t is None else KIND.to_warp(t) for name, t in vars(tensors).items()})


def _stream(device: torch.device) -> AbstractContextManager[Any]:
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)))


for _operator in OPERATORS.values():
    register(_operator)
LISTENERS.append(register)
