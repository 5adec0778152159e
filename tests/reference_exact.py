"""Slow reference of exact merging (section 9), in plain loops over `reference`'s pieces, and its gradients.

All boundaries cut the ray into intervals; in each the parts of all slabs that cover it are mixed; intervals are
composited by over. Numbers may be complex, as in `reference`: every decision looks at real parts only.
"""

from typing import NamedTuple

import numpy as np
from reference import (
    NOTHING,
    Fragment,
    Layers,
    Piece,
    absorbed_per_depth,
    composite_pixel,
    depth_per_opacity,
    fragment_rows,
    over,
    part_between,
    pixel_fragments,
    tail,
)
from reference_gradient import STEP


def mix_all(pieces: list[Piece], mix: str) -> Piece:
    """Let any number of pieces fill the same space: section 2 for n of them, in no order."""
    if len(pieces) == 1:
        return pieces[0]
    opacity, opacity_sum = 0.0, 0.0
    for piece in pieces:
        opacity = opacity + (1.0 - opacity) * piece.opacity
        opacity_sum = opacity_sum + piece.opacity_sum
    if mix == "opacity":
        factor = opacity / opacity_sum if opacity_sum.real != 0.0 else 1.0
        color = sum(piece.color * piece.weight for piece in pieces) * factor
    elif mix == "optical_depth":
        opaque = [piece.color for piece in pieces if piece.opacity.real == 1.0]
        if opaque:
            color = sum(opaque) / len(opaque)
        else:
            ratios = [depth_per_opacity(piece.opacity) for piece in pieces]
            depth = sum(piece.opacity * ratio for piece, ratio in zip(pieces, ratios, strict=True))
            color = sum(piece.color * ratio for piece, ratio in zip(pieces, ratios, strict=True))
            color = color * absorbed_per_depth(depth)
    else:
        raise ValueError(f"mix is {mix!r}, expected 'opacity' or 'optical_depth': the average is not associative")
    return Piece(color, opacity, opacity_sum)


def is_surface(fragment: Fragment) -> bool:
    """Tell whether a fragment has no thickness, or one that is lost in the rounding of its depth."""
    return fragment.front.real >= fragment.depth.real


def runs(fragments: list[Fragment]) -> list[list[Fragment]]:
    """Divide fragments into connected runs of overlapping slabs, in order of depth.

    Slabs that only touch, and a surface on a boundary, are apart; surfaces at one depth are one interval, so together.
    """
    found: list[list[Fragment]] = []
    end = -np.inf
    for fragment in sorted(fragments, key=lambda f: (f.front.real, f.depth.real)):
        same_surface = bool(found) and all(is_surface(f) and f.depth.real == fragment.depth.real for f in found[-1])
        if found and (fragment.front.real < end or (is_surface(fragment) and same_surface)):
            found[-1].append(fragment)
        else:
            found.append([fragment])
        end = max(end, fragment.depth.real)
    return found


def merge_run(run: list[Fragment], betas: dict[int, float], mix: str) -> Fragment:
    """Merge the fragments of one run into a layer; `betas` by the identity of a fragment."""
    # Where an interval before ends and the next begins; the first boundary to lie at a depth keeps it.
    ends: dict[float, float] = {}
    begins: dict[float, float] = {}
    for fragment in [f for f in run if is_surface(f)]:
        ends.setdefault(fragment.depth.real, fragment.front + (fragment.depth.real - fragment.front.real))
        begins.setdefault(fragment.depth.real, fragment.depth)
    for boundary in [f.front for f in run if not is_surface(f)] + [f.depth for f in run]:
        ends.setdefault(boundary.real, boundary)
        begins.setdefault(boundary.real, boundary)
    cuts = sorted(ends)
    merged = NOTHING
    for index, cut in enumerate(cuts):
        surfaces = [f for f in run if is_surface(f) and f.depth.real == cut]
        if surfaces:
            # The slabs around are in it with no length: all that counts is how that would grow with the thickness.
            around = [f for f in run if f.front.real < cut < f.depth.real]
            parts = [part_between(f, ends[cut], begins[cut], betas[id(f)], mix) for f in around]
            merged = over(merged, mix_all(parts + [Piece(f.color, f.opacity, f.opacity_sum) for f in surfaces], mix))
        if index + 1 < len(cuts):
            end = cuts[index + 1]
            filling = [f for f in run if f.front.real <= cut and f.depth.real >= end and not is_surface(f)]
            parts = [part_between(f, begins[cut], ends[end], betas[id(f)], mix) for f in filling]
            if parts:
                merged = over(merged, mix_all(parts, mix))
    depth = max((f.depth for f in run), key=lambda depth: depth.real)
    front = min((f.front for f in run), key=lambda depth: depth.real)
    return Fragment(merged.color, merged.opacity, depth, depth - front, merged.opacity_sum)


def resolve_pixel_exactly(
    fragments: list[Fragment], betas: list[float], max_layers: int = 8, mix: str = "opacity"
) -> list[Fragment]:
    """Turn the fragments of a pixel, each with its β, into at most `max_layers` layers in depth order."""
    beta_of = {id(fragment): beta for fragment, beta in zip(fragments, betas, strict=True)}
    layers: list[Fragment] = []
    for run in runs(fragments):
        layer = merge_run(run, beta_of, mix)
        if len(layers) < max_layers:
            layers.append(layer)
        else:
            layers[-1] = tail(layers[-1], layer)
    return layers


def by_fragment(beta: float | np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """One β per fragment, from one number, one per pixel (P,) or one per fragment (F,)."""
    beta = np.asarray(beta, dtype=np.float64)
    if beta.shape == (len(offsets) - 1,) and beta.shape != (offsets[-1],):
        beta = np.repeat(beta, np.diff(offsets))
    return np.broadcast_to(beta, (offsets[-1],))


def resolve_exactly(
    rgba, depth, thickness, offsets, beta=1.0, opacity_sum=None, max_layers: int = 8, mix: str = "opacity"
) -> Layers:
    """Resolve every pixel; `beta` is one number, one per pixel (P,) or one per fragment (F,)."""
    rows, betas = fragment_rows(rgba, depth, thickness, opacity_sum), by_fragment(beta, offsets)
    pixel_count = len(offsets) - 1
    dense = np.zeros((pixel_count, max_layers, 7))
    count = np.zeros(pixel_count, dtype=np.int32)
    for pixel in range(pixel_count):
        own = slice(offsets[pixel], offsets[pixel + 1])
        layers = resolve_pixel_exactly(pixel_fragments(rows[own]), betas[own].tolist(), max_layers, mix)
        count[pixel] = len(layers)
        for slot, layer in enumerate(layers):
            dense[pixel, slot] = (*layer.color, *layer[1:5])
    return Layers(dense[..., :4], dense[..., 4], dense[..., 5], dense[..., 6], count)


class Gradients(NamedTuple):
    """Derivatives by each input, all by fragment; `opacity_sum` None where it was not given (then S = A)."""

    rgba: np.ndarray  # (F, 4)
    depth: np.ndarray  # (F,)
    thickness: np.ndarray  # (F,)
    beta: np.ndarray  # (F,)
    opacity_sum: np.ndarray | None  # (F,)


def exact_gradient(
    rgba, depth, thickness, offsets, beta=1.0, opacity_sum=None, *, cotangents=None, image_cotangent=None, **options
) -> Gradients:
    """Pull cotangents of the layers (rgba, depth, thickness, opacity_sum), or of the image, back by complex steps."""
    rows, betas = fragment_rows(rgba, depth, thickness, opacity_sum), by_fragment(beta, offsets)
    # One more column: β.
    rows = np.column_stack([rows, betas])
    grads = np.zeros_like(rows)

    def objective(pixel: int, own_rows: np.ndarray) -> float:
        layers = resolve_pixel_exactly(pixel_fragments(own_rows[:, :-1]), own_rows[:, -1].tolist(), **options)
        if image_cotangent is not None:
            return np.sum(image_cotangent[pixel] * composite_pixel(layers))
        total = 0.0
        for slot, layer in enumerate(layers):
            values = (np.append(layer.color, layer.opacity), *layer[2:5])
            for cotangent, value in zip(cotangents, values, strict=True):
                total = total + np.sum(cotangent[pixel, slot] * value)
        return total

    for pixel in range(len(offsets) - 1):
        own = slice(offsets[pixel], offsets[pixel + 1])
        for index in np.ndindex(rows[own].shape):
            perturbed = rows[own].astype(np.complex128)
            perturbed[index] += 1j * STEP
            grads[own][index] = np.imag(objective(pixel, perturbed)) / STEP
    by_sum = None if opacity_sum is None else grads[:, 6]
    return Gradients(grads[:, :4], grads[:, 4], grads[:, 5], grads[:, -1], by_sum)
