"""The slab: a fragment with its z-thickness, and what is computed from one slab alone.

Premultiplied colour `c`, opacity `a`, transmittance `t = 1 - a`, logarithm of it `l`, weight `w = S/A` (the opacity sum
per opacity: 1 for a fresh fragment), front depth `f`, back depth `z`. Transmittance multiplies and its logarithm adds
however slabs are merged, so both are carried along and never computed from a rounded opacity: that keeps opaque slabs
exact and costs one logarithm per fragment.
"""

import math
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

# The optical depth of an opaque slab is cut at 13.8 (transmittance 1e-6): the derivatives of its parts stay finite.
LOG_FLOOR = math.log(1.0e-6)
# The logarithm of no transmittance, and the floor under optical-depth mixing: there an opaque slab is opaque from its
# front on, as in deep images. Sums of it stay finite in single precision.
LOG_OPAQUE = wp.constant(-1.0e30)
# Below this opacity (1 - T^r)/A is summed as a series: the quotient would lose half of the digits of its derivative.
SERIES_OPACITY = wp.constant(0.02)
# What lets less than this through is opaque, and nothing is divided by less: in single precision derivatives of such
# quotients would overflow.
NEGLIGIBLE = wp.constant(1.0e-24)
# The weight of a slab can triple whenever it is divided (all three parts of an opaque slab are opaque). Above this
# limit no other slab has a say in a mix: there it stays, with no derivative, before it overflows.
WEIGHT_LIMIT = wp.constant(1.0e12)


@wp.struct
class Slab32:
    """A slab in single precision."""

    c: wp.vec3f
    a: wp.float32
    t: wp.float32
    l: wp.float32  # noqa: E741
    w: wp.float32
    f: wp.float32
    z: wp.float32


@wp.struct
class Slab64:
    """A slab in double precision."""

    c: wp.vec3d
    a: wp.float64
    t: wp.float64
    l: wp.float64  # noqa: E741
    w: wp.float64
    f: wp.float64
    z: wp.float64


@wp.func(inline=True)
def slab(c: wp.vec3f, a: float, t: float, l: float, w: float, f: float, z: float) -> Slab32:  # noqa: E741
    """Return the slab of these components."""
    s = Slab32()
    s.c = c
    s.a = a
    s.t = t
    s.l = l
    s.w = w
    s.f = f
    s.z = z
    return s


@wp.func(inline=True)  # type: ignore[no-redef]
def slab(  # noqa: F811
    c: wp.vec3d,
    a: wp.float64,
    t: wp.float64,
    l: wp.float64,  # noqa: E741
    w: wp.float64,
    f: wp.float64,
    z: wp.float64,
) -> Slab64:
    """Return the slab of these components, in double precision."""
    s = Slab64()
    s.c = c
    s.a = a
    s.t = t
    s.l = l
    s.w = w
    s.f = f
    s.z = z
    return s


@wp.func(inline=True)
def log_transmittance(a: Any):
    """Return log(1 - A), or `LOG_OPAQUE` for an opaque slab."""
    t = type(a)(1.0) - a
    if t <= type(a)(0.0):
        return type(a)(LOG_OPAQUE)
    return wp.log(t)


@wp.func(inline=True)
def divide(numerator: Any, denominator: Any, limit: Any):
    """Return the quotient, or its limit where both vanish."""
    if denominator > type(denominator)(NEGLIGIBLE):
        return numerator / denominator
    return limit


@wp.func(inline=True)
def overlap(a: Any, b: Any):
    """Tell whether two slabs overlap; slabs that only touch do not."""
    return a.z > b.f and b.z > a.f


@wp.func(inline=True)
def series(a: Any, r: Any):
    """Return (1 - (1 - A)^r)/A for small A: the binomial series, to A^6."""
    one = type(a)(1.0)
    sum = type(a)(1.0)
    for i in range(6):
        k = type(a)(6 - i)
        sum = one + (k - r) / (k + one) * a * sum
    return r * sum


@wp.func(inline=True)
def series_gradient(a: Any, r: Any):
    """Return the derivatives of `series` in A and in r."""
    one = type(a)(1.0)
    sum = type(a)(1.0)
    by_a = type(a)(0.0)
    by_r = type(a)(0.0)
    for i in range(6):
        k = type(a)(6 - i)
        factor = (k - r) / (k + one)
        by_a = factor * (sum + a * by_a)
        by_r = a * (factor * by_r - sum / (k + one))
        sum = one + factor * a * sum
    return r * by_a, sum + r * by_r


@wp.func(inline=True)
def depth_per_opacity(a: Any, t: Any):
    """Return u/A, the optical depth -log(1 - A) per opacity; 1 where A = 0."""
    if a < type(a)(SERIES_OPACITY):
        sum = type(a)(0.0)
        for i in range(7):
            sum = type(a)(1.0) / type(a)(7 - i) + a * sum
        return sum
    return -wp.log(t) / a


@wp.func(inline=True)
def depth_per_opacity_gradient(a: Any, t: Any):
    """Return the derivatives of `depth_per_opacity` in A and in 1 - A."""
    if a < type(a)(SERIES_OPACITY):
        sum = type(a)(0.0)
        for i in range(6):
            sum = type(a)(6 - i) / type(a)(7 - i) + a * sum
        return sum, type(a)(0.0)
    return wp.log(t) / (a * a), type(a)(-1.0) / (t * a)
