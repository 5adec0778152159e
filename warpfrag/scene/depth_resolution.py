"""The resolution of a depth buffer, P(z), from which default z-thicknesses derive (fragment merging, eq. 9).

P(z) = z²·δ / (b + z·δ),  b = near·far / (far − near),  δ = 2^−bits
dP/dz = P (2 b + z δ) / (z (b + z δ)) = z δ (2 b + z δ) / (b + z δ)²
"""

from collections.abc import Sequence
from functools import cache
from math import prod
from numbers import Real
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.legacy import Operator, apply, dtype_name, kind_of

wp.set_module_options({"enable_backward": False})

DEPTH_BITS = 24
DEPTH_STEP = wp.constant(wp.float64(2.0**-DEPTH_BITS))


@wp.func
def depth_resolution(z: wp.float64, near: wp.float64, far: wp.float64, step: wp.float64) -> wp.float64:
    """Return P(z)."""
    return z * z * step / (near * far / (far - near) + z * step)


@wp.func
def depth_resolution_slope(z: wp.float64, near: wp.float64, far: wp.float64, step: wp.float64) -> wp.float64:
    """Return dP/dz."""
    b = near * far / (far - near)
    return z * step * (wp.float64(2.0) * b + z * step) / ((b + z * step) * (b + z * step))


@cache
def _kernels(scalar: Any) -> tuple[wp.Kernel, wp.Kernel]:
    @wp.kernel(module="unique", enable_backward=False)
    def z_resolution_fwd(
        span: Span, depth: wp.array(dtype=scalar), near: wp.float64, far: wp.float64, step: wp.float64,
        resolution: wp.array(dtype=scalar),
    ):  # fmt: skip
        for item in range(span.begin + wp.tid(), span.end, span.stride):
            resolution[item] = scalar(depth_resolution(wp.float64(depth[item]), near, far, step))

    @wp.kernel(module="unique", enable_backward=False)
    def z_resolution_bwd(
        span: Span, depth: wp.array(dtype=scalar), near: wp.float64, far: wp.float64, step: wp.float64,
        grad_resolution: wp.array(dtype=scalar), grad_depth: wp.array(dtype=scalar),
    ):  # fmt: skip
        for item in range(span.begin + wp.tid(), span.end, span.stride):
            slope = depth_resolution_slope(wp.float64(depth[item]), near, far, step)
            grad_depth[item] = scalar(slope * wp.float64(grad_resolution[item]))

    return z_resolution_fwd, z_resolution_bwd


def _forward(inputs: Sequence[Any], outputs: Sequence[Any], near: float, far: float, step: float) -> None:
    depth = inputs[0]
    forward, _ = _kernels(depth.dtype)
    launch(forward, depth.size, [depth, near, far, step, outputs[0]], depth.device)


def _backward(
    inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any], near: float, far: float, step: float
) -> None:
    depth, grad_depth = inputs[0], grad_inputs[0]
    if grad_depth is None:
        return
    if grad_outputs[0] is None:
        grad_depth.zero_()
        return
    _, backward = _kernels(depth.dtype)
    launch(backward, depth.size, [depth, near, far, step, grad_outputs[0], grad_depth], depth.device)


_Z_RESOLUTION = Operator(
    name="z_resolution",
    tensors=("depth",),
    differentiable=("depth",),
    outputs=("resolution",),
    output_like=lambda inputs, **options: [(tuple(inputs[0].shape), "float")],
    forward=_forward,
    backward=_backward,
    options={"near": "float", "far": "float", "step": "float"},
)


def z_resolution(depth: Any, near: float, far: float, bits: int = DEPTH_BITS) -> Any:
    """Return the resolution P(z) of a depth buffer of `bits` bits at a depth (fragment merging, eq. 9).

    Differentiable in the depth.

    Args:
        depth: distance from the eye [scene units], at least 0: a number, or an array of any shape, float32 or float64.
        near: distance of the near plane [scene units], above 0.
        far: distance of the far plane [scene units], beyond `near`.
        bits: bits of the depth buffer, from 1 to 64.

    Returns:
        P(z) [scene units], in the kind, precision and shape of `depth`.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: a plane or `bits` is out of its range, or a number `depth` is negative or not finite.

    Example:
        >>> wf.z_resolution(1.0, near=0.01, far=10.0)
        5.954...e-06
    """
    for name, value in (("near", near), ("far", far)):
        if isinstance(value, bool) or not isinstance(value, Real):
            raise TypeError(f"{name}: got {type(value).__name__}, expected a number")
    if not 0.0 < near < far < float("inf"):
        raise ValueError(f"near, far: got {near} and {far}, expected finite numbers with 0 < near < far")
    if isinstance(bits, bool) or not isinstance(bits, (int, np.integer)):
        raise TypeError(f"bits: got {bits!r}, expected a whole number from 1 to 64")
    if not 1 <= bits <= 64:
        raise ValueError(f"bits: got {bits}, expected a whole number from 1 to 64")
    near, far, step = float(near), float(far), 2.0 ** -int(bits)
    kind = kind_of(depth)
    if kind is None:
        if isinstance(depth, bool) or not isinstance(depth, Real):
            raise TypeError(
                f"depth: got {type(depth).__name__}, expected a number, torch.Tensor, wp.array or NumPy array"
            )
        depth = float(depth)
        if not 0.0 <= depth < float("inf"):
            raise ValueError(f"depth: got {depth}, expected a finite number of at least 0")
    elif dtype_name(depth) not in ("float32", "float64"):
        raise TypeError(f"depth: got dtype {dtype_name(depth)}, expected float32 or float64")
    if kind == "warp":
        flat = depth.contiguous().reshape((prod(depth.shape),))
        return apply(_Z_RESOLUTION, (flat,), near=near, far=far, step=step)[0].reshape(depth.shape)
    return depth * depth * step / (near * far / (far - near) + depth * step)
