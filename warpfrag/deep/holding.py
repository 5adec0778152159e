"""Holding fragments out by others: cut at their boundaries, dimmed by what those let through.

It is made of functions of arrays, in float64, that torch differentiates. Which boundary cuts a fragment is held fixed;
where it lies is not: the ends of a part move with the boundaries that they are.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import dtype_name, kind_named
from warpfrag.deep.gather import IDS, gathered
from warpfrag.deep.lists import check_alike
from warpfrag.fragments import Fragments
from warpfrag.slabs.slab import THIN, THINNEST


def holdout(fragments: Fragments, holder: Fragments) -> Fragments:
    """Return what of some fragments remains in front of and inside of others: these hold them out, and are not seen.

    Each fragment is cut at the holder's fronts and backs. Of a part remains, of colour and opacity alike, what the
    holder lets through up to it; where both fill an interval, times the share that exact merging with
    mix "optical_depth" and beta 0 gives to the part: `(1 - exp(-u - v))/(u + v) * u/(1 - exp(-u))` for the optical
    depths u of the part and v of the holder there, and the mean where both are opaque. Fragments of one image do not
    hold out each other. What has neither opacity nor colour left is left out.

    Differentiable in torch, in `rgba`, `depth` and `thickness` of both and in `opacity_sum`; not on a `wp.Tape`, where
    the result has no gradient. Held fixed: which boundaries cut a fragment, and what is left out.

    Args:
        fragments: what is held out.
        holder: what holds it out, of the same grid, kind of array, precision and device.

    Returns:
        The parts that remain, in each pixel by fragment and from front to back, with the opacity sums and ids of their
        fragments (sums by their share of the opacity), offsets and ids in int32.

    Raises:
        TypeError: an argument is no `Fragments`, or kinds or precisions differ.
        ValueError: grids or devices differ, offsets do not fit, or a value is not finite or out of its range.
    """
    check_alike("fragments", fragments, fragments)
    check_alike("holder", holder, fragments)
    kind, own, other = kind_named(fragments.kind), fragments.numpy(), holder.numpy()
    own.validate()
    other.validate()
    if kind.xp is None:
        return _in_kind_of(fragments, holdout(own, other))
    parts = _cut(own, other)
    values = _held_out(fragments, holder, parts)
    kept = np.flatnonzero((kind.to_numpy(values["rgba"]) != 0.0).any(axis=1))
    ids = {name: getattr(fragments, name) for name in IDS if getattr(fragments, name) is not None}
    values |= {name: kind.astype(array, "int32")[parts.fragment] for name, array in ids.items()}
    whole = Fragments(**values, offsets=parts.offsets_like(fragments), shape=fragments.shape)
    return gathered(whole, kept, whole.pixel[kept])


@dataclass(frozen=True, eq=False)
class _Parts:
    """Fragments cut at boundaries of others.

    Attributes:
        fragment: which fragment each part is of, (N,).
        pixel: which pixel that is in, (N,).
        begin: the boundary that a part begins at: 2 j for the front, 2 j + 1 for the back of holder j, -1 for its own.
        end: the boundary that it ends at.
        holders: where the holder's fragments of each part's pixel begin and end, (N, 2).
        pixel_count: number of pixels.
    """

    fragment: np.ndarray
    pixel: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    holders: np.ndarray
    pixel_count: int

    def offsets_like(self, fragments: Fragments) -> Any:
        """Return offsets of the parts in the kind of some fragments."""
        kind = kind_named(fragments.kind)
        offsets = np.concatenate([[0], np.cumsum(np.bincount(self.pixel, minlength=self.pixel_count))])
        return kind.asarray(offsets, fragments.offsets)


def _divisible(depth: Any, thickness: Any, xp: Any) -> Any:
    """Return thicknesses, 0 for slabs that are too thin to be divided: they are surfaces, as everywhere."""
    thin = (thickness < THIN * abs(depth)) | (thickness < THINNEST)
    return xp.where(thin, xp.zeros_like(thickness), thickness)


def _cut(own: Fragments, others: Fragments) -> _Parts:
    """Cut fragments at the boundaries of others (both of them NumPy arrays)."""
    pixel = own.pixel
    back, thickness = own.depth.astype(np.float64), own.thickness.astype(np.float64)
    front = back - _divisible(back, thickness, np)
    edges = _boundaries(others.depth.astype(np.float64), others.thickness.astype(np.float64), np)
    begins, ends = others.offsets[:-1][pixel].astype(np.int64), others.offsets[1:][pixel].astype(np.int64)
    fragments, codes = [np.arange(own.count)], [np.full(own.count, -1)]
    for rank in range(int((ends - begins).max(initial=0))):
        holder = begins + rank
        for side in (0, 1):
            inside = np.flatnonzero(holder < ends)
            edge = edges[2 * holder[inside] + side]
            inside = inside[(edge > front[inside]) & (edge < back[inside])]
            fragments.append(inside)
            codes.append(2 * holder[inside] + side)
    fragment, code = np.concatenate(fragments), np.concatenate(codes)
    depth = np.where(code < 0, front[fragment], edges[code] if len(edges) else 0.0)
    order = np.lexsort((code, depth, fragment))
    fragment, code, depth = fragment[order], code[order], depth[order]
    # Of boundaries in one place one cuts.
    new = np.ones(len(order), bool)
    new[1:] = (fragment[1:] != fragment[:-1]) | (depth[1:] != depth[:-1])
    fragment, code = fragment[new], code[new]
    last = np.ones(len(code), bool)
    last[:-1] = fragment[1:] != fragment[:-1]
    following = np.where(last, -1, np.roll(code, -1))
    holders = np.stack([begins[fragment], ends[fragment]], axis=1)
    return _Parts(fragment, pixel[fragment], code, following, holders, own.pixel_count)


def _boundaries(depth: Any, thickness: Any, xp: Any) -> Any:
    """Return front and back of each slab, one after the other, (2 F,)."""
    return xp.stack((depth - _divisible(depth, thickness, xp), depth), 1).reshape(-1)


def _held_out(fragments: Fragments, holder: Fragments, parts: _Parts) -> dict[str, Any]:
    """Return what remains of each part, in the precision of the fragments; computed in float64."""
    kind = kind_named(fragments.kind)
    xp, precision = kind.xp, dtype_name(fragments.rgba)
    rgba, depth, own_thickness = (
        kind.astype(array, "float64")[parts.fragment]
        for array in (fragments.rgba, fragments.depth, fragments.thickness)
    )
    thickness = _divisible(depth, own_thickness, xp)
    other_rgba, other_depth, other_thickness = (
        kind.astype(array, "float64") for array in (holder.rgba, holder.depth, holder.thickness)
    )
    other_thickness = _divisible(other_depth, other_thickness, xp)
    # One more, for where a part has no boundary but its own.
    edges = xp.concatenate((_boundaries(other_depth, other_thickness, xp), kind.asarray([0.0], depth)))
    first, last = kind.asarray(parts.begin < 0, depth) != 0, kind.asarray(parts.end < 0, depth) != 0
    begin = xp.where(first, depth - thickness, edges[parts.begin])
    end = xp.where(last, depth, edges[parts.end])
    length = xp.where(first & last, xp.ones_like(depth), (end - begin) / xp.where(thickness > 0.0, thickness, 1.0))
    opacity = rgba[:, 3]
    own_depth, opaque = _optical_depth(opacity, xp)
    through, inside, opaque_holders = xp.ones_like(depth), xp.zeros_like(depth), xp.zeros_like(depth)
    for rank in range(int((parts.holders[:, 1] - parts.holders[:, 0]).max(initial=0))):
        at = parts.holders[:, 0] + rank
        there = kind.asarray(at < parts.holders[:, 1], depth)
        at = np.minimum(at, len(holder.depth) - 1)
        before, within = _shares(begin, end, other_depth[at], other_thickness[at], xp)
        before, within = before * there, within * there
        total, is_opaque = _optical_depth(other_rgba[at, 3], xp)
        through = through * xp.where(is_opaque, xp.where(before > 0.0, 0.0, 1.0), xp.exp(-before * total))
        inside = inside + xp.where(is_opaque, 0.0, within * total)
        opaque_holders = opaque_holders + xp.where(is_opaque & (within > 0.0), 1.0, 0.0)
    part = own_depth * length
    share = _absorption(part + inside, xp) / _absorption(part, xp)
    share = xp.where(opaque, 1.0 / (1.0 + opaque_holders), xp.where(opaque_holders > 0.0, 0.0, share))
    # Of a whole fragment the opacity is its own, to the bit; A_part / A is its length where A is 0.
    rest = xp.where(opaque | (first & last), 1.0, length * _absorption(part, xp) / _absorption(own_depth, xp))
    factor = rest * share * through
    values = {"rgba": rgba * factor[:, None], "depth": end}
    values["thickness"] = xp.where(first & last, own_thickness, end - begin)
    if fragments.opacity_sum is not None:
        values["opacity_sum"] = kind.astype(fragments.opacity_sum, "float64")[parts.fragment] * factor
    return {name: kind.astype(array, precision) for name, array in values.items()}


def _optical_depth(opacity: Any, xp: Any) -> tuple[Any, Any]:
    """Return -log(1 - A), 0 where that is infinite, and where it is."""
    opaque = opacity >= 1.0
    return -xp.log1p(-xp.where(opaque, 0.0, opacity)), opaque


def _absorption(u: Any, xp: Any) -> Any:
    """Return (1 - exp(-u))/u, 1 for u = 0."""
    small = u < 1e-5
    series = 1.0 - u * (0.5 - u / 6.0)
    safe = xp.where(small, 1.0, u)
    return xp.where(small, series, -xp.expm1(-safe) / safe)


def _shares(begin: Any, end: Any, back: Any, thickness: Any, xp: Any) -> tuple[Any, Any]:
    """Return which share of a slab's optical depth lies before an interval, and which within it.

    A surface lies behind slabs that end where it is, before those that begin there, and within a surface there.
    """
    slab = thickness > 0.0
    safe = xp.where(slab, thickness, 1.0)
    cuts = [xp.clip((edge - back + thickness) / safe, 0.0, 1.0) for edge in (begin, end)]
    is_before = (back < begin) | ((back == begin) & (end > begin))
    is_within = (back == begin) & (end == begin)
    before = xp.where(slab, cuts[0], xp.where(is_before, 1.0, 0.0))
    within = xp.where(slab, cuts[1] - cuts[0], xp.where(is_within, 1.0, 0.0))
    return before, within


def _in_kind_of(like: Fragments, host: Fragments) -> Fragments:
    kind = kind_named(like.kind)
    values = {name: array for name, array in vars(host).items() if isinstance(array, np.ndarray)}
    models = {name: like.offsets if name == "offsets" else getattr(like, name) for name in values}
    return replace(host, **{name: kind.asarray(array, models[name]) for name, array in values.items()})
