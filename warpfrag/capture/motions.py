"""What the gradients of fragments are in rigid motions: a force and a torque for each."""

from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span
from warpfrag.arrays.precisions import kernels
from warpfrag.capture.corner_gradients import ShadedGradients, fragment_adjoint, load_corners
from warpfrag.capture.surfaces import SurfaceArrays
from warpfrag.raster.ray import centre_x, centre_y

wp.set_module_options({"enable_backward": False})


@kernels
def motion_bwd(number: Any) -> Any:
    """Return the kernel of the gradients in rigid motions."""

    def kernel(
        span: Span,
        surface: SurfaceArrays[number],
        faces: wp.array(dtype=int),
        offsets: wp.array(dtype=int),
        grads: ShadedGradients[number],
        motions: wp.array2d(dtype=wp.vec3d),
    ):
        """Turn the gradients of fragments into forces and torques.

        Args:
            span: the pixels.
            surface: what was shaded.
            faces: triangle of each fragment, (F,).
            offsets: see `Fragments`, (P + 1,).
            grads: gradients of the fragments.
            motions: output, force [1 / scene unit] and torque [1 / radian] of each fragment, (F, 2).
        """
        rays = surface.rays
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            row = pixel // rays.width
            x = centre_x(rays, pixel - row * rays.width)
            y = centre_y(rays, row)
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                triangle = load_corners(surface, faces[fragment])
                gradients = fragment_adjoint(surface, triangle, grads, fragment, pixel, x, y, True)
                force = gradients.point_a + gradients.point_b + gradients.point_c
                torque = (
                    wp.cross(triangle.point_a, gradients.point_a)
                    + wp.cross(triangle.point_b, gradients.point_b)
                    + wp.cross(triangle.point_c, gradients.point_c)
                )
                motions[fragment, 0] = force
                motions[fragment, 1] = torque

    return kernel
