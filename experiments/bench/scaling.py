"""Cost against fragments per pixel: the number of fragments is the same everywhere, so a linear cost shows as flat.

The last two columns are nanoseconds a fragment relative to the first row's.
"""

import argparse
from functools import partial

import numpy as np
import torch
from composite import BETA, MAX_LAYERS, Side, forward, forward_backward
from measure import medians, quiet_warp, ragged, random_pixels, ratio, set_threads, show

quiet_warp()

import warpfrag as wf  # noqa: E402


def make_side(pixel_count: int, per_pixel: int, merge: str, shuffle: bool) -> Side:
    """Return the composite of random pixels, with gradients in everything."""
    arrays = random_pixels(pixel_count, per_pixel)
    if shuffle:
        order = np.random.default_rng(1).permuted(np.tile(np.arange(per_pixel), (pixel_count, 1)), axis=1)
        arrays = tuple(np.take_along_axis(a, order.reshape(*order.shape, *[1] * (a.ndim - 2)), axis=1) for a in arrays)
    fragments = ragged(*map(torch.from_numpy, arrays))
    leaves = (fragments.rgba, fragments.depth, fragments.thickness, torch.tensor(BETA))
    for leaf in leaves:
        leaf.requires_grad_()
    beta = leaves[-1]
    layers = per_pixel if merge == "none" else MAX_LAYERS
    return Side(lambda *_: wf.composite(fragments, beta, merge=merge, max_layers=layers).reshape(-1, 4), leaves)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--per-pixel", type=int, nargs="+", default=[4, 8, 16, 32, 64, 128, 256], help="fragments")
    parser.add_argument("--fragments", type=float, default=4.0, help="fragments in all [millions]")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads")
    parser.add_argument("--merge", choices=("smooth", "order_independent", "none"), default="smooth", help="merge")
    parser.add_argument("--shuffle", action="store_true", help="fragments of a pixel in random order, not sorted")
    parser.add_argument("--repetitions", type=int, default=7, help="timed calls of each")
    arguments = parser.parse_args()
    set_threads(arguments.threads)
    entries, counts = {}, {}
    for per_pixel in arguments.per_pixel:
        pixel_count = max(1, round(arguments.fragments * 1e6 / per_pixel))
        counts[per_pixel] = pixel_count * per_pixel
        side = make_side(pixel_count, per_pixel, arguments.merge, arguments.shuffle)
        entries[per_pixel, "forward"] = partial(forward, side)
        entries[per_pixel, "both"] = partial(forward_backward, side)
    times = medians(entries, arguments.repetitions)
    cost = {key: 1e9 * value / counts[key[0]] for key, value in times.items()}
    first = arguments.per_pixel[0]
    rows = [
        [
            str(per_pixel),
            *(f"{cost[per_pixel, name]:.1f} ns" for name in ("forward", "both")),
            *(ratio(cost[per_pixel, name], cost[first, name]) for name in ("forward", "both")),
        ]
        for per_pixel in arguments.per_pixel
    ]
    columns = ["fragments a pixel", "forward", "forward + backward", "forward, relative", "both, relative"]
    order = "shuffled" if arguments.shuffle else "sorted"
    show(f'composite, merge="{arguments.merge}", {order}, {arguments.threads} thread(s), a fragment', columns, rows)


if __name__ == "__main__":
    main()
