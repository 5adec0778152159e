"""Multi-layer alpha blending (Salvi and Vaidyanathan, I3D 2014).

A pixel keeps N nodes in order of depth, each with premultiplied colour and transmittance. A fragment is inserted by its
depth; if that makes N + 1, the last two are blended, whatever will still arrive between them:

    C_N = C_N + T_N C_{N+1},   T_N = T_N T_{N+1}          (the depth stays that of the nearer one)

The image is the over of the nodes. It depends on the order of submission, and is exact if what arrives once the nodes
are full lies behind all that are kept.
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
    vec3 = wp.types.vector(3, scalar)
    vec4 = wp.types.vector(4, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def multi_layer_fwd(
        span: Span,
        rgba: wp.array(dtype=vec4),
        depth: wp.array(dtype=scalar),
        offsets: wp.array(dtype=int),
        exact: wp.array(dtype=vec4),
        node_count: int,
        node_depth: wp.array2d(dtype=scalar),
        node_color: wp.array2d(dtype=vec3),
        node_through: wp.array2d(dtype=scalar),
        image: wp.array(dtype=vec4),
    ):
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
                node_through[row, slot] = scalar(1.0) - c[3]
                used += 1
                if used > node_count:
                    last = used - 2
                    behind = node_color[row, last + 1]
                    node_color[row, last] = node_color[row, last] + node_through[row, last] * behind
                    node_through[row, last] = node_through[row, last] * node_through[row, last + 1]
                    used -= 1
            color = vec3()
            through = scalar(1.0)
            for slot in range(used):
                color += through * node_color[row, slot]
                through *= node_through[row, slot]
            image[pixel] = vec4(color[0], color[1], color[2], scalar(1.0) - through)

    return multi_layer_fwd


def _nodes(scalar: Any, nodes: int) -> Sequence[tuple[Any, int]]:
    return [(scalar, nodes + 1), (wp.types.vector(3, scalar), nodes + 1), (scalar, nodes + 1)]


_MULTI_LAYER = stream_operator("multi_layer_alpha_blending", _kernel, _nodes, {"nodes": "int"})


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
    return stream(_MULTI_LAYER, fragments, nodes=nodes)
