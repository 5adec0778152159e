"""The time of each pass of a render: triangles, count, scan + store, sort, shade, resolve + composite.

Every pass is timed where it is called inside `wf.render`, so that together they are the render, but for what stands
under "rest" (checks, sums, background). "triangles ... composite" is all that depends on the camera's pixels: it leaves
out assembling the scene and taking it to camera space.
"""

import argparse
import importlib
import os
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from measure import milliseconds, quiet_warp, ratio, show

quiet_warp()

import warp as wp  # noqa: E402

import warpfrag as wf  # noqa: E402

SCENE = Path(__file__).parents[2] / "scenes" / "bunny_in_sphere.toml"
# The functions of each pass: the module that calls them, and their name there.
PASSES = {
    "assemble": (("warpfrag.renderer", "surfaces_of"),),
    "triangles": (("warpfrag.capture.surfaces", "prepare_triangles"),),
    "count": (("warpfrag.renderer", "count_fragments"),),
    "scan + store": (("warpfrag.capture.coverage", "fill"),),
    "sort": (("warpfrag.capture.coverage", "sort_lists"),),
    "shade": (("warpfrag.capture.coverage", "apply"),),
    "resolve + composite": (("warpfrag.renderer", "composite"),),
}
NOT_PIXELS = ("assemble", "rest", "all")


def timed(function: Callable[..., Any], name: str, times: dict[str, float]) -> Callable[..., Any]:
    """Return a function that adds its time to `times`."""

    def call(*arguments: Any, **options: Any) -> Any:
        wp.synchronize()
        start = time.perf_counter()
        result = function(*arguments, **options)
        wp.synchronize()
        times[name] += time.perf_counter() - start
        return result

    return call


def render_once(scene: wf.Scene) -> dict[str, float]:
    """Render, and return the time of each pass, of what no pass accounts for, and of all [s]."""
    times = dict.fromkeys(PASSES, 0.0)
    with ExitStack() as stack:
        for name, functions in PASSES.items():
            for module_name, attribute in functions:
                module = importlib.import_module(module_name)
                stack.enter_context(patch.object(module, attribute, timed(getattr(module, attribute), name, times)))
        start = time.perf_counter()
        wf.render(scene)
        total = time.perf_counter() - start
    return {**times, "rest": total - sum(times.values()), "all": total}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--scene", type=Path, default=SCENE, help="scene file")
    parser.add_argument("--size", type=int, default=1024, help="edge of the square image [pixels]")
    parser.add_argument("--threads", type=int, nargs=2, default=[1, 2], help="two numbers of CPU threads to compare")
    parser.add_argument("--repetitions", type=int, default=9, help="timed renders at each number of threads")
    arguments = parser.parse_args()
    scene = wf.load_scene(arguments.scene)
    scene = replace(scene, camera=scene.camera.resized((arguments.size, arguments.size)))
    fragment_count = wf.capture(scene).count
    runs: dict[int, list[dict[str, float]]] = {threads: [] for threads in arguments.threads}
    for repetition in range(arguments.repetitions + 1):
        for threads, taken in runs.items():
            os.environ["WARPFRAG_THREADS"] = str(threads)
            times = render_once(scene)
            # The first one compiles and loads.
            if repetition > 0:
                taken.append(times)
    few, many = ({name: statistics.median(run[name] for run in taken) for name in taken[0]} for taken in runs.values())
    for times in (few, many):
        times["triangles ... composite"] = sum(times[name] for name in times if name not in NOT_PIXELS)
    rows = [
        [
            name,
            milliseconds(few[name]),
            milliseconds(many[name]),
            f"{many[name] / many['all']:.0%}",
            ratio(few[name], many[name]),
        ]
        for name in many
    ]
    first, second = arguments.threads
    columns = ["pass", f"{first} thread(s)", f"{second} thread(s)", "share", f"{first} / {second}"]
    show(f"{arguments.scene.name}, {arguments.size}², {fragment_count / 1e6:.2f} M fragments", columns, rows)


if __name__ == "__main__":
    main()
