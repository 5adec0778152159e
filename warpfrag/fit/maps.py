"""What is fitted per pixel or vertex: coarser grids to begin with, and a prior that neighbours be alike."""

from typing import Any

import numpy as np

from warpfrag.fit.parameters import FittedParameter
from warpfrag.scene.parameters import VERTICES
from warpfrag.scene.scene import Scene


def level_of(fitted: FittedParameter, stage: int) -> int:
    """Return how many times a map's grid is halved in a stage: one time less in each, then not any more."""
    return max(0, fitted.levels - 1 - stage)


def coarsen(grid: Any, level: int) -> Any:
    """Average a tensor (H, W) or (V, H, W) down to the grid of a level."""
    import torch

    if level == 0:
        return grid
    height, width = (max(1, -(-size // 2**level)) for size in grid.shape[-2:])
    flat = grid.reshape(1, -1, *grid.shape[-2:])
    return torch.nn.functional.adaptive_avg_pool2d(flat, (height, width)).reshape(*grid.shape[:-2], height, width)


def refine(grid: Any, shape: tuple[int, ...]) -> Any:
    """Interpolate a coarse grid bilinearly to the last two sizes of a shape; differentiable."""
    import torch

    size = tuple(shape[-2:])
    if tuple(grid.shape[-2:]) == size:
        return grid
    flat = grid.reshape(1, -1, *grid.shape[-2:])
    fine = torch.nn.functional.interpolate(flat, size, mode="bilinear", align_corners=False)
    return fine.reshape(*grid.shape[:-2], *size)


class Smoothness:
    """The prior on one parameter: its weight times the mean squared difference of neighbours' coordinates.

    Neighbours are pixels side by side, or vertices that share an edge; of positions it is the displacement from the
    start that is to be alike.

    Args:
        fitted: the parameter, per pixel or vertex.
        scene: the scene, whose faces tell neighbours.
        device: where torch computes.
    """

    def __init__(self, fitted: FittedParameter, scene: Scene, device: str) -> None:
        import torch

        self.fitted = fitted
        self.edges: Any = None
        if fitted.per == "vertex":
            faces = next(item for item in scene.objects if item.name == fitted.owner).faces
            pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
            self.edges = torch.as_tensor(np.unique(pairs, axis=0).astype(np.int64), device=device)
        start = fitted.to_coordinate(fitted.start) if fitted.kind is VERTICES else 0.0
        self.origin = torch.as_tensor(start, dtype=torch.float64, device=device)

    def __call__(self, coordinate: Any) -> Any:
        """Return the prior, a 0-d float64 tensor."""
        moved = coordinate - self.origin
        if self.edges is not None:
            differences = [moved[self.edges[:, 0]] - moved[self.edges[:, 1]]]
        else:
            differences = [moved[..., 1:, :] - moved[..., :-1, :], moved[..., :, 1:] - moved[..., :, :-1]]
        count = sum(part.numel() for part in differences)
        total = sum(part.square().sum() for part in differences)
        return self.fitted.smoothness * total / max(1, count)
