"""Draws what study.py has found."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from target import Target, pen_line

from warpfrag.colors import linear_to_srgb

STYLE = {"font.size": 9, "axes.titlesize": 9}
# Root mean square over the channels at which the colours of the error end [linear light].
WORST = 0.25
# Ends of the colours of a thickness [scene units].
THINNEST, THICKEST = 0.01, 100.0


def draw(
    target: Target,
    images: dict[str, np.ndarray],
    levels: dict[str, float],
    maps: dict[str, np.ndarray],
    folder: Path,
) -> None:
    """Draw the images with their PSNR [dB], and the maps of the last one; a map is NaN where it has nothing to say."""
    folder.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        pictures(target, images, levels).savefig(folder / "ghosting.png", dpi=150)
        charts(maps).savefig(folder / "maps.png", dpi=150)


def pictures(target: Target, images: dict[str, np.ndarray], levels: dict[str, float]) -> Figure:
    """Show the scene with the pen's line, the target, the fits and the error of the last."""
    figure = Figure(figsize=(10.0, 5.5), layout="constrained")
    axes = figure.subplots(2, 4)
    first, *others = images.items()
    last = others[-1][1]
    shown = [first, ("target", target.image), *others]
    for axis, (name, image) in zip(axes.flat, shown, strict=False):
        axis.imshow(linear_to_srgb(np.clip(image[..., :3], 0.0, 1.0)))
        axis.set_title(f"{name}, {levels[name]:.1f} dB" if name in levels else name)
    height, width = target.region.shape
    closed = np.concatenate([pen_line(), pen_line()[:1]]) * [width, height] - 0.5
    axes.flat[0].plot(*closed.T, color="#1f78b4", lw=1.2)
    error = np.sqrt(((last[..., :3] - target.image) ** 2).mean(axis=-1))
    drawn = axes.flat[-1].imshow(error, cmap="inferno", vmin=0.0, vmax=WORST)
    axes.flat[-1].set_title("error of the last, rms")
    figure.colorbar(drawn, ax=axes.flat[-1], shrink=0.85, extend="max")
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    return figure


def charts(maps: dict[str, np.ndarray]) -> Figure:
    """Draw the maps, each with its colours' scale."""
    figure = Figure(figsize=(10.0, 3.0), layout="constrained")
    for axis, (name, values) in zip(figure.subplots(1, len(maps)), maps.items(), strict=True):
        is_beta = name == "β"
        norm: Any = Normalize(0.0, 1.0) if is_beta else LogNorm(THINNEST, THICKEST)
        drawn = axis.imshow(values, cmap="cividis" if is_beta else "viridis", norm=norm, interpolation="nearest")
        axis.set(title=name, xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
        bar = figure.colorbar(drawn, ax=axis, shrink=0.85)
        bar.set_label("" if is_beta else "z-thickness [scene units]")
    return figure
