"""Bytes per fragment: what a capture stores, and what gradients take on top, predicted and measured.

"predicted" is what `warpfrag.capture.memory` counts on before anything is stored; "pixels" is what arrays with an entry
for each pixel add (counts, offsets, the image and its gradient), shared out over the fragments; "arrays" is the size of
the arrays that come out; "measured" is by how much the process grew (resident memory, Linux only), at its peak and with
the result still alive: to compare with predicted + pixels.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from measure import memory_growth, quiet_warp, show

quiet_warp()

import warp as wp  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.capture.memory import fragment_bytes  # noqa: E402

SCENE = Path(__file__).parents[2] / "scenes" / "bunny_in_sphere.toml"


# Bytes of a pixel: count and offset; or offset, and the numbers (r, g, b, opacity) of the image and of its gradient.
PIXEL_CAPTURE = 4 + 4
PIXEL_BACKWARD = 4
PIXEL_NUMBERS = 2 * 4


def array_bytes(fragments: wf.Fragments) -> int:
    """Return the bytes of the arrays that have an entry for each fragment."""
    arrays = vars(fragments.numpy()).items()
    return sum(a.nbytes for name, a in arrays if isinstance(a, np.ndarray) and name != "offsets")


def with_gradients(scene: wf.Scene, dtype: torch.dtype) -> tuple[wf.Fragments, list[torch.Tensor]]:
    """Capture, differentiably in all colours, opacities and thicknesses."""
    names = [n for n in scene.parameters() if n.endswith((".color", ".opacity", ".thickness"))]
    parameters = {n: torch.tensor(np.asarray(scene.parameters()[n]), dtype=dtype) for n in names}
    leaves = [tensor.requires_grad_() for tensor in parameters.values()]
    return wf.capture(scene, parameters=parameters), leaves


def backward(scene: wf.Scene, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    """Capture, composite, and take the gradients of the image's sum."""
    fragments, leaves = with_gradients(scene, dtype)
    return torch.autograd.grad(wf.composite(fragments, scene.beta).sum(), leaves)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--scene", type=Path, default=SCENE, help="scene file")
    parser.add_argument("--size", type=int, default=2048, help="edge of the square image [pixels]")
    arguments = parser.parse_args()
    scene = wf.load_scene(arguments.scene)
    scene = replace(scene, camera=scene.camera.resized((arguments.size, arguments.size)))
    small = replace(scene, camera=scene.camera.resized((64, 64)))
    rows = []
    count = 0
    for name, scalar, dtype in (("float32", wp.float32, torch.float32), ("float64", wp.float64, torch.float64)):
        calls: dict[str, Callable[[wf.Scene], Any]] = {
            "capture": lambda scene, dtype=dtype: with_gradients(scene, dtype)[0],
            "capture, composite, backward": lambda scene, dtype=dtype: backward(scene, dtype),
        }
        stored = 0.0
        for call, function in calls.items():
            # Compiles and loads, which takes memory of its own.
            function(small)
            peak, alive = memory_growth(lambda function=function: function(scene))
            if call == "capture":
                fragments = function(scene)
                count = fragments.count
                stored = array_bytes(fragments) / count
                del fragments
            predicted = fragment_bytes(scalar, gradient=call != "capture")
            size = 4 if scalar is wp.float32 else 8
            pixel = PIXEL_CAPTURE if call == "capture" else PIXEL_BACKWARD + PIXEL_NUMBERS * size
            pixels = f"{pixel * arguments.size**2 / count:.1f}"
            arrays = f"{stored:.0f}" if call == "capture" else "-"
            measured = [f"{peak / count:.1f}", f"{alive / count:.1f}" if call == "capture" else "-"]
            rows.append([call, name, str(predicted), pixels, arrays, *measured])
    columns = ["", "precision", "predicted", "pixels", "arrays", "measured, peak", "measured, kept"]
    title = f"{arguments.scene.name}, {arguments.size}², {count / 1e6:.2f} M fragments"
    show(f"{title}: bytes a fragment", columns, rows)


if __name__ == "__main__":
    main()
