"""Methods that take the fragments of a pixel one after the other, in order of submission: one thread a pixel.

Their kernels are written as the papers state the algorithms. They are not differentiable: the result is detached.
"""

from collections.abc import Callable, Sequence
from dataclasses import astuple
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.apply import apply
from warpfrag.arrays.kinds import as_vectors, common_kind
from warpfrag.arrays.launch import launch, worker_count
from warpfrag.arrays.operators import Input, Operator, Output
from warpfrag.fragments import Fragments, as_int32

_INPUTS = (Input("rgba", "F 4"), Input("depth", "F"), Input("offsets", "P+1", "int"))


def sequential_operator(
    name: str,
    kernel: Callable[[Any], wp.Kernel],
    nodes: Callable[[Any, Any], Sequence[tuple[Any, int]]],
    options: type,
    *,
    takes_exact: bool = False,
) -> Operator:
    """Make an operator of a kernel.

    Args:
        name: its name.
        kernel: makes the kernel for a number type. It takes span, rgba, depth, offsets, the exact image where it
            `takes_exact` (or an empty array), the options in their order, the arrays of nodes, and the image that it
            fills.
        nodes: `(number, options) -> [(dtype, length), ...]`: the arrays of nodes, of which each thread has a row.
        options: the dataclass of its options.
        takes_exact: whether it wants the image of plain over.
    """

    def forward(inputs: SimpleNamespace, outputs: SimpleNamespace, chosen: Any) -> None:
        number, device, pixel_count = inputs.depth.dtype, inputs.depth.device, inputs.offsets.shape[0] - 1
        wanted = nodes(number, chosen)
        row_bytes = sum(wp.types.type_size_in_bytes(dtype) * length for dtype, length in wanted)
        rows = worker_count(pixel_count, device, row_bytes)
        arguments = [as_vectors(inputs.rgba), inputs.depth, inputs.offsets]
        if takes_exact:
            nothing = wp.empty(0, dtype=wp.types.vector(4, number), device=device)
            arguments.append(nothing if inputs.exact is None else as_vectors(inputs.exact))
        arguments += [*astuple(chosen), *(wp.empty((rows, size), dtype=dtype, device=device) for dtype, size in wanted)]
        launch(kernel(number), pixel_count, [*arguments, as_vectors(outputs.image)], device, rows)

    inputs = (*_INPUTS, Input("exact", "P 4")) if takes_exact else _INPUTS
    return Operator(name, inputs, (Output("image", "P 4"),), forward, options=options)


def blend(operator: Operator, fragments: Fragments, options: Any, exact: Any = None) -> Any:
    """Run such an operator over fragments; returns the image (H, W, 4) in their kind and precision."""
    arrays = {"rgba": fragments.rgba, "depth": fragments.depth, "offsets": as_int32(fragments.offsets)}
    if exact is not None:
        arrays["exact"] = exact.reshape((fragments.pixel_count, 4))
    kind = common_kind(arrays)
    image = apply(operator, {name: kind.detach(array) for name, array in arrays.items()}, options).image
    return image.reshape((*fragments.shape, 4))
