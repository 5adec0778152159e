"""Draws what study.py has measured: the figures, and the tables of README.md between its markers.

Images go to experiments/oit/figures; with `--out` elsewhere, where the tables are then written too, and README.md stays
as it is.
"""

import argparse
import io
import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import tables
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from warpfrag.files.saving import replacing

HERE = Path(__file__).parent
RESULTS = Path("results") / "oit"
# Pictures of noise do not compress: they get fewer dots an inch, so that what is committed stays below this [bytes].
LARGEST = 290_000
DOTS = (130, 120, 110, 100, 90, 80, 70)
# A square of an image: row, column, size, as shares of its height.
Zoom = tuple[float, float, float]
# Errors smaller than this are rounding [levels of 255].
LEAST = 1e-4
COLORS = {
    "DFB": "#222222",
    "MBT": "#8c6bb1",
    "MBT, 4 moments": "#8c6bb1",
    "MBT, 8 moments": "#c994c7",
    "SKB": "#d7301f",
    "SKB+OFM": "#ef8a17",
    "DFB+SFM": "#1f78b4",
    "exact": "#33a02c",
    "DFB+exact": "#33a02c",
}
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def panels(arrays: Any, titles: dict[str, str], *zooms: Zoom) -> Figure:
    """Draw images in a row, and below them what lies in the frames (row, column, size: shares of the image)."""
    edge = min(2.9, 11.0 / len(titles))
    figure, axes = plt.subplots(
        *(1 + len(zooms), len(titles)),
        figsize=(edge * len(titles), (edge + 0.04) * (1 + len(zooms)) + 0.2),
        squeeze=False,
        layout="constrained",
    )
    for column, (name, title) in zip(axes.T, titles.items(), strict=True):
        image = arrays[name]
        _show(column[0], image, title)
        for axis, zoom in zip(column[1:], zooms, strict=True):
            _zoom(axis, image, zoom, column[0])
    return figure


def figure_1(arrays: Any, numbers: Any) -> Figure:
    """Intersections and coplanar surfaces."""
    titles = {
        "over": "(a) individual fragments",
        "MBT": "(b) transmittance function (MBT)",
        "SFM": "(c) merged, $t = 2P(z)$",
    }
    return panels(arrays, titles, (0.25, 0.3, 0.3))


def figure_3(arrays: Any, numbers: Any) -> Figure:
    """Superimposed cubes."""
    titles = {"over": "individual fragments: z-fighting", "SFM": "merged, $t = 2P(z)$"}
    return panels(arrays, titles, (0.4, 0.2, 0.3))


def figure_6(arrays: Any, numbers: Any) -> Figure:
    """Crossing cylinders."""
    titles = {"over": "individual fragments", "SFM": "SFM", "OFM": "OFM"}
    return panels(arrays, titles, (0.36, 0.36, 0.28))


def figure_7(arrays: Any, numbers: Any) -> Figure:
    """Crossing spheres by beta."""
    titles = {name: f"$\\beta = {name}$" for name in ("0", "0.5", "1")}
    return panels(arrays, titles, (0.44, 0.44, 0.12))


def figure_9(arrays: Any, numbers: Any) -> Figure:
    """Spheres in a sphere by beta."""
    return panels(arrays, {name: f"$\\beta = {name}$" for name in ("0", "0.3", "0.6", "1")})


def figure_8(arrays: Any, numbers: Any) -> Figure:
    """Opacity of the front part of a slab."""
    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.0), sharey=True, layout="constrained")
    along = np.linspace(0.0, 1.0, 201)
    for axis, opacity in zip(axes, ("0.5", "0.99"), strict=True):
        for beta, color in zip(
            ("0.0", "0.25", "0.5", "0.75", "1.0"), plt.cm.viridis(np.linspace(0, 0.9, 5)), strict=True
        ):
            axis.plot(along, arrays[f"{opacity} {beta}"], color=color, label=f"β = {float(beta):g}")
        axis.set(
            xlabel="relative depth $r$ in the slab",
            xlim=(0, 1),
            ylim=(0, 1),
            title=f"opacity of the fragment {opacity}",
        )
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("opacity of the front part $A(r)$")
    axes[1].legend(loc="lower right")
    return figure


def figure_10(arrays: Any, numbers: Any) -> Figure:
    """Difference heat maps."""
    ways = ("MBT", "SKB", "SKB+OFM", "DFB+SFM", "exact")
    height = 1.6 * len(numbers)
    figure, axes = plt.subplots(
        len(numbers), 1 + len(ways), figsize=(10.4, height + 0.25), squeeze=False, layout="constrained"
    )
    # One scale for all, which the worst method of the paper's three just fills.
    worst = max(np.percentile(arrays[f"{scene}/{way}/difference"], 99.5) for scene in numbers for way in ways)
    top = 5.0 * np.ceil(float(worst) / 5.0)
    titles = ("sorted A-buffer (DFB)", *({"exact": "DFB+exact"}.get(way, way) for way in ways))
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title)
    for row, (scene, about) in zip(axes, numbers.items(), strict=True):
        layers = about["layers"]
        _show(row[0], arrays[f"{scene}/DFB"])
        row[0].set_ylabel(f"{scene}\n{layers['max']} layers, mean {layers['mean']:.0f}")
        for axis, way in zip(row[1:], ways, strict=True):
            map = axis.imshow(arrays[f"{scene}/{way}/difference"].astype(np.float32), cmap="inferno", vmin=0, vmax=top)
            axis.set(xticks=[], yticks=[])
            axis.text(
                *(0.97, 0.04),
                f"{about['errors'][way]['mean']:.2f}",
                color="white",
                ha="right",
                transform=axis.transAxes,
            )
    figure.colorbar(map, ax=axes, shrink=0.8, pad=0.01, label="mean absolute difference [levels of 255]", extend="max")
    return figure


def figure_10b(arrays: Any, numbers: Any) -> Figure:
    """Errors by thickness and by number of slots."""
    figure, axes = plt.subplots(2, len(numbers), figsize=(9.6, 5.0), sharey=True, squeeze=False, layout="constrained")
    for column, (scene, about) in zip(axes.T, numbers.items(), strict=True):
        for axis, key, label, mark in (
            (column[0], "by multiple", "z-thickness [multiples of $P(z)$], 8 slots", 100),
            (column[1], "by slots", "slots $K$, z-thickness $100\\,P(z)$", 8),
        ):
            for way, row in about[key].items():
                # No error at all is below any axis.
                points = [(float(at), error) for at, error in row.items() if error > LEAST]
                if points:
                    axis.loglog(*zip(*points, strict=True), "o-", ms=3, color=COLORS[way], label=way)
            axis.axvline(mark, color="#aaaaaa", lw=0.8, ls=":")
            ticks = [float(at) for at in row]
            axis.set_xticks(ticks, [f"{at:g}" for at in ticks])
            axis.minorticks_off()
            axis.set_xlabel(label)
            axis.grid(alpha=0.25)
        column[0].axhline(max(about["errors"]["SKB"]["mean"], LEAST), color=COLORS["SKB"], ls="--", lw=1, label="SKB")
        column[0].set_title(scene)
    for axis in axes[:, 0]:
        axis.set_ylabel("mean difference [levels of 255]")
        axis.legend(fontsize=8)
    return figure


def figure_11(arrays: Any, numbers: Any) -> Figure:
    """Bunny, planes and text."""
    ways = {"DFB": "(a) DFB, not merged", "MBT": "(b) MBT", "SKB": "(c) SKB", "SKB+OFM": "(d) SKB+OFM, $t = 2P(z)$"}
    figure = plt.figure(figsize=(11.0, 3.9), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(0.5, 1.0))
    whole = left.subplots()
    _show(whole, arrays["DFB+SFM"], "DFB+SFM, $t = 2P(z)$")
    zooms = ((0.12, 0.06, 0.2), (0.54, 0.57, 0.2))
    for row, zoom in zip(right.subplots(len(zooms), len(ways)), zooms, strict=True):
        for axis, (way, title) in zip(row, ways.items(), strict=True):
            _zoom(axis, arrays[way], zoom, whole)
            if zoom is zooms[0]:
                axis.set_title(title, fontsize=8)
    return figure


def figure_12(arrays: Any, numbers: Any) -> Figure:
    """Time of each pass."""
    names = list(numbers)
    ways = list(numbers[names[0]]["seconds"])
    parts = {"count": "#bdbdbd", "store": "#6baed6", "resolve": "#fd8d3c"}
    columns = (len(names) + 1) // 2
    figure, axes = plt.subplots(2, columns, figsize=(3.2 * columns, 5.0), squeeze=False, layout="constrained")
    for axis, name in zip(axes.flat, names, strict=False):
        left = np.zeros(len(ways))
        timed = numbers[name]
        for part, color in parts.items():
            width = np.array([1000.0 * timed["seconds"][way].get(part, 0.0) for way in ways])
            axis.barh(ways, width, left=left, color=color, label=f"{part} pass")
            left += width
        for place, total in enumerate(left):
            axis.text(total, place, f" {total:,.0f}", va="center", fontsize=8)
        scene, _, size = name.rpartition(" ")
        axis.set(title=f"{scene}, {size}²: {timed['fragments'] / 1e6:.1f} M fragments", xlim=(0, 1.18 * left.max()))
        axis.invert_yaxis()
    for axis in axes.flat[len(names) :]:
        axis.axis("off")
    for axis in axes[-1]:
        axis.set_xlabel("time [ms]")
    axes[0, -1].legend(loc="lower right", fontsize=8)
    return figure


def figure_13(arrays: Any, numbers: Any) -> Figure:
    """Absorbance along a ray."""
    figure = plt.figure(figsize=(10.0, 5.2), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(0.62, 1.0))
    axis = left.subplots()
    _show(axis, arrays["image"], "the ray through the marked pixel")
    row, column = numbers["pixel"]
    axis.plot(column, row, "o", ms=11, mfc="none", mec="red", mew=1.6)
    axis.plot(column, row, ".", ms=3, color="red")
    axis.set_xlabel(f"{numbers['fragments']} fragments in {numbers['separate layers']} separate layers")
    rows = (("SKB", "SKB+OFM"), ("MBT, 4 moments", "MBT, 8 moments"), ("DFB+SFM", "exact"))
    end = arrays["MBT, 4 moments/depth"][-1]
    behind = np.append(arrays["DFB/depth"], end), np.append(arrays["DFB/absorbance"], arrays["DFB/absorbance"][-1])
    axes = right.subplots(len(rows), 1, sharex=True, sharey=True)
    for axis, ways in zip(axes, rows, strict=True):
        axis.fill_between(*behind, color="#d4d4d4", label="DFB: every fragment", lw=0)
        for way, style in zip(ways, ("-", "--"), strict=True):
            label = f"{way} ({numbers['mean difference'][way]:.4f})"
            axis.plot(
                arrays[f"{way}/depth"], arrays[f"{way}/absorbance"], style, color=COLORS[way], lw=1.4, label=label
            )
        axis.legend(loc="lower right", fontsize=8, frameon=True, facecolor="white", edgecolor="white")
        axis.set(ylabel="absorbance", ylim=(0, 1.02))
        axis.grid(alpha=0.25)
    axes[-1].set_xlabel("depth along the ray [scene units]; in brackets the mean difference from DFB")
    return figure


FIGURES = {
    name.removeprefix("figure_"): function for name, function in list(globals().items()) if name.startswith("figure_")
}


def _show(axis: Axes, image: np.ndarray, title: str | None = None) -> None:
    axis.imshow(image, interpolation="lanczos" if image.shape[0] > 300 else "nearest")
    axis.set(xticks=[], yticks=[])
    if title is not None:
        axis.set_title(title)
    axis.spines[:].set_visible(False)


def _zoom(axis: Axes, image: np.ndarray, zoom: Zoom, whole: Axes) -> None:
    """Show a square of an image, pixel by pixel, and frame it in the whole."""
    row, column, edge = (round(share * image.shape[0]) for share in zoom)
    axis.imshow(image[row : row + edge, column : column + edge], interpolation="nearest")
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set(visible=True, color="black")
    whole.add_patch(Rectangle((column, row), edge, edge, fill=False, edgecolor="black", lw=0.8))


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG, at a lower resolution where it would be too large."""
    for dpi in DOTS:
        buffer = io.BytesIO()
        figure.savefig(buffer, dpi=dpi)
        content = io.BytesIO()
        Image.open(buffer).convert("RGB").save(content, "PNG", optimize=True)
        if content.tell() <= LARGEST:
            break
    plt.close(figure)
    with replacing(path) as temporary:
        temporary.write_bytes(content.getvalue())


def draw(data: Path, out: Path) -> dict[str, Any]:
    """Draw every figure there is data for; return all numbers by figure."""
    out.mkdir(parents=True, exist_ok=True)
    documents = {}
    with plt.rc_context(STYLE):
        for name, function in FIGURES.items():
            file = data / f"fig{name.rstrip('b')}.npz"
            if not file.is_file():
                print(f"Fig. {name}: no data in {data}")
                continue
            documents[name] = json.loads(file.with_suffix(".json").read_text())
            with np.load(file) as arrays:
                save(function(arrays, documents[name]["numbers"]), out / f"fig{name}.png")
            print(f"Fig. {name}: {out / f'fig{name}.png'}")
    return documents


def main(arguments: list[str] | None = None) -> None:
    """Draw the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=RESULTS, help=f"what study.py has written ({RESULTS})")
    parser.add_argument("--out", type=Path, help="folder for the images (experiments/oit/figures)")
    given = parser.parse_args(arguments)
    out = given.out or HERE / "figures"
    documents = draw(given.data, out)
    text = tables.report(documents)
    if given.out is not None:
        with replacing(out / "tables.md") as temporary:
            temporary.write_text(text)
    elif {"10", "11", "12", "13"} <= documents.keys():
        tables.insert(HERE / "README.md", text)


if __name__ == "__main__":
    main()
