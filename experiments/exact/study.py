"""Exact merging against smooth merging: how far apart their images are, and which of them a fit can go down.

Writes data to results/exact, which figures.py draws.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

import warpfrag as wf  # noqa: E402
from warpfrag.fit import FitParameter, Reference, Study  # noqa: E402

RESULTS = Path("results") / "exact"
MERGES = ("smooth", "exact")

# Random fragments of one pixel: backs uniform in a range of 1, thickness such that `overlap` slabs cover a point of it
# on average, each half to one and a half times the mean.
OVERLAPS = np.geomspace(0.125, 16.0, 22)
OPACITIES = (0.1, 0.3, 0.5, 0.7, 0.9, 0.99)
COUNTS = (2, 3, 4, 6, 8, 12, 16)
BETA = 0.5

# Fits: a scene, the opacity of all of its objects (None: its own), and the values to find.
CASES: dict[str, tuple[str, float | None, dict[str, float]]] = {
    "three spheres side by side": (
        "three_spheres",
        None,
        {"beta": 0.5, "red.thickness": 0.15, "green.thickness": 0.2, "blue.thickness": 0.1},
    ),
    "three spheres in one, A = 0.99": (
        "spheres_in_sphere",
        None,
        {"beta": 0.6, "white.thickness": 0.8, "red.thickness": 0.5, "green.thickness": 0.4, "blue.thickness": 0.6},
    ),
    "three spheres in one, A = 0.6": (
        "spheres_in_sphere",
        0.6,
        {"beta": 0.6, "white.thickness": 0.8, "red.thickness": 0.5, "green.thickness": 0.4, "blue.thickness": 0.6},
    ),
}
# Starts: beta uniform in 0 ... 1, the logarithm of a thickness uniform between these [scene units].
THINNEST, THICKEST = 0.02, 2.0
# Along a line: the case, what moves and between which multiples of its true value, what else is not true.
LINE = ("three spheres in one, A = 0.99", "red.thickness", (0.6, 1.6), {"beta": 0.3})
# How far off a start is that is near the truth.
NEAR = 0.02
# Half the width of differences on it, relative.
STEP = 0.01


def main() -> None:
    """Measure everything, or one part."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--only", choices=("difference", "line", "near", "fits"), help="compute one part only")
    parser.add_argument("--pixels", type=int, default=20000, help="random pixels for each mean difference")
    parser.add_argument("--starts", type=int, default=100, help="random starts of each fit")
    parser.add_argument("--size", type=int, default=64, help="width and height of the fitted images")
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    if arguments.only in (None, "difference"):
        np.savez(RESULTS / "difference.npz", **differences(arguments.pixels))
    if arguments.only in (None, "line"):
        np.savez(RESULTS / "line.npz", **line(arguments.size))
    if arguments.only in (None, "near"):
        (RESULTS / "near.json").write_text(json.dumps(near(arguments.size), indent=1))
    if arguments.only in (None, "fits"):
        (RESULTS / "fits.json").write_text(json.dumps(fits(arguments.starts, arguments.size), indent=1))


def random_fragments(
    rng: np.random.Generator, pixel_count: int, count: int, overlap: float, opacity: float | None
) -> wf.Fragments:
    """Draw fragments of one opacity, or of any (None), and of any colour."""
    back = rng.uniform(10.0, 11.0, (pixel_count, count))
    thickness = rng.uniform(0.5, 1.5, (pixel_count, count)) * overlap / count
    alpha = rng.uniform(0.0, 1.0, back.shape) if opacity is None else np.full(back.shape, opacity)
    rgba = np.concatenate([rng.uniform(0.0, 1.0, (*back.shape, 3)) * alpha[..., None], alpha[..., None]], axis=-1)
    offsets = np.arange(pixel_count + 1, dtype=np.int32) * count
    return wf.Fragments(rgba.reshape(-1, 4), back.ravel(), thickness.ravel(), offsets, (pixel_count,))


def difference(fragments: wf.Fragments) -> tuple[float, float, float]:
    """Return mean, 99th percentile and largest difference of the two images, of the worst channel in each pixel."""
    smooth, exact = (wf.composite(fragments, BETA, merge=merge) for merge in MERGES)
    apart = np.abs(smooth - exact)[:, :3].max(axis=1)
    return float(apart.mean()), float(np.quantile(apart, 0.99)), float(apart.max())


def differences(pixel_count: int) -> dict[str, np.ndarray]:
    """Return differences by overlap and opacity for six fragments, and by their number."""
    rng = np.random.default_rng(0)
    opacities = (*OPACITIES, None)
    table = [
        [difference(random_fragments(rng, pixel_count, 6, overlap, opacity)) for overlap in OVERLAPS]
        for opacity in opacities
    ]
    by_count = [
        [difference(random_fragments(rng, pixel_count, count, overlap, None)) for count in COUNTS]
        for overlap in (0.5, 2.0, 8.0)
    ]
    return {
        "overlaps": OVERLAPS,
        "opacities": np.array(OPACITIES),
        "six": np.array(table),
        "counts": np.array(COUNTS),
        "by_count": np.array(by_count),
        "heavy": np.array(difference(random_fragments(rng, pixel_count, 6, 2.0, None))),
    }


def scene_of(case: str, size: int) -> wf.Scene:
    """Return the scene of a case, with room for more layers than it has."""
    name, opacity, _ = CASES[case]
    scene = wf.load_scene(Path("scenes") / f"{name}.toml")
    scene = replace(scene, camera=scene.camera.resized((size, size)), layers=16)
    if opacity is not None:
        scene.objects = [replace(item, opacity=opacity) for item in scene.objects]
    return scene


def fits(start_count: int, size: int) -> dict[str, Any]:
    """Fit every case from the same random starts by either way of merging, each against its own render."""
    cases: dict[str, Any] = {}
    for case, (_, _, true) in CASES.items():
        rng = np.random.default_rng(0)
        starts = [
            {
                name: float(rng.uniform() if name == "beta" else np.exp(rng.uniform(*np.log([THINNEST, THICKEST]))))
                for name in true
            }
            for _ in range(start_count)
        ]
        scene = scene_of(case, size)
        begin = time.perf_counter()
        cases[case] = {merge: [fit_once(replace(scene, merge=merge), true, s) for s in starts] for merge in MERGES}
        print(f"{case}: {2 * start_count} fits, {time.perf_counter() - begin:.0f} s", flush=True)
    return {"size": size, "starts": start_count, "cases": cases}


def near(size: int) -> dict[str, dict[str, dict[str, Any]]]:
    """Fit every case from all parameters being larger than true by a small share."""
    return {
        case: {
            merge: fit_once(
                replace(scene_of(case, size), merge=merge), true, {name: (1.0 + NEAR) * true[name] for name in true}
            )
            for merge in MERGES
        }
        for case, (_, _, true) in CASES.items()
    }


def fit_once(scene: wf.Scene, true: dict[str, float], start: dict[str, float]) -> dict[str, Any]:
    """Fit all parameters from a start; return the largest relative error, the root mean square and evaluations."""
    bounds = {"lower": THINNEST / 4.0, "upper": THICKEST * 4.0}
    parameters = {
        name: FitParameter(value) if name == "beta" else FitParameter(value, **bounds) for name, value in start.items()
    }
    result = wf.fit(Study(scene, Reference(true=true), parameters, method="least_squares", steps=100))
    errors = result.relative_errors() or {}
    return {
        "error": max(errors.values()),
        "root_mean_square": float(np.sqrt(result.loss)),
        "evaluations": result.evaluations,
        "reason": result.reason,
    }


def line(size: int) -> dict[str, np.ndarray]:
    """Return the slope of the root mean square of image minus reference along a line: by adjoint, by differences."""
    import torch

    case, name, multiples, others = LINE
    true = CASES[case][2]
    scene = scene_of(case, size)
    values = true[name] * np.linspace(*multiples, 81)
    curves = {}
    for merge in MERGES:
        target = torch.as_tensor(wf.render(scene, parameters=true, merge=merge)).double()

        def loss(value: Any, merge: Any = merge, target: Any = target) -> Any:
            parameters = {**true, **others, name: torch.as_tensor(value, dtype=torch.float64)}
            return (wf.render(scene, parameters=parameters, merge=merge) - target).square().mean().sqrt()

        rows = []
        for value in values:
            leaf = torch.tensor(value, dtype=torch.float64, requires_grad=True)
            (slope,) = torch.autograd.grad(loss(leaf), leaf)
            change = float(loss(value * (1.0 + STEP)) - loss(value * (1.0 - STEP)))
            rows.append((float(slope), change / (2.0 * STEP * value)))
        curves[merge] = np.array(rows)
    return {"values": values, "true": np.array(true[name]), **curves}


if __name__ == "__main__":
    main()
