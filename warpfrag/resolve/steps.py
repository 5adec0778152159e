"""The steps of the resolve pass (fragment merging, Algorithm 1), and their adjoints.

A step either starts a new layer, merges the next slab into the running one, or adds it to the tail. Which of the three
happens is a discrete choice: the adjoint holds it fixed. Merge and mix are constants of a kernel, and as every function
here is inlined, the compiler drops the branches that are not taken.
"""

from typing import Any

import warp as wp

from warpfrag.slabs.merge import ofm, ofm_adjoint, sfm, sfm_adjoint
from warpfrag.slabs.over import over, over_adjoint
from warpfrag.slabs.part import sfm_powers
from warpfrag.slabs.slab import overlap

wp.set_module_options({"enable_backward": False})

MERGE_NONE = wp.constant(0)
MERGE_SMOOTH = wp.constant(1)
MERGE_ORDER_INDEPENDENT = wp.constant(2)

STEP_START = wp.constant(0)
STEP_MERGE = wp.constant(1)
STEP_TAIL = wp.constant(2)


@wp.func(inline=True)
def choose_step(running: Any, following: Any, layer: int, max_layers: int, merge: int):
    """Return what happens to the slab that follows the running one, which is to become layer number `layer`."""
    if merge != MERGE_NONE and overlap(running, following):
        return STEP_MERGE
    if layer < max_layers - 1:
        return STEP_START
    return STEP_TAIL


@wp.func(inline=True)
def step_powers(step: int, a: Any, b: Any, merge: int, floor: Any):
    """Return the `sfm_powers` of a step; they mean nothing where it does not merge smoothly."""
    one = type(floor)(1.0)
    if step == STEP_MERGE and merge == MERGE_SMOOTH:
        return sfm_powers(a, b, floor)
    return one, one


@wp.func(inline=True)
def take_step(step: int, a: Any, b: Any, beta: Any, through_front: Any, through_back: Any, merge: int, mix: int):
    """Return the running slab after a step that is not a start, given its `step_powers`."""
    if step == STEP_TAIL:
        return over(a, b)
    if merge == MERGE_SMOOTH:
        return sfm(a, b, beta, mix, through_front, through_back)
    return ofm(a, b, mix)


@wp.func(inline=True)
def take_step_adjoint(
    step: int,
    g: Any,
    a: Any,
    b: Any,
    beta: Any,
    through_front: Any,
    through_back: Any,
    merge: int,
    mix: int,
    floor: Any,
):
    """Return the gradients in a, b and beta of <g, take_step(...)>."""
    if step == STEP_MERGE and merge == MERGE_SMOOTH:
        return sfm_adjoint(g, a, b, beta, mix, floor, through_front, through_back)
    if step == STEP_MERGE:
        ofm_a, ofm_b = ofm_adjoint(g, a, b, mix)
        return ofm_a, ofm_b, type(beta)(0.0)
    over_a, over_b = over_adjoint(g, a, b)
    return over_a, over_b, type(beta)(0.0)
