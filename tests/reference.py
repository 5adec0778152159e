"""Slow reference of the fragment operators: one pixel at a time, float64, in plain loops.

It exists to be believed, not to be fast: each function is one paragraph of the mathematics. Colours are premultiplied,
a slab reaches from ``front = depth - thickness`` back to ``depth``, and ``beta`` blends optical (0) and linear (1)
slabs. Numbers may be complex: all decisions look at real parts only, so that an imaginary perturbation of 1e-30 carries
a derivative to full precision while the decisions stay as they are (module `reference_gradient`).
"""

import cmath
import math
from typing import NamedTuple

import numpy as np

FLOOR = 1e-6
"""Least transmittance of a slab that is to be divided: gives an opaque slab the optical depth 13.8."""

SERIES_BELOW = 1e-3
"""Where series replace quotients that tend to 0/0; six terms leave a relative error below 1e-17."""


class Fragment(NamedTuple):
    """A fragment or a layer: a homogeneous slab, or a surface where its thickness is 0."""

    color: np.ndarray
    opacity: float
    depth: float
    thickness: float
    opacity_sum: float
    opaque_count: float = 1
    """How many opaque fragments it was mixed of, if it is opaque."""

    @property
    def front(self) -> float:
        """Depth of the front boundary."""
        return self.depth - self.thickness

    @property
    def weight(self) -> float:
        """Opacity sum per opacity: w = S / A, and 1 where A = 0."""
        return 1.0 if self.opacity.real == 0.0 else self.opacity_sum / self.opacity


class Piece(NamedTuple):
    """What a fragment, or a part of it, contributes, wherever it lies."""

    color: np.ndarray
    opacity: float
    opacity_sum: float
    opaque_count: float = 1

    weight = Fragment.weight


NOTHING = Piece(np.zeros(3), 0.0, 0.0)


# Elementary functions of a real number with an infinitesimal imaginary part, accurate near 0 in both parts.


def exp(x: float) -> float:
    """e^x."""
    return cmath.exp(x) if isinstance(x, complex) else math.exp(x)


def log1p(x: float) -> float:
    """log(1 + x)."""
    return complex(math.log1p(x.real), x.imag / (1.0 + x.real)) if isinstance(x, complex) else math.log1p(x)


def expm1(x: float) -> float:
    """e^x - 1."""
    return complex(math.expm1(x.real), math.exp(x.real) * x.imag) if isinstance(x, complex) else math.expm1(x)


def absorbed_per_depth(x: float) -> float:
    """(1 - e^-x) / x, which tends to 1 as x → 0."""
    if abs(x.real) < SERIES_BELOW:
        return sum((-x) ** n / math.factorial(n + 1) for n in range(6))
    return -expm1(-x) / x


def depth_per_opacity(opacity: float) -> float:
    """Optical depth per opacity, -log(1 - A) / A, which tends to 1 as A → 0; A < 1."""
    if abs(opacity.real) < SERIES_BELOW:
        return sum(opacity**n / (n + 1) for n in range(6))
    return -log1p(-opacity) / opacity


# Section 1: over.


def over(first: Piece, second: Piece) -> Piece:
    """Composite `first` in front of `second`; opacity sums add."""
    transmittance = 1.0 - first.opacity
    return Piece(
        first.color + transmittance * second.color,
        first.opacity + transmittance * second.opacity,
        first.opacity_sum + second.opacity_sum,
        first.opaque_count if first.opacity.real == 1.0 else second.opaque_count,
    )


# Section 2: mix.


def mix_pieces(first: Piece, second: Piece, mix: str = "opacity") -> Piece:
    """Let two pieces fill the same space: opacities combine as in over, `mix` says how colours are weighted."""
    opacity = first.opacity + (1.0 - first.opacity) * second.opacity
    opacity_sum = first.opacity_sum + second.opacity_sum
    if mix == "opacity":
        factor = opacity / opacity_sum if opacity_sum.real != 0.0 else 1.0
        color = (first.color * first.weight + second.color * second.weight) * factor
    elif mix == "average":
        color = first.color + second.color - (first.color * second.opacity + second.color * first.opacity) / 2.0
    elif mix == "optical_depth":
        color = mix_by_optical_depth(first, second)
    else:
        raise ValueError(f"mix is {mix!r}, expected 'opacity', 'average' or 'optical_depth'")
    count = sum(piece.opaque_count for piece in (first, second) if piece.opacity.real == 1.0)
    return Piece(color, opacity, opacity_sum, count or 1)


def mix_by_optical_depth(first: Piece, second: Piece) -> np.ndarray:
    """Colour of two pieces weighted by optical depth; where any is opaque, the mean of all opaque fragments in them."""
    opaque = [piece for piece in (first, second) if piece.opacity.real == 1.0]
    if opaque:
        return sum(piece.color * piece.opaque_count for piece in opaque) / sum(piece.opaque_count for piece in opaque)
    first_ratio = depth_per_opacity(first.opacity)
    second_ratio = depth_per_opacity(second.opacity)
    optical_depth = first.opacity * first_ratio + second.opacity * second_ratio
    # A = 1 - e^-u holds for the mixed piece too, so A / u needs neither a limit nor a guard.
    return (first.color * first_ratio + second.color * second_ratio) * absorbed_per_depth(optical_depth)


# Section 3: inside a slab.


def transmittance_to(fragment: Fragment, r: float, beta: float, mix: str = "opacity") -> float:
    """1 - A(r): what passes the front part of relative length `r`; exactly 1 - A for the whole fragment."""
    if r == 1.0:
        return 1.0 - fragment.opacity
    linear = (1.0 - r) + r * (1.0 - fragment.opacity)
    return beta * linear + (1.0 - beta) * optical_transmittance(fragment, r, mix)


def optical_transmittance(fragment: Fragment, r: float, mix: str) -> float:
    """max(1 - A, floor)^r."""
    if r.real == 0.0 and r.imag == 0.0:
        return 1.0
    optical_depth = slab_optical_depth(fragment, mix)
    return 0.0 if math.isinf(optical_depth.real) else exp(-r * optical_depth)


def slab_optical_depth(fragment: Fragment, mix: str) -> float:
    """-log(max(1 - A, floor)), with no floor for deep images (`mix` = "optical_depth")."""
    if mix == "optical_depth":
        return math.inf if fragment.opacity.real == 1.0 else -log1p(-fragment.opacity)
    return -math.log(FLOOR) if 1.0 - fragment.opacity.real < FLOOR else -log1p(-fragment.opacity)


def part(fragment: Fragment, r0: float, r1: float, beta: float, mix: str = "opacity") -> Piece:
    """The part of a slab between the relative lengths `r0` ≤ `r1`, counted from its front.

    A_01 = (A(r1) - A(r0)) / (1 - A(r0)), and colour and opacity sum in proportion to it.
    """
    if r0 == 0.0 and r1 == 1.0:
        return whole(fragment)
    if r0 == r1:
        return NOTHING
    share = part_share(fragment, r0, r1, beta, mix)
    opacity = fragment.opacity * share
    if opacity.real > 0.5:
        # The last part of an opaque slab is to be opaque exactly, not up to rounding.
        passed = transmittance_to(fragment, r0, beta, mix)
        if passed.real > 0.0:
            opacity = 1.0 - transmittance_to(fragment, r1, beta, mix) / passed
    return Piece(fragment.color * share, opacity, fragment.opacity_sum * share, fragment.opaque_count)


def whole(fragment: Fragment) -> Piece:
    """A fragment as a piece."""
    return Piece(fragment.color, fragment.opacity, fragment.opacity_sum, fragment.opaque_count)


def part_share(fragment: Fragment, r0: float, r1: float, beta: float, mix: str) -> float:
    """A_01 / A, which tends to r1 - r0 as A → 0."""
    opacity = fragment.opacity
    length = r1 - r0
    passed = transmittance_to(fragment, r0, beta, mix)
    if passed.real == 0.0:
        # Nothing reaches this part, 0/0. No image can show it; by our choice it adds nothing to the opacity sum.
        return 0.0
    before = optical_transmittance(fragment, r0, mix)
    optical_depth = slab_optical_depth(fragment, mix)
    if math.isinf(optical_depth.real):
        optical = before / opacity if length.real > 0.0 else 0.0
    else:
        ratio = depth_per_opacity(opacity) if 1.0 - opacity.real >= FLOOR else optical_depth / opacity
        optical = before * length * ratio * absorbed_per_depth(length * optical_depth)
    if r1 == 1.0 and 1.0 - opacity.real < FLOOR:
        # The floor does not hold for the whole: its back boundary is reached with 1 - A.
        optical = optical + (optical_transmittance(fragment, 1.0, mix) - (1.0 - opacity)) / opacity
    return (beta * length + (1.0 - beta) * optical) / passed


def part_between(fragment: Fragment, begin: float, end: float, beta: float, mix: str = "opacity") -> Piece:
    """The part of a fragment's slab between two depths; a fragment without thickness is not divided."""
    if fragment.front.real >= fragment.depth.real:
        # Also where the thickness is lost in the rounding of the depth: no boundary lies inside such a slab.
        return part(fragment, 0.0, 1.0, beta, mix)

    def relative(depth: float) -> float:
        if depth.real <= fragment.front.real:
            return 0.0
        if depth.real >= fragment.depth.real:
            return 1.0
        return (depth - fragment.depth + fragment.thickness) / fragment.thickness

    return part(fragment, relative(begin), relative(end), beta, mix)


# Sections 4 to 6: overlap and the two ways to merge.


def overlap(a: Fragment, b: Fragment) -> bool:
    """Tell whether two slabs share more than a boundary."""
    return a.depth.real > b.front.real and b.depth.real > a.front.real


def sfm(first: Fragment, second: Fragment, beta: float, mix: str = "opacity") -> Fragment:
    """Merge two overlapping fragments smoothly; `first` is the one whose back comes first."""
    front, middle = sorted((first.front, second.front), key=lambda depth: depth.real)
    opening = first if first.front.real <= second.front.real else second
    shared = mix_pieces(
        part_between(first, middle, first.depth, beta, mix), part_between(second, middle, first.depth, beta, mix), mix
    )
    rest = part_between(second, first.depth, second.depth, beta, mix)
    merged = over(part_between(opening, front, middle, beta, mix), over(shared, rest))
    thickness = second.depth - front
    return Fragment(merged.color, merged.opacity, second.depth, thickness, merged.opacity_sum, merged.opaque_count)


def ofm(a: Fragment, b: Fragment, mix: str = "opacity") -> Fragment:
    """Merge two fragments without regard to their order."""
    mixed = mix_pieces(whole(a), whole(b), mix)
    depth = max(a.depth, b.depth, key=lambda depth: depth.real)
    front = min(a.front, b.front, key=lambda depth: depth.real)
    return Fragment(mixed.color, mixed.opacity, depth, depth - front, mixed.opacity_sum, mixed.opaque_count)


# Section 7: the resolve pass.


def tail(running: Fragment, successor: Fragment) -> Fragment:
    """Take a fragment that does not overlap into the last layer, by over."""
    both = over(whole(running), whole(successor))
    thickness = successor.depth - running.depth + running.thickness
    return Fragment(both.color, both.opacity, successor.depth, thickness, both.opacity_sum, both.opaque_count)


def sort_fragments(fragments: list[Fragment]) -> list[Fragment]:
    """Order fragments by depth, then front, then submission."""
    return sorted(fragments, key=lambda fragment: (fragment.depth.real, fragment.front.real))


def resolve_pixel(
    fragments: list[Fragment], beta: float = 1.0, max_layers: int = 8, merge: str = "smooth", mix: str = "opacity"
) -> list[Fragment]:
    """Turn the fragments of a pixel, in any order, into at most `max_layers` layers in depth order."""
    if merge not in ("none", "smooth", "order_independent"):
        raise ValueError(f"merge is {merge!r}, expected 'none', 'smooth' or 'order_independent'")
    layers: list[Fragment] = []
    running = None
    for successor in sort_fragments(fragments):
        if running is None:
            running = successor
        elif merge == "smooth" and overlap(running, successor):
            running = sfm(running, successor, beta, mix)
        elif merge == "order_independent" and overlap(running, successor):
            running = ofm(running, successor, mix)
        elif len(layers) < max_layers - 1:
            layers.append(running)
            running = successor
        else:
            running = tail(running, successor)
    return layers if running is None else [*layers, running]


def composite_pixel(layers: list[Fragment]) -> np.ndarray:
    """Over of the layers in order: premultiplied rgba."""
    image = NOTHING
    for layer in layers:
        image = over(image, Piece(layer.color, layer.opacity, layer.opacity_sum))
    return np.append(image.color, image.opacity)


# Section 11: z-thickness from depth precision.


def z_resolution(depth: np.ndarray, near: float, far: float, bits: int = 24) -> np.ndarray:
    """P(z): the smallest depth difference that a z-buffer of so many bits resolves."""
    b = near * far / (far - near)
    delta = 2.0**-bits
    return depth**2 * delta / (b + depth * delta)


# Whole arrays of ragged pixels.


class Layers(NamedTuple):
    """Layers of all pixels, zero past `count`."""

    rgba: np.ndarray  # (P, M, 4)
    depth: np.ndarray  # (P, M)
    thickness: np.ndarray  # (P, M)
    opacity_sum: np.ndarray  # (P, M)
    count: np.ndarray  # (P,)


def pixel_fragments(rows: np.ndarray) -> list[Fragment]:
    """Make fragments of rows of (r, g, b, A, z, t) or (r, g, b, A, z, t, S); without S, S = A."""
    fragments = []
    for row in rows:
        opacity, depth, thickness, *opacity_sum = row[3:].tolist()
        fragments.append(Fragment(row[:3], opacity, depth, thickness, opacity_sum[0] if opacity_sum else opacity))
    return fragments


def fragment_rows(rgba: np.ndarray, depth: np.ndarray, thickness: np.ndarray, opacity_sum: np.ndarray | None):
    """Put the values of each fragment into one row, float64."""
    columns = [rgba, depth, thickness] + ([] if opacity_sum is None else [opacity_sum])
    return np.column_stack([np.asarray(column, dtype=np.float64) for column in columns])


def resolve(
    rgba: np.ndarray,
    depth: np.ndarray,
    thickness: np.ndarray,
    offsets: np.ndarray,
    beta: float | np.ndarray = 1.0,
    opacity_sum: np.ndarray | None = None,
    max_layers: int = 8,
    merge: str = "smooth",
    mix: str = "opacity",
) -> Layers:
    """Resolve every pixel; `beta` is one number or one per pixel (P,)."""
    rows = fragment_rows(rgba, depth, thickness, opacity_sum)
    pixel_count = len(offsets) - 1
    betas = np.broadcast_to(np.asarray(beta, dtype=np.float64), (pixel_count,)).tolist()
    dense = np.zeros((pixel_count, max_layers, 7))
    count = np.zeros(pixel_count, dtype=np.int32)
    for pixel in range(pixel_count):
        fragments = pixel_fragments(rows[offsets[pixel] : offsets[pixel + 1]])
        layers = resolve_pixel(fragments, betas[pixel], max_layers, merge, mix)
        count[pixel] = len(layers)
        for slot, layer in enumerate(layers):
            dense[pixel, slot] = (*layer.color, *layer[1:5])
    return Layers(dense[..., :4], dense[..., 4], dense[..., 5], dense[..., 6], count)


def composite(rgba: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Composite the layers (P, M, 4) of every pixel, `count` of them: (P, 4), premultiplied."""
    image = np.zeros((len(rgba), 4))
    for pixel in range(len(rgba)):
        for layer in range(count[pixel]):
            image[pixel] = image[pixel] + (1.0 - image[pixel, 3]) * rgba[pixel, layer]
    return image
