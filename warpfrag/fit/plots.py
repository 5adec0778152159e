"""The plots of a fit: where the image is wrong, before and after, and how the loss fell."""

from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.files.saving import replacing
from warpfrag.fit.result import FitResult, ViewResult

_DPI = 150
_STYLE = {"font.size": 9.0, "axes.titlesize": 10.0, "axes.linewidth": 0.6, "figure.dpi": _DPI, "savefig.dpi": _DPI}


def draw_error(view: ViewResult, path: Path) -> None:
    """Draw the absolute error of each pixel, its largest over the channels, at the start and at the end.

    Args:
        view: the view, before and after the fit.
        path: the PNG file.
    """
    matplotlib, figure_class = _matplotlib()
    channels = view.reference.shape[2]
    panels = [
        (title, np.abs(image[..., :channels] - view.reference))
        for title, image in (("at the start", view.before), ("at the end", view.after))
    ]
    height, width = view.reference.shape[:2]
    # Panels 4 inches wide, higher or lower as the image is, within reason.
    tall = float(np.clip(4.0 * height / width, 2.0, 7.0))
    label = "|image − reference|, largest of the channels, linear light"
    # One scale for both: a fit that changed little shows it.
    top = max(float(error.max(initial=0.0)) for _, error in panels) or 1.0
    with matplotlib.rc_context(_STYLE):
        figure = figure_class(figsize=(10.4, tall + 0.4), layout="constrained")
        axes = figure.subplots(1, 2)
        for axis, (title, error) in zip(axes, panels, strict=True):
            root = float(np.sqrt(np.mean(np.square(error, dtype=np.float64))))
            largest = error.max(axis=2)
            shown = axis.imshow(largest, cmap="inferno", vmin=0.0, vmax=top, interpolation="nearest")
            axis.set_title(f"Absolute error {title} (rms {root:.2g}, largest {largest.max():.2g})")
            axis.set_xticks([])
            axis.set_yticks([])
            bar = figure.colorbar(shown, cax=axis.inset_axes([1.02, 0.0, 0.04, 1.0]))
            bar.set_label(label)
            # No power of ten above the bar: it would push one of the titles up.
            bar.ax.yaxis.set_major_formatter(lambda value, position: f"{value:.2g}")
            bar.outline.set_linewidth(0.6)
        _save(figure, path)


def draw_loss(result: FitResult, path: Path) -> None:
    """Draw the loss over the steps, on a logarithmic scale, with the best so far.

    Args:
        result: the fit.
        path: the PNG file.
    """
    matplotlib, figure_class = _matplotlib()
    steps = np.arange(1, len(result.losses) + 1)
    # Zero has no place on a logarithmic scale; a loss that small is rounding.
    losses = np.maximum(np.asarray(result.losses, dtype=np.float64), 1e-20)
    method = str(result.setting.get("method", "")).replace("_", " ")
    with matplotlib.rc_context(_STYLE):
        figure = figure_class(figsize=(6.4, 4.0), layout="constrained")
        axis = figure.subplots()
        marker = "o" if len(steps) <= 60 else ""
        axis.semilogy(steps, losses, marker=marker, markersize=3.5, linewidth=0.8, color="#8aa4c8", label="loss")
        axis.semilogy(steps, np.minimum.accumulate(losses), linewidth=1.6, color="#1f3b63", label="best so far")
        axis.set_xlabel("evaluation" if method == "least squares" else "step")
        axis.set_ylabel(f"loss ({result.setting.get('loss_name', '')})")
        axis.set_title(f"{result.setting.get('study', 'fit')}: {method}")
        axis.xaxis.get_major_locator().set_params(integer=True)
        axis.grid(visible=True, which="major", linewidth=0.4, color="#dddddd")
        axis.legend(frameon=False)
        _save(figure, path)


def _matplotlib() -> tuple[Any, Any]:
    """Return matplotlib and its class of figures, which draws to files without pyplot and its choice of a display."""
    purpose = "The report of a fit"
    return need("matplotlib", "fit", purpose), need("matplotlib.figure", "fit", purpose).Figure


def _save(figure: Any, path: Path) -> None:
    with replacing(path) as partial:
        figure.savefig(partial, format="png")
