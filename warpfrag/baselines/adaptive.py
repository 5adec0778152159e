"""Adaptive transparency (Salvi, Montgomery and Lefohn, HPG 2011).

The visibility along a pixel's ray, v(z) = prod_{z_j < z} (1 - A_j), is kept as a step function with N nodes: depths d_k
and what is visible behind them, t_k. A fragment inserts a node and scales those behind it:

    t_new = t_{k-1} (1 - A),   t_k <- t_k (1 - A) for all d_k >= z

If that makes N + 1, the node r goes whose removal changes the area under the curve least, and the step before it takes
over its drop, so that the curve only ever gets lower:

    r = argmin_{k >= 1} (d_k - d_{k-1}) (t_{k-1} - t_k),   t_{r-1} <- t_r

A second pass blends, C = sum_i C_i v(z_i). The image is exact if no node had to go and no depths coincide.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span
from warpfrag.baselines.inputs import check_whole, exact_image
from warpfrag.baselines.stream import stream, stream_operator
from warpfrag.fragments import Fragments

wp.set_module_options({"enable_backward": False})


@cache
def _kernel(scalar: Any) -> wp.Kernel:
    vec4 = wp.types.vector(4, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def adaptive_fwd(
        span: Span,
        rgba: wp.array(dtype=vec4),
        depth: wp.array(dtype=scalar),
        offsets: wp.array(dtype=int),
        exact: wp.array(dtype=vec4),
        node_count: int,
        first_removed: int,
        node_depth: wp.array2d(dtype=scalar),
        node_through: wp.array2d(dtype=scalar),
        image: wp.array(dtype=vec4),
    ):
        row = span.worker + wp.tid()
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            used = int(0)
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                passed = scalar(1.0) - rgba[fragment][3]
                slot = int(used)
                while slot > 0 and node_depth[row, slot - 1] >= depth[fragment]:
                    node_depth[row, slot] = node_depth[row, slot - 1]
                    node_through[row, slot] = node_through[row, slot - 1] * passed
                    slot -= 1
                before = scalar(1.0)
                if slot > 0:
                    before = node_through[row, slot - 1]
                node_depth[row, slot] = depth[fragment]
                node_through[row, slot] = before * passed
                used += 1
                if used > node_count:
                    removed = int(first_removed)
                    least = scalar(wp.inf)
                    for k in range(first_removed, used):
                        drop = node_through[row, k - 1] - node_through[row, k]
                        area = (node_depth[row, k] - node_depth[row, k - 1]) * drop
                        if area < least:
                            least = area
                            removed = k
                    node_through[row, removed - 1] = node_through[row, removed]
                    for k in range(removed, used - 1):
                        node_depth[row, k] = node_depth[row, k + 1]
                        node_through[row, k] = node_through[row, k + 1]
                    used -= 1
            color = vec4()
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                visible = scalar(1.0)
                for k in range(used):
                    if node_depth[row, k] < depth[fragment]:
                        visible = node_through[row, k]
                color += visible * rgba[fragment]
            opacity = scalar(0.0)
            if used > 0:
                opacity = scalar(1.0) - node_through[row, used - 1]
            image[pixel] = vec4(color[0], color[1], color[2], opacity)

    return adaptive_fwd


def _nodes(scalar: Any, nodes: int, first_removed: int) -> Sequence[tuple[Any, int]]:
    return [(scalar, nodes + 1), (scalar, nodes + 1)]


_ADAPTIVE = stream_operator("adaptive_transparency", _kernel, _nodes, {"nodes": "int", "first_removed": "int"})


def adaptive_transparency(fragments: Fragments, *, nodes: int = 8, keep_near: bool = False) -> Any:
    """Blend with a visibility function of few steps, compressed as fragments arrive (Salvi et al. 2011).

    Its opacity is exact, its visibility never too high. Not differentiable.

    Args:
        fragments: what to blend; their order is that of submission.
        nodes: number N of nodes of the visibility function, at least 1.
        keep_near: remove only nodes of the farther half.

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4), in the kind and precision of the fragments.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: values are not finite or out of range.
    """
    nodes = check_whole("nodes", nodes, 1)
    exact_image(fragments)
    return stream(_ADAPTIVE, fragments, nodes=nodes, first_removed=max(1, nodes // 2) if keep_near else 1)
