"""Ways to choose the thickness: by search, by a rule, and by gradient.

Pixels do not depend on one another. One render with the same thickness everywhere therefore tries it in all pixels at
once, and renders over a grid of thicknesses are all that a search needs, for any map: one value, one for each block of
pixels, or one a pixel, which no other map with one value a pixel can beat but by what lies between the grid's values.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from budget import MEASURES, Case

# Thicknesses that are tried, as shares of the scene's depth.
GRID = np.concatenate([[0.0], np.geomspace(1e-4, 0.7, 27)])
# Factors of the rule that are tried.
FACTORS = np.geomspace(0.06, 1.0, 12)
# Edge of the blocks of pixels [pixels].
BLOCK = 8
# The rule, and what it is without its bound.
RULES = ("min(c·extent/M, gap)", "c·extent/M")
# Of Adam, in the logarithm of the thickness.
LEARNING_RATE = 0.1


@dataclass(frozen=True, eq=False)
class Search:
    """What every thickness of the grid does to each pixel.

    Attributes:
        case: the scene.
        thicknesses: those tried [scene units], (G,).
        squares: mean square error of each pixel by measure, (G, P).
    """

    case: Case
    thicknesses: np.ndarray
    squares: dict[str, np.ndarray]

    @classmethod
    def run(cls, case: Case, method: str, layer_count: int) -> "Search":
        """Render with every thickness."""
        thicknesses = GRID * (case.span[1] - case.span[0])
        tried = [case.squares(method, layer_count, np.full(len(case.counts), value)) for value in thicknesses]
        return cls(case, thicknesses, {measure: np.stack([one[measure] for one in tried]) for measure in MEASURES})

    def one(self, measure: str) -> float:
        """Return the one value that is best for all pixels together [scene units]."""
        return float(self.thicknesses[self.squares[measure][:, self.case.covered].mean(axis=1).argmin()])

    def blocks(self, measure: str, edge: int = BLOCK) -> np.ndarray:
        """Return the map of the best value for each block of pixels [scene units], (P,)."""
        height, width = self.case.scene.camera.shape
        # Pixels without fragments have no error, whatever the thickness.
        rows, columns = np.arange(height) // edge, np.arange(width) // edge
        block = (rows[:, None] * (columns[-1] + 1) + columns).reshape(-1)
        sums = np.stack([np.bincount(block, row) for row in self.squares[measure]])
        return self.thicknesses[sums.argmin(axis=0)][block]

    def pixels(self, measure: str) -> np.ndarray:
        """Return the map of the best value for each pixel [scene units], (P,)."""
        return self.thicknesses[self.squares[measure].argmin(axis=0)]


def by_rule(case: Case, layer_count: int, factor: float, rule: str = RULES[0]) -> np.ndarray:
    """Return the thickness that a pixel's complexity asks for [scene units], (P,): 0 where all fragments find room.

    That is a share of the pixel's extent in depth, but no more than merges its fragments into M layers: the M-th
    largest gap between two that follow one another.

    Args:
        case: the scene.
        layer_count: number of layers M.
        factor: c, the share for M = 1.
        rule: one of `RULES`.
    """
    thickness = np.where(case.counts > layer_count, factor * case.extent / layer_count, 0.0)
    return np.minimum(thickness, case.gap(layer_count)) if rule == RULES[0] else thickness


@dataclass(frozen=True, eq=False)
class Descent:
    """What Adam has found.

    Attributes:
        pixels: the thickness with which each pixel was best on its way [scene units], (P,).
        together: the map of the step that was best for all pixels together [scene units], (P,).
        moved: share of the pixels with fragments whose first gradient is not 0.
    """

    pixels: np.ndarray
    together: np.ndarray
    moved: float


def descend(case: Case, method: str, layer_count: int, start: float, steps: int) -> Descent:
    """Fit a map by the gradient of the error with a surface inserted, from one value for all pixels [scene units]."""
    logarithm = torch.full((len(case.counts),), float(np.log(start)), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([logarithm], lr=LEARNING_RATE)
    least, together, moved = np.inf, np.full(len(case.counts), start), 0.0
    squares, pixels = np.full(len(case.counts), np.inf), together
    for step in range(steps + 1):
        optimizer.zero_grad()
        losses = case.differences(method, layer_count, logarithm.exp())[:, :-1].square().mean(dim=(1, 2))
        loss = losses.sum()
        loss.backward()
        gradient: Any = logarithm.grad
        if step == 0:
            moved = float((gradient.numpy()[case.covered] != 0.0).mean())
        here, now = logarithm.detach().exp().numpy(), losses.detach().numpy()
        if loss.item() < least:
            least, together = loss.item(), here
        pixels, squares = np.where(now < squares, here, pixels), np.minimum(now, squares)
        optimizer.step()
    return Descent(pixels, together, moved)
