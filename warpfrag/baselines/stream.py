"""Methods that take the fragments of a pixel one after the other, in order of submission: one thread a pixel.

Their kernels are written as the papers state the algorithms. They are not differentiable: the result is detached.
"""

from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from warpfrag.arrays.launch import launch, worker_count
from warpfrag.arrays.legacy import Operator, apply, kind_of, vectors
from warpfrag.fragments import Fragments
from warpfrag.resolve.arguments import as_int32


def stream_operator(
    name: str,
    kernel: Callable[[Any], wp.Kernel],
    nodes: Callable[..., Sequence[tuple[Any, int]]],
    options: dict[str, str],
) -> Operator:
    """Make an operator of a kernel.

    Args:
        name: its name.
        kernel: makes the kernel for a scalar type. It takes span, rgba, depth, offsets, the exact image (or an empty
            array), the options in their order, the arrays of nodes, and the image that it fills.
        nodes: `(scalar, **options) -> [(dtype, length), ...]`: the arrays of nodes, of which each thread has a row.
        options: names and types of the options.
    """

    def output_like(inputs: Sequence[Any], **chosen: Any) -> list[tuple[tuple[int, ...], str]]:
        return [((inputs[2].shape[0] - 1, 4), "float")]

    def forward(inputs: Sequence[Any], outputs: Sequence[Any], **chosen: Any) -> None:
        rgba, depth, offsets, exact = inputs
        scalar, device, pixel_count = depth.dtype, depth.device, offsets.shape[0] - 1
        wanted = nodes(scalar, **chosen)
        row_bytes = sum(wp.types.type_size_in_bytes(dtype) * length for dtype, length in wanted)
        rows = worker_count(pixel_count, device, row_bytes)
        arrays = [wp.empty((rows, length), dtype=dtype, device=device) for dtype, length in wanted]
        vector = wp.types.vector(4, scalar)
        seen = wp.empty(0, dtype=vector, device=device) if exact is None else vectors(exact)
        arguments = [vectors(rgba), depth, offsets, seen, *chosen.values(), *arrays, vectors(outputs[0])]
        launch(kernel(scalar), pixel_count, arguments, device, rows)

    def backward(*_: Any, **__: Any) -> None:
        raise NotImplementedError(f"{name} is not differentiable")

    return Operator(
        name=name,
        tensors=("rgba", "depth", "offsets", "exact"),
        differentiable=(),
        outputs=("image",),
        output_like=output_like,
        forward=forward,
        backward=backward,
        options=options,
    )


def stream(operator: Operator, fragments: Fragments, exact: Any = None, **options: Any) -> Any:
    """Run such an operator over fragments; returns the image (H, W, 4) in their kind and precision."""
    inputs = [fragments.rgba, fragments.depth, as_int32(fragments.offsets), exact]
    if exact is not None:
        inputs[3] = exact.reshape((fragments.pixel_count, 4))
    if kind_of(fragments.rgba) == "torch":
        inputs = [None if array is None else array.detach() for array in inputs]
    (image,) = apply(operator, inputs, **options)
    return image.reshape((*fragments.shape, 4))
