"""Draws a view that was held out."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from warpfrag.images import linear_to_srgb
from warpfrag.saving import replacing

STYLE = {"font.size": 9, "axes.titlesize": 9, "savefig.dpi": 150}
# The middle of the image, as shares of its width and height.
CROP = (0.15, 0.85)
# Of the error's scale, linear light.
MOST = 0.3


def draw_views(reference: np.ndarray, cases: dict[str, dict[str, Any]], view: int, path: Path) -> None:
    """Draw a view of each case beside the reference, and below it the error.

    Args:
        reference: the image to approach, (H, W, 4).
        cases: images and PSNR by name.
        view: which of the images.
        path: the PNG file.
    """
    size = reference.shape[0]
    part = slice(round(CROP[0] * size), round(CROP[1] * size))
    with rc_context(STYLE):
        figure = Figure(figsize=(2.0 * (len(cases) + 1) + 0.5, 4.6), layout="constrained")
        axes = figure.subplots(2, len(cases) + 1)
        for axis in axes.flat:
            axis.set_axis_off()
        _show(axes[0, 0], reference[part, part], "mesh, 16 samples a pixel")
        for column, (name, case) in enumerate(cases.items(), start=1):
            image = case["images"][view]
            words = name.replace(", ", ",\n", 1)
            _show(axes[0, column], image[part, part], f"{words}\n{case['held out']:.1f} dB held out")
            error = np.abs(image[..., :3] - reference[..., :3]).max(axis=2)[part, part]
            shown = axes[1, column].imshow(error, cmap="inferno", vmin=0.0, vmax=MOST, interpolation="nearest")
        bar = figure.colorbar(shown, ax=axes[1, :].tolist(), fraction=0.02, extend="max")
        bar.set_label("|error|, linear light")
        with replacing(path) as partial:
            figure.savefig(partial)


def _show(axis: Any, image: np.ndarray, title: str) -> None:
    over_white = image[..., :3] + 1.0 - image[..., 3:]
    axis.imshow(linear_to_srgb(over_white), interpolation="nearest")
    axis.set_title(title)
