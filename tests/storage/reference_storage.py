"""Which fragments of a pixel each method captures, in the words of the papers: plain loops over the true list.

A pixel is a list of pairs (item, key) in order of submission: the triangle, by which its ids are ordered, and what its
depth is compared by.
"""

from itertools import groupby

ROBUST = (
    "dfb",
    "dxdfb",
    "s_buffer",
    "linked_list",
    "paged_list",
    "f2b_2p",
    "f2b_3p",
    "f2b_ll",
    "dual_2p",
    "dual_ll",
    "bun_ll",
)


def layers_of(pixel):
    """Return the fragments of each depth, nearest first, in order of submission."""
    ordered = sorted(pixel, key=lambda fragment: fragment[1])
    return [list(layer) for _, layer in groupby(ordered, key=lambda fragment: fragment[1])]


def last_of_each_layer(pixel):
    """Return one fragment of each depth, the last that is drawn."""
    return [max(layer) for layer in layers_of(pixel)]


def first_of_each_layer(pixel, slots):
    """Return of each depth as many fragments as there are slots, the first that are drawn."""
    return [fragment for layer in layers_of(pixel) for fragment in layer[:slots]]


def nearest(pixel, slots, hazard=1):
    """Return the K nearest, of equals the first; of each `hazard` that follow one another only the last is seen."""
    groups = [pixel[begin : begin + hazard] for begin in range(0, len(pixel), hazard)]
    kept = []
    for group in groups:
        kept = sorted([*kept, group[-1]], key=lambda fragment: fragment[1])[:slots]
    return kept


def captured(method, pixel, *, slots=8, packed=False, hazard=1, max_passes=None, **unused):
    """Return what a method captures of a pixel.

    Args:
        method: its name.
        pixel: the fragments.
        slots: K.
        packed: whether attributes are packed.
        hazard: fragments that read before any of them writes.
        max_passes: passes of the stencil-routed A-buffer.
        unused: options that change nothing.
    """
    if method in ROBUST:
        return pixel
    if method in ("f2b", "f2b2", "dual", "bun", "bad"):
        return last_of_each_layer(pixel)
    if method in ("f2b_fab", "f2b_kb", "dual_fab"):
        return first_of_each_layer(pixel, slots * (4 if packed else 1))
    if method == "multi_kb":
        return first_of_each_layer(pixel, slots * (2 if packed else 1))
    if method == "fixed_array":
        return pixel[:slots]
    if method == "srab":
        return pixel if max_passes is None else pixel[: slots * max_passes]
    if method in ("kb", "k_plus_array", "k_plus_heap"):
        return nearest(pixel, slots * (2 if packed else 1), hazard)
    raise AssertionError(f"{method} is not described")


def passes(method, pixels, *, slots=8, buckets=8, words=8, max_passes=None, **unused):
    """Return the passes over the geometry that a method of many passes makes for all pixels together.

    Args:
        method: its name.
        pixels: the fragments of each pixel.
        slots: K.
        buckets: B.
        words: words of an occupancy map.
        max_passes: most passes.
        unused: options that change nothing.
    """
    layers = max((len(layers_of(pixel)) for pixel in pixels), default=0)
    pairs = max((sum(-(-len(layer) // 2) for layer in layers_of(pixel)) for pixel in pixels), default=0)
    count = {
        "dfb": 2, "dxdfb": 2, "s_buffer": 2, "fixed_array": 1, "kb": 1, "k_plus_array": 1, "k_plus_heap": 1,
        "f2b": layers, "f2b2": 2 * layers, "f2b_ll": 2 * layers, "f2b_fab": 2 * layers, "f2b_kb": 2 * layers,
        "f2b_2p": 2 * pairs + 1, "f2b_3p": 3 * pairs,
        "dual": -(-layers // 2) + 1, "dual_ll": 2 * -(-layers // 2), "dual_fab": 2 * -(-layers // 2),
        "srab": max_passes or -(-max(map(len, pixels)) // slots),
    }[method]  # fmt: skip
    return count if max_passes is None else min(count, max_passes)


def pool_keeps(fragments, width, pool, page=1, band_rows=16):
    """Return which fragments find room in a pool that does not grow: bands of rows, each in order of submission.

    Args:
        fragments: pairs (pixel, item).
        width: pixels of a row.
        pool: fragments that there is room for, in pages.
        page: fragments of a page.
        band_rows: rows of a band.
    """
    order = sorted(fragments, key=lambda each: (each[0] // width // band_rows, each[1], each[0]))
    pages, sizes, kept = 0, {}, []
    for pixel, item in order:
        size = sizes.get(pixel, 0)
        if size % page == 0:
            if pages == -(-pool // page):
                continue
            pages += 1
        sizes[pixel] = size + 1
        kept.append((pixel, item))
    return kept
