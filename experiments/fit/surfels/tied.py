"""A fit in which the vertices of a disc have no say of their own: a colour, an opacity and a radius for each point.

Opacity falls off as o · exp(−½ (r / s)²) with the distance r from the centre, so that the radius s, unlike the outline
of a disc, has a gradient.
"""

from dataclasses import dataclass

import numpy as np
from discs import Discs

from warpfrag.fit import Study
from warpfrag.fit.problem import Problem
from warpfrag.scene.parameters import THICKNESS

# Of the radii [spacings].
SMALLEST, LARGEST = 0.2, 4.0


@dataclass(frozen=True, eq=False)
class Tied:
    """What the fit found.

    Attributes:
        radius: s of each point [spacings], (P,).
        opacity: o of each point, (P,).
        thickness: of all [P(z)].
        images: by view.
    """

    radius: np.ndarray
    opacity: np.ndarray
    thickness: float
    images: dict[str, np.ndarray]


def fit_tied(study: Study, discs: Discs, radius: float) -> Tied:
    """Fit a colour, an opacity and a radius for each point, and one thickness, by Adam with the settings of a study.

    Args:
        study: one that fits colours and opacities per vertex and a thickness.
        discs: those of its scene.
        radius: where the radii start [spacings]; opacities start at 1.
    """
    import torch

    problem = Problem(study)
    thickness = next(variable for variable in study.prepared.parameters if variable.kind is THICKNESS)
    count, size = len(discs.points.points), len(discs.radii)
    radii = torch.as_tensor(discs.radii)
    color = torch.as_tensor(discs.points.color).clone().requires_grad_()
    opacity = torch.ones(count, dtype=torch.float64, requires_grad=True)
    spread = torch.full((count,), float(np.log(radius)), dtype=torch.float64, requires_grad=True)
    thick = torch.tensor(float(thickness.to_coordinate(thickness.start)), dtype=torch.float64, requires_grad=True)

    def values() -> dict[str, torch.Tensor]:
        falloff = torch.exp(-0.5 * (radii / spread.exp()[:, None]) ** 2)
        return {
            "points.color": color.repeat_interleave(size, dim=0),
            "points.opacity": (opacity[:, None] * falloff).reshape(-1),
            "points.thickness": thick.exp(),
        }

    steps, batch, rate = study.prepared.steps, int(study.batch or len(problem.views)), study.learning_rate
    groups = [{"params": [color, opacity, spread]}, {"params": [thick], "lr": thickness.learning_rate or rate}]
    optimizer = torch.optim.Adam(groups, lr=rate)
    generator = np.random.default_rng(study.seed)
    order: list[int] = []
    for _ in range(steps):
        if len(order) < batch:
            order = generator.permutation(len(problem.views)).tolist()
        views = [problem.views[order.pop()] for _ in range(batch)]
        optimizer.zero_grad()
        sum(view.loss(view.image(values())) for view in views).backward()
        optimizer.step()
        with torch.no_grad():
            color.clamp_(0.0, 1.0)
            opacity.clamp_(0.0, 1.0)
            spread.clamp_(np.log(SMALLEST), np.log(LARGEST))
    with torch.no_grad():
        found = values()
        images = {view.view.name: view.image(found).numpy() for view in (*problem.views, *problem.held_out)}
    return Tied(spread.detach().exp().numpy(), opacity.detach().numpy(), float(thick.detach().exp()), images)
