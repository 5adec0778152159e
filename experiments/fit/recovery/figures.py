"""Draws what study.py has measured."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from recover import METHODS, RECOVERED

from warpfrag.files.saving import replacing

NAMES = {"smooth": "SFM", "exact": "exact"}
COLORS = dict(zip(METHODS, ("#1f78b4", "#6a3d9a", "#ff7f00", "#33a02c", "#8c8c8c"), strict=True))
MARKERS = dict(zip(METHODS, "osD^v", strict=True))
STYLE = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "savefig.dpi": 150,
}


def draw_recovery(records: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the share of draws recovered by scene and method, and below it how errors are distributed."""
    scenes = list(dict.fromkeys(record["case"] for record in records))
    with rc_context(STYLE):
        figure = Figure(figsize=(10.5, 7.6), layout="constrained")
        rows = figure.subplots(2, 2)
        for axis, below, merge in zip(*rows, NAMES, strict=True):
            for place, method in enumerate(METHODS):
                chosen = {r["case"]: r for r in records if r["merge"] == merge and r["method"] == method}
                errors = {name: _errors(chosen[name]) for name in scenes}
                shares = [100.0 * np.mean(errors[name] < RECOVERED) if len(errors[name]) else np.nan for name in scenes]
                style = {"color": COLORS[method], "label": METHODS[method].name}
                shift = 0.14 * (place - 2)
                axis.plot(np.arange(len(scenes)) + shift, shares, MARKERS[method], markersize=5.5, **style)
                ordered = np.sort(np.concatenate([errors[name] for name in scenes]))
                below.step(ordered, 100.0 * (np.arange(ordered.size) + 1) / ordered.size, where="post", **style)
            axis.set_title(f"{NAMES[merge]}: recovered to 1 %")
            axis.set_xticks(range(len(scenes)), scenes, rotation=25, ha="right")
            axis.set_ylim(-4, 104)
            axis.grid(axis="y", linewidth=0.4, color="#dddddd")
            for line in np.arange(len(scenes) - 1) + 0.5:
                axis.axvline(line, color="#eeeeee", linewidth=0.8)
            below.set_xscale("log")
            below.set_xlim(1e-7, 1e2)
            below.set_ylim(0, 102)
            below.axvline(RECOVERED, color="black", linewidth=0.8, linestyle=":")
            below.set_xlabel("largest relative error of the identifiable parameters")
            below.grid(linewidth=0.4, color="#dddddd")
            below.set_title(f"{NAMES[merge]}: all scenes")
        rows[0][0].set_ylabel("draws [%]")
        rows[1][0].set_ylabel("draws with a smaller error [%]")
        handles, labels = rows[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(METHODS))
        with replacing(path) as partial:
            figure.savefig(partial)


def draw_identifiability(opacities: Sequence[float], curves: Mapping[str, Sequence[float]], path: Path) -> None:
    """Draw the standard error of beta by opacity."""
    with rc_context(STYLE):
        figure = Figure(figsize=(5.6, 3.8), layout="constrained")
        axis = figure.subplots()
        for (merge, values), marker in zip(curves.items(), "os", strict=True):
            axis.semilogy(opacities, values, f"{marker}-", markersize=4, label=NAMES[merge])
        axis.axhline(0.25, color="#888888", linewidth=0.8)
        axis.text(0.99, 0.3, "± 2 standard errors are all of 0 … 1", ha="right", color="#555555")
        axis.set_xlabel("opacity of all objects")
        axis.set_ylabel("standard error of β, image of 8 bits")
        axis.set_title("three spheres side by side, β = 0.5, t = 0.3")
        axis.grid(linewidth=0.4, color="#dddddd", which="major")
        axis.legend(loc="lower left")
        with replacing(path) as partial:
            figure.savefig(partial)


def _errors(record: Mapping[str, Any]) -> np.ndarray:
    return np.array([draw["error"] for draw in record["draws"] if draw["known"]])
