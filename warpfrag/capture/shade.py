"""Shading: the colour, opacity, depth and z-thickness of fragments, and the gradients of these by vertex and map.

One fragment's formulas are in `warpfrag.capture.interpolation`, their gradient in `warpfrag.capture.corner_gradients`.
Differentiable in the corners' positions, colour, opacity and thickness and in the thickness maps. Held fixed: which
pixels a triangle covers, the order of the fragments, and which four texels a lookup takes (its place between them is
not). Everything is computed in float64 and stored in the precision of the inputs.

On the way back triangles are walked through once more, in strips of rows. A strip finds its fragments in the lists of
the pixels that it covers and sums up their gradients, row by row, per corner; then every vertex sums up the corners of
its triangles. No two threads write one address, and no sum depends on the number of threads. Where coverage was found
with the vertices elsewhere, `covered`, strips look for fragments there.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.operators import Input, Operator, Output
from warpfrag.arrays.precisions import Array, Number, Vector4, in_precisions, kernels
from warpfrag.capture.corner_gradients import (
    CornerGradients,
    CornerValues,
    ShadedGradients,
    fragment_adjoint,
    load_corners,
)
from warpfrag.capture.corner_sums import CornerSums, add_corners, gather_corners, store_corners
from warpfrag.capture.interpolation import hit_of, shade_color, shade_thickness, thickness_scale
from warpfrag.capture.surfaces import OBJECT_FIRST_FACE, OBJECT_IN_P, OBJECT_MAP, SurfaceArrays, surface_arrays
from warpfrag.raster.cover import triangle_walk
from warpfrag.raster.ray import Window, centre_x, centre_y, stretch
from warpfrag.raster.strips import area_of_strip, cut_strips, first_strip
from warpfrag.raster.triangles import TriangleArrays, prepare_triangles

wp.set_module_options({"enable_backward": False})


@in_precisions
class ShadedArrays:
    """Shaded fragments, (F,): premultiplied colour and opacity, depth, z-thickness, object, triangle of that."""

    rgba: Array[Vector4]
    depth: Array[Number]
    thickness: Array[Number]
    object_id: Array[wp.int32]
    primitive_id: Array[wp.int32]


@kernels
def shade_fwd(number: Any) -> Any:
    """Return the kernel that shades fragments."""
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        surface: SurfaceArrays[number],
        faces: wp.array(dtype=int),
        offsets: wp.array(dtype=int),
        shaded: ShadedArrays[number],
    ):
        """Shade all fragments.

        Args:
            span: the pixels.
            surface: what to interpolate.
            faces: triangle of each fragment, (F,).
            offsets: see `Fragments`, (P + 1,).
            shaded: output, the fragments.
        """
        rays = surface.rays
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            row = pixel // rays.width
            x = centre_x(rays, pixel - row * rays.width)
            y = centre_y(rays, row)
            along = stretch(x, y, rays.scale, rays.perspective)
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                face = faces[fragment]
                corner = surface.corners[face]
                hit = hit_of(surface, corner, x, y)
                depth = hit[2] * along
                owner = surface.object_id[face]
                item = surface.objects[owner]
                shaded.rgba[fragment] = vec4(shade_color(surface, face, corner, hit))
                shaded.depth[fragment] = number(depth)
                shaded.thickness[fragment] = number(shade_thickness(surface, item, corner, hit, along, pixel))
                shaded.object_id[fragment] = owner
                shaded.primitive_id[fragment] = face - item[OBJECT_FIRST_FACE]

    return kernel


@wp.func
def find_fragment(faces: wp.array[int], begin: int, end: int, face: int) -> int:
    """Return the fragment of a triangle in a pixel's list, or -1."""
    for fragment in range(begin, end):
        if faces[fragment] == face:
            return fragment
    return -1


@in_precisions
class Strip:
    """A strip of a triangle, what its fragments have given to the corners so far, and where those are looked up."""

    surface: SurfaceArrays
    faces: Array[wp.int32]
    offsets: Array[wp.int32]
    grads: ShadedGradients
    wants_points: wp.int32
    triangle: CornerValues
    gradients: CornerGradients


@cache
def add_fragment(number: Any, covered_number: Any) -> wp.Function:
    """Return the visit that adds a pixel's fragment to its strip."""

    @wp.func(inline=True)
    def visit(strip: wp.ref[Strip[number]], worker: int, pixel: int, face: int, depth: covered_number):
        fragment = find_fragment(strip.faces, strip.offsets[pixel], strip.offsets[pixel + 1], face)
        if fragment >= 0:
            rays = strip.surface.rays
            row = pixel // rays.width
            x = centre_x(rays, pixel - row * rays.width)
            more = fragment_adjoint(
                strip.surface, strip.triangle, strip.grads, fragment, pixel, x, centre_y(rays, row),
                strip.wants_points != 0,
            )  # fmt: skip
            strip.gradients = add_corners(strip.gradients, more)

    return visit


@kernels
def shade_bwd(number: Any, covered_number: Any) -> Any:
    """Return the kernel of the way back to corners; the precision of the points that were covered may be another."""
    walk = triangle_walk(covered_number, Strip[number], add_fragment(number, covered_number))

    def kernel(
        span: Span,
        triangles: TriangleArrays[covered_number],
        given: Strip[number],
        strip_ends: wp.array(dtype=int),
        strip_faces: wp.array(dtype=int),
        sums: CornerSums,
    ):
        """Sum up the gradients of the corners by strip.

        Args:
            span: the strips.
            triangles: where coverage was found.
            given: the surfaces, the fragments, and the gradients of these.
            strip_ends: where each triangle's strips end, (N,).
            strip_faces: triangle of each strip, (S,).
            sums: output, by strip and corner.
        """
        strip = given
        for index in range(span.begin + wp.tid(), span.end, span.stride):
            face = strip_faces[index]
            strip.triangle = load_corners(strip.surface, face)
            strip.gradients = CornerGradients()
            number_of_face = index - first_strip(strip_ends, face)
            area = area_of_strip(triangles.boxes[face], number_of_face, triangles.rays.width)
            walk(strip, span.worker, triangles, face, area)
            store_corners(sums, index, strip.gradients)

    return kernel


@kernels
def maps_bwd(number: Any) -> Any:
    """Return the kernel of the way back to thickness maps."""

    def kernel(
        span: Span,
        surface: SurfaceArrays[number],
        faces: wp.array(dtype=int),
        offsets: wp.array(dtype=int),
        grads: ShadedGradients[number],
        grad_maps: wp.array2d(dtype=number),
    ):
        """Sum up the gradients of the thickness maps.

        Args:
            span: the pixels.
            surface: what was shaded.
            faces: triangle of each fragment, (F,).
            offsets: see `Fragments`, (P + 1,).
            grads: gradients of the fragments.
            grad_maps: output, by map and pixel of the whole image, (maps, H·W).
        """
        rays = surface.rays
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            row = pixel // rays.width
            x = centre_x(rays, pixel - row * rays.width)
            y = centre_y(rays, row)
            for map_row in range(grad_maps.shape[0]):
                total = wp.float64(0.0)
                for fragment in range(offsets[pixel], offsets[pixel + 1]):
                    face = faces[fragment]
                    item = surface.objects[surface.object_id[face]]
                    if item[OBJECT_MAP] == map_row:
                        hit = hit_of(surface, surface.corners[face], x, y)
                        along = stretch(x, y, rays.scale, rays.perspective)
                        scale = thickness_scale(hit[2], along, item[OBJECT_IN_P], rays)
                        total += scale * wp.float64(grads.thickness[fragment])
                grad_maps[map_row, rays.first_row * rays.width + pixel] = number(total)

    return kernel


def shade_forward(inputs: SimpleNamespace, outputs: SimpleNamespace, window: Window) -> None:
    """Shade fragments: arguments are those of `SHADE`."""
    number = inputs.points.dtype
    if inputs.faces.shape[0]:
        shaded = ShadedArrays[number]()
        for name, array in vars(outputs).items():
            setattr(shaded, name, as_vectors(array) if name == "rgba" else array)
        arguments = [surface_arrays(vars(inputs), window), inputs.faces, inputs.offsets, shaded]
        launch(shade_fwd(number), window.pixel_count, arguments, inputs.points.device)


def shaded_gradients(number: Any, grads: SimpleNamespace) -> Any:
    """Return the gradients of fragments, `rgba`, `depth` and `thickness` or None, as kernels take them."""
    found = ShadedGradients[number]()
    if grads.rgba is not None:
        found.rgba = as_vectors(grads.rgba)
    if grads.depth is not None:
        found.depth = grads.depth
    if grads.thickness is not None:
        found.thickness = grads.thickness
    return found


def shade_backward(inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, window: Window) -> None:
    """Fill the gradients `targets` of the inputs that are not None, given those of the outputs."""
    number, device = inputs.points.dtype, inputs.points.device
    surface, shaded = surface_arrays(vars(inputs), window), shaded_gradients(number, grads)
    if targets.maps is not None:
        targets.maps.zero_()
        if grads.thickness is not None and inputs.faces.shape[0]:
            arguments = [surface, inputs.faces, inputs.offsets, shaded, targets.maps]
            launch(maps_bwd(number), window.pixel_count, arguments, device)
    wanted = {name: getattr(targets, name) for name in ("points", "rgba", "thickness")}
    if all(array is None for array in wanted.values()):
        return
    covered = inputs.points if inputs.covered is None else inputs.covered
    triangles = prepare_triangles(covered, inputs.corners, window)
    strips = cut_strips(triangles.boxes)
    if strips.count == 0 or inputs.faces.shape[0] == 0:
        for array in wanted.values():
            if array is not None:
                array.zero_()
        return
    strip = Strip[number]()
    strip.surface, strip.grads = surface, shaded
    strip.faces, strip.offsets = inputs.faces, inputs.offsets
    strip.wants_points = int(wanted["points"] is not None)
    sums = CornerSums()
    for name, dtype in (("points", wp.vec3d), ("rgba", wp.vec4d), ("thickness", wp.float64)):
        if wanted[name] is not None:
            setattr(sums, name, wp.empty((strips.count, 3), dtype=dtype, device=device))
    arguments = [triangles.arrays(by_band=False), strip, strips.ends, strips.faces, sums]
    launch(shade_bwd(number, covered.dtype), strips.count, arguments, device)
    gather_corners(inputs.corners, strips, sums, targets)


SHADE = Operator(
    name="shade",
    inputs=(
        Input("points", "V 3", gradient=True),
        Input("rgba", "V 4", gradient=True),
        Input("thickness", "V", gradient=True),
        Input("maps", "maps pixels", gradient=True),
    ),
    tables=(
        Input("corners", "N 3", None),
        Input("faces", "F", None),
        Input("offsets", "P+1", None),
        Input("object_id", "N", None),
        Input("objects", "objects 3", None),
        Input("uv", "V 2", None),
        Input("texture_id", "N", None),
        Input("texels", "texels 4", None),
        Input("textures", "images 3", None),
        Input("covered", "V 3", None),
    ),
    outputs=(
        Output("rgba", "F 4"),
        Output("depth", "F"),
        Output("thickness", "F"),
        Output("object_id", "F", "int"),
        Output("primitive_id", "F", "int"),
    ),
    options=Window,
    forward=shade_forward,
    backward=shade_backward,
)
