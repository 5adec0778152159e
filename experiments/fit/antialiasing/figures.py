"""Draws what study.py has measured."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from warpfrag.colors import linear_to_srgb

STYLE = {"font.size": 9, "axes.titlesize": 9, "axes.spines.top": False, "axes.spines.right": False}
SHADES = {"cube and sphere": "#1f78b4", "another view": "#33a02c", "half the size": "#ff7f00", "cylinders": "#6a3d9a"}
SHOWN = {
    "none": "no merging",
    "hand-set": "hand-set t",
    "pixel size": "t = pixel size",
    "global": "fitted, global",
    "rule": "rule",
    "per pixel": "fitted, per pixel",
    "64 samples": "64 samples",
}
# The crop of the images: left, top and edge as shares of the image.
CROP = (0.36, 0.1, 0.42)
GAIN = 8.0


def images(cases: Sequence[Any]) -> Figure:
    """Draw a crop of the first view by each method, and its error, for both opacities."""
    firsts = [case for case in cases if case.fitted]
    with rc_context(STYLE):
        figure = Figure(figsize=(12.0, 3.75 * len(firsts)), layout="constrained")
        axes = figure.subplots(2 * len(firsts), len(SHOWN))
        for row, case in enumerate(firsts):
            for column, (name, words) in enumerate(SHOWN.items()):
                image = case.images.get(name, case.reference)
                error = np.abs(image - case.reference)[..., :3]
                top, bottom = axes[2 * row, column], axes[2 * row + 1, column]
                top.imshow(linear_to_srgb(cropped(image)[..., :3]), interpolation="nearest")
                bottom.imshow(np.clip(GAIN * cropped(error), 0.0, 1.0), interpolation="nearest")
                level = f"{case.psnr(image, case.band):.1f} dB" if name in case.images else ""
                top.set_title(f"{words}\n{level}")
                for axis in (top, bottom):
                    axis.set(xticks=[], yticks=[])
                    for side in axis.spines.values():
                        side.set_visible(False)
            axes[2 * row, 0].set_ylabel(f"A = {case.opacity:g}")
            axes[2 * row + 1, 0].set_ylabel(f"{GAIN:g} × |error|")
    return figure


def cropped(image: np.ndarray) -> np.ndarray:
    """Return the part of an image that is shown."""
    size = len(image)
    left, top, edge = (round(share * size) for share in CROP)
    return image[top : top + edge, left : left + edge]


def rule(cases: Sequence[Any], best: dict[str, Any], factors: dict[str, float], chosen: str) -> Figure:
    """Draw the best thickness of each pixel against three footprints, and PSNR against the factor of the chosen one."""
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 3.2), layout="constrained")
        axes = figure.subplots(1, 4)
        for axis, name in zip(axes, ("s", "|g₁| + |g₂|", chosen), strict=False):
            values = np.concatenate([data[name] for data in best.values()])
            for case in cases:
                label = case.name if case.opacity == 1.0 else None
                data = best[case.title]
                axis.scatter(data[name], data["t"], s=3.5, lw=0, alpha=0.7, color=SHADES[case.name], label=label)
            ends = np.array([0.9 * values.min(), 1.1 * values.max()])
            axis.plot(ends, factors[name] * ends, color="black", lw=0.9)
            axis.set(xscale="log", yscale="log", xlim=(6e-3, 0.4), ylim=(3e-3, 0.12))
            axis.set_xlabel(f"{'pixel size s' if name == 's' else name} [scene units]")
            axis.set_title(f"line: t = {factors[name]:.2f}·{f'({name})' if '+' in name else name}")
        axes[0].set_ylabel("best thickness of a pixel [scene units]")
        axes[0].legend(fontsize=7.5, frameon=False, loc="upper right", markerscale=3.0, handletextpad=0.1)
        grid = np.geomspace(0.2, 2.0, 61)
        for case in cases:
            levels = [case.psnr(case.by_rule(chosen, factor), case.band) for factor in grid]
            axes[3].plot(grid, levels, color=SHADES[case.name], ls="--" if case.opacity < 1.0 else "-", lw=1.2)
        axes[3].axvline(factors[chosen], color="black", lw=0.7, ls=":")
        axes[3].set(xscale="log", xlabel=f"factor of {chosen}", ylabel="PSNR in the band [dB]")
        axes[3].set_title("solid: A = 1, dashed: A = 0.6")
        axes[3].set_xticks([0.25, 0.5, 1.0, 2.0], ["0.25", "0.5", "1", "2"])
        axes[3].minorticks_off()
    return figure
