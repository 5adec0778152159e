"""Hybrid transparency: an exact core and an averaged tail (Maule, Comba, Torchelsen and Bastos, I3D 2013).

The K nearest fragments of a pixel are composited exactly. The others, in whatever order, are averaged by opacity:

    C = C_core + T_core A_tail sum_i C_i / sum_i A_i       (sums over the n fragments of the tail; C_i premultiplied)
    A = 1 - T_core (1 - A_tail)

    "average" (the paper's):  A_tail = 1 - (1 - sum_i A_i / n)^n
    "product" (exact):        A_tail = 1 - prod_i (1 - A_i)

The tail's n fragments count as n of equal opacity in the first. The image is exact if the core holds all fragments.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import warp as wp

from warpfrag.arrays.launch import Span
from warpfrag.arrays.precisions import kernels
from warpfrag.baselines.inputs import exact_image
from warpfrag.baselines.sequential import blend, sequential_operator
from warpfrag.errors import check_choice, check_whole
from warpfrag.fragments import Fragments

wp.set_module_options({"enable_backward": False})

TailOpacity = Literal["average", "product"]


@dataclass(frozen=True)
class HybridOptions:
    """Number of core fragments, and whether the tail's opacity is the product."""

    core: int
    product: bool


@kernels
def hybrid_fwd(number: Any) -> Any:
    """Return the kernel."""
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        rgba: wp.array(dtype=vec4),
        depth: wp.array(dtype=number),
        offsets: wp.array(dtype=int),
        core_count: int,
        product: bool,
        core: wp.array2d(dtype=int),
        image: wp.array(dtype=vec4),
    ):
        """Composite the nearest fragments of each pixel, and average the others.

        Args:
            span: pixels.
            rgba: colour and opacity of the fragments, (F,).
            depth: depth of the fragments [scene units], (F,).
            offsets: where each pixel's fragments begin, (P + 1,).
            core_count: number of core fragments K.
            product: whether the tail's opacity is the product.
            core: scratch memory: the nearest fragments, (threads, K + 1).
            image: output, (P,).
        """
        row = span.worker + wp.tid()
        one = number(1.0)
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            used = int(0)
            tail = vec4()
            tail_count = number(0.0)
            tail_through = number(1.0)
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                slot = int(used)
                while slot > 0 and depth[core[row, slot - 1]] > depth[fragment]:
                    core[row, slot] = core[row, slot - 1]
                    slot -= 1
                core[row, slot] = fragment
                used += 1
                if used > core_count:
                    used -= 1
                    farthest = rgba[core[row, used]]
                    tail += farthest
                    tail_count += one
                    tail_through *= one - farthest[3]
            color = vec4()
            through = number(1.0)
            for slot in range(used):
                color += through * rgba[core[row, slot]]
                through *= one - rgba[core[row, slot]][3]
            opacity = one - tail_through
            if not product and tail_count > number(0.0):
                opacity = one - wp.pow(one - tail[3] / tail_count, tail_count)
            # As all opacities go to 0, so does the tail's, at the same pace.
            scale = one
            if tail[3] > number(0.0):
                scale = opacity / tail[3]
            color += (through * scale) * tail
            image[pixel] = vec4(color[0], color[1], color[2], one - through * (one - opacity))

    return kernel


def _nodes(number: Any, options: HybridOptions) -> Sequence[tuple[Any, int]]:
    return [(wp.int32, options.core + 1)]


_HYBRID = sequential_operator("hybrid_transparency", hybrid_fwd, _nodes, HybridOptions)


def hybrid_transparency(fragments: Fragments, *, core: int = 4, tail_opacity: TailOpacity = "average") -> Any:
    """Composite the nearest fragments exactly and average the others (Maule et al. 2013).

    Does not depend on the order of submission, but for fragments of equal depth. Not differentiable.

    Args:
        fragments: what to blend, in any order.
        core: number K of fragments that are composited exactly; 0 averages all (Bavoil and Myers 2008).
        tail_opacity: opacity of what is averaged, "average" as in the paper or "product", which is exact.

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4), in the kind and precision of the fragments.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an option does not exist, or values are not finite or out of range.
    """
    core = check_whole("core", core, 0)
    check_choice("tail_opacity", tail_opacity, get_args(TailOpacity))
    exact_image(fragments)
    return blend(_HYBRID, fragments, HybridOptions(core, tail_opacity == "product"))
