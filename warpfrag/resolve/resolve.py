"""The resolve pass: N fragments of a pixel become at most M layers (fragment merging, Algorithm 1)."""

from types import SimpleNamespace
from typing import Any

from warpfrag.arrays.apply import apply
from warpfrag.arrays.operators import Operator
from warpfrag.fragments import LAYER_OUTPUTS, Fragments, Layers, as_layers
from warpfrag.resolve.exact.exact import RESOLVE_EXACT, exact_inputs
from warpfrag.resolve.options import MERGE_INPUTS, MergeOptions, check_options, merge_inputs
from warpfrag.resolve.sinks import LAYERS
from warpfrag.resolve.walk import ingredients, resolve_bwd, resolve_fwd, walk_backward, walk_forward
from warpfrag.scene.names import Merge, Mix


def _forward(inputs: SimpleNamespace, outputs: SimpleNamespace, options: MergeOptions) -> None:
    kernel = resolve_fwd(*ingredients(inputs, options), LAYERS)
    walk_forward(kernel, inputs, options, LAYERS.fill(outputs, inputs.rgba.dtype))


def _backward(inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, options: MergeOptions) -> None:
    kernel = resolve_bwd(*ingredients(inputs, options), LAYERS)
    walk_backward(kernel, inputs, options, LAYERS.fill(grads, inputs.rgba.dtype), targets)


RESOLVE = Operator("resolve", MERGE_INPUTS, LAYER_OUTPUTS, _forward, _backward, MergeOptions)


def resolve(
    fragments: Fragments,
    beta: Any = 1.0,
    max_layers: int = 8,
    merge: Merge = "smooth",
    mix: Mix = "opacity",
) -> Layers:
    """Merge the fragments of every pixel into at most `max_layers` layers (fragment merging, Algorithm 1).

    Differentiable in the fragments' colour, opacity, depth, thickness and opacity sum, and in beta; which fragments
    merge, their order, and what falls into the tail are held fixed.

    Args:
        fragments: what to merge, in any order.
        beta: how a slab fills up from its front to its back (eq. 4): 0 optically (exponential), 1 linearly. A number
            from 0 to 1, a 0-d array, or one value per pixel; with "exact" also one per fragment, (F,).
        max_layers: largest number M of layers per pixel; what does not fit is composited into the last.
        merge: "smooth" subdivides overlapping slabs one after the other (SFM); "exact" subdivides all at once, which is
            symmetric in the fragments and continuous in depth and thickness; "order_independent" mixes overlapping
            slabs whole (OFM); "none" keeps every fragment by itself.
        mix: weights of the colours of mixed parts: "opacity" (fragment merging, eq. 8), "average" (zSlab eq. 4.4) or
            "optical_depth" (as deep images are flattened). "average" does not go with "exact".

    Returns:
        The layers, in the kind and precision of the fragments' arrays.

    Raises:
        TypeError: an argument is of the wrong type, or beta of another kind or precision than the fragments.
        ValueError: an option does not exist, or values are not finite or out of range.

    Example:
        >>> fragments = wf.capture(wf.load_scene("scenes/three_spheres.toml"))
        >>> wf.resolve(fragments, beta=0.5, max_layers=4).depth.shape
        (512, 512, 4)
    """
    options = check_options(merge, mix, max_layers)
    if merge == "exact":
        outputs = apply(RESOLVE_EXACT, *exact_inputs(fragments, beta, options, dimensions=2))
    else:
        outputs = apply(RESOLVE, merge_inputs(fragments, beta, dimensions=2), options)
    return as_layers(outputs, fragments.shape)
