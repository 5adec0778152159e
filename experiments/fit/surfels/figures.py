"""Draws what study.py has measured."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from fits import FALLOFF, OPAQUE, PAPER, RADIUS, Row, Setting, reference_of
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from tied import Tied

from warpfrag.colors import linear_to_srgb
from warpfrag.fit.losses import psnr
from warpfrag.scene.names import Merge

STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
}
SHOWN = {
    "opaque, over": "opaque discs,\nplain over",
    "opaque, 10 P": "opaque discs,\n10 P(z)",
    "opaque, color, t": "opaque; colours and\nt fitted",
    "all, 10 P": "colours and opacities\nfitted, 10 P(z)",
    "all, t": "colours, opacities\nand t fitted",
}
# The held-out view that is shown, and the part of it that is shown larger: left, top and edge as shares of the image.
VIEW, CROP = 0, (0.36, 0.36, 0.25)
# Largest error of the maps [linear light].
DARKEST = 0.25
MERGES = {"smooth": ("SFM", "-"), "order_independent": ("OFM", "--"), "exact": ("exact", ":")}
COLORS = {OPAQUE: "#1f78b4", FALLOFF: "#e6550d"}


def images(setting: Setting, rows: Mapping[str, Row]) -> Figure:
    """Draw a held-out view by each method: all of it, a part of it, and its error."""
    view = setting.views(held_out=True)[VIEW]
    reference = reference_of(view)
    with rc_context(STYLE):
        figure = Figure(figsize=(12.0, 6.3), layout="constrained")
        axes = figure.subplots(3, 1 + len(SHOWN))
        for axis in axes.flat:
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        columns = {"mesh, 16 samples\na pixel": reference, **{w: rows[n].images[view.name] for n, w in SHOWN.items()}}
        for index, (words, image) in enumerate(columns.items()):
            axes[0, index].set_title(words if index == 0 else f"{words}: {psnr(image, reference):.1f} dB")
            axes[0, index].imshow(over_white(image), interpolation="nearest")
            axes[1, index].imshow(over_white(cropped(image)), interpolation="nearest")
            if index:
                error = np.abs(image - reference)[..., :3].mean(axis=-1)
                shown = axes[2, index].imshow(error, vmin=0.0, vmax=DARKEST, cmap="magma_r", interpolation="nearest")
        label = "mean |error| of the channels,\nlinear light"
        options = {"location": "left", "fraction": 0.08, "aspect": 12, "extend": "max", "label": label}
        bar = figure.colorbar(shown, ax=axes[2, 0], **options)
        bar.outline.set_visible(False)
        size = len(reference)
        left, top, edge = (round(share * size) for share in CROP)
        frame = Rectangle((left - 0.5, top - 0.5), edge, edge, fill=False, color="black", lw=0.8)
        axes[0, 0].add_patch(frame)
    return figure


def over_white(image: np.ndarray) -> np.ndarray:
    """Return an image over white, in sRGB."""
    return linear_to_srgb(np.clip(image[..., :3] + 1.0 - image[..., 3:], 0.0, 1.0))


def cropped(image: np.ndarray) -> np.ndarray:
    """Return the part of an image that is shown larger."""
    left, top, edge = (round(share * len(image)) for share in CROP)
    return image[top : top + edge, left : left + edge]


def curves(
    setting: Setting,
    rows: Mapping[str, Row],
    tied: Tied,
    multiples: np.ndarray,
    by_disc: Mapping[tuple[str, Merge], np.ndarray],
    by_count: Mapping[int, np.ndarray],
) -> Figure:
    """Draw PSNR by thickness without fits, by way of merging and by number of points; and the opacities found."""
    with rc_context(STYLE):
        figure = Figure(figsize=(12.0, 3.7), layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        for (discs, merge), levels in by_disc.items():
            name, style = MERGES[merge]
            left.plot(multiples, levels[1:], color=COLORS[discs], ls=style, lw=1.3, label=f"{discs}, {name}")
        left.set(ylabel="mean PSNR of held-out views [dB]")
        left.set_title("(a) Colours of the mesh")
        left.legend(loc="lower left")
        shades = ("#9ecae1", "#4292c6", "#08306b")
        for shade, (count, levels) in zip(shades, by_count.items(), strict=True):
            middle.plot(multiples, levels[1:] - levels[0], color=shade, lw=1.3, label=f"{count} points")
        middle.axhline(0.0, color="#999999", lw=0.6)
        middle.set(ylabel="PSNR, gain over plain over [dB]")
        middle.set_title("(b) Falloff, SFM, by number of points")
        middle.legend(loc="upper left", bbox_to_anchor=(0.05, 1.0))
        for axis in (left, middle):
            axis.set(xscale="log", xlabel="thickness [spacings of the points]")
        paper = PAPER / setting.spacing
        left.axvline(paper, color="#777777", lw=0.8)
        left.text(1.15 * paper, 0.97, "10 P(z)", color="#555555", va="top", transform=left.get_xaxis_transform())
        _profiles(right, setting, rows["all, t"].opacity, tied)
    return figure


def _profiles(axis: Any, setting: Setting, opacity: Any, tied: Tied) -> None:
    radii = setting.discs.radii
    places = np.unique(radii)
    by_ring = [opacity[:, radii == place] for place in places]
    low, middle, high = np.array([np.quantile(part, (0.25, 0.5, 0.75)) for part in by_ring]).T
    axis.fill_between(places, low, high, color="#dddddd", lw=0, label="vertices: quartiles")
    axis.plot(places, middle, "o-", color="black", ms=4, lw=1.2, label="vertices: median")
    r = np.linspace(0.0, places[-1], 101)
    each = tied.opacity[:, None] * np.exp(-0.5 * (r / tied.radius[:, None]) ** 2)
    axis.plot(r, np.median(each, axis=0), color="#31a354", lw=1.3, label="by point: median")
    axis.plot(r, np.exp(-0.5 * (r / RADIUS) ** 2), color="#999999", ls=":", lw=1.3, label="start")
    axis.set(xlabel="distance from a disc's centre [spacings]", ylabel="opacity", ylim=(0.0, 1.02))
    axis.set_title("(c) Opacities found")
    axis.legend(loc="upper right")
