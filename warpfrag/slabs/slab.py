"""The slab: a fragment with its z-thickness, and what is computed from one slab alone.

Transmittance multiplies and its logarithm adds however slabs are merged, so both are carried along and never computed
from a rounded opacity: that keeps opaque slabs exact and costs one logarithm per fragment.

Functions of slabs are generic over both precisions: `type(a)(…)` is a slab, or a number, of the precision of `a`.
"""

import math
from typing import Any

import warp as wp

from warpfrag.arrays.precisions import Number, Vector3, in_precisions

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
# A slab thinner than this, in units of its depth, is a surface: it could not be told from one. So is one whose length
# has no reciprocal in single precision.
THIN = wp.constant(1.0e-15)
THINNEST = wp.constant(1.0e-36)
# The weight of a slab can triple whenever it is divided (all three parts of an opaque slab are opaque). Above this
# limit no other slab has a say in a mix: there it stays, with no derivative, before it overflows.
WEIGHT_LIMIT = wp.constant(1.0e12)
# What a gradient counts as that is beyond the numbers of its precision, as one in a thickness of 1e-36 or an opacity of
# 1e-24 may be: so large that sums of some, and their products with ordinary numbers, stay finite.
LARGEST_GRADIENT = wp.constant(1.0e30)


@in_precisions
class Slab:
    """A slab, or the gradient in one.

    `color` is premultiplied; `transmittance` is 1 - `opacity`, `log_transmittance` its logarithm; `weight` is S/A, the
    opacity sum per opacity: 1 for a fresh fragment; it reaches from the depth back - `thickness` to `back`. Fronts are
    never formed: their differences would have lost the digits of thin slabs far away, those of backs have not. Adjoints
    take opacity, transmittance and its logarithm as independent: the sum of the three is the derivative in opacity.
    """

    color: Vector3
    opacity: Number
    transmittance: Number
    log_transmittance: Number
    weight: Number
    thickness: Number
    back: Number


@wp.func(inline=True)
def log_transmittance(opacity: Any):
    """Return log(1 - A), or `LOG_OPAQUE` for an opaque slab."""
    transmittance = type(opacity)(1.0) - opacity
    if transmittance <= type(opacity)(0.0):
        return type(opacity)(LOG_OPAQUE)
    return wp.log(transmittance)


@wp.func(inline=True)
def divide(numerator: Any, denominator: Any, limit: Any):
    """Return the quotient, or its limit where both vanish."""
    if denominator > type(denominator)(NEGLIGIBLE):
        return numerator / denominator
    return limit


@wp.func(inline=True)
def overlap(a: Any, b: Any):
    """Tell whether two slabs overlap; slabs that only touch do not."""
    between = b.back - a.back
    return b.thickness > between and a.thickness > -between


@wp.func(inline=True)
def begins_first(a: Any, b: Any):
    """Tell whether slab a begins in front of slab b; one that begins where the other does, does not."""
    return a.thickness > b.thickness - (b.back - a.back)


@wp.func(inline=True)
def finite(gradient: Any):
    """Return a gradient; in place of an infinite one the largest, in place of one whose terms cancel there none."""
    if wp.isfinite(gradient):
        return gradient
    if gradient > type(gradient)(0.0):
        return type(gradient)(LARGEST_GRADIENT)
    if gradient < type(gradient)(0.0):
        return -type(gradient)(LARGEST_GRADIENT)
    return type(gradient)(0.0)
