"""Slow reference of the bounded k-buffer: FORMULAS' four rules, one fragment after the other, nothing kept sorted.

Numbers may be complex, as in `reference`.
"""

import numpy as np
from reference import Fragment, Layers, fragment_rows, ofm, overlap, pixel_fragments


def kbuffer_pixel(
    fragments: list[Fragment], slots: int = 8, merge: str = "order_independent", tail: str = "mix"
) -> list[Fragment]:
    """Stream a pixel's fragments, in the order given, into its slots; return them in depth order."""
    if merge == "none":
        fragments = [fragment._replace(thickness=0.0 * fragment.thickness) for fragment in fragments]
    core: list[Fragment] = []
    core_size = slots - 1 if tail == "mix" else slots
    last: Fragment | None = None
    for fragment in fragments:
        if last is not None and fragment.depth.real > last.front.real:
            last = ofm(last, fragment)
            continue
        grown, overlapped = fragment, True
        merged = False
        while merge != "none" and overlapped:
            overlapped = False
            for slot in core:
                if overlap(slot, grown):
                    core = [other for other in core if other is not slot]
                    grown, overlapped, merged = ofm(slot, grown), True, True
                    break
        if merged or len(core) < core_size:
            core.append(grown)
            continue
        # Python's sort is stable: of two at the same place, the one that came first is the nearer.
        *core, loser = sorted([*core, fragment], key=place)
        if tail == "mix":
            last = loser if last is None else ofm(last, loser)
    return [*sorted(core, key=place), *([] if last is None else [last])]


def place(fragment: Fragment) -> tuple[float, float]:
    """Depth, then front."""
    return fragment.depth.real, fragment.front.real


def kbuffer(rgba, depth, thickness, offsets, opacity_sum=None, slots: int = 8, **options) -> Layers:
    """Stream every pixel of ragged fragments, in the order given."""
    rows = fragment_rows(rgba, depth, thickness, opacity_sum)
    dense = np.zeros((len(offsets) - 1, slots, 7))
    count = np.zeros(len(offsets) - 1, dtype=np.int32)
    for pixel in range(len(offsets) - 1):
        fragments = pixel_fragments(rows[offsets[pixel] : offsets[pixel + 1]])
        layers = kbuffer_pixel(fragments, slots, **options)
        count[pixel] = len(layers)
        for slot, layer in enumerate(layers):
            dense[pixel, slot] = (*layer.color, *layer[1:5])
    return Layers(dense[..., :4], dense[..., 4], dense[..., 5], dense[..., 6], count)


def kbuffer_gradient(rgba, depth, thickness, offsets, opacity_sum=None, *, cotangents, slots: int = 8, **options):
    """Pull cotangents of (rgba, depth, thickness, opacity_sum) back to the fragments by complex steps.

    Returns:
        One row (r, g, b, A, z, t), with S at the end if opacity sums are given, for each fragment.
    """
    step = 1e-30
    rows = fragment_rows(rgba, depth, thickness, opacity_sum)
    gradients = np.zeros_like(rows)
    for pixel in range(len(offsets) - 1):
        own = slice(offsets[pixel], offsets[pixel + 1])
        for index in np.ndindex(rows[own].shape):
            perturbed = rows[own].astype(np.complex128)
            perturbed[index] += 1j * step
            for slot, layer in enumerate(kbuffer_pixel(pixel_fragments(perturbed), slots, **options)):
                values = (np.append(layer.color, layer.opacity), *layer[2:5])
                for cotangent, value in zip(cotangents, values, strict=True):
                    gradients[own][index] += np.imag(np.sum(cotangent[pixel, slot] * value)) / step
    return gradients
