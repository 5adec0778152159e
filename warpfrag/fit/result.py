"""What a fit found."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpfrag.fit.losses import psnr
from warpfrag.fit.parameters import value_wording
from warpfrag.scene.parameters import kind_named


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
        coordinates: the same as a vector of what methods move.
        loss: the least loss.
        losses: the loss of each step.
        evaluations: times that the images were computed.
        converged: whether the stopping rule ended it.
        reason: why it ended.
    """

    start: dict[str, Any] = field(repr=False)
    found: dict[str, Any]
    coordinates: np.ndarray = field(repr=False)
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
        unseen: names of those with which the images change, but by what this gradient does not see: outlines that move,
            or jumps.
        notes: what else there is to know, a sentence each.
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
    unseen: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

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
            line = f"{name}: {value_wording(self.start[name])} → {value_wording(found)}"
            if self.standard_errors is not None and np.size(found) == 1:
                line += f" ± {float(self.standard_errors[name]):.2g}"
            if self.true is not None and errors is not None:
                line += f" (true {value_wording(self.true[name])}, off by {100.0 * errors[name]:.3g} %)"
            if _names(self.undetermined, name):
                line += " — not determined by this image"
            elif _names(self.unseen, name):
                moves = kind_named(name).moves is not None
                outlines = "its outlines move; this gradient holds coverage fixed"
                line += " — " + (outlines if moves else "the images change with it by what this gradient does not see")
            lines.append(line)
        if len(self.views) > 1:
            lines += [f"{v.name}{' (held out)' if v.held_out else ''}: PSNR {v.psnr:.2f} dB" for v in self.views]
        if len(self.runs) > 1:
            lines.append(f"losses from {len(self.runs)} starts: " + ", ".join(f"{run.loss:.3g}" for run in self.runs))
        lines += self.notes
        state = "converged" if self.converged else "stopped"
        end = f"{state}: {self.reason}; loss {self.loss:.3g}, {self.steps} steps, {self.seconds:.1f} s"
        if self.condition_number is not None:
            end += f", condition number {self.condition_number:.3g}"
        return [*lines, end]


def _names(components: tuple[str, ...], name: str) -> bool:
    """Tell whether a parameter, or a number of it, is among some names."""
    return any(part == name or part.startswith(f"{name}[") for part in components)


def plain_value(value: Any) -> Any:
    """Return a parameter as a float, or as a float64 array."""
    array = np.array(value, dtype=np.float64)
    return float(array) if array.ndim == 0 else array
