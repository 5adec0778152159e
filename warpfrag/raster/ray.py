"""Where the ray of a pixel meets a triangle: edge functions in homogeneous pixel coordinates (Olano and Greer 1997).

Seen from the pixel centre (kx, ky), counted from the middle of the image, a corner (x, y, z) of a triangle in camera
space lies at a = (s·x − kx·w, s·y − ky·w), where w = z and s is the focal length (perspective), or w = 1 and s pixels
per scene unit (orthographic). The cross products of two corners are the triangle's edge functions,
E = (b × c, c × a, a × b). The ray meets the triangle where all three have one sign, at the barycentric coordinates
E / ΣE, which are exact in perspective: no corner is divided by its depth, so corners behind the eye need no clipping;
the depth of the hit tells.

A centre exactly on an edge (E = 0) counts as moved right by an infinitesimal ε and down by ε²: that is the top-left
rule. All corners come ordered by their coordinates, so that two triangles compute the same |E| for the edge that they
share, to the bit, whatever the compiler does with multiply-add; and all edges that meet in a vertex see it at the same
rounded place.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))

# Slack around projected corners [pixels]: coverage is decided by the edge functions, whose rounding is far below this.
BOUND_MARGIN = wp.constant(wp.float64(1e-6))
SPAN_MARGIN = wp.constant(wp.float64(1e-2))
# An edge is followed from row to row only if it climbs this much and stays this near: else rounding passes the margin.
SPAN_LEAST_CLIMB = wp.constant(wp.float64(1e-2))
SPAN_FARTHEST = wp.constant(wp.float64(1e5))
# Columns from which on it pays to look for the part of a row that a triangle crosses.
SPAN_LEAST_COLUMNS = wp.constant(8)


@wp.struct
class Rays:
    """The rays through the rows of an image that are captured; see `Window`."""

    scale: wp.float64
    perspective: wp.int32
    near: wp.float64
    far: wp.float64
    middle_x: wp.float64
    middle_y: wp.float64
    width: wp.int32
    first_row: wp.int32
    row_count: wp.int32


@dataclass(frozen=True)
class Window:
    """Some rows of a camera's image.

    Attributes:
        scale: focal length [pixels] (perspective), or pixels per scene unit (orthographic).
        perspective: 1, or 0 for an orthographic camera.
        near: planar depth of the near plane [scene units].
        far: planar depth of the far plane [scene units].
        width: columns of the image.
        height: rows of the whole image.
        middle_x: where the line of sight meets the image, from its left edge [pixels].
        middle_y: the same from its top edge [pixels].
        first_row: first row of the window.
        row_count: number of rows of the window.
    """

    scale: float
    perspective: int
    near: float
    far: float
    width: int
    height: int
    middle_x: float
    middle_y: float
    first_row: int
    row_count: int

    @staticmethod
    def of(camera: Any, rows: tuple[int, int] | None = None) -> "Window":
        """Return the window of a camera's rows [begin, end), all by default."""
        height, width = camera.shape
        begin, end = rows or (0, height)
        scale = camera.focal if camera.is_perspective else 1.0 / camera.pixel_size
        perspective = int(camera.is_perspective)
        middle_x, middle_y = camera.middle
        return Window(
            scale, perspective, camera.near, camera.far, width, height, middle_x, middle_y, begin, end - begin
        )

    @property
    def pixel_count(self) -> int:
        """Number of pixels of the window."""
        return self.width * self.row_count

    def rays(self) -> Rays:
        """Return the window as kernels take it."""
        rays = Rays()
        rays.scale, rays.perspective, rays.near, rays.far = self.scale, self.perspective, self.near, self.far
        rays.middle_x, rays.middle_y = self.middle_x, self.middle_y
        rays.width, rays.first_row, rays.row_count = self.width, self.first_row, self.row_count
        return rays


@wp.func
def load_point(points: Any, vertex: int) -> wp.vec3d:
    """Return a corner in camera space."""
    return wp.vec3d(points[vertex])


@wp.func
def centre_x(rays: Rays, column: int) -> wp.float64:
    """Return how far right of the middle of the image a pixel centre lies [pixels]."""
    return wp.float64(column) + HALF - rays.middle_x


@wp.func
def centre_y(rays: Rays, row: int) -> wp.float64:
    """Return how far below the middle of the image a pixel centre lies [pixels]; rows count from the window's first."""
    return wp.float64(rays.first_row + row) + HALF - rays.middle_y


@wp.func
def stretch(x: wp.float64, y: wp.float64, scale: wp.float64, perspective: int) -> wp.float64:
    """Return the distance along the ray per planar depth."""
    if perspective != 0:
        return wp.sqrt(ONE + (x / scale) * (x / scale) + (y / scale) * (y / scale))
    return ONE


@wp.func
def homogeneous(z: wp.float64, perspective: int) -> wp.float64:
    """Return a corner's w."""
    return wp.where(perspective != 0, z, ONE)


@wp.func
def seen_from(corner: wp.vec3d, x: wp.float64, y: wp.float64, scale: wp.float64, perspective: int) -> wp.vec2d:
    """Return where a corner lies seen from a pixel centre, times its w."""
    w = homogeneous(corner[2], perspective)
    return wp.vec2d(scale * corner[0] - x * w, scale * corner[1] - y * w)


@wp.func
def cross(a: wp.vec2d, b: wp.vec2d) -> wp.float64:
    """Return a × b."""
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def edge_functions(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d) -> wp.vec3d:
    """Return (b × c, c × a, a × b); every product is taken in the order of the corners."""
    return wp.vec3d(cross(b, c), -cross(a, c), cross(a, b))


@wp.func
def side(e: wp.float64, a: wp.vec2d, b: wp.vec2d, a_w: wp.float64, b_w: wp.float64) -> int:
    """Return the sign of the edge function a × b; on the edge, as seen from the centre moved by (ε, ε²)."""
    if e > ZERO:
        return 1
    if e < ZERO:
        return -1
    slope_x = b_w * a[1] - a_w * b[1]
    if slope_x > ZERO:
        return 1
    if slope_x < ZERO:
        return -1
    slope_y = a_w * b[0] - b_w * a[0]
    if slope_y > ZERO:
        return 1
    if slope_y < ZERO:
        return -1
    return 0


@wp.func
def planar_depth(e: wp.vec3d, a: wp.float64, b: wp.float64, c: wp.float64) -> wp.float64:
    """Interpolate the corners' planar depths; exact where all three are equal."""
    scale = ONE / (e[0] + e[1] + e[2])
    return a + e[1] * scale * (b - a) + e[2] * scale * (c - a)


@wp.func
def hit_depth(rays: Rays, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, x: wp.float64, y: wp.float64) -> wp.float64:
    """Return the planar depth at which the ray meets the triangle within near and far, else -1."""
    seen_a = seen_from(a, x, y, rays.scale, rays.perspective)
    seen_b = seen_from(b, x, y, rays.scale, rays.perspective)
    seen_c = seen_from(c, x, y, rays.scale, rays.perspective)
    e = edge_functions(seen_a, seen_b, seen_c)
    a_w = homogeneous(a[2], rays.perspective)
    b_w = homogeneous(b[2], rays.perspective)
    c_w = homogeneous(c[2], rays.perspective)
    side_a = side(e[0], seen_b, seen_c, b_w, c_w)
    side_b = -side(-e[1], seen_a, seen_c, a_w, c_w)
    if side_a != side_b:
        return -ONE
    side_c = side(e[2], seen_a, seen_b, a_w, b_w)
    if side_a != side_c or side_a == 0:
        return -ONE
    depth = planar_depth(e, a[2], b[2], c[2])
    # Written so that a NaN, as from an empty sum of edge functions, is no hit.
    if depth >= rays.near and depth <= rays.far:
        return depth
    return -ONE


@wp.func
def projected(corner: wp.vec3d, scale: wp.float64, perspective: int) -> wp.vec2d:
    """Return a corner's place in the image [pixels from its middle]."""
    w = homogeneous(corner[2], perspective)
    return wp.vec2d(scale * corner[0] / w, scale * corner[1] / w)


@wp.func
def extend_span(span: wp.vec2d, a: wp.vec2d, b: wp.vec2d, y: wp.float64) -> wp.vec2d:
    """Extend a span of x to where the edge from a to b crosses a row."""
    if y < wp.min(a[1], b[1]) - BOUND_MARGIN or y > wp.max(a[1], b[1]) + BOUND_MARGIN:
        return span
    climb = b[1] - a[1]
    if wp.abs(climb) < SPAN_LEAST_CLIMB:
        return wp.vec2d(wp.min(span[0], wp.min(a[0], b[0])), wp.max(span[1], wp.max(a[0], b[0])))
    x = a[0] + wp.clamp((y - a[1]) / climb, ZERO, ONE) * (b[0] - a[0])
    return wp.vec2d(wp.min(span[0], x), wp.max(span[1], x))


@wp.func
def is_wide(rays: Rays, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, left: int, right: int) -> bool:
    """Tell whether it pays, and is safe, to narrow each row of a triangle down from its bounds."""
    if right - left < SPAN_LEAST_COLUMNS:
        return False
    if rays.perspective != 0 and wp.min(wp.min(a[2], b[2]), c[2]) < rays.near:
        return False
    p = projected(a, rays.scale, rays.perspective)
    q = projected(b, rays.scale, rays.perspective)
    r = projected(c, rays.scale, rays.perspective)
    farthest_x = wp.max(wp.max(wp.abs(p[0]), wp.abs(q[0])), wp.abs(r[0]))
    farthest_y = wp.max(wp.max(wp.abs(p[1]), wp.abs(q[1])), wp.abs(r[1]))
    return farthest_x < SPAN_FARTHEST and farthest_y < SPAN_FARTHEST


@wp.func
def columns_of_row(rays: Rays, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, y: wp.float64, left: int, right: int) -> wp.vec2i:
    """Return the columns [begin, end) of a row that a wide triangle may cover."""
    p = projected(a, rays.scale, rays.perspective)
    q = projected(b, rays.scale, rays.perspective)
    r = projected(c, rays.scale, rays.perspective)
    span = wp.vec2d(SPAN_FARTHEST, -SPAN_FARTHEST)
    span = extend_span(span, p, q, y)
    span = extend_span(span, q, r, y)
    span = extend_span(span, p, r, y)
    if span[0] > span[1]:
        return wp.vec2i(left, left)
    return wp.vec2i(
        wp.max(left, int(wp.ceil(span[0] - SPAN_MARGIN - HALF + rays.middle_x))),
        wp.min(right, int(wp.floor(span[1] + SPAN_MARGIN - HALF + rays.middle_x)) + 1),
    )


@wp.func
def extend_box(box: wp.vec4d, p: wp.vec2d) -> wp.vec4d:
    """Extend a box (least x, largest x, least y, largest y) to a point."""
    return wp.vec4d(wp.min(box[0], p[0]), wp.max(box[1], p[0]), wp.min(box[2], p[1]), wp.max(box[3], p[1]))


@wp.func
def extend_to_crossing(box: wp.vec4d, rays: Rays, front: wp.vec3d, behind: wp.vec3d) -> wp.vec4d:
    """Extend a box, on an edge through the near plane, beyond where it crosses that."""
    # Half way to the eye the crossing is well conditioned, and all that is left of the edge is in the box.
    plane = HALF * rays.near
    p = behind
    if behind[2] < plane:
        p = front + (plane - front[2]) / (behind[2] - front[2]) * (behind - front)
        p = wp.vec3d(p[0], p[1], plane)
    return extend_box(box, projected(p, rays.scale, rays.perspective))


@wp.func
def bounds(rays: Rays, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec4i:
    """Return rows [top, bottom) and columns [left, right) outside of which a triangle covers no pixel centre."""
    nothing = wp.vec4i(0, 0, 0, 0)
    nearest = wp.min(wp.min(a[2], b[2]), c[2])
    farthest = wp.max(wp.max(a[2], b[2]), c[2])
    # Infinite or NaN coordinates make this sum NaN.
    if ZERO * (a[0] + b[0] + c[0] + a[1] + b[1] + c[1] + nearest + farthest) != ZERO:
        return nothing
    if farthest < rays.near or nearest > rays.far:
        return nothing
    far = wp.float64(1e300)
    box = wp.vec4d(far, -far, far, -far)
    clipped = rays.perspective != 0
    if not clipped or a[2] >= rays.near:
        box = extend_box(box, projected(a, rays.scale, rays.perspective))
    if not clipped or b[2] >= rays.near:
        box = extend_box(box, projected(b, rays.scale, rays.perspective))
    if not clipped or c[2] >= rays.near:
        box = extend_box(box, projected(c, rays.scale, rays.perspective))
    if clipped and nearest < rays.near:
        for edge in range(6):
            front = a
            behind = b
            if edge == 1:
                behind = c
            elif edge == 2:
                front = b
                behind = a
            elif edge == 3:
                front = b
                behind = c
            elif edge == 4:
                front = c
                behind = a
            elif edge == 5:
                front = c
            if front[2] >= rays.near and behind[2] < rays.near:
                box = extend_to_crossing(box, rays, front, behind)
    width = wp.float64(rays.width)
    height = wp.float64(rays.row_count)
    offset_y = rays.middle_y - wp.float64(rays.first_row) - HALF
    left = wp.clamp(wp.ceil(box[0] + rays.middle_x - HALF - BOUND_MARGIN), ZERO, width)
    right = wp.clamp(wp.floor(box[1] + rays.middle_x - HALF + BOUND_MARGIN) + ONE, ZERO, width)
    top = wp.clamp(wp.ceil(box[2] + offset_y - BOUND_MARGIN), ZERO, height)
    bottom = wp.clamp(wp.floor(box[3] + offset_y + BOUND_MARGIN) + ONE, ZERO, height)
    if left < right and top < bottom:
        return wp.vec4i(int(top), int(bottom), int(left), int(right))
    return nothing


@wp.func
def before(a: wp.vec3d, b: wp.vec3d) -> bool:
    """Tell whether a comes before b, by x, then y, then z."""
    if a[0] != b[0]:
        return a[0] < b[0]
    if a[1] != b[1]:
        return a[1] < b[1]
    return a[2] < b[2]
