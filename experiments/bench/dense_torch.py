"""The composites of warpfrag as a PyTorch user would write them, to compare values, gradients and speed with.

Fragments lie in dense arrays (P, N), sorted in depth; all pixels take each step together, cases are chosen by
`torch.where`, and autograd keeps every intermediate of every step. Works in eager mode and under `torch.compile`
(the loop over N unrolls).
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

FLOOR = 1e-6
"""Least transmittance of a slab that is to be divided."""

TINY = 1e-12
"""Keeps 0/0 behind an opaque part finite; the quotient is multiplied by a transmittance of 0."""


class Slabs(NamedTuple):
    """One fragment of each pixel."""

    color: Tensor  # (P, 3) premultiplied
    opacity: Tensor  # (P,)
    depth: Tensor  # (P,)
    front: Tensor  # (P,)
    opacity_sum: Tensor  # (P,)


def over(rgba: Tensor) -> Tensor:
    """Composite sorted fragments (P, N, 4) to (P, 4), no merging."""
    transmittance = torch.cumprod(1.0 - rgba[..., 3], dim=1)
    visibility = torch.cat([torch.ones_like(transmittance[:, :1]), transmittance[:, :-1]], dim=1)
    return (visibility[..., None] * rgba).sum(dim=1)


def composite(rgba: Tensor, depth: Tensor, thickness: Tensor, beta: Tensor, max_layers: int = 8) -> Tensor:
    """Merge overlapping neighbours smoothly (mix "opacity") into at most `max_layers` layers and composite them.

    Args:
        rgba: Premultiplied colour and opacity, shape (P, N, 4). Padding has all zeros.
        depth: Depth of the back boundaries, ascending in each row, ties by front, shape (P, N).
        thickness: z-thickness, shape (P, N); 0 in padding.
        beta: 0 for optical, 1 for linear slabs, 0-d.
        max_layers: Number of layers; what does not overlap beyond goes into the last, by over.

    Returns:
        Premultiplied rgba, shape (P, 4).
    """
    colors, opacities = rgba[..., :3].unbind(1), rgba[..., 3].unbind(1)
    depths, fronts = depth.unbind(1), (depth - thickness).unbind(1)
    running = Slabs(colors[0], opacities[0], depths[0], fronts[0], opacities[0])
    image = torch.zeros_like(colors[0])
    transmittance = torch.ones_like(opacities[0])
    layer_count = torch.zeros_like(opacities[0], dtype=torch.int32)

    for fragment in zip(colors[1:], opacities[1:], depths[1:], fronts[1:], opacities[1:], strict=True):
        successor = Slabs(*fragment)
        overlap = (running.depth > successor.front) & (successor.depth > running.front)
        full = layer_count >= max_layers - 1

        put_out = ~overlap & ~full
        image = image + torch.where(put_out, transmittance, 0.0)[:, None] * running.color
        transmittance = torch.where(put_out, transmittance * (1.0 - running.opacity), transmittance)
        layer_count = layer_count + put_out.int()

        merged = smooth_merge(running, successor, beta, overlap)
        behind = append(running, successor)
        running = choose(overlap, merged, choose(full, behind, successor))

    image = image + transmittance[:, None] * running.color
    transmittance = transmittance * (1.0 - running.opacity)
    return torch.cat([image, (1.0 - transmittance)[:, None]], dim=1)


def choose(condition: Tensor, yes: Slabs, no: Slabs) -> Slabs:
    """Select a fragment in each pixel."""
    color = torch.where(condition[:, None], yes.color, no.color)
    return Slabs(color, *(torch.where(condition, a, b) for a, b in zip(yes[1:], no[1:], strict=True)))


def append(running: Slabs, successor: Slabs) -> Slabs:
    """Take the successor into the tail, by over."""
    passed = 1.0 - running.opacity
    return Slabs(
        running.color + passed[:, None] * successor.color,
        running.opacity + passed * successor.opacity,
        successor.depth,
        running.front,
        running.opacity_sum + successor.opacity_sum,
    )


def smooth_merge(first: Slabs, second: Slabs, beta: Tensor, overlap: Tensor) -> Slabs:
    """Merge two fragments; where they do not overlap the result is finite and to be ignored."""
    first_length = (first.depth - first.front).clamp(min=0.0)
    second_length = (second.depth - second.front).clamp(min=0.0)
    cut_first = relative(second.front - first.front, first_length, overlap)
    cut_second = relative(first.front - second.front, second_length, overlap)
    end_second = relative(first.depth - second.front, second_length, overlap)

    upto_first = opacity_upto(first.opacity, cut_first, beta)
    before_second = opacity_upto(second.opacity, cut_second, beta)
    upto_second = opacity_upto(second.opacity, end_second, beta)
    rest_first = (first.opacity - upto_first) / (1.0 - upto_first).clamp(min=TINY)
    mid_second = (upto_second - before_second) / (1.0 - before_second).clamp(min=TINY)
    rest_second = (second.opacity - upto_second) / (1.0 - upto_second).clamp(min=TINY)

    # One of the two front parts is empty.
    front_opacity = upto_first + before_second
    front_color = part_color(first, upto_first, cut_first) + part_color(second, before_second, cut_second)

    first_weight = quotient(first.opacity_sum, first.opacity)
    second_weight = quotient(second.opacity_sum, second.opacity)
    mid_opacity = rest_first + mid_second - rest_first * mid_second
    mid_sum = first_weight * rest_first + second_weight * mid_second
    mid_color = quotient(mid_opacity, mid_sum)[:, None] * (
        first_weight[:, None] * part_color(first, rest_first, 1.0 - cut_first)
        + second_weight[:, None] * part_color(second, mid_second, end_second - cut_second)
    )
    rest_color = part_color(second, rest_second, 1.0 - end_second)

    back_opacity = mid_opacity + (1.0 - mid_opacity) * rest_second
    back_color = mid_color + (1.0 - mid_opacity)[:, None] * rest_color
    return Slabs(
        front_color + (1.0 - front_opacity)[:, None] * back_color,
        front_opacity + (1.0 - front_opacity) * back_opacity,
        second.depth,
        torch.minimum(first.front, second.front),
        first_weight * (upto_first + rest_first) + second_weight * (before_second + mid_second + rest_second),
    )


def relative(distance: Tensor, length: Tensor, overlap: Tensor) -> Tensor:
    """Position in a slab as a share of its length, 0 … 1; 0 where it does not matter."""
    inside = overlap & (length > 0.0)
    return torch.where(inside, distance / torch.where(inside, length, 1.0), 0.0).clamp(0.0, 1.0)


def opacity_upto(opacity: Tensor, r: Tensor, beta: Tensor) -> Tensor:
    """Opacity of the front part of relative length r."""
    optical = -torch.expm1(r * torch.log((1.0 - opacity).clamp(min=FLOOR)))
    return torch.where(r < 1.0, beta * r * opacity + (1.0 - beta) * optical, opacity)


def part_color(slab: Slabs, part_opacity: Tensor, part_length: Tensor) -> Tensor:
    """Colour of a part: in proportion to its opacity, or to its length where the slab has no opacity."""
    return slab.color * quotient(part_opacity, slab.opacity, part_length)[:, None]


def quotient(numerator: Tensor, denominator: Tensor, limit: Tensor | float = 1.0) -> Tensor:
    """Divide; `limit` where the denominator is 0, without NaN on the way back."""
    positive = denominator > 0.0
    return torch.where(positive, numerator / torch.where(positive, denominator, 1.0), limit)


def pack(
    rgba: np.ndarray, depth: np.ndarray, thickness: np.ndarray, offsets: np.ndarray, dtype=torch.float32, device="cpu"
) -> tuple[Tensor, Tensor, Tensor]:
    """Sort ragged NumPy fragments and pad them to dense tensors: rgba (P, N, 4), depth (P, N), thickness (P, N)."""
    counts = np.diff(offsets)
    pixel = np.repeat(np.arange(len(counts)), counts)
    order = np.lexsort((depth - thickness, depth, pixel))
    slot = np.arange(len(depth)) - np.repeat(np.asarray(offsets)[:-1], counts)
    shape = (len(counts), max(int(counts.max(initial=0)), 1))
    # Padding lies behind everything, touches nothing, and being transparent leaves no trace.
    dense = [np.zeros((*shape, 4)), np.full(shape, depth.max(initial=0.0)), np.zeros(shape)]
    for array, values in zip(dense, (rgba, depth, thickness), strict=True):
        array[pixel, slot] = values[order]
    return tuple(torch.as_tensor(array, dtype=dtype, device=device) for array in dense)
