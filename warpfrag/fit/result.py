"""What a fit found, and the folder it is saved in."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.files.images import write_image
from warpfrag.files.saving import replacing
from warpfrag.fit.losses import psnr
from warpfrag.fit.parameters import value_words
from warpfrag.versions import package_versions

# Arrays with more numbers than this are written beside result.json, not into it.
MOST_NUMBERS = 256


@dataclass(frozen=True, eq=False)
class ViewResult:
    """A view before and after a fit.

    Attributes:
        name: the view's name.
        held_out: whether it was only compared, not fitted.
        reference: the image to approach, (H, W, 3 or 4), linear premultiplied.
        before: the image at the start, (H, W, 4).
        after: the image found, (H, W, 4).
    """

    name: str
    held_out: bool
    reference: np.ndarray = field(repr=False)
    before: np.ndarray = field(repr=False)
    after: np.ndarray = field(repr=False)

    @property
    def psnr(self) -> float:
        """Peak signal-to-noise ratio of the colours found [dB], in linear light; inf where they are equal."""
        return psnr(self.after, self.reference)


@dataclass(frozen=True, eq=False)
class Run:
    """A fit from one of the starts.

    Attributes:
        start: parameters at the start, by name: floats and float64 arrays.
        found: parameters of the least loss.
        loss: the least loss.
        losses: the loss of each step.
        evaluations: times that the images were computed.
        converged: whether the stopping rule ended it.
        reason: why it ended.
    """

    start: dict[str, Any] = field(repr=False)
    found: dict[str, Any]
    loss: float
    losses: tuple[float, ...] = field(repr=False)
    evaluations: int
    converged: bool
    reason: str


@dataclass(frozen=True, eq=False)
class FitResult:
    """What a fit found.

    Attributes:
        start: parameters at the start, by name: floats and float64 arrays.
        found: parameters of the least loss.
        true: parameters that made the reference, where they are known, else None.
        standard_errors: one standard error of each found parameter in its own unit, from the Jacobian and the variance
            of the residuals; inf where the image does not depend on it. None unless every parameter is global.
        condition_number: of the Jacobian (thicknesses as logarithms); None unless every parameter is global.
        undetermined: names of the parameters the image does not determine, see `warpfrag.fit.certainty.assess`.
        loss: the least loss.
        losses: the loss of each step from the start that led there.
        evaluations: times that the images were computed, from all starts.
        seconds: time the fit took.
        converged: whether the stopping rule ended it.
        reason: why it ended.
        views: the views before and after, those held out last.
        runs: the fits from all starts, the study's own first.
        setting: how it was fitted: method, loss, size, and so on.
    """

    start: dict[str, Any]
    found: dict[str, Any]
    true: dict[str, Any] | None
    standard_errors: dict[str, Any] | None
    condition_number: float | None
    undetermined: tuple[str, ...]
    loss: float
    losses: tuple[float, ...]
    evaluations: int
    seconds: float
    converged: bool
    reason: str
    views: tuple[ViewResult, ...] = field(repr=False)
    runs: tuple[Run, ...] = field(repr=False)
    setting: dict[str, Any] = field(default_factory=dict)

    @property
    def reference(self) -> np.ndarray:
        """The first view's image to approach, (H, W, 3 or 4), linear premultiplied."""
        return self.views[0].reference

    @property
    def before(self) -> np.ndarray:
        """The first view's image at the start, (H, W, 4)."""
        return self.views[0].before

    @property
    def after(self) -> np.ndarray:
        """The first view's image found, (H, W, 4)."""
        return self.views[0].after

    @property
    def steps(self) -> int:
        """Steps taken: evaluations of least squares, iterations of the other methods."""
        return len(self.losses)

    def relative_errors(self) -> dict[str, float] | None:
        """Return the largest deviation of each parameter from its true value, relative to the largest true number."""
        if self.true is None:
            return None
        errors = {}
        for name, found in self.found.items():
            true = np.asarray(self.true[name], dtype=np.float64)
            scale = float(np.abs(true).max(initial=0.0)) or 1.0
            errors[name] = float(np.abs(np.asarray(found) - true).max(initial=0.0)) / scale
        return errors

    def lines(self) -> list[str]:
        """Return the result in words: a line for each parameter, and one for how it ended."""
        errors = self.relative_errors()
        lines = []
        for name, found in self.found.items():
            line = f"{name}: {value_words(self.start[name])} → {value_words(found)}"
            if self.standard_errors is not None and np.size(found) == 1:
                line += f" ± {float(self.standard_errors[name]):.2g}"
            if self.true is not None and errors is not None:
                line += f" (true {value_words(self.true[name])}, off by {100.0 * errors[name]:.3g} %)"
            if any(part == name or part.startswith(f"{name}[") for part in self.undetermined):
                line += " — not determined by this image"
            lines.append(line)
        if len(self.views) > 1:
            lines += [f"{v.name}{' (held out)' if v.held_out else ''}: PSNR {v.psnr:.2f} dB" for v in self.views]
        if len(self.runs) > 1:
            lines.append(f"losses from {len(self.runs)} starts: " + ", ".join(f"{run.loss:.3g}" for run in self.runs))
        state = "converged" if self.converged else "stopped"
        end = f"{state}: {self.reason}; loss {self.loss:.3g}, {self.steps} steps, {self.seconds:.1f} s"
        if self.condition_number is not None:
            end += f", condition number {self.condition_number:.3g}"
        return [*lines, end]

    def to_json(self, arrays: dict[str, np.ndarray] | None = None) -> dict[str, Any]:
        """Return everything but the images as plain values; large arrays go to `arrays`, if it is given."""
        return {
            "start": _plain_values("start", self.start, arrays),
            "found": _plain_values("found", self.found, arrays),
            "true": _plain_values("true", self.true, arrays),
            "relative_errors": _plain(self.relative_errors()),
            "standard_errors": _plain_values("standard_errors", self.standard_errors, arrays),
            "condition_number": _plain(self.condition_number),
            "undetermined": list(self.undetermined),
            "loss": _plain(self.loss),
            "losses": _plain(list(self.losses)),
            "steps": self.steps,
            "evaluations": self.evaluations,
            "seconds": self.seconds,
            "converged": self.converged,
            "reason": self.reason,
            "views": [_plain({"name": v.name, "held_out": v.held_out, "psnr": v.psnr}) for v in self.views],
            "runs": [self._run_to_json(index, run, arrays) for index, run in enumerate(self.runs)],
            **_plain(self.setting),
            "versions": package_versions(),
        }

    @staticmethod
    def _run_to_json(index: int, run: Run, arrays: dict[str, np.ndarray] | None) -> dict[str, Any]:
        return {
            "start": _plain_values(f"runs.{index}.start", run.start, arrays),
            "found": _plain_values(f"runs.{index}.found", run.found, arrays),
            "loss": _plain(run.loss),
            "steps": len(run.losses),
            "evaluations": run.evaluations,
            "converged": run.converged,
            "reason": run.reason,
        }

    def save(self, folder: str | Path) -> None:
        """Write images, plots and result.json to a folder, made if need be; the images of several views to one each.

        Raises:
            ImageError: a file cannot be written.
            ImportError: matplotlib is not installed.
        """
        from warpfrag.fit.plots import draw_error, draw_loss

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for view in self.views:
            place = folder / view.name if len(self.views) > 1 else folder
            place.mkdir(exist_ok=True)
            for name in ("reference", "before", "after"):
                write_image(place / f"{name}.png", getattr(view, name))
            draw_error(view, place / "error.png")
        draw_loss(self, folder / "loss.png")
        arrays: dict[str, np.ndarray] = {}
        content = self.to_json(arrays)
        if arrays:
            with replacing(folder / "parameters.npz") as partial:
                np.savez(partial, **arrays)  # type: ignore[arg-type]
        with replacing(folder / "result.json") as partial:
            partial.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def plain_value(value: Any) -> Any:
    """Return a parameter as a float, or as a float64 array."""
    array = np.array(value, dtype=np.float64)
    return float(array) if array.ndim == 0 else array


def _plain_values(kind: str, values: Mapping[str, Any] | None, arrays: dict[str, np.ndarray] | None) -> Any:
    if values is None:
        return None
    result = {}
    for name, value in values.items():
        array = np.asarray(value)
        if arrays is not None and array.size > MOST_NUMBERS:
            arrays[f"{kind}.{name}"] = array
            result[name] = {"shape": list(array.shape), "mean": _plain(float(array.mean())), "file": "parameters.npz"}
        else:
            result[name] = _plain(array.tolist())
    return result


def _plain(value: Any) -> Any:
    """Return a value as JSON takes it: what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
