"""Moving fragments: the operator that gathers them from up to four lists by an index.

On the way back each fragment takes the gradient of where it went, and none where it went nowhere. Differentiable in
`rgba`, `depth`, `thickness` and `opacity_sum`; which fragment goes where is held fixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.apply import apply
from warpfrag.arrays.kinds import as_vectors, kind_named
from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.operators import Input, Operator, Output
from warpfrag.arrays.precisions import Array, Number, Vector4, in_precisions, kernels
from warpfrag.fragments import Fragments

wp.set_module_options({"enable_backward": False})

IDS = ("object_id", "primitive_id")
BY_FRAGMENT = ("rgba", "depth", "thickness", "opacity_sum", *IDS)
# What the names of each list's arrays begin with. Four at once: putting images together by twos would take two passes.
LISTS = ("", "second_", "third_", "fourth_")
MOST_LISTS = len(LISTS)


@in_precisions
class FragmentValues:
    """What fragments are made of, as in `Fragments`; what is not there is empty."""

    rgba: Array[Vector4]
    depth: Array[Number]
    thickness: Array[Number]
    opacity_sum: Array[Number]
    object_id: Array[wp.int32]
    primitive_id: Array[wp.int32]


@dataclass(frozen=True)
class GatherOptions:
    """How many opacity sums, object ids and primitive ids are gathered: as many as fragments, or none."""

    sum_count: int
    object_count: int
    primitive_count: int

    def sizes(self) -> dict[str, int]:
        """Return these numbers, as shapes name them."""
        return {"S": self.sum_count, "O": self.object_count, "Q": self.primitive_count}


@wp.func(inline=True)
def copy_fragment(source: Any, at: int, out: Any, fragment: int):
    """Copy one fragment; what the result does not have is left out."""
    rgba = source.rgba[at]
    out.rgba[fragment] = rgba
    out.depth[fragment] = source.depth[at]
    out.thickness[fragment] = source.thickness[at]
    if out.opacity_sum.shape[0] > 0:
        opacity_sum = rgba[3]
        if source.opacity_sum.shape[0] > 0:
            opacity_sum = source.opacity_sum[at]
        out.opacity_sum[fragment] = opacity_sum
    if out.object_id.shape[0] > 0:
        out.object_id[fragment] = source.object_id[at]
    if out.primitive_id.shape[0] > 0:
        out.primitive_id[fragment] = source.primitive_id[at]


@kernels
def gather_fwd(number: Any) -> Any:
    """Return the kernel that gathers fragments from four lists."""

    def kernel(
        span: Span,
        first: FragmentValues[number],
        second: FragmentValues[number],
        third: FragmentValues[number],
        fourth: FragmentValues[number],
        index: wp.array(dtype=int),
        out: FragmentValues[number],
    ):
        """Gather fragments.

        Args:
            span: fragments of the result.
            first: fragments with the numbers from 0 on.
            second: fragments with the numbers after those.
            third: the same.
            fourth: the same.
            index: which fragment each of the result is, (N,).
            out: output: the result.
        """
        begin_second = first.depth.shape[0]
        begin_third = begin_second + second.depth.shape[0]
        begin_fourth = begin_third + third.depth.shape[0]
        for fragment in range(span.begin + wp.tid(), span.end, span.stride):
            at = index[fragment]
            if at < begin_second:
                copy_fragment(first, at, out, fragment)
            elif at < begin_third:
                copy_fragment(second, at - begin_second, out, fragment)
            elif at < begin_fourth:
                copy_fragment(third, at - begin_third, out, fragment)
            else:
                copy_fragment(fourth, at - begin_fourth, out, fragment)

    return kernel


@kernels
def gather_bwd(number: Any) -> Any:
    """Return the kernel of the gradient of gathered fragments in one of the lists."""
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        index: wp.array(dtype=int),
        begin: int,
        end: int,
        fresh: bool,
        grad_out: FragmentValues[number],
        grads: FragmentValues[number],
    ):
        """Take the gradient back to the fragments of one list, which is zero where nothing was gathered.

        Args:
            span: fragments of the result.
            index: which fragment each of the result is, none twice, (N,).
            begin: number of the list's first fragment.
            end: number after its last.
            fresh: whether the list has no opacity sums: they are its opacities.
            grad_out: gradients of the result; those that are zero are empty.
            grads: output: gradients of the list; those that nobody wants are empty.
        """
        for fragment in range(span.begin + wp.tid(), span.end, span.stride):
            at = index[fragment] - begin
            if at >= 0 and at < end - begin:
                if grads.rgba.shape[0] > 0:
                    grad = vec4()
                    if grad_out.rgba.shape[0] > 0:
                        grad = grad_out.rgba[fragment]
                    if fresh and grad_out.opacity_sum.shape[0] > 0:
                        grad[3] = grad[3] + grad_out.opacity_sum[fragment]
                    grads.rgba[at] = grad
                if grads.depth.shape[0] > 0 and grad_out.depth.shape[0] > 0:
                    grads.depth[at] = grad_out.depth[fragment]
                if grads.thickness.shape[0] > 0 and grad_out.thickness.shape[0] > 0:
                    grads.thickness[at] = grad_out.thickness[fragment]
                if grads.opacity_sum.shape[0] > 0 and grad_out.opacity_sum.shape[0] > 0:
                    grads.opacity_sum[at] = grad_out.opacity_sum[fragment]

    return kernel


def _values(arrays: SimpleNamespace, number: Any, prefix: str = "") -> Any:
    values = FragmentValues[number]()
    for name in BY_FRAGMENT:
        array = getattr(arrays, prefix + name, None)
        if array is not None:
            setattr(values, name, as_vectors(array) if name == "rgba" else array)
    return values


def _gather_forward(inputs: SimpleNamespace, outputs: SimpleNamespace, options: GatherOptions) -> None:
    number, index = inputs.rgba.dtype, inputs.index
    sources = [_values(inputs, number, prefix) for prefix in LISTS]
    launch(gather_fwd(number), index.shape[0], [*sources, index, _values(outputs, number)], index.device)


def _gather_backward(
    inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, options: GatherOptions
) -> None:
    number, index = inputs.rgba.dtype, inputs.index
    for target in vars(targets).values():
        if target is not None:
            target.zero_()
    begin = 0
    for prefix in LISTS:
        depth = getattr(inputs, f"{prefix}depth")
        end = begin + (0 if depth is None else depth.shape[0])
        if any(getattr(targets, prefix + name) is not None for name in BY_FRAGMENT):
            fresh = getattr(inputs, f"{prefix}opacity_sum") is None
            arguments = [index, begin, end, fresh, _values(grads, number), _values(targets, number, prefix)]
            launch(gather_bwd(number), index.shape[0], arguments, index.device)
        begin = end


def _list_inputs(prefix: str, size: str) -> tuple[Input, ...]:
    return (
        Input(f"{prefix}rgba", f"{size} 4", gradient=True),
        *(Input(prefix + name, size, gradient=True) for name in ("depth", "thickness", "opacity_sum")),
        *(Input(prefix + name, size, "int") for name in IDS),
    )


GATHER = Operator(
    "gather_fragments",
    (
        *(each for prefix, size in zip(LISTS, "FGHI", strict=True) for each in _list_inputs(prefix, size)),
        Input("index", "N", "int"),
    ),
    (
        *(Output("rgba", "N 4"), Output("depth", "N"), Output("thickness", "N"), Output("opacity_sum", "S")),
        *(Output("object_id", "O", "int"), Output("primitive_id", "Q", "int")),
    ),
    _gather_forward,
    _gather_backward,
    GatherOptions,
)


def gathered(fragments: Fragments, index: np.ndarray, pixel: np.ndarray) -> Fragments:
    """Return some fragments, by number, of which it is known which pixel each belongs to, in ascending order."""
    counts = np.bincount(pixel, minlength=fragments.pixel_count)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    kind = kind_named(fragments.kind)
    like = kind.astype(fragments.offsets, "int32")
    return gather([fragments], *(kind.asarray(each.astype(np.int32), like) for each in (index, offsets)))


def gather(images: Sequence[Fragments], index: Any, offsets: Any) -> Fragments:
    """Return fragments of up to `MOST_LISTS` images, which are alike.

    Args:
        images: the fragments, numbered through from 0 on.
        index: which of them come where, none twice, int32, in the kind of the fragments, (N,).
        offsets: where the pixels of the result begin, (P + 1,).
    """
    kind, count = kind_named(images[0].kind), index.shape[0]
    given = {name: [getattr(each, name) is not None for each in images] for name in BY_FRAGMENT}
    wanted = {name: all(given[name]) for name in BY_FRAGMENT} | {"opacity_sum": any(given["opacity_sum"])}
    arrays = {"index": index}
    for prefix, each in zip(LISTS, images, strict=False):
        for name in (name for name in BY_FRAGMENT if wanted[name] and getattr(each, name) is not None):
            array = getattr(each, name)
            arrays[prefix + name] = kind.astype(array, "int32") if name in IDS else array
    counts = [count if wanted[name] else 0 for name in ("opacity_sum", *IDS)]
    found = apply(GATHER, arrays, GatherOptions(*counts))
    values = {name: getattr(found, name) for name in BY_FRAGMENT if wanted[name]}
    return Fragments(**values, offsets=offsets, shape=images[0].shape)
