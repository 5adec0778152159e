"""What first-order methods move: a parameter's coordinates as a torch leaf; and the course that they take.

Adam's leaves are the coordinates themselves, put back on the bound after a step that crosses it. L-BFGS's are w with
coordinate = middle + half·sin(w/half), which cannot leave the bounds.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpfrag.fit.maps import Smoothness, coarsen, level_of, refine
from warpfrag.fit.problem import Problem

# L-BFGS starts at least this share of the range inside the bounds, where the slope is not 0.
INSIDE = 1e-3


class Coordinate:
    """One parameter's coordinates as a torch leaf, in the way a method moves them."""

    def __init__(self, problem: Problem, index: int, bent: bool) -> None:
        self.fitted, self.device = problem.study.parameters[index], problem.processes.device
        self.lower, self.upper = self.fitted.coordinate_bounds
        self.bent = bent and math.isfinite(self.lower)
        self.middle, self.half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
        self.smoothness: Smoothness | None = None
        if self.fitted.smoothness:
            self.smoothness = Smoothness(self.fitted, problem.study.scene, self.device)
        self.leaf: Any = None

    def put(self, coordinate: np.ndarray, stage: int) -> None:
        """Make a new leaf for coordinates, on the grid of a stage."""
        import torch

        whole = torch.tensor(coordinate.reshape(self.fitted.start.shape), dtype=torch.float64, device=self.device)
        leaf = coarsen(whole, level_of(self.fitted, stage))
        if self.bent:
            leaf = self.half * torch.asin(((leaf - self.middle) / self.half).clamp(INSIDE - 1.0, 1.0 - INSIDE))
        self.leaf = leaf.requires_grad_()

    def coordinate(self) -> Any:
        """Return the coordinates, differentiable in the leaf."""
        inside = self.middle + self.half * (self.leaf / self.half).sin() if self.bent else self.leaf
        return refine(inside, self.fitted.start.shape) if self.fitted.levels > 1 else inside

    def project(self) -> None:
        """Put the leaf back between the bounds."""
        if not self.bent and math.isfinite(self.lower):
            self.leaf.data.clamp_(self.lower, self.upper)


@dataclass
class Course:
    """Where the fit from one start has come to, but for leaves and optimiser.

    Attributes:
        begin: steps of all starts before it.
        best: coordinates of the least loss.
        best_loss: the least loss.
        evaluations: times that the images were computed.
        stage: of the maps' grids.
        stage_end: steps from this start after which the stage ends.
        scores: losses in this stage that the stopping rule goes by.
        scale: what L-BFGS divides losses by, its first; 0 before.
    """

    begin: int
    best: np.ndarray
    best_loss: float = math.inf
    evaluations: int = 0
    stage: int = 0
    stage_end: int = 0
    scores: list[float] = field(default_factory=list)
    scale: float = 0.0

    def to_state(self) -> dict[str, Any]:
        """Return it as a checkpoint keeps it."""
        import torch

        return {**vars(self), "best": torch.tensor(self.best), "scores": list(self.scores)}

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> "Course":
        """Return what `to_state` has made a state of."""
        return Course(**{**state, "best": state["best"].cpu().numpy(), "scores": list(state["scores"])})


def values_and_priors(moved: list[tuple[Coordinate, Any]]) -> tuple[dict[str, Any], list[Any]]:
    """Return the parameters for coordinates, by name, and the priors of those that have one."""
    values = {each.fitted.name: each.fitted.to_value(tensor) for each, tensor in moved}
    return values, [each.smoothness(tensor) for each, tensor in moved if each.smoothness]
