"""What resolving and compositing fragments take: options and beta, checked, and the operators' inputs made of them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.kinds import dtype_name, kind_of
from warpfrag.arrays.operators import Input
from warpfrag.errors import check_choice, check_number, check_whole
from warpfrag.fragments import FRAGMENT_INPUTS, fragment_inputs
from warpfrag.scene.names import MERGES, MIXES

# Most layers: Warp counts in 32 bits.
MOST_LAYERS = 2**31 - 1

# Inputs of the operators that resolve fragments; B is 1, or the number of pixels or fragments.
MERGE_INPUTS = (*FRAGMENT_INPUTS, Input("beta", "B", gradient=True))


@dataclass(frozen=True)
class MergeOptions:
    """How fragments merge; see `resolve`."""

    max_layers: int
    merge: str
    mix: str

    def sizes(self) -> dict[str, int]:
        """Return the number of layers."""
        return {"M": self.max_layers}


def check_options(merge: Any, mix: Any, max_layers: Any) -> MergeOptions:
    """Return the options; raise for a merge, mix or number of layers that does not exist."""
    check_choice("merge", merge, MERGES)
    check_choice("mix", mix, MIXES)
    if merge == "exact" and mix == "average":
        raise ValueError(
            'mix: got "average" with merge "exact", expected "opacity" or "optical_depth" (averages of three parts '
            "depend on their order)"
        )
    return MergeOptions(check_whole("max_layers", max_layers, 1, MOST_LAYERS), merge, mix)


def merge_inputs(fragments: Any, beta: Any, *, dimensions: int, by_fragment: bool = False) -> dict[str, Any]:
    """Return `MERGE_INPUTS`, for outputs of so many dimensions beside those of the grid.

    With `by_fragment` beta may also be one value per fragment.
    """
    inputs = fragment_inputs(fragments, dimensions=dimensions)
    count = fragments.count if by_fragment else None
    return {**inputs, "beta": beta_array(beta, fragments.rgba, fragments.shape, count)}


def beta_array(beta: Any, like: Any, shape: tuple[int, ...], fragment_count: int | None = None) -> Any:
    """Return beta as an array of one entry, one per pixel, or one per fragment if that is allowed (has a count).

    It is of the kind and precision of `like`.
    """
    kind, own = kind_of(like), kind_of(beta)
    assert kind is not None
    if own is None:
        return kind.asarray([check_number("beta", beta, 0.0, 1.0)], like)
    if own is not kind:
        raise TypeError(f"beta: got a {own.name} array, expected a {kind.name} array like the fragments, or a number")
    if dtype_name(beta) != dtype_name(like):
        raise TypeError(f"beta: got dtype {dtype_name(beta)}, expected {dtype_name(like)} like the fragments")
    if kind.device_of(beta) != kind.device_of(like):
        raise ValueError(f"beta: got it on {beta.device}, expected {like.device} like the fragments")
    shapes = [(), tuple(shape)] + ([] if fragment_count is None else [(fragment_count,)])
    if tuple(beta.shape) not in ((1,), *shapes):
        expected = " or ".join(map(str, shapes))
        hint = "" if fragment_count is not None else '; one per fragment goes with merge "exact"'
        raise ValueError(f"beta: got shape {tuple(beta.shape)}, expected {expected}{hint}")
    return beta.reshape((math.prod(beta.shape),))


def sum_beta(grad_pixels: wp.array, grad_beta: wp.array) -> None:
    """Write the gradient of beta, given that of each pixel; the sum's order does not depend on threads."""
    if grad_beta.shape == grad_pixels.shape:
        wp.copy(grad_beta, grad_pixels)
    elif grad_beta.device.is_cpu:
        grad_beta.numpy()[0] = grad_pixels.numpy().sum(dtype=np.float64)
    else:
        wp.utils.array_sum(grad_pixels, out=grad_beta)
