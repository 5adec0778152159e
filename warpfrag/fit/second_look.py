"""A second look at the end of a fit: is it one, and what do the images show that the gradient does not?

A method stops by what its gradient tells. But the gradient holds coverage fixed and passes by jumps of merging, and a
method may stop at a bound it cannot leave. So small steps are tried, and finite changes of the images compared with
what the Jacobian says of them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.parameters import FittedParameter, component_names, with_places
from warpfrag.fit.problem import Problem
from warpfrag.scene.parameters import COMMON_THICKNESS, THICKNESS

# Steps that are tried, as shares of the range.
SMALL_STEP = 1e-3
# A loss has fallen if it is less by this share, and above what rounding of float32 images amounts to.
FALLEN, ROUNDING = 1e-4, 1e-12
# Of more numbers only all of a parameter's at once are tried.
MOST_NUMBERS = 24
# Steps whose change of the images is compared with the Jacobian's: shares of the range, or of a unit where there is no
# range, and of a thickness's logarithm: what moves is moved by a pixel or so.
CHANGE_STEP, MOTION_STEP, THICKNESS_STEP = 1e-2, 2e-2, 1e-2
# The images change if a value somewhere does by so much; the gradient passes by what it holds less than half of.
CHANGED, PASSED_BY = 2e-3, 0.5
# From this share on it is worth a word that merging jumps.
JUMPS = 0.05


class HasLoss(Protocol):
    """A method of fitting, as far as its loss goes."""

    def loss_at(self, coordinates: np.ndarray) -> float:
        """Return the loss at some coordinates."""
        ...


@dataclass(frozen=True)
class Unseen:
    """What of the images' change the gradient does not see.

    Attributes:
        components: names of the numbers with which the images change much more than the gradient says.
        jumps: share of the change with all thicknesses that merging's jumps make up.
    """

    components: tuple[str, ...] = ()
    jumps: float = 0.0


def falling_steps(problem: Problem, method: HasLoss, coordinates: np.ndarray, loss: float) -> list[str]:
    """Return the parameters in which a step of a thousandth of the range lowers the loss.

    Args:
        problem: what was fitted.
        method: by which.
        coordinates: where it ended.
        loss: the loss there.
    """
    if loss <= ROUNDING:
        return []
    lower, upper = problem.bounds()
    names = component_names(problem.study.parameters)
    found = []
    for name, place, span in _steps(problem, names):
        for sign in (1.0, -1.0):
            moved = coordinates.copy()
            moved[place] += sign * SMALL_STEP * span
            moved = np.clip(moved, lower, upper)
            if (moved != coordinates).any() and method.loss_at(moved) < (1.0 - FALLEN) * loss:
                found.append(name)
                break
    return found


def unseen_changes(problem: Problem, coordinates: np.ndarray, evaluation: Evaluation, doubtful: set[str]) -> Unseen:
    """Compare changes of the images with the Jacobian.

    Args:
        problem: what was fitted, every parameter global.
        coordinates: where it ended.
        evaluation: the images there.
        doubtful: names of numbers of which the Jacobian says that nothing tells them; those of motions are looked at
            in any case.
    """
    names = component_names(problem.study.parameters)
    components: list[str] = []
    for each, place in with_places(problem.study.parameters):
        own = []
        for index in range(place.start, place.stop):
            if each.is_motion or names[index] in doubtful:
                direction = np.zeros(coordinates.size)
                direction[index] = _change_step(each)
                share, change = _missing(problem, coordinates, evaluation, direction)
                if share > PASSED_BY and change > CHANGED:
                    own.append(names[index])
        # Where outlines move, what the gradient says of the other directions of a motion is no measure either.
        components += names[place] if own and each.is_motion else own
    jumps = 0.0
    thicknesses = np.zeros(coordinates.size)
    for each, place in with_places(problem.study.parameters):
        if each.kind in (THICKNESS, COMMON_THICKNESS):
            thicknesses[place] = THICKNESS_STEP
    if thicknesses.any() and problem.study.asked.resolve == "sorted" and problem.study.scene.merge == "smooth":
        share, change = _missing(problem, coordinates, evaluation, thicknesses)
        jumps = share if change > CHANGED else 0.0
    return Unseen(tuple(components), jumps)


def _steps(problem: Problem, names: list[str]) -> Iterator[tuple[str, Any, float]]:
    """Yield names, places and ranges of what is tried: single numbers while they are few, else whole parameters."""
    for each, place in with_places(problem.study.parameters):
        low, high = each.coordinate_bounds
        span = high - low if np.isfinite(high - low) else 1.0
        if each.is_global and len(names) <= MOST_NUMBERS:
            for index in range(place.start, place.stop):
                yield names[index], index, span
        else:
            yield each.name, place, span


def _change_step(each: FittedParameter) -> float:
    if each.is_motion:
        return MOTION_STEP
    low, high = each.coordinate_bounds
    return CHANGE_STEP * (high - low) if np.isfinite(high - low) else CHANGE_STEP


def _missing(
    problem: Problem, coordinates: np.ndarray, evaluation: Evaluation, direction: np.ndarray
) -> tuple[float, float]:
    """Return the share of the images' absolute change along a direction that the Jacobian lacks, and its largest."""
    lower, upper = problem.bounds()
    ends = [np.clip(coordinates + sign * direction, lower, upper) for sign in (1.0, -1.0)]
    step = ends[0] - ends[1]
    ahead, behind = (problem.values(end) for end in ends)
    missing, total, largest = 0.0, 0.0, 0.0
    for view in evaluation.views:
        change = np.subtract(view.problem.image(ahead), view.problem.image(behind), dtype=np.float64)
        for channel in range(view.problem.channels):
            seen = view.channel(channel) @ step
            actual = change[..., channel].reshape(-1)
            missing += float(np.abs(actual - seen).sum())
            total += float(np.abs(actual).sum())
            largest = max(largest, float(np.abs(actual).max(initial=0.0)))
    sums = problem.processes.sum(np.array([missing, total, largest]))
    return (float(sums[0] / sums[1]) if sums[1] > 0.0 else 0.0), float(sums[2])
