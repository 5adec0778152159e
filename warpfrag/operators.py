"""The formulas: slabs, and how two of them become one. Straight-line functions, so that Warp differentiates them.

A slab is a fragment with its z-thickness: premultiplied colour `c`, opacity `a`, transmittance `t = 1 - a`, logarithm of
it `l`, weight `w = S/A` (the opacity sum per opacity: 1 for a fresh fragment), front depth `f`, back depth `z`.
Transmittance multiplies and its logarithm adds however slabs are merged, so both are carried along and never computed
from a rounded opacity: that keeps opaque slabs exact and costs one logarithm per fragment.

All functions are generic over `Slab32` and `Slab64`. Equation numbers are those of the fragment-merging paper.
"""

import math
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

MIX_OPACITY = wp.constant(0)
MIX_AVERAGE = wp.constant(1)
MIX_OPTICAL_DEPTH = wp.constant(2)

# The optical depth of an opaque slab is cut at 13.8 (transmittance 1e-6): the derivatives of its parts stay finite.
LOG_FLOOR = math.log(1.0e-6)
# The logarithm of no transmittance, and the floor under optical-depth mixing: there an opaque slab is opaque from its
# front on, as in deep images. Sums of it stay finite in single precision.
LOG_OPAQUE = wp.constant(-1.0e30)
# Below this opacity (1 - T^r)/A is summed as a series: the quotient would lose half of the digits of its derivative.
SERIES_OPACITY = wp.constant(0.02)


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


@wp.func
def slab(c: wp.vec3f, a: float, t: float, l: float, w: float, f: float, z: float) -> Slab32:  # noqa: E741
    s = Slab32()
    s.c = c
    s.a = a
    s.t = t
    s.l = l
    s.w = w
    s.f = f
    s.z = z
    return s


@wp.func
def slab(  # noqa: F811
    c: wp.vec3d,
    a: wp.float64,
    t: wp.float64,
    l: wp.float64,  # noqa: E741
    w: wp.float64,
    f: wp.float64,
    z: wp.float64,
) -> Slab64:
    s = Slab64()
    s.c = c
    s.a = a
    s.t = t
    s.l = l
    s.w = w
    s.f = f
    s.z = z
    return s


@wp.func
def log_transmittance(a: Any):
    """Return log(1 - A), or `LOG_OPAQUE` for an opaque slab."""
    t = type(a)(1.0) - a
    if t <= type(a)(0.0):
        return type(a)(LOG_OPAQUE)
    return wp.log(t)


@wp.func
def divide(numerator: Any, denominator: Any, limit: Any):
    """Return the quotient, or its limit where both vanish."""
    if denominator > type(denominator)(0.0):
        return numerator / denominator
    return limit


@wp.func
def overlap(a: Any, b: Any):
    """Tell whether two slabs overlap; slabs that only touch do not."""
    return a.z > b.f and b.z > a.f


@wp.func
def power(s: Any, r: Any, floor: Any):
    """Return T^r, what the front part of relative length r lets through in the optical model (eq. 2)."""
    if r <= type(r)(0.0):
        return type(r)(1.0)
    if r >= type(r)(1.0) and s.l < floor:
        return s.t
    return wp.exp(r * wp.max(s.l, floor))


@wp.func
def series(a: Any, r: Any):
    """Return (1 - (1 - A)^r)/A for small A: the binomial series, to A^6."""
    one = type(a)(1.0)
    sum = one + (type(a)(6.0) - r) * a / type(a)(7.0)
    sum = one + (type(a)(5.0) - r) * a / type(a)(6.0) * sum
    sum = one + (type(a)(4.0) - r) * a / type(a)(5.0) * sum
    sum = one + (type(a)(3.0) - r) * a / type(a)(4.0) * sum
    sum = one + (type(a)(2.0) - r) * a / type(a)(3.0) * sum
    sum = one + (one - r) * a / type(a)(2.0) * sum
    return r * sum


@wp.func
def optical_gain(s: Any, r0: Any, r1: Any, power0: Any, power1: Any):
    """Return (A(r1) - A(r0))/A in the optical model; power0 and power1 are T^r0 and T^r1."""
    if s.a < type(r0)(SERIES_OPACITY):
        return series(s.a, r1) - series(s.a, r0)
    return (power0 - power1) / s.a


@wp.func
def mix_color(c1: Any, a1: Any, t1: Any, w1: Any, c2: Any, a2: Any, t2: Any, w2: Any, mix: int):
    """Return the colour of two mixed parts (eq. 6-8; zSlab eq. 4.1-4.4); t1 and t2 are 1 - a1 and 1 - a2."""
    one = type(a1)(1.0)
    if mix == MIX_AVERAGE:
        return c1 + c2 - (c1 * a2 + c2 * a1) * type(a1)(0.5)
    a = a1 + a2 * t1
    if mix == MIX_OPTICAL_DEPTH:
        # Opaque parts win; two of them are averaged.
        if t1 <= type(a1)(0.0) and t2 <= type(a1)(0.0):
            return (c1 + c2) * type(a1)(0.5)
        if t1 <= type(a1)(0.0):
            return c1
        if t2 <= type(a1)(0.0):
            return c2
        v1 = depth_per_opacity(a1, t1)
        v2 = depth_per_opacity(a2, t2)
        return (c1 * v1 + c2 * v2) * divide(a, a1 * v1 + a2 * v2, one)
    return (c1 * w1 + c2 * w2) * divide(a, a1 * w1 + a2 * w2, one)


@wp.func
def depth_per_opacity(a: Any, t: Any):
    """Return u/A, the optical depth -log(1 - A) per opacity; 1 where A = 0."""
    if a < type(a)(SERIES_OPACITY):
        one = type(a)(1.0)
        sum = one / type(a)(7.0)
        sum = one / type(a)(6.0) + a * sum
        sum = one / type(a)(5.0) + a * sum
        sum = one / type(a)(4.0) + a * sum
        sum = one / type(a)(3.0) + a * sum
        sum = one / type(a)(2.0) + a * sum
        return one + a * sum
    return -wp.log(t) / a


@wp.func
def over(a: Any, b: Any):
    """Return slab a over slab b; the slab reaches from a's front to b's back (Algorithm 1, tail handling)."""
    opacity = a.a + a.t * b.a
    weight = divide(a.a * a.w + b.a * b.w, opacity, type(opacity)(1.0))
    return slab(a.c + a.t * b.c, opacity, a.t * b.t, a.l + b.l, weight, a.f, b.z)


@wp.func
def ofm(a: Any, b: Any, mix: int):
    """Return the order-independent merging of two slabs (section 3.2.2): they are mixed whole."""
    opacity = a.a + a.t * b.a
    weight = divide(a.a * a.w + b.a * b.w, opacity, type(opacity)(1.0))
    c = mix_color(a.c, a.a, a.t, a.w, b.c, b.a, b.t, b.w, mix)
    return slab(c, opacity, a.t * b.t, a.l + b.l, weight, wp.min(a.f, b.f), wp.max(a.z, b.z))


@wp.func
def sfm(a: Any, b: Any, beta: Any, mix: int, floor: Any):
    """Return the smooth merging of two overlapping slabs, a.z <= b.z (section 3.2.1, eq. 4-5).

    The three pieces are one slab's front part alone (`0`), the mix of the rest of a with as much of b (`1`), and the
    rest of b (`2`). A part's colour and opacity are its share (`gain`) of the slab's, divided by the transmittance
    `before` of the slab up to it; over multiplies by that again, so the front and last pieces need no division.
    """
    one = type(beta)(1.0)
    zero = type(beta)(0.0)
    optical = one - beta
    inner = wp.max(a.f, b.f)
    # Relative lengths: a = [a0 | a1], b = [b0 | b1 | b2]; a0 = 0 or b0 = 0. A slab without thickness is not divided.
    a0 = zero
    a1 = one
    if a.z > a.f:
        a0 = (inner - a.f) / (a.z - a.f)
        a1 = (a.z - inner) / (a.z - a.f)
    b0 = (inner - b.f) / (b.z - b.f)
    b1 = (a.z - inner) / (b.z - b.f)
    b2 = (b.z - a.z) / (b.z - b.f)
    power_a = power(a, a0, floor)
    power_b0 = power(b, b0, floor)
    power_b1 = power(b, one - b2, floor)
    gain_a0 = beta * a0 + optical * optical_gain(a, zero, a0, one, power_a)
    gain_a1 = beta * a1 + optical * optical_gain(a, a0, one, power_a, a.t)
    gain_b0 = beta * b0 + optical * optical_gain(b, zero, b0, one, power_b0)
    gain_b1 = beta * b1 + optical * optical_gain(b, b0, one - b2, power_b0, power_b1)
    gain_b2 = beta * b2 + optical * optical_gain(b, one - b2, one, power_b1, b.t)
    before_a = beta * (a1 + a0 * a.t) + optical * power_a
    before_b1 = beta * (b1 + b2 + b0 * b.t) + optical * power_b0
    before_b2 = beta * (b2 + (one - b2) * b.t) + optical * power_b1
    part_a = divide(gain_a1, before_a, one)
    part_b = divide(gain_b1, before_b1, wp.where(b1 > zero, one, zero))
    rest_b = divide(gain_b2, before_b2, wp.where(b2 > zero, one, zero))
    mixed = mix_color(
        a.c * part_a,
        a.a * part_a,
        divide(a.t, before_a, zero),
        a.w,
        b.c * part_b,
        b.a * part_b,
        divide(before_b2, before_b1, wp.where(b1 > zero, zero, one)),
        b.w,
        mix,
    )
    c = a.c * gain_a0 + b.c * gain_b0 + before_a * before_b1 * mixed + a.t * gain_b2 * b.c
    opacity = a.a + a.t * b.a
    sum = a.a * a.w * (gain_a0 + part_a) + b.a * b.w * (gain_b0 + part_b + rest_b)
    weight = divide(sum, opacity, one)
    return slab(c, opacity, a.t * b.t, a.l + b.l, weight, wp.min(a.f, b.f), b.z)
