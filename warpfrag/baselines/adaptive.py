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
from dataclasses import dataclass
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span
from warpfrag.arrays.precisions import kernels
from warpfrag.baselines.inputs import exact_image
from warpfrag.baselines.sequential import blend, sequential_operator
from warpfrag.errors import check_whole
from warpfrag.fragments import Fragments

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class AdaptiveOptions:
    """Number of nodes, and the first that may be removed."""

    nodes: int
    first_removed: int


@kernels
def adaptive_fwd(number: Any) -> Any:
    """Return the kernel."""
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        rgba: wp.array(dtype=vec4),
        depth: wp.array(dtype=number),
        offsets: wp.array(dtype=int),
        node_count: int,
        first_removed: int,
        node_depth: wp.array2d(dtype=number),
        node_through: wp.array2d(dtype=number),
        image: wp.array(dtype=vec4),
    ):
        """Compress the visibility of each pixel, then blend by it.

        Args:
            span: pixels.
            rgba: colour and opacity of the fragments, (F,).
            depth: depth of the fragments [scene units], (F,).
            offsets: where each pixel's fragments begin, (P + 1,).
            node_count: most nodes N.
            first_removed: first node that may be removed.
            node_depth: scratch memory: depths of the nodes, (threads, N + 1).
            node_through: scratch memory: what is visible behind them, (threads, N + 1).
            image: output, (P,).
        """
        row = span.worker + wp.tid()
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            used = int(0)
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                passed = number(1.0) - rgba[fragment][3]
                slot = int(used)
                while slot > 0 and node_depth[row, slot - 1] >= depth[fragment]:
                    node_depth[row, slot] = node_depth[row, slot - 1]
                    node_through[row, slot] = node_through[row, slot - 1] * passed
                    slot -= 1
                before = number(1.0)
                if slot > 0:
                    before = node_through[row, slot - 1]
                node_depth[row, slot] = depth[fragment]
                node_through[row, slot] = before * passed
                used += 1
                if used > node_count:
                    removed = int(first_removed)
                    least = number(wp.inf)
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
                visible = number(1.0)
                for k in range(used):
                    if node_depth[row, k] < depth[fragment]:
                        visible = node_through[row, k]
                color += visible * rgba[fragment]
            opacity = number(0.0)
            if used > 0:
                opacity = number(1.0) - node_through[row, used - 1]
            image[pixel] = vec4(color[0], color[1], color[2], opacity)

    return kernel


def _nodes(number: Any, options: AdaptiveOptions) -> Sequence[tuple[Any, int]]:
    return [(number, options.nodes + 1), (number, options.nodes + 1)]


_ADAPTIVE = sequential_operator("adaptive_transparency", adaptive_fwd, _nodes, AdaptiveOptions)


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
    return blend(_ADAPTIVE, fragments, AdaptiveOptions(nodes, max(1, nodes // 2) if keep_near else 1))
