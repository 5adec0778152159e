"""Draws what study.py has measured."""

import numpy as np
from comparison import Comparison
from matplotlib import rc_context
from matplotlib.figure import Figure

import warpfrag as wf
from warpfrag.colors import linear_to_srgb
from warpfrag.fit.losses import psnr

STYLE = {"font.size": 9, "axes.titlesize": 9, "axes.spines.top": False, "axes.spines.right": False}
COLORS = {"pyrender": "#1f78b4", "ours": "#ff7f00"}


def by_thickness(scene: wf.Scene, references: dict[str, np.ndarray], band: np.ndarray) -> dict[str, np.ndarray]:
    """Return thicknesses for all objects and, for each reference, PSNR in the band."""
    thickness = np.geomspace(1e-3, 0.1, 41)
    images = [wf.render(scene, parameters={"thickness": float(t)}) for t in thickness]
    levels = {name: np.array([psnr(image, r, band) for image in images]) for name, r in references.items()}
    return {"thickness": thickness, **levels}


def comparison(compared: dict[str, Comparison], curves: dict[str, np.ndarray]) -> Figure:
    """Draw pyrender's image, where ours differs from it, and PSNR by thickness against either."""
    first = next(iter(compared.values()))
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 3.3), layout="constrained")
        axes = figure.subplots(1, 4, width_ratios=[1.0, 1.0, 1.0, 1.25])
        axes[0].imshow(linear_to_srgb(first.theirs), interpolation="nearest")
        axes[0].set_title("pyrender,\n64 samples a pixel")
        for axis, (name, pair) in zip(axes[1:], compared.items(), strict=False):
            axis.imshow(1.0 - 0.25 * (1.0 - linear_to_srgb(pair.theirs)), interpolation="nearest")
            residual = 255.0 * pair.residual
            for mask, color, words in (
                (~pair.crossing, "#d7301f", "outside intersections"),
                (pair.crossing, "#252525", "at intersections"),
            ):
                row, column = np.nonzero(mask & (pair.differing > 0))
                area = 3.0 + 7.0 * residual[row, column]
                axis.scatter(column, row, s=area, lw=0, color=color, label=f"{len(row)} {words}")
            axis.set_title(f"pixels that differ,\nvertices {name}")
            legend = axis.legend(fontsize=7.5, frameon=False, loc="upper center", bbox_to_anchor=(0.5, 0.02))
            for handle in legend.legend_handles:
                handle.set_sizes([16.0])
        for axis in axes[:3]:
            axis.set(xticks=[], yticks=[])
            for side in axis.spines.values():
                side.set_visible(False)
        for (name, color), style in zip(COLORS.items(), ("-", "--"), strict=True):
            axes[3].plot(curves["thickness"], curves[name], color=color, ls=style, label=f"against {name}")
        axes[3].set(xscale="log", xlabel="thickness of both objects [scene units]", ylabel="PSNR in the band [dB]")
        axes[3].set_title("one sample a pixel, merged,\nagainst either reference")
        axes[3].legend(fontsize=8, frameon=False)
    return figure
