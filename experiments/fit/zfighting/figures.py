"""Draws what study.py has measured."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from planes import BUFFERS, Setting, make_pair
from speckle import FEW, VISIBLE, WAYS, composite

from warpfrag.colors import linear_to_srgb

NAMES = {
    "eye": "float32 distance (warpfrag)",
    "fixed": "24-bit z-buffer",
    "float": "float32 z-buffer",
    "rasteriser": "24-bit z-buffer, rasterised",
}
COLORS = {"eye": "#1f78b4", "fixed": "#33a02c", "float": "#b2df8a", "rasteriser": "#e31a1c"}
LINES = {"OFM": "-", "SFM": "--", "SFM, β = 0": ":"}
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
}
PANELS = ((0.0, "SFM"), (2.0, "SFM"), (10.0, "SFM"), (100.0, "SFM"), (2.0, "OFM"))


def draw(data: dict[str, Any], base: Setting, folder: Path) -> None:
    """Draw both figures."""
    folder.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        pictures(base).savefig(folder / "speckle.png", dpi=150)
        multiples(data).savefig(folder / "multiples.png", dpi=150)


def pictures(base: Setting) -> Figure:
    """Show the coplanar planes at some thicknesses, as two depth buffers leave them."""
    pair = make_pair(base)
    figure = Figure(figsize=(10.0, 4.35), layout="constrained")
    rows = figure.subplots(2, len(PANELS))
    for buffer, row in zip(("fixed", "rasteriser"), rows, strict=True):
        for axis, (multiple, way) in zip(row, PANELS, strict=True):
            merge, beta = WAYS[way] if multiple else ("none", 1.0)
            image = composite(pair, pair.depths[buffer], multiple, merge, beta)
            # Over white.
            image = image[:, :3] + (1.0 - image[:, 3:])
            image = image.reshape(base.size, base.size, 3)
            axis.imshow(linear_to_srgb(np.clip(image, 0.0, 1.0)), interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
            if buffer == "fixed":
                axis.set_title(f"{multiple:g} P(z), {way}" if multiple else "no merging")
        row[0].set_ylabel(NAMES[buffer])
    return figure


def multiples(data: dict[str, Any]) -> Figure:
    """Draw speckle by multiple, the smallest multiple by depth and by the rule, and planes that are not coplanar."""
    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    (left, right), (lower_left, lower_right) = figure.subplots(2, 2)
    _curves(left, data)
    _depths(right, data)
    _rule(lower_left, data["rule"])
    _offsets(lower_right, data)
    return figure


def _curves(axis: Any, data: dict[str, Any]) -> None:
    for way, buffers in data["curves"].items():
        for buffer, rows in buffers.items():
            label = "SFM, β = 1" if way == "SFM" else way
            axis.plot(
                data["multiples"],
                np.maximum(rows[:, 1], 1e-5),
                color=COLORS[buffer],
                ls=LINES[way],
                label=label if buffer == "fixed" else None,
            )
    axis.axhline(VISIBLE, color="#888888", lw=0.8)
    axis.text(0.27, VISIBLE * 1.06, "1/255", color="#555555", fontsize=8, va="bottom")
    for multiple in (2.0, 10.0, 100.0):
        axis.axvline(multiple, color="#bbbbbb", lw=0.8, zorder=0)
        axis.text(multiple * 1.06, 0.68, f"{multiple:g} P", color="#777777", fontsize=8, ha="left")
    axis.set(xscale="log", yscale="log", ylim=(8e-4, 1.0), xlim=(0.25, 4096.0))
    axis.set(xlabel="thickness [P(z)]", ylabel=f"deviation that {FEW:.1%} of the pixels pass")
    axis.set_title("(a) Coplanar, z = 10 near (green: 24-bit z-buffer, red: rasterised)")
    axis.legend(loc="upper right", bbox_to_anchor=(1.0, 0.92))


def _depths(axis: Any, data: dict[str, Any]) -> None:
    z = np.array([case.setting.z for case in data["depth"]])
    for buffer in BUFFERS:
        if buffer == "float":
            continue
        for way in ("OFM", "SFM"):
            found = np.array([case.smallest[way][buffer] for case in data["depth"]])
            found[found == 0.0] = np.nan
            label = NAMES[buffer] if way == "OFM" else None
            axis.plot(z, found, ls=LINES[way], marker="o", ms=3, color=COLORS[buffer], label=label)
    axis.axhline(2.0, color="black", lw=0.8)
    axis.text(z[-1], 2.2, "the paper's 2 P(z)", fontsize=8, ha="right", va="bottom")
    axis.set(xscale="log", yscale="log", xlabel="depth z [near]", ylabel="smallest multiple of P(z)", ylim=(1e-3, 1e5))
    axis.set_title("(b) Speckle gone: OFM (solid), SFM with β = 1 (dashed)")
    axis.legend(loc="upper right")


def _rule(axis: Any, rule: dict[str, Any]) -> None:
    for buffer in ("eye", "fixed", "rasteriser"):
        chosen = [case for case in rule["cases"] if case[0] == buffer and case[2] > 0.0]
        given, needed = np.array([case[1:] for case in chosen]).T
        axis.plot(given, needed, "o", ms=4, mfc="none", color=COLORS[buffer], label=NAMES[buffer])
    ends = np.array([2e-3, 3e2])
    axis.plot(ends, ends, color="black", lw=0.8)
    axis.set(xscale="log", yscale="log", xlabel="thickness by the rule [P(z)]", ylabel="smallest, OFM [P(z)]")
    axis.set_title("(c) The rule, at all depths, far planes, tilts and origins")
    axis.legend(loc="upper left")


def _offsets(axis: Any, data: dict[str, Any]) -> None:
    offsets = np.array(data["offsets"])
    shades = {"none": "black", "2 P": "#fdae61", "10 P": "#f46d43", "100 P": "#a50026", "2 P, OFM": "#4575b4"}
    for name, curve in data["offset"].items():
        axis.plot(offsets, np.maximum(curve, 1e-6), color=shades[name], lw=1.3, label=name)
    axis.set_xscale("symlog", linthresh=2.0, linscale=0.8)
    axis.set_xticks([0, 1, 2, 10, 100], ["0", "1", "2", "10", "100"])
    axis.set(yscale="log", ylim=(3e-4, 0.5), xlim=(0.0, offsets[-1]))
    axis.set(xlabel="one plane behind the other by [P(z)]", ylabel="root mean square deviation")
    axis.set_title("(d) Nearly coplanar, 24-bit z-buffer, SFM but for one")
    axis.legend(title="thickness", loc="upper right")
