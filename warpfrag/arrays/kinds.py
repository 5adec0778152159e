"""Kinds of arrays: NumPy, Warp, torch, each one object that knows its own.

The kind of array that goes in comes out. Arrays are shared between kinds, not copied, wherever device and layout allow.
A further library is a file with one more `Kind`, named in `LIBRARIES`.
"""

import sys
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.operators import Operator, empty_outputs, named


class Kind:
    """One kind of array.

    Attributes:
        name: what it is called in messages.
        type_name: the type of its arrays, for messages.
        xp: the namespace of its functions (`stack`, `where`, …); None if it has none like NumPy's.
    """

    name = ""
    type_name = ""
    xp: Any = None

    def owns(self, array: Any) -> bool:
        """Tell whether something is an array of this kind."""
        raise NotImplementedError

    def to_warp(self, array: Any) -> wp.array:
        """Return a contiguous Warp array that shares an array's memory where it can; without gradient."""
        raise NotImplementedError

    def from_warp(self, array: wp.array) -> Any:
        """Return a Warp array as this kind, sharing its memory."""
        raise NotImplementedError

    def to_numpy(self, array: Any) -> np.ndarray:
        """Return an array on the host, detached from any gradient."""
        raise NotImplementedError

    def astype(self, array: Any, dtype: str) -> Any:
        """Return an array as "float32", "float64", "int32" or "int64"; itself if it is so already."""
        raise NotImplementedError

    def asarray(self, values: Any, like: Any) -> Any:
        """Return numbers, or a NumPy array, in the precision and on the device of an array of this kind."""
        raise NotImplementedError

    def device_of(self, array: Any) -> Any:
        """Return where an array is, in this kind's own words; None for the host's memory."""
        return array.device

    def detach(self, array: Any) -> Any:
        """Return an array without its gradient."""
        return array

    def clip(self, array: Any, low: float, high: float) -> Any:
        """Return an array with numbers outside of a range put on its ends.

        There the gradient is that of the end, but zero if following it (downhill) would lead farther outside: what has
        strayed out comes back in.
        """
        return self.xp.clip(array, low, high)

    def records(self, arrays: Iterable[Any]) -> bool:
        """Tell whether gradients are recorded in any of the arrays (those that are not None)."""
        return False

    def in_order(self, array: Any) -> AbstractContextManager[Any]:
        """Return a context in which kernels run in order with the library's own work on the array's device."""
        return nullcontext()

    def call(self, operator: Operator, inputs: SimpleNamespace, options: Any) -> SimpleNamespace:
        """Call an operator on arrays of this kind (its tables are Warp arrays) and return its outputs in it."""
        raise NotImplementedError


class NumpyKind(Kind):
    """NumPy arrays: no gradients."""

    name, type_name, xp = "numpy", "NumPy array", np

    def owns(self, array: Any) -> bool:
        return isinstance(array, np.ndarray)

    def to_warp(self, array: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(array), device="cpu", copy=False)

    def from_warp(self, array: wp.array) -> np.ndarray:
        return array.numpy()

    def to_numpy(self, array: Any) -> np.ndarray:
        return array

    def astype(self, array: Any, dtype: str) -> Any:
        return array.astype(dtype, copy=False)

    def asarray(self, values: Any, like: Any) -> Any:
        return np.asarray(values, like.dtype)

    def device_of(self, array: Any) -> Any:
        return None

    def call(self, operator: Operator, inputs: SimpleNamespace, options: Any) -> SimpleNamespace:
        arrays = SimpleNamespace(**{name: self._shared(array) for name, array in vars(inputs).items()})
        outputs = empty_outputs(operator, arrays, options, requires_grad=False)
        operator.forward(arrays, outputs, options)
        return SimpleNamespace(**{name: output.numpy() for name, output in vars(outputs).items()})

    def _shared(self, array: Any) -> wp.array | None:
        return array if array is None or isinstance(array, wp.array) else self.to_warp(array)


class WarpKind(Kind):
    """Warp arrays: operators record themselves on an active `wp.Tape`."""

    name, type_name = "warp", "wp.array"

    def owns(self, array: Any) -> bool:
        return isinstance(array, wp.array)

    def to_warp(self, array: Any) -> wp.array:
        return array.contiguous()

    def from_warp(self, array: wp.array) -> wp.array:
        return array

    def to_numpy(self, array: Any) -> np.ndarray:
        return array.numpy()

    def astype(self, array: Any, dtype: str) -> Any:
        if dtype_name(array) == dtype:
            return array
        cast = wp.empty(array.shape, dtype=getattr(wp, dtype), device=array.device)
        wp.utils.array_cast(array, cast)
        return cast

    def asarray(self, values: Any, like: Any) -> Any:
        return wp.array(np.asarray(values, dtype_name(like)), device=like.device)

    def records(self, arrays: Iterable[Any]) -> bool:
        wanted = any(array is not None and array.requires_grad for array in arrays)
        return wanted and _tape() is not None

    def call(self, operator: Operator, inputs: SimpleNamespace, options: Any) -> SimpleNamespace:
        given = vars(inputs)
        arrays = SimpleNamespace(**{name: None if a is None else a.contiguous() for name, a in given.items()})
        wanted = {
            each.name: each.gradient and given[each.name] is not None and given[each.name].requires_grad
            for each in operator.inputs
        }
        differentiable = operator.backward is not None and any(wanted.values())
        outputs = empty_outputs(operator, arrays, options, requires_grad=differentiable)
        operator.forward(arrays, outputs, options)
        tape = _tape()
        if tape is not None and differentiable:
            _record(tape, operator, (inputs, arrays, outputs), wanted, options)
        return outputs


NUMPY, WARP = NumpyKind(), WarpKind()


def _tape() -> Any:
    return wp._src.context.runtime.tape


def _record(
    tape: Any, operator: Operator, arrays: tuple[Any, Any, Any], wanted: Mapping[str, bool], options: Any
) -> None:
    """Let a tape know how a call goes back."""
    inputs, dense, outputs = arrays

    def backward() -> None:
        grads = SimpleNamespace(**{name: output.grad for name, output in vars(outputs).items()})
        targets = named(
            operator.inputs,
            [wp.empty_like(getattr(dense, each.name)) if wanted[each.name] else None for each in operator.inputs],
        )
        assert operator.backward is not None
        operator.backward(dense, grads, targets, options)
        for name, target in vars(targets).items():
            if target is not None:
                add_in_place(getattr(inputs, name).grad, target)
        # Consumed: left in place, a second backward pass over the tape would count them twice.
        for grad in vars(grads).values():
            if grad is not None and grad.size:
                grad.zero_()

    # An empty array has no gradient that a tape could keep.
    concerned = [*vars(inputs).values(), *vars(outputs).values()]
    tape.record_func(backward, [a for a in concerned if a is not None and a.requires_grad and a.size])


def kind_of(array: Any) -> Kind | None:
    """Return which kind of array this is, or None if it is none."""
    for kind in (NUMPY, WARP):
        if kind.owns(array):
            return kind
    for library in LIBRARIES:
        if sys.modules.get(library) is not None and LIBRARIES[library]().owns(array):
            return LIBRARIES[library]()
    return None


def _torch_kind() -> Kind:
    from warpfrag.arrays import torch_ops

    return torch_ops.KIND


# The kinds of other libraries. One that nobody has imported has no arrays, and stays unloaded. (Import statements, as
# torch.compile follows those.)
LIBRARIES = {"torch": _torch_kind}


def kind_named(name: str) -> Kind:
    """Return a kind by its name; imports its library.

    Raises:
        ImportError: the library is not installed.
    """
    for kind in (NUMPY, WARP):
        if kind.name == name:
            return kind
    return LIBRARIES[name]()


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
        raise TypeError(f"{other_name}: got a {other.name} array, expected a {kind.name} array like {name}")
    return next(iter(found))


def dtype_name(array: Any) -> str:
    """Return the name of an array's dtype, such as "float32", whatever its kind."""
    return str(getattr(array.dtype, "__name__", array.dtype)).removeprefix("torch.")


def as_vectors(array: wp.array | None) -> wp.array | None:
    """Return a Warp array of shape (…, k) as an array of vectors, which kernels load at once; shares its memory."""
    if array is None:
        return None
    *sizes, length = array.shape
    dtype = wp.types.vector(length, array.dtype)
    view = wp.array(ptr=array.ptr, dtype=dtype, shape=tuple(sizes), device=array.device, capacity=array.capacity)
    # A view by address does not keep its memory alive by itself.
    view._ref = array
    return view


def add_in_place(target: wp.array, increment: wp.array) -> None:
    """Add one Warp array to another of the same shape."""
    if target.size == 0:
        return
    dense = target.contiguous()
    inputs = [dense.flatten(), increment.flatten()]
    wp.launch(_add[target.dtype], target.size, inputs, device=target.device, record_tape=False)
    if dense is not target:
        wp.copy(target, dense)


def _add_kernel(number: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def add_increment(target: wp.array(dtype=number), increment: wp.array(dtype=number)):
        item = wp.tid()
        target[item] = target[item] + increment[item]

    return add_increment


_add = {number: _add_kernel(number) for number in (wp.float32, wp.float64)}
