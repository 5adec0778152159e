"""Functions of NumPy arrays and torch tensors, called with Warp arrays.

Without an active tape a function is called with NumPy arrays. On one, and given arrays with gradients, it is called
with torch tensors that share their memory; the tape gets to know how torch's gradient goes back to them. That takes
torch, as nothing else here differentiates what stands before the operators: a scene on its way into camera space.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import is_dataclass, replace
from typing import Any

import warp as wp

from warpfrag.arrays.kinds import NUMPY, WARP, Kind, dtype_name, kind_of
from warpfrag.errors import shorten
from warpfrag.extras import need


def named_values(parameters: Mapping[str, Any] | None, **own: Any) -> dict[str, Any]:
    """Return parameter values by name; those in `own` that are not None come before them.

    Raises:
        TypeError: they are no mapping.
    """
    if parameters is not None and not isinstance(parameters, Mapping):
        raise TypeError(f"parameters: got {type(parameters).__name__}, expected a mapping from names to values")
    return {**(parameters or {}), **{name: value for name, value in own.items() if value is not None}}


def call_with_warp(
    function: Callable[[Mapping[str, Any], str | None], Any],
    values: Mapping[str, Any],
    value_shapes: Mapping[str, tuple[int, ...]],
    device: str | None,
) -> Any:
    """Return what a function of named values gives: Warp arrays if there are any among the values.

    Args:
        function: takes the values and the device on which to compute, or None for that of the values; returns an array,
            a dataclass of arrays, or a mapping to those.
        values: by name; without Warp arrays among them the function is called as it is. A number is a wp.array of one
            entry, as there are none without dimensions.
        value_shapes: shape of one value, by name.
        device: on which to compute; None for that of the values.

    Raises:
        TypeError: an array that is not of floats, or of another library beside Warp's.
        ValueError: arrays on several devices, or not on the one that is asked for.
        ImportError: gradients are to be recorded, and torch is not installed.
    """
    arrays = {name: value for name, value in values.items() if kind_of(value) is WARP}
    if not arrays:
        return function(values, device)
    place = _check(arrays, values, device)
    if not WARP.records(arrays.values()):
        plain = {name: WARP.to_numpy(array) for name, array in arrays.items()}
        given = function({**values, **_single_values(plain, value_shapes)}, str(place))
        return _mapped(given, lambda array: wp.array(NUMPY.to_numpy(array), device=place))
    need("torch", "torch", "The gradient of a scene's parameters as Warp arrays")
    from warpfrag.arrays.torch_ops import KIND

    return _recorded(function, values, arrays, value_shapes, KIND)


def _recorded(
    function: Callable[[Mapping[str, Any], str | None], Any],
    values: Mapping[str, Any],
    arrays: Mapping[str, wp.array],
    value_shapes: Mapping[str, tuple[int, ...]],
    kind: Kind,
) -> Any:
    torch, runtime = kind.xp, wp._src.context.runtime
    tape = runtime.tape
    wanted = {name: array for name, array in arrays.items() if array.requires_grad}
    tensors = {name: wp.to_torch(array, requires_grad=False).detach() for name, array in arrays.items()}
    leaves = {name: tensors[name].requires_grad_() for name in wanted}
    outputs: list[tuple[wp.array, Any]] = []

    def given(tensor: Any) -> wp.array:
        array = kind.to_warp(tensor)
        # An empty array has no gradient that a tape could keep.
        if tensor.requires_grad and array.size:
            array.requires_grad = True
            outputs.append((array, tensor))
        return array

    device = next(iter(arrays.values())).device
    with _one_stream(device, torch), torch.enable_grad():
        # What is computed inside is torch's to differentiate, not the tape's as well.
        runtime.tape = None
        try:
            result = _mapped(function({**values, **_single_values(tensors, value_shapes)}, None), given)
        finally:
            runtime.tape = tape

    def backward() -> None:
        with _one_stream(device, torch):
            grads = [wp.to_torch(array.grad, requires_grad=False) for array, _ in outputs]
            ends = [tensor for _, tensor in outputs]
            found = torch.autograd.grad(ends, list(leaves.values()), grads, retain_graph=True, allow_unused=True)
            for array, gradient in zip(wanted.values(), found, strict=True):
                if gradient is not None:
                    wp.to_torch(array.grad, requires_grad=False).add_(gradient)
            # Consumed: left in place, a second backward pass over the tape would count them twice.
            for grad in grads:
                grad.zero_()

    if outputs:
        tape.record_func(backward, [*wanted.values(), *(array for array, _ in outputs)])
    return result


def _check(arrays: Mapping[str, wp.array], values: Mapping[str, Any], device: str | None) -> wp.Device:
    """Return the device of Warp arrays, once it is known that they go with one another and with all else."""
    first, place = next((name, array.device) for name, array in arrays.items())
    for name, value in values.items():
        kind = kind_of(value)
        if kind not in (None, NUMPY, WARP):
            assert kind is not None
            got = f"{first} of warp and {name} of {kind.name}"
            raise TypeError(f"parameters: got {got}, expected one library")
        if kind is WARP:
            scalar = getattr(value.dtype, "_wp_scalar_type_", value.dtype)
            if scalar not in (wp.float32, wp.float64):
                raise TypeError(f"{name}: got a wp.array of {dtype_name(value)}, expected float32 or float64")
            if value.device != place:
                got = f"{first} on {place} and {name} on {value.device}"
                raise ValueError(f"parameters: got {got}, expected one device")
    if device is not None and wp.get_device(device) != place:
        raise ValueError(f"device: got {shorten(device)}, expected {place} like {first}")
    return place


def _single_values(arrays: Mapping[str, Any], value_shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    """Return arrays, those of one value in the shape of that: a number without dimensions."""

    def single(name: str, array: Any) -> Any:
        shape = value_shapes.get(name)
        return array.reshape(shape) if shape is not None and tuple(array.shape) == (1, *shape) else array

    return {name: single(name, array) for name, array in arrays.items()}


def _mapped(value: Any, convert: Callable[[Any], wp.array]) -> Any:
    """Return the same structure with all arrays in it converted."""
    if isinstance(value, Mapping):
        return {name: _mapped(each, convert) for name, each in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        own = {name: convert(each) for name, each in vars(value).items() if kind_of(each) is not None}
        return replace(value, **own)
    return value if kind_of(value) is None else convert(value)


@contextmanager
def _one_stream(device: wp.Device, torch: Any) -> Iterator[None]:
    """Let torch work on Warp's stream of a device, so that both come in order."""
    with torch.cuda.stream(wp.stream_to_torch(wp.get_stream(device))) if device.is_cuda else nullcontext():
        yield
