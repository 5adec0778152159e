"""A differentiable operator, written once on Warp arrays and callable with NumPy, Warp and torch arrays.

The kind of array that goes in comes out: torch tensors with autograd, Warp arrays recorded on an active `wp.Tape`,
NumPy arrays without gradients. Arrays are shared between the kinds, not copied, wherever device and layout allow.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import warp as wp

Kind = Literal["numpy", "warp", "torch"]
Shape = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Operator:
    """One differentiable function of arrays.

    Attributes:
        name: name under which torch knows it, `torch.ops.warpfrag.<name>`.
        tensors: names of the array arguments, in order; any may be None in a call.
        differentiable: those of `tensors` that have a gradient.
        options: names of the other arguments and their types in torch's schema language.
        outputs: names of the outputs, in order.
        output_like: `(inputs, **options) -> [(shape, "float" | "int32"), …]`, from shapes alone.
        forward: `(inputs, outputs, **options)`: fills the allocated outputs.
        backward: `(inputs, grad_outputs, grad_inputs, **options)`: fills the allocated gradients that are not None;
            a `grad_outputs` entry that is None stands for zeros.
    """

    name: str
    tensors: tuple[str, ...]
    differentiable: tuple[str, ...]
    outputs: tuple[str, ...]
    output_like: Callable[..., list[tuple[Shape, str]]]
    forward: Callable[..., None]
    backward: Callable[..., None]
    options: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        OPERATORS[self.name] = self


# Every operator by name, filled as modules define theirs; torch learns of all of them at once, when it is first used.
OPERATORS: dict[str, Operator] = {}


def kind_of(array: Any) -> Kind | None:
    """Return which kind of array this is, or None if it is none of the three."""
    if isinstance(array, np.ndarray):
        return "numpy"
    if isinstance(array, wp.array):
        return "warp"
    torch = sys.modules.get("torch")
    return "torch" if torch is not None and isinstance(array, torch.Tensor) else None


def dtype_name(array: Any) -> str:
    """Return the name of an array's dtype, such as "float32", whatever its kind."""
    return str(getattr(array.dtype, "__name__", array.dtype)).removeprefix("torch.")


def common_kind(arrays: Mapping[str, Any]) -> Kind:
    """Return the kind that all arrays (those that are not None) share.

    Raises:
        TypeError: something is no array, or two arrays are of different kinds.
    """
    found: dict[Kind, str] = {}
    for name, array in arrays.items():
        if array is None:
            continue
        kind = kind_of(array)
        if kind is None:
            raise TypeError(f"{name}: got {type(array).__name__}, expected a torch.Tensor, wp.array or NumPy array")
        found.setdefault(kind, name)
    if len(found) > 1:
        (kind, name), (other, other_name) = list(found.items())[:2]
        raise TypeError(f"{other_name}: got a {other} array, expected a {kind} array like {name}")
    return next(iter(found))


def apply(operator: Operator, inputs: Sequence[Any], **options: Any) -> tuple[Any, ...]:
    """Call an operator on arrays of one kind and return its outputs in that kind.

    Args:
        operator: what to compute.
        inputs: one array (or None) per name in `operator.tensors`, all of one kind, dtype and device.
        options: one value per name in `operator.options`.
    """
    kind = common_kind(dict(zip(operator.tensors, inputs, strict=True)))
    if kind == "torch":
        from warpfrag.arrays import legacy_torch as torch_ops

        return torch_ops.call(operator, inputs, options)
    if kind == "warp":
        return _apply_warp(operator, inputs, options)
    arrays = tuple(None if array is None else _share_numpy(array) for array in inputs)
    outputs = _allocate(operator, arrays, options, requires_grad=False)
    operator.forward(arrays, outputs, **options)
    return tuple(output.numpy() for output in outputs)


def float_type(inputs: Sequence[Any]) -> Any:
    """Return the Warp scalar type of the floating-point arrays among the inputs."""
    return next(a.dtype for a in inputs if a is not None and a.dtype in (wp.float32, wp.float64))


def vectors(array: wp.array) -> wp.array:
    """Return a Warp array of shape (n, k) as an array of n vectors, which kernels load at once; shares its memory."""
    size, length = array.shape
    dtype = wp.types.vector(length, array.dtype)
    view = wp.array(ptr=array.ptr, dtype=dtype, shape=(size,), device=array.device, capacity=array.capacity)
    # A view by address does not keep its memory alive by itself.
    view._ref = array
    return view


def _allocate(operator: Operator, inputs: Sequence[Any], options: Mapping[str, Any], requires_grad: bool) -> tuple:
    scalar = float_type(inputs)
    device = next(a.device for a in inputs if a is not None)
    return tuple(
        wp.empty(shape, dtype=scalar, device=device, requires_grad=requires_grad)
        if kind == "float"
        else wp.empty(shape, dtype=wp.int32, device=device)
        for shape, kind in operator.output_like(inputs, **options)
    )


def _share_numpy(array: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(array), device="cpu", copy=False)


def _apply_warp(operator: Operator, inputs: Sequence[Any], options: Mapping[str, Any]) -> tuple[wp.array, ...]:
    arrays = tuple(None if array is None else array.contiguous() for array in inputs)
    wanted = [
        array is not None and array.requires_grad and name in operator.differentiable
        for name, array in zip(operator.tensors, inputs, strict=True)
    ]
    tape = wp._src.context.runtime.tape
    record = tape is not None and any(wanted)
    outputs = _allocate(operator, arrays, options, requires_grad=any(wanted))
    operator.forward(arrays, outputs, **options)
    if record:

        def backward() -> None:
            grad_outputs = tuple(output.grad for output in outputs)
            grads = tuple(wp.empty_like(a) if w else None for a, w in zip(arrays, wanted, strict=True))
            operator.backward(arrays, grad_outputs, grads, **options)
            for array, grad in zip(inputs, grads, strict=True):
                if grad is not None:
                    add(array.grad, grad)
            # Consumed: left in place, a second backward pass over the tape would count them twice.
            for grad in grad_outputs:
                if grad is not None and grad.size:
                    grad.zero_()

        # An empty array has no gradient that a tape could keep.
        tape.record_func(backward, [a for a in (*inputs, *outputs) if a is not None and a.requires_grad and a.size])
    return outputs


def add(target: wp.array, increment: wp.array) -> None:
    """Add one array to another of the same shape, in place."""
    if target.size == 0:
        return
    dense = target.contiguous()
    inputs = [dense.flatten(), increment.flatten()]
    wp.launch(_add[target.dtype], target.size, inputs, device=target.device, record_tape=False)
    if dense is not target:
        wp.copy(target, dense)


def _add_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def add_increment(target: wp.array(dtype=scalar), increment: wp.array(dtype=scalar)):
        item = wp.tid()
        target[item] = target[item] + increment[item]

    return add_increment


_add = {wp.float32: _add_kernel(wp.float32), wp.float64: _add_kernel(wp.float64)}
