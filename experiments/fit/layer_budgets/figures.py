"""Draws what study.py has measured."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from maps import BLOCK, RULES
from matplotlib import rc_context
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

from warpfrag.colors import linear_to_srgb

STYLE = {"font.size": 9, "axes.titlesize": 9, "axes.spines.top": False, "axes.spines.right": False}
LINES = {
    "2P": ("t = 2P", "#9e9e9e", "o-"),
    "100P": ("t = 100P", "#616161", "s-"),
    "one value": ("one value, fitted", "#1f78b4", "^-"),
    "together": ("map, by gradient", "#6a3d9a", "v-"),
    "on the way": ("best that gradients pass by", "#cab2d6", "v:"),
    RULES[0]: ("rule, factor of the machine", "#e31a1c", "D-"),
    "blocks": (f"map, {BLOCK}² blocks", "#33a02c", "P--"),
    "pixels": ("best possible per pixel", "#000000", "*--"),
}
PANELS = (("SFM", "inserted"), ("exact", "inserted"), ("SKB+OFM", "inserted"), ("SKB+OFM", "image"))
WORDS = {"image": "the image", "inserted": "a surface inserted"}
SHOWN = {
    "2P": "2P",
    "100P": "100P",
    "one value": "one value, fitted",
    RULES[0]: "rule",
    "blocks": f"map, {BLOCK}² blocks",
    "pixels": "best possible per pixel",
}
LAYERS = 4


def errors(measured: Sequence[Any], budgets: Sequence[int]) -> Figure:
    """Draw the error against the number of layers for every scene, method and way of choosing."""
    with rc_context(STYLE):
        figure = Figure(figsize=(13.0, 3.0 * len(measured) + 0.4), layout="constrained")
        axes = figure.subplots(len(measured), 1 + len(PANELS), width_ratios=[0.85] + [1.0] * len(PANELS))
        for row, found in zip(axes, measured, strict=True):
            case = found.case
            row[0].imshow(_displayed(case, case.reference[:, -1]), interpolation="nearest")
            row[0].set(xticks=[], yticks=[], title=f"{case.name}, all fragments")
            row[0].spines[:].set_visible(False)
            for axis, (method, measure) in zip(row[1:], PANELS, strict=True):
                for way, (label, color, style) in LINES.items():
                    if way not in found.scores[method, measure, budgets[0]]:
                        continue
                    values = [found.scores[method, measure, count][way]["rms"] for count in budgets]
                    axis.plot(budgets, values, style, color=color, label=label, lw=1.3, ms=5.0)
                axis.set(xscale="log", yscale="log", title=f"{method}: {WORDS[measure]}")
                axis.set_xticks(budgets, [str(count) for count in budgets])
                axis.minorticks_off()
                axis.yaxis.set_major_formatter(ScalarFormatter())
                axis.yaxis.set_minor_formatter(NullFormatter())
                axis.grid(alpha=0.25)
                _ticks(axis)
            row[1].set_ylabel("root mean square error\n[levels of 255]")
        for axis in axes[-1, 1:]:
            axis.set_xlabel("layers M")
        handles, labels = axes[0, 1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(LINES), frameon=False, fontsize=8.5)
    return figure


def images(found: Any) -> Figure:
    """Draw images of four layers by several thicknesses, and where they are off."""
    case = found.case
    rows = (("SKB+OFM", "image", -1, 15.0), ("SFM", "inserted", len(case.distances) // 2, 40.0))
    with rc_context(STYLE):
        figure = Figure(figsize=(13.0, 7.2), layout="constrained")
        axes = figure.subplots(2 * len(rows), 1 + len(SHOWN))
        for number, (method, measure, view, most) in enumerate(rows):
            top, bottom = axes[2 * number], axes[2 * number + 1]
            reference = case.reference[:, view]
            top[0].imshow(_cropped(case, _displayed(case, reference)), interpolation="nearest")
            top[0].set_title("all fragments")
            words = "the image" if view < 0 else f"a surface inserted\nat distance {case.distances[view]:.1f}"
            top[0].set_ylabel(f"{method}, M = {LAYERS}:\n{words}")
            bottom[0].set_visible(False)
            for column, (way, label) in enumerate(SHOWN.items(), start=1):
                difference = case.differences(method, LAYERS, found.choices[method, measure, LAYERS][way])[:, view]
                image = _displayed(case, reference + difference)
                top[column].imshow(_cropped(case, image), interpolation="nearest")
                top[column].set_title(label)
                apart = 255.0 * difference.abs().mean(dim=1).numpy()
                shown = bottom[column].imshow(
                    _cropped(case, apart.reshape(case.scene.camera.shape)),
                    cmap="inferno", vmin=0.0, vmax=most, interpolation="nearest",
                )  # fmt: skip
                bottom[column].set_xlabel(f"mean {apart[case.covered].mean():.2f}")
            bar = figure.colorbar(shown, ax=bottom, location="right", shrink=0.9, pad=0.01, extend="max")
            bar.set_label("|error| [levels of 255]")
        for axis in axes.flat:
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
    return figure


def maps(found: Any) -> Figure:
    """Draw the complexity of pixels and the thickness maps that were fitted to it."""
    case, key = found.case, ("SFM", "inserted", LAYERS)
    chosen = found.choices[key]
    panels = {
        "by the rule": chosen[RULES[0]],
        "by gradient, from one value": chosen["together"],
        f"by search, {BLOCK}² blocks": chosen["blocks"],
        "by search, per pixel": chosen["pixels"],
    }
    shape = case.scene.camera.shape
    with rc_context(STYLE):
        figure = Figure(figsize=(13.0, 3.0), layout="constrained")
        axes = figure.subplots(1, 2 + len(panels))
        counts = np.where(case.covered, case.counts, np.nan).reshape(shape)
        extent = np.where(case.covered, case.extent, np.nan).reshape(shape)
        for axis, values, title, label in (
            (axes[0], counts, "fragments", "n"),
            (axes[1], extent, "extent in depth", "[scene units]"),
        ):
            shown = axis.imshow(_cropped(case, values), cmap="viridis", interpolation="nearest")
            axis.set_title(title)
            figure.colorbar(shown, ax=axis, location="bottom", shrink=0.9, label=label)
        norm = LogNorm(1e-3, 1.0)
        for axis, (title, values) in zip(axes[2:], panels.items(), strict=True):
            map = np.where(case.covered, np.maximum(values, 1e-9), np.nan).reshape(shape)
            shown = axis.imshow(_cropped(case, map), cmap="magma", norm=norm, interpolation="nearest")
            axis.set_title(title)
        figure.colorbar(
            shown, ax=list(axes[2:]), location="bottom", shrink=0.6, extend="both", aspect=50,
            label=f"thickness for SFM, M = {LAYERS}, a surface inserted [scene units]",
        )  # fmt: skip
        for axis in axes:
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
    return figure


def _cropped(case: Any, image: np.ndarray) -> np.ndarray:
    """Return the part of an image that has fragments, with a margin."""
    covered = case.covered.reshape(case.scene.camera.shape)
    (rows,), (columns,) = np.nonzero(covered.any(axis=1)), np.nonzero(covered.any(axis=0))
    return image[max(rows[0] - 2, 0) : rows[-1] + 3, max(columns[0] - 2, 0) : columns[-1] + 3]


def _displayed(case: Any, image: Any) -> np.ndarray:
    """Return an image (P, 3) in linear light as one to look at."""
    return linear_to_srgb(np.clip(image.numpy(), 0.0, 1.0)).reshape(*case.scene.camera.shape, 3)


def _ticks(axis: Any) -> None:
    """Label a logarithmic axis at 1, 2 and 5."""
    low, high = axis.get_ylim()
    ticks = [digit * 10.0**power for power in range(-3, 3) for digit in (1, 2, 5)]
    inside = [tick for tick in ticks if low <= tick <= high]
    axis.set_yticks(inside, [f"{tick:g}" for tick in inside])
