"""Derivatives in the look of whole objects, summed by pixel.

With a fragment's premultiplied colour unit · colour · opacity, its opacity unit · opacity and its thickness
unit · thickness, the derivatives in an object's colour, opacity and logarithm of the thickness are those of its
fragments times what stands beside. Pixels stay apart: with gradients that are seeded with ones in a channel of each
pixel, the sums are rows of the Jacobian of the image.
"""

from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.precisions import kernels
from warpfrag.fragments import Fragments

wp.set_module_options({"enable_backward": False})

# Places in a row of an object's columns.
OPACITY, THICKNESS = 3, 4


@kernels
def sum_objects(number: Any) -> Any:
    """Make the kernel for a precision of the gradients."""
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        offsets: wp.array[int],  # (P + 1,)
        object_id: wp.array[int],  # (F,)
        columns: wp.array2d[int],  # (objects, 5): of red, green, blue, opacity, thickness; −1 for none
        look: wp.array2d(dtype=number),  # (objects, 5)
        unit_rgba: wp.array(dtype=vec4),  # (F,)
        thickness: wp.array(dtype=number),  # (F,)
        grad_rgba: wp.array(dtype=vec4),  # (F,)
        grad_thickness: wp.array(dtype=number),  # (F,)
        # outputs
        sums: wp.array2d[wp.float64],  # (P, numbers)
    ):
        """Add to each pixel's row; gradients of what no object has a column for may be empty."""
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                item = object_id[fragment]
                column = columns[item, THICKNESS]
                if column >= 0:
                    # Coordinates are logarithms: dt/dlog t = t.
                    to_log = grad_thickness[fragment] * thickness[fragment]
                    sums[pixel, column] = sums[pixel, column] + wp.float64(to_log)
                if columns[item, 0] >= 0 or columns[item, OPACITY] >= 0:
                    g = wp.cw_mul(grad_rgba[fragment], unit_rgba[fragment])
                    column = columns[item, OPACITY]
                    if column >= 0:
                        to_opacity = g[0] * look[item, 0] + g[1] * look[item, 1] + g[2] * look[item, 2] + g[3]
                        sums[pixel, column] = sums[pixel, column] + wp.float64(to_opacity)
                    if columns[item, 0] >= 0:
                        for k in range(3):
                            to_color = wp.float64(g[k] * look[item, OPACITY])
                            column = columns[item, k]
                            sums[pixel, column] = sums[pixel, column] + to_color

    return kernel


def add_object_gradients(
    sums: np.ndarray,
    fragments: Fragments,
    unit_rgba: np.ndarray,
    look: np.ndarray,
    columns: np.ndarray,
    grads: tuple[wp.array | None, wp.array | None],
) -> None:
    """Add the derivatives in colours, opacities and logarithms of thicknesses of objects to the rows of pixels.

    Args:
        sums: rows to add to, (P, numbers) float64.
        fragments: as they are seen, NumPy float32, with object ids.
        unit_rgba: premultiplied colour and opacity of fragments whose objects' colours and opacities are 1, (F, 4).
        look: red, green, blue, opacity and thickness of each object, (objects, 5) float32.
        columns: where their derivatives go in a row, (objects, 5) int32; −1 for nowhere.
        grads: gradients in the fragments' `rgba` and `thickness`, Warp arrays of float32; None where none is needed.
    """
    if (columns < 0).all():
        return
    grad_rgba, grad_thickness = grads
    device = next(grad.device for grad in grads if grad is not None)

    def shared(array: Any, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device, copy=False)

    target = wp.array(sums, device=device, copy=False)
    inputs = [
        shared(fragments.offsets, int),
        shared(fragments.object_id, int),
        shared(columns, int),
        shared(look, float),
        shared(unit_rgba, wp.vec4f),
        shared(fragments.thickness, float),
        wp.empty((0,), dtype=wp.vec4f, device=device) if grad_rgba is None else as_vectors(grad_rgba),
        wp.empty((0,), dtype=float, device=device) if grad_thickness is None else grad_thickness,
        target,
    ]
    launch(sum_objects(wp.float32), len(sums), inputs, device)
    if not device.is_cpu:
        sums[...] = target.numpy()
