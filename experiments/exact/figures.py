"""Draws what study.py has measured: two figures, and the numbers of README.md between its markers.

With `--out` figures and numbers go elsewhere, and README.md stays as it is.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from warpfrag.files.saving import replacing

HERE = Path(__file__).parent
RESULTS = Path("results") / "exact"
BEGIN, END = "<!-- results: begin (written by figures.py) -->", "<!-- results: end -->"
COLORS = {"smooth": "#1f78b4", "exact": "#33a02c"}
NAMES = {"smooth": "SFM", "exact": "exact"}
# A fit has found its parameters if the worst of them is off by no more than this share.
FOUND = 0.01
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def main() -> None:
    """Draw everything."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--out", type=Path, help="folder for figures and numbers in the place of experiments/exact")
    arguments = parser.parse_args()
    folder = (arguments.out or HERE) / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    difference, line = np.load(RESULTS / "difference.npz"), np.load(RESULTS / "line.npz")
    fits = json.loads((RESULTS / "fits.json").read_text())
    with plt.rc_context(STYLE):
        differences(difference).savefig(folder / "difference.png", dpi=150)
        convergence(line, fits).savefig(folder / "fits.png", dpi=150)
    text = report(difference, fits, json.loads((RESULTS / "near.json").read_text()))
    if arguments.out:
        (arguments.out / "numbers.md").write_text(text)
        return
    readme = HERE / "README.md"
    before, rest = readme.read_text().split(BEGIN)
    after = rest.split(END)[1]
    with replacing(readme) as temporary:
        temporary.write_text(f"{before}{BEGIN}\n\n{text}\n{END}{after}")


def differences(data: Any) -> Figure:
    """Draw how far SFM is from exact merging by overlap, opacity and number of fragments."""
    figure, axes = plt.subplots(1, 3, figsize=(10.0, 3.1), layout="constrained")
    shades = plt.get_cmap("viridis")(np.linspace(0.88, 0.05, len(data["opacities"])))
    for index, (axis, title) in enumerate(zip(axes, ("Mean", "99th percentile"), strict=False)):
        for opacity, shade, row in zip(data["opacities"], shades, data["six"], strict=False):
            axis.plot(data["overlaps"], row[:, index], color=shade, label=f"A = {opacity:g}")
        axis.plot(data["overlaps"], data["six"][-1][:, index], color="black", ls="--", label="A in 0 … 1")
        axis.set(xscale="log", xlabel="slabs at a point, on average", title=f"{title}, six fragments", ylim=(0.0, None))
        axis.set_xticks([0.125, 0.5, 2.0, 8.0], ["1/8", "1/2", "2", "8"])
        axis.minorticks_off()
    axes[0].set_ylabel("|SFM − exact|, worst channel")
    axes[0].legend(loc="upper left", fontsize=8, labelspacing=0.25)
    greys = ("#bdbdbd", "#737373", "#000000")
    for overlap, grey, row in reversed(list(zip(("1/2", "2", "8"), greys, data["by_count"], strict=True))):
        axes[2].plot(data["counts"], row[:, 0], "o-", ms=3, color=grey, label=overlap)
    axes[2].set(xlabel="fragments", title="Mean, A in 0 … 1", ylim=(0.0, None))
    axes[2].set_xticks(data["counts"])
    axes[2].legend(title="slabs at a point", fontsize=8, loc="center right", bbox_to_anchor=(1.0, 0.62))
    return figure


def convergence(line: Any, fits: dict[str, Any]) -> Figure:
    """Draw what gradients leave out along a line, and how far each fit ended from the truth."""
    cases = fits["cases"]
    figure, axes = plt.subplots(
        1, 1 + len(cases), figsize=(12.0, 3.1), layout="constrained", width_ratios=[1.25, *[1.0] * len(cases)]
    )
    for merge, color in COLORS.items():
        gradient, change = line[merge].T
        axes[0].plot(line["values"], change, color=color, ls=":", lw=1.8)
        axes[0].plot(line["values"], gradient, color=color, lw=1.2, label=NAMES[merge])
    axes[0].axhline(0.0, color="#999999", lw=0.6)
    axes[0].set(xlabel="red.thickness, true: 0.5", ylabel="slope of the error", title="gradient (line), loss (dotted)")
    axes[0].legend(loc="upper left", fontsize=8)
    for axis, (case, found) in zip(axes[1:], cases.items(), strict=True):
        for merge, color in COLORS.items():
            errors = np.sort([max(one["error"], 1e-8) for one in found[merge]])
            axis.step(errors, 100.0 * np.arange(1, len(errors) + 1) / len(errors), where="post", color=color)
        axis.axvline(FOUND, color="#999999", lw=0.8, ls=":")
        axis.set(xscale="log", xlim=(1e-8, 10.0), ylim=(-2.0, 102.0), title=case, xlabel="error of the worst parameter")
        axis.set_xticks([1e-8, 1e-6, 1e-4, 1e-2, 1.0])
    axes[1].set_ylabel("fits up to this error [%]")
    return figure


def report(difference: Any, fits: dict[str, Any], near: dict[str, Any]) -> str:
    """Return the numbers as Markdown."""
    mean, _, largest = difference["heavy"]
    pair = difference["by_count"][:, 0].max()
    lines = [
        f"Six fragments of any opacity and colour, two slabs at a point on average: mean difference {mean:.3f}, "
        f"largest {largest:.2f}. Two fragments: at most {pair:.0e}.",
        "",
        f"{fits['starts']} random starts each, images of {fits['size']}²; found: every parameter within {FOUND:.0%}.",
        "",
        "| scene | SFM finds | exact finds | exact, where SFM does not | SFM, where exact does not | "
        "evaluations SFM / exact | error from a start 2 % off: SFM / exact |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, found in fits["cases"].items():
        good = {merge: np.array([one["error"] <= FOUND for one in found[merge]]) for merge in COLORS}
        smooth, exact = good["smooth"], good["exact"]
        counts = [np.median([one["evaluations"] for one in found[merge]]) for merge in COLORS]
        rescued = f"{(exact & ~smooth).sum()} of {(~smooth).sum()}"
        lost = f"{(smooth & ~exact).sum()} of {(~exact).sum()}"
        ends = [near[case][merge]["error"] for merge in COLORS]
        lines.append(
            f"| {case} | {smooth.sum()} | {exact.sum()} | {rescued} | {lost} | {counts[0]:.0f} / {counts[1]:.0f} | "
            f"{ends[0]:.0e} / {ends[1]:.0e} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
