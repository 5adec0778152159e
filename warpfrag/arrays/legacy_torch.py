"""Operators as torch custom operators, so that autograd and `torch.compile(fullgraph=True)` know them."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
import warp as wp

from warpfrag.arrays.legacy import OPERATORS, Operator

_FLOATS = (torch.float32, torch.float64)
_LIBRARY = "warpfrag"


def call(operator: Operator, inputs: Sequence[Any], options: Mapping[str, Any]) -> tuple[torch.Tensor, ...]:
    """Call the torch operator that `register` made of `operator`."""
    outputs = getattr(torch.ops.warpfrag, operator.name)(*inputs, *(options[name] for name in operator.options))
    return outputs if isinstance(outputs, tuple) else (outputs,)


def register(operator: Operator) -> None:
    """Define `torch.ops.warpfrag.<name>` and `<name>_backward`: what they compute, their shapes, their gradient."""
    tensor_count, output_count = len(operator.tensors), len(operator.outputs)
    arguments_schema = ", ".join(
        [f"Tensor? {name}" for name in operator.tensors] + [f"{kind} {name}" for name, kind in operator.options.items()]
    )
    grads_schema = ", ".join(f"Tensor? grad_{name}" for name in operator.outputs)

    def split(arguments: Sequence[Any]) -> tuple[Sequence[Any], dict[str, Any]]:
        return arguments[:tensor_count], dict(zip(operator.options, arguments[tensor_count:], strict=True))

    def allocate(*arguments: Any) -> Any:
        inputs, options = split(arguments)
        first = next(t for t in inputs if t is not None and t.dtype in _FLOATS)
        outputs = tuple(
            first.new_empty(shape, dtype=first.dtype if kind == "float" else torch.int32)
            for shape, kind in operator.output_like(inputs, **options)
        )
        return outputs if output_count > 1 else outputs[0]

    def forward(*arguments: Any) -> Any:
        inputs, options = split(arguments)
        outputs = allocate(*arguments)
        listed = outputs if output_count > 1 else (outputs,)
        with _stream(listed[0].device):
            operator.forward(_share(inputs), _share(listed), **options)
        return outputs

    forward_op = torch.library.custom_op(
        f"{_LIBRARY}::{operator.name}",
        forward,
        mutates_args=(),
        schema=f"({arguments_schema}) -> ({', '.join(['Tensor'] * output_count)})",
    )
    forward_op.register_fake(allocate)

    def allocate_grads(*arguments: Any) -> list[torch.Tensor]:
        needed, inputs = arguments[output_count], arguments[output_count + 1 :]
        return [
            torch.empty_like(t, memory_format=torch.contiguous_format)
            for t, need in zip(inputs[:tensor_count], needed, strict=True)
            if need
        ]

    def backward(*arguments: Any) -> list[torch.Tensor]:
        grads = allocate_grads(*arguments)
        needed = arguments[output_count]
        inputs, options = split(arguments[output_count + 1 :])
        shared = iter(_share(grads))
        grad_inputs = tuple(next(shared) if need else None for need in needed)
        with _stream(grads[0].device):
            operator.backward(_share(inputs), _share(arguments[:output_count]), grad_inputs, **options)
        return grads

    backward_op = torch.library.custom_op(
        f"{_LIBRARY}::{operator.name}_backward",
        backward,
        mutates_args=(),
        schema=f"({grads_schema}, bool[] needed, {arguments_schema}) -> Tensor[]",
    )
    backward_op.register_fake(allocate_grads)

    def remember(ctx: Any, inputs: Sequence[Any], output: Any) -> None:
        ctx.set_materialize_grads(False)
        tensors, ctx.options = split(inputs)
        ctx.save_for_backward(*tensors)

    def differentiate(ctx: Any, *grads: Any) -> tuple[Any, ...]:
        tensors = ctx.saved_tensors
        needed = [
            bool(ctx.needs_input_grad[index]) and name in operator.differentiable
            for index, name in enumerate(operator.tensors)
        ]
        nothing = [None] * len(operator.options)
        if not any(needed) or all(grad is None for grad in grads):
            return (*([None] * tensor_count), *nothing)
        found = iter(backward_op(*grads, needed, *tensors, *ctx.options.values()))
        return (*(next(found) if need else None for need in needed), *nothing)

    forward_op.register_autograd(differentiate, setup_context=remember)

    def refuse(ctx: Any, *grads: Any) -> None:
        raise NotImplementedError(f"warpfrag.{operator.name}: second derivatives (double backward) are not supported")

    backward_op.register_autograd(refuse)


def _share(tensors: Sequence[torch.Tensor | None]) -> tuple[wp.array | None, ...]:
    wp.init()
    # Detached first: for a leaf that requires a gradient, from_torch would allocate one.
    return tuple(None if t is None else wp.from_torch(t.detach().contiguous()) for t in tensors)


def _stream(device: torch.device) -> AbstractContextManager[Any]:
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)))


for _operator in OPERATORS.values():
    register(_operator)
