"""Bounded against unbounded: a scene straight into a k-buffer (SKB+OFM) and stored, sorted, merged (DFB+SFM).

Small triangles all over an orthographic image: first more and more layers at one size, then more and more pixels at one
number of layers. Times include the projection of the mesh, which both sides do; memory is what the process grows by.
The last columns are times relative to the first row's.
"""

import argparse
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from measure import medians, memory_growth, milliseconds, quiet_warp, ratio, set_threads, show

quiet_warp()

import warpfrag as wf  # noqa: E402


def tangle(size: int, layers: int, edge: float, seed: int = 0) -> wf.Scene:
    """Return triangles of random corners that cover every pixel `layers` times on average, in random order.

    Args:
        size: pixels along an edge of the image.
        layers: fragments of a pixel on average.
        edge: largest distance of a corner from the middle of its triangle, along an axis [pixels].
        seed: of the random numbers.
    """
    random = np.random.default_rng(seed)
    # The expected area of a triangle whose corners are uniform in a square of side 2 e is 11/144 of the square's.
    count = max(1, round(layers * (size + edge) ** 2 / (11.0 / 144.0 * (2.0 * edge) ** 2)))
    half = 0.5 * (size + edge)
    middle = random.uniform([-half, -half, 2.0], [half, half, 50.0], (count, 1, 3))
    corners = middle + random.uniform(-1.0, 1.0, (count, 3, 3)) * [edge, edge, 0.2]
    item = wf.SceneObject(
        "tangle",
        corners.reshape(-1, 3).astype(np.float32),
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        color=random.random((3 * count, 3), dtype=np.float32),
        opacity=random.uniform(0.05, 0.3, 3 * count).astype(np.float32),
        thickness=0.2,
        thickness_unit="scene",
    )
    camera = wf.Camera((0, 0, 0), (0, 0, 1), (0, -1, 0), height=float(size), near=1.0, far=60.0, size=(size, size))
    return wf.Scene(camera, [item])


def sides(scene: wf.Scene, slots: int) -> dict[str, Callable[[], Any]]:
    """Return what is compared, each from scene to image."""
    return {
        "SKB+OFM": lambda: wf.composite(wf.storage.capture_kbuffer(scene, slots=slots)),
        "SKB": lambda: wf.composite(wf.storage.capture_kbuffer(scene, slots=slots, merge="none")),
        "DFB+SFM": lambda: wf.render(scene, max_layers=slots, merge="smooth", mix="opacity"),
    }


def tabulate(title: str, name: str, scenes: Mapping[int, wf.Scene], slots: int, repetitions: int) -> None:
    """Measure some scenes and print a row for each."""
    times = {key: medians(sides(scene, slots), repetitions) for key, scene in scenes.items()}
    grown = {
        key: {side: memory_growth(function)[0] for side, function in sides(scene, slots).items()}
        for key, scene in scenes.items()
    }
    first = times[next(iter(times))]
    rows = [
        [
            str(key),
            f"{len(scenes[key].objects[0].faces)}",
            *(milliseconds(found[side]) for side in found),
            ratio(found["DFB+SFM"], found["SKB+OFM"]),
            *(f"{grown[key][side] / 2**20:.0f} MiB" for side in ("SKB+OFM", "DFB+SFM")),
            *(ratio(found[side], first[side]) for side in ("SKB+OFM", "DFB+SFM")),
        ]
        for key, found in times.items()
    ]
    memory = ["SKB+OFM, memory", "DFB+SFM, memory"]
    growth = ["SKB+OFM, relative", "DFB+SFM, relative"]
    show(title, [name, "triangles", *first, "DFB+SFM / SKB+OFM", *memory, *growth], rows)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--layers", type=int, nargs="+", default=[8, 16, 32, 64, 128, 256], help="fragments a pixel")
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256, 512, 1024], help="edges of the image")
    parser.add_argument("--size", type=int, default=512, help="edge of the image while layers grow")
    parser.add_argument("--depth", type=int, default=32, help="layers while the image grows")
    parser.add_argument("--slots", type=int, default=8, help="slots, and layers of DFB+SFM")
    parser.add_argument("--edge", type=float, default=12.0, help="half the width of a triangle's square [pixels]")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads")
    parser.add_argument("--repetitions", type=int, default=5, help="timed calls of each")
    arguments = parser.parse_args()
    set_threads(arguments.threads)
    slots, repetitions = arguments.slots, arguments.repetitions
    setting = f"{slots} slots, {arguments.threads} thread(s)"
    scenes = {layers: tangle(arguments.size, layers, arguments.edge) for layers in arguments.layers}
    tabulate(f"Layers, {arguments.size}², {setting}", "layers", scenes, slots, repetitions)
    scenes = {size: tangle(size, arguments.depth, arguments.edge) for size in arguments.sizes}
    tabulate(f"Pixels, {arguments.depth} layers, {setting}", "edge", scenes, slots, repetitions)


if __name__ == "__main__":
    main()
