"""What is fitted per pixel or vertex: coarser grids, and the prior that neighbours be alike."""

import pytest
import torch
from small_study import make_study

from warpfrag.fit import FitParameter
from warpfrag.fit.maps import Smoothness, coarsen, level_of, refine


def smoothness(name: str, parameter: FitParameter) -> Smoothness:
    """Return the prior on a parameter of the small scene."""
    study = make_study({name: parameter}, method="adam")
    return Smoothness(study.prepared.parameters[0], study.scene, "cpu")


def test_grids_go_there_and_back():
    """A constant stays what it is, a refined grid stays within the coarse one's values, sizes are rounded up."""
    grid = torch.arange(35.0, dtype=torch.float64).reshape(5, 7)
    assert coarsen(grid, 0) is grid
    # Means of what each coarse pixel covers; in between linear, and constant beyond the outer middles.
    torch.testing.assert_close(coarsen(grid[:4, :4], 1), torch.tensor([[4.0, 6.0], [18.0, 20.0]]).double())
    torch.testing.assert_close(
        refine(torch.tensor([[0.0, 4.0]]).double(), (1, 4))[0], torch.tensor([0, 1, 3, 4]).double()
    )
    assert coarsen(grid, 1).shape == (3, 4)
    assert coarsen(grid, 9).shape == (1, 1)
    assert refine(coarsen(grid, 1), (5, 7)).shape == (5, 7)
    assert refine(coarsen(grid, 1), (5, 7)).max() <= grid.max()
    ones = torch.ones(2, 5, 7, dtype=torch.float64)
    torch.testing.assert_close(refine(coarsen(ones, 2), (2, 5, 7)), ones)


def test_levels_go_down_by_stages():
    """The coarsest first, the finest from then on."""
    variable = make_study({"beta": FitParameter(per="pixel", levels=3)}).prepared.parameters[0]
    assert [level_of(variable, stage) for stage in range(5)] == [2, 1, 0, 0, 0]


def test_smoothness_of_a_map():
    """The mean squared difference of pixels side by side, by hand."""
    prior = smoothness("beta", FitParameter(per="pixel", smoothness=3.0))
    grid = torch.tensor([[0.0, 1.0], [0.0, 3.0]], dtype=torch.float64, requires_grad=True)
    # Differences: 0 and 2 down, 1 and 3 across.
    assert prior(grid).item() == pytest.approx(3.0 * (0 + 4 + 1 + 9) / 4)
    assert torch.autograd.gradcheck(prior, grid)


def test_smoothness_of_vertices():
    """Along edges, each once; of positions it is the displacement that counts."""
    prior = smoothness("red.vertices", FitParameter(smoothness=2.0))
    start = prior.origin.clone()
    assert prior(start + 0.3).item() == pytest.approx(0.0, abs=1e-20)
    moved = start.clone()
    moved[0] += torch.tensor([1.0, 0.0, 0.0])
    ends = int((prior.edges == 0).sum())
    assert prior(moved).item() == pytest.approx(2.0 * ends / (3 * len(prior.edges)))
    assert len({tuple(edge) for edge in prior.edges.tolist()}) == len(prior.edges)
