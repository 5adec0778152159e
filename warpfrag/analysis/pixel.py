"""What a pixel is made of: its fragments as a table, and a plot of them, of their layers and of the absorbance."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.analysis.absorbance import Absorbance, absorbance, fragments_of_pixel
from warpfrag.capture.coverage import capture
from warpfrag.colors import linear_to_srgb
from warpfrag.extras import need
from warpfrag.files.saving import replacing
from warpfrag.fragments import Fragments
from warpfrag.scene.scene import Scene

# Longer lists are cut in the table; the plot has all.
MOST_LINES = 40
_DPI = 200
_STYLE = {"font.size": 9.0, "axes.titlesize": 10.0, "axes.linewidth": 0.6, "figure.dpi": _DPI, "savefig.dpi": _DPI}
_ALL_COLOR, _LAYERS_COLOR = "#1b1b1b", "#d1495b"
# Wide enough to be seen, relative to the width of the plot.
_LEAST_WIDTH = 0.004


@dataclass(frozen=True, eq=False)
class Inspection:
    """One pixel of a scene.

    Attributes:
        scene: the scene.
        column: column of the pixel, from the left.
        row: row of the pixel, from the top.
        fragments: its fragments in order of depth, of shape (1,), NumPy float64.
        every: absorbance of all fragments.
        merged: absorbance of the layers that they are resolved into.
    """

    scene: Scene
    column: int
    row: int
    fragments: Fragments
    every: Absorbance
    merged: Absorbance

    def lines(self) -> Iterator[str]:
        """Yield the lines of a table: each fragment with its place, its colour and the layer that it is part of."""
        count, layer_count = self.fragments.count, self.merged.slabs.count
        yield f"pixel {self.column},{self.row}: {_counted(count, 'fragment')}, {_counted(layer_count, 'layer')}"
        if count == 0:
            return
        names = [item.name for item in self.scene.objects]
        rows = [("", "object", "face", "depth", "thickness", "opacity", "red", "green", "blue", "layer")]
        layer_of = np.searchsorted(self.merged.slabs.depth, self.fragments.depth)
        for at in range(min(count, MOST_LINES)):
            name, face = names[self.fragments.object_id[at]], str(self.fragments.primitive_id[at])
            place = (f"{self.fragments.depth[at]:.6g}", f"{self.fragments.thickness[at]:.4g}")
            straight = (f"{value:.3f}" for value in _straight(self.fragments.rgba[at]))
            layer = str(min(layer_of[at], layer_count - 1) + 1)
            rows.append((str(at + 1), name, face, *place, f"{self.fragments.rgba[at, 3]:.3f}", *straight, layer))
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        for row in rows:
            # Words to the left, numbers to the right.
            cells = [
                text.ljust(width) if column == 1 else text.rjust(width)
                for column, (text, width) in enumerate(zip(row, widths, strict=True))
            ]
            yield "  ".join(cells).rstrip()
        if count > MOST_LINES:
            yield f"... {_counted(count - MOST_LINES, 'more fragment')}"

    def draw(self, path: Path) -> None:
        """Draw fragments, layers and absorbance against depth.

        Args:
            path: the PNG file.

        Raises:
            ImportError: matplotlib is not installed.
        """
        purpose = "A plot"
        matplotlib = need("matplotlib", "fit", purpose)
        figure_class = need("matplotlib.figure", "fit", purpose).Figure
        begin, end = self._extent()
        listed = [("fragment", self.fragments), ("layer", self.merged.slabs)]
        lanes = [_lanes(slabs, _LEAST_WIDTH * (end - begin)) for _, slabs in listed]
        heights = [0.3 + min(1.5, 0.12 * (1 + max(lane, default=0))) for lane in lanes]
        with matplotlib.rc_context(_STYLE):
            figure = figure_class(figsize=(7.0, 3.3 + sum(heights)), layout="constrained")
            axes = figure.subplots(3, 1, sharex=True, height_ratios=[*heights, 2.8])
            for axis, (word, slabs), lane in zip(axes, listed, lanes, strict=False):
                _draw_slabs(axis, slabs, lane, _LEAST_WIDTH * (end - begin))
                axis.set_ylabel(_counted(slabs.count, word), rotation=0, ha="right", va="center")
            for curve, options in (
                (self.every, {"color": _ALL_COLOR, "linewidth": 1.6, "label": "all fragments"}),
                (self.merged, {"color": _LAYERS_COLOR, "linewidth": 1.4, "dashes": (4, 1.6), "label": self._words()}),
            ):
                last = curve.absorbance[-1] if len(curve.absorbance) else 0.0
                axes[2].plot([begin, *curve.depth, end], [0.0, *curve.absorbance, last], **options)
            axes[2].set_xlim(begin, end)
            axes[2].set_ylim(-0.02, 1.02)
            axes[2].set_xlabel("depth along the ray [scene units]")
            axes[2].set_ylabel("absorbance (1 − transmittance)")
            axes[2].grid(visible=True, linewidth=0.4, color="#dddddd")
            axes[2].legend(loc="lower right", framealpha=0.9, edgecolor="none")
            axes[0].set_title(f"Pixel ({self.column}, {self.row})")
            with replacing(path) as partial:
                figure.savefig(partial, format="png")

    def _words(self) -> str:
        merge, mix = (word.replace("_", "-") for word in (self.scene.merge, self.scene.mix))
        layers = _counted(self.merged.slabs.count, "layer")
        words = f"{layers} (of at most {self.scene.layers}), merge {merge}, β = {self.scene.beta:g}"
        return words if mix == "opacity" else f"{words}, mix {mix}"

    def _extent(self) -> tuple[float, float]:
        """Return the depths between which to draw."""
        if self.fragments.count == 0:
            return self.scene.camera.near, self.scene.camera.far
        begin = float((self.fragments.depth - self.fragments.thickness).min())
        end = float(self.fragments.depth.max())
        margin = 0.04 * (end - begin) or 0.02 * max(abs(end), 1e-3)
        return begin - margin, end + margin


def inspect_pixel(scene: Scene, column: int, row: int, device: str | None = None) -> Inspection:
    """Capture one pixel of a scene, and resolve it as the scene says.

    Args:
        scene: what to look at; its camera, beta, layers, merge and mix count.
        column: column of the pixel, from the left, 0 first.
        row: row of the pixel, from the top, 0 first.
        device: where to capture it; default "cpu".

    Raises:
        ValueError: the image has no such pixel.
    """
    height, width = scene.camera.shape
    if not (0 <= column < width and 0 <= row < height):
        raise ValueError(f"pixel: got {column},{row}, expected a column below {width} and a row below {height}")
    captured = capture(scene, rows=(row, row + 1), device=device)
    every = absorbance(captured, (0, column), scene.beta, mix=scene.mix)
    merged = absorbance(captured, (0, column), scene.beta, merge=scene.merge, max_layers=scene.layers, mix=scene.mix)
    return Inspection(scene, column, row, fragments_of_pixel(captured, (0, column)), every, merged)


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def _straight(rgba: np.ndarray) -> np.ndarray:
    return rgba[:3] / rgba[3] if rgba[3] > 0.0 else rgba[:3]


def _lanes(slabs: Fragments, least: float) -> list[int]:
    """Return a lane for each slab such that those in the same lane do not touch; the nearest take the lowest."""
    ends: list[float] = []
    lanes = []
    for depth, thickness in zip(slabs.depth, slabs.thickness, strict=True):
        begin = depth - max(thickness, least)
        free = [lane for lane, end in enumerate(ends) if end < begin]
        lane = free[0] if free else len(ends)
        if lane == len(ends):
            ends.append(-math.inf)
        ends[lane] = depth + 0.5 * least
        lanes.append(lane)
    return lanes


def _draw_slabs(axis: Any, slabs: Fragments, lanes: list[int], least: float) -> None:
    """Draw each slab as a bar from its front to its back, in its colour, with a line at the back: the surface itself.

    What is too thin for that is a stripe around its depth.
    """
    for rgba, depth, thickness, lane in zip(slabs.rgba, slabs.depth, slabs.thickness, lanes, strict=True):
        fill = [*linear_to_srgb(_straight(rgba)), 0.4 + 0.6 * float(rgba[3])]
        box = {"height": 0.72, "edgecolor": "#00000055", "linewidth": 0.4}
        if thickness < least:
            axis.barh(lane, least, left=depth - 0.5 * least, color=fill[:3], **box)
            continue
        axis.barh(lane, thickness, left=depth - thickness, color=fill, **box)
        axis.plot([depth, depth], [lane - 0.36, lane + 0.36], color=_ALL_COLOR, linewidth=0.9, solid_capstyle="butt")
    axis.set_ylim(-0.7, max(lanes, default=0) + 0.7)
    axis.set_yticks([])
    axis.tick_params(axis="x", length=0, labelbottom=False)
    axis.spines[:].set_visible(False)
