"""Multi-layer alpha blending (Salvi and Vaidyanathan, I3D 2014).

A pixel keeps N nodes in order of depth, each with premultiplied colour and transmittance. A fragment is inserted by its
depth; if that makes N + 1, the last two are blended, whatever will still arrive between them:

    C_N = C_N + T_N C_{N+1},   T_N = T_N T_{N+1}          (the depth stays that of the nearer one)

The image is the over of the nodes. It depends on the order of submission, and is exact if what arrives once the nodes
are full lies behind all that are kept.
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
class MultiLayerOptions:
    """Number of nodes."""

    nodes: int


@kernels
def multi_layer_fwd(number: Any) -> Any:
    """Return the kernel."""
    vec3 = wp.types.vector(3, number)
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        rgba: wp.array(dtype=vec4),
        depth: wp.array(dtype=number),
        offsets: wp.array(dtype=int),
        node_count: int,
        node_depth: wp.array2d(dtype=number),
        node_color: wp.array2d(dtype=vec3),
        node_through: wp.array2d(dtype=number),
        image: wp.array(dtype=vec4),
    ):
        """Blend each pixel into its nodes.

        Args:
            span: pixels.
            rgba: colour and opacity of the fragments, (F,).
            depth: depth of the fragments [scene units], (F,).
            offsets: where each pixel's fragments begin, (P + 1,).
            node_count: most nodes N.
            node_depth: scratch memory: depths of the nodes, (threads, N + 1).
            node_color: scratch memory: their colours.
            node_through: scratch memory: their transmittances.
            image: output, (P,).
        """
        row = span.worker + wp.tid()
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            used = int(0)
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                slot = int(used)
                while slot > 0 and node_depth[row, slot - 1] > depth[fragment]:
                    node_depth[row, slot] = node_depth[row, slot - 1]
                    node_color[row, slot] = node_color[row, slot - 1]
                    node_through[row, slot] = node_through[row, slot - 1]
                    slot -= 1
                c = rgba[fragment]
                node_depth[row, slot] = depth[fragment]
                node_color[row, slot] = vec3(c[0], c[1], c[2])
                node_through[row, slot] = number(1.0) - c[3]
                used += 1
                if used > node_count:
                    last = used - 2
                    behind = node_color[row, last + 1]
                    node_color[row, last] = node_color[row, last] + node_through[row, last] * behind
                    node_through[row, last] = node_through[row, last] * node_through[row, last + 1]
                    used -= 1
            color = vec3()
            through = number(1.0)
            for slot in range(used):
                color += through * node_color[row, slot]
                through *= node_through[row, slot]
            image[pixel] = vec4(color[0], color[1], color[2], number(1.0) - through)

    return kernel


def _nodes(number: Any, options: MultiLayerOptions) -> Sequence[tuple[Any, int]]:
    length = options.nodes + 1
    return [(number, length), (wp.types.vector(3, number), length), (number, length)]


_MULTI_LAYER = sequential_operator("multi_layer_alpha_blending", multi_layer_fwd, _nodes, MultiLayerOptions)


def multi_layer_alpha_blending(fragments: Fragments, *, nodes: int = 4) -> Any:
    """Blend into a few nodes per pixel, the farthest of which takes what does not fit (Salvi and Vaidyanathan 2014).

    Its opacity is exact. Not differentiable.

    Args:
        fragments: what to blend; their order is that of submission.
        nodes: number N of nodes, at least 1.

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4), in the kind and precision of the fragments.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: values are not finite or out of range.
    """
    nodes = check_whole("nodes", nodes, 1)
    exact_image(fragments)
    return blend(_MULTI_LAYER, fragments, MultiLayerOptions(nodes))
