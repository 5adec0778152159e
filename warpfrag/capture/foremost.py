"""The foremost surface of each pixel: its depth, its object, its normal.

It is that of the fragment nearest to the eye that is seen at all: whose opacity is above 0. Differentiable is its
depth; which fragment it is, and the normal, are held fixed.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.apply import apply
from warpfrag.arrays.kinds import as_vectors, kind_of
from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.operators import Input, Operator, Output
from warpfrag.arrays.precisions import kernels
from warpfrag.capture.coverage import Coverage
from warpfrag.capture.surfaces import CameraSurfaces
from warpfrag.fragments import Fragments
from warpfrag.raster.ray import ZERO, load_point

wp.set_module_options({"enable_backward": False})


@wp.func
def foremost_of(rgba: Any, depth: Any, begin: int, end: int) -> int:
    """Return the nearest fragment of a pixel's list with an opacity above 0, or -1."""
    nearest = int(-1)
    for fragment in range(begin, end):
        if rgba[fragment][3] > type(depth[fragment])(0.0):
            known = wp.where(nearest < 0, fragment, nearest)
            nearest = wp.where(depth[fragment] < depth[known], fragment, known)
    return nearest


@kernels
def foremost_fwd(number: Any) -> Any:
    """Return the kernel that finds the foremost fragment of each pixel."""
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        rgba: wp.array(dtype=vec4),
        depth: wp.array(dtype=number),
        offsets: wp.array(dtype=int),
        object_id: wp.array(dtype=int),
        out_depth: wp.array(dtype=number),
        out_object: wp.array(dtype=int),
        out_fragment: wp.array(dtype=int),
    ):
        """Find the foremost fragments.

        Args:
            span: the pixels.
            rgba: colour and opacity of the fragments, (F,).
            depth: their depth, (F,).
            offsets: see `Fragments`, (P + 1,).
            object_id: object of each fragment, (F,).
            out_depth: output, depth by pixel, 0 for none, (P,).
            out_object: output, object by pixel, -1 for none, (P,).
            out_fragment: output, fragment by pixel, -1 for none, (P,).
        """
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            fragment = foremost_of(rgba, depth, offsets[pixel], offsets[pixel + 1])
            out_fragment[pixel] = fragment
            out_depth[pixel] = number(0.0)
            out_object[pixel] = -1
            if fragment >= 0:
                out_depth[pixel] = depth[fragment]
                out_object[pixel] = object_id[fragment]

    return kernel


@kernels
def foremost_bwd(number: Any) -> Any:
    """Return the kernel that gives the gradient of each pixel's depth to its fragment."""
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        rgba: wp.array(dtype=vec4),
        depth: wp.array(dtype=number),
        offsets: wp.array(dtype=int),
        grad_out: wp.array(dtype=number),
        grad_depth: wp.array(dtype=number),
    ):
        """Take the gradient of depth by pixel back to the fragments; see `foremost_fwd`.

        Args:
            span: the pixels.
            rgba: colour and opacity of the fragments, (F,).
            depth: their depth, (F,).
            offsets: see `Fragments`, (P + 1,).
            grad_out: gradient by pixel, (P,).
            grad_depth: output, gradient by fragment, (F,).
        """
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            foremost = foremost_of(rgba, depth, offsets[pixel], offsets[pixel + 1])
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                grad_depth[fragment] = wp.where(fragment == foremost, grad_out[pixel], number(0.0))

    return kernel


def _forward(inputs: SimpleNamespace, outputs: SimpleNamespace, options: Any) -> None:
    found = [outputs.depth, outputs.object_id, outputs.fragment]
    arguments = [as_vectors(inputs.rgba), inputs.depth, inputs.offsets, inputs.object_id, *found]
    launch(foremost_fwd(inputs.depth.dtype), outputs.depth.shape[0], arguments, inputs.depth.device)


def _backward(inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, options: Any) -> None:
    arguments = [as_vectors(inputs.rgba), inputs.depth, inputs.offsets, grads.depth, targets.depth]
    launch(foremost_bwd(inputs.depth.dtype), inputs.offsets.shape[0] - 1, arguments, inputs.depth.device)


FOREMOST = Operator(
    "foremost",
    (
        Input("rgba", "F 4"),
        Input("depth", "F", gradient=True),
        Input("offsets", "P+1", "int"),
        Input("object_id", "F", "int"),
    ),
    (Output("depth", "P"), Output("object_id", "P", "int"), Output("fragment", "P", "int")),
    _forward,
    _backward,
)


@kernels
def normal_fwd(number: Any) -> Any:
    """Return the kernel of the normals of fragments' triangles."""
    vec3 = wp.types.vector(3, number)

    def kernel(
        span: Span,
        points: wp.array(dtype=vec3),
        corners: wp.array(dtype=wp.vec3i),
        faces: wp.array(dtype=int),
        foremost: wp.array(dtype=int),
        perspective: int,
        normals: wp.array(dtype=vec3),
    ):
        """Compute the unit normal of each pixel's triangle, turned towards the eye.

        Args:
            span: the pixels.
            points: vertices in camera space [scene units], (V,).
            corners: vertices of each triangle, (N,).
            faces: triangle of each fragment, (F,).
            foremost: fragment of each pixel, -1 for none, (P,).
            perspective: 0 for an orthographic camera.
            normals: output, in camera space, zero for none, (P,).
        """
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            normal = wp.vec3d()
            if foremost[pixel] >= 0:
                corner = corners[faces[foremost[pixel]]]
                a = load_point(points, corner[0])
                normal = wp.cross(load_point(points, corner[1]) - a, load_point(points, corner[2]) - a)
                # Scaled by the largest part first: areas of tiny triangles have squares that underflow.
                largest = wp.max(wp.max(wp.abs(normal[0]), wp.abs(normal[1])), wp.abs(normal[2]))
                if largest > ZERO:
                    normal = wp.normalize(normal / largest)
                away = normal[2]
                if perspective != 0:
                    away = wp.dot(normal, a)
                if away > ZERO:
                    normal = -normal
            normals[pixel] = vec3(number(normal[0]), number(normal[1]), number(normal[2]))

    return kernel


def foremost(fragments: Fragments) -> SimpleNamespace:
    """Return the foremost surface of each pixel: `depth` and `object_id`, of the grid's shape, and `fragment`, (P,).

    Where there is none they are 0, -1 and -1. Differentiable is the depth, in that of the fragments.
    """
    arrays = {name: getattr(fragments, name) for name in ("rgba", "depth", "object_id")}
    offsets = fragments.offsets
    kind = kind_of(offsets)
    assert kind is not None
    found = apply(FOREMOST, {**arrays, "offsets": kind.astype(offsets, "int32")})
    return SimpleNamespace(
        depth=found.depth.reshape(fragments.shape),
        object_id=found.object_id.reshape(fragments.shape),
        fragment=found.fragment,
    )


def foremost_normals(coverage: Coverage, surfaces: CameraSurfaces, fragment: Any) -> Any:
    """Return the unit normals of the triangles of fragments, (H, W, 3), in camera space and turned towards the eye.

    Args:
        coverage: what each pixel sees.
        surfaces: the surfaces, on the same device.
        fragment: of each pixel, -1 for none, (P,) int32, of the kind of the surfaces.
    """
    kind, window, number = surfaces.kind, coverage.window, surfaces.number
    normals = wp.empty((window.row_count, window.width, 3), dtype=number, device=surfaces.device)
    arguments = [
        as_vectors(kind.to_warp(surfaces.points)),
        as_vectors(coverage.corners),
        coverage.faces,
        kind.to_warp(fragment),
        window.perspective,
        as_vectors(normals.reshape((window.pixel_count, 3))),
    ]
    launch(normal_fwd(number), window.pixel_count, arguments, surfaces.device)
    return kind.from_warp(normals)
