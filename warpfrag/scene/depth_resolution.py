"""The resolution of a depth buffer, P(z), from which default z-thicknesses derive (fragment merging, eq. 9).

perspective:   P(z) = z²·δ / (b + z·δ),  b = near·far / (far − near),  δ = 2^−bits
               dP/dz = z·δ (2 b + z·δ) / (b + z·δ)²
orthographic:  P = (far − near)·δ, for there the buffer is linear;  dP/dz = 0

z is the planar depth, as a depth buffer has it; along a pixel's ray z and P are longer by 1 over its angle's cosine.
"""

from dataclasses import dataclass
from math import prod
from numbers import Real
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.apply import apply
from warpfrag.arrays.kinds import dtype_name, kind_of
from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.operators import Input, Operator, Output
from warpfrag.arrays.precisions import kernels
from warpfrag.errors import check_number, check_whole

wp.set_module_options({"enable_backward": False})

DEPTH_BITS = 24
DEPTH_STEP = wp.constant(wp.float64(2.0**-DEPTH_BITS))
MOST_BITS = 64


@wp.func
def depth_resolution(
    z: wp.float64, near: wp.float64, far: wp.float64, step: wp.float64, perspective: int
) -> wp.float64:
    """Return P(z), of a perspective camera if `perspective` is not 0."""
    if perspective != 0:
        return z * z * step / (near * far / (far - near) + z * step)
    return (far - near) * step


@wp.func
def depth_resolution_slope(
    z: wp.float64, near: wp.float64, far: wp.float64, step: wp.float64, perspective: int
) -> wp.float64:
    """Return dP/dz."""
    if perspective != 0:
        b = near * far / (far - near)
        return z * step * (wp.float64(2.0) * b + z * step) / ((b + z * step) * (b + z * step))
    return wp.float64(0.0)


@dataclass(frozen=True)
class DepthBuffer:
    """A depth buffer.

    Attributes:
        near: distance of the near plane [scene units].
        far: distance of the far plane [scene units].
        step: distance of neighbouring values that it can hold, of 1.
        perspective: 1, or 0 for an orthographic camera.
    """

    near: float
    far: float
    step: float
    perspective: int


@kernels
def z_resolution_fwd(number: Any) -> Any:
    """Return the kernel of P(z)."""

    def kernel(
        span: Span,
        depth: wp.array(dtype=number),
        near: wp.float64,
        far: wp.float64,
        step: wp.float64,
        perspective: int,
        resolution: wp.array(dtype=number),
    ):
        """Compute P(z).

        Args:
            span: the depths.
            depth: [scene units], (n,).
            near: see `DepthBuffer`, as the three that follow.
            far: [scene units].
            step: of 1.
            perspective: 1 or 0.
            resolution: output, P [scene units], (n,).
        """
        for item in range(span.begin + wp.tid(), span.end, span.stride):
            resolution[item] = number(depth_resolution(wp.float64(depth[item]), near, far, step, perspective))

    return kernel


@kernels
def z_resolution_bwd(number: Any) -> Any:
    """Return the kernel of the gradient of P(z)."""

    def kernel(
        span: Span,
        depth: wp.array(dtype=number),
        near: wp.float64,
        far: wp.float64,
        step: wp.float64,
        perspective: int,
        grad_resolution: wp.array(dtype=number),
        grad_depth: wp.array(dtype=number),
    ):
        """Multiply a gradient by dP/dz.

        Args:
            span: the depths.
            depth: [scene units], (n,).
            near: see `DepthBuffer`, as the three that follow.
            far: [scene units].
            step: of 1.
            perspective: 1 or 0.
            grad_resolution: gradient in P, (n,).
            grad_depth: output, gradient in the depth, (n,).
        """
        for item in range(span.begin + wp.tid(), span.end, span.stride):
            slope = depth_resolution_slope(wp.float64(depth[item]), near, far, step, perspective)
            grad_depth[item] = number(slope * wp.float64(grad_resolution[item]))

    return kernel


def _forward(inputs: SimpleNamespace, outputs: SimpleNamespace, buffer: DepthBuffer) -> None:
    depth = inputs.depth
    arguments = [depth, buffer.near, buffer.far, buffer.step, buffer.perspective, outputs.resolution]
    launch(z_resolution_fwd(depth.dtype), depth.size, arguments, depth.device)


def _backward(inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, buffer: DepthBuffer) -> None:
    depth = inputs.depth
    if targets.depth is None:
        return
    if grads.resolution is None:
        targets.depth.zero_()
        return
    arguments = [depth, buffer.near, buffer.far, buffer.step, buffer.perspective, grads.resolution, targets.depth]
    launch(z_resolution_bwd(depth.dtype), depth.size, arguments, depth.device)


Z_RESOLUTION = Operator(
    name="z_resolution",
    inputs=(Input("depth", "n", gradient=True),),
    outputs=(Output("resolution", "n"),),
    options=DepthBuffer,
    forward=_forward,
    backward=_backward,
)


def z_resolution(depth: Any, near: float, far: float, bits: int = DEPTH_BITS, *, orthographic: bool = False) -> Any:
    """Return the resolution P(z) of a depth buffer of `bits` bits at a depth (fragment merging, eq. 9).

    Differentiable in the depth, on which that of an orthographic camera does not depend.

    Args:
        depth: planar depth, along the camera's axis [scene units], at least 0: a number, or an array of any shape,
            float32 or float64. Along a ray of another direction both z and P are longer, by 1 over the angle's cosine.
        near: distance of the near plane [scene units], above 0.
        far: distance of the far plane [scene units], beyond `near`.
        bits: bits of the depth buffer, from 1 to 64.
        orthographic: whether the buffer is that of an orthographic camera.

    Returns:
        P(z) [scene units], in the kind, precision and shape of `depth`.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: a plane or `bits` is out of its range, or a number `depth` is negative or not finite.

    Example:
        >>> wf.z_resolution(1.0, near=0.01, far=10.0)
        5.954...e-06
    """
    near = check_number("near", near, above=0.0)
    far = check_number("far", far, above=near)
    bits = check_whole("bits", bits, 1, MOST_BITS)
    buffer = DepthBuffer(near, far, 2.0**-bits, int(not orthographic))
    kind = kind_of(depth)
    if kind is None:
        if not isinstance(depth, Real) or isinstance(depth, bool):
            raise TypeError(
                f"depth: got {type(depth).__name__}, expected a number, torch.Tensor, wp.array or NumPy array"
            )
        # The same formula, called as Python's.
        return depth_resolution.func(check_number("depth", depth, 0.0), near, far, buffer.step, buffer.perspective)
    if dtype_name(depth) not in ("float32", "float64"):
        raise TypeError(f"depth: got dtype {dtype_name(depth)}, expected float32 or float64")
    flat = depth.reshape((prod(depth.shape),))
    return apply(Z_RESOLUTION, {"depth": flat}, buffer).resolution.reshape(depth.shape)
