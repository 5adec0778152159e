"""First-order methods for any parameters, maps and vertices included: Adam and L-BFGS of torch.

Bounds. Adam moves the coordinates and is put back on the bound after a step that crosses it: its step has the length of
the learning rate, so nothing is lost. L-BFGS learns the curvature from the gradients and must not be pushed about: it
moves w with coordinate = middle + half·sin(w/half), which cannot leave the bounds, has slope 1 in the middle and
slope 0 at the bounds (as in MINUIT).
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.outcome import Outcome
from warpfrag.fit.problem import Problem
from warpfrag.fit.session import FitError, Session, check_finite
from warpfrag.fit.study import StudyError

# Adam stops when the best loss of so many steps is not better than the best before them by the tolerance.
ADAM_PATIENCE = 50
# L-BFGS stops after so many steps in a row that changed the loss relatively by less than the tolerance.
LBFGS_PATIENCE = 3
LBFGS_EVALUATIONS = 25
# L-BFGS starts at least this share of the range inside the bounds, where the slope is not 0.
INSIDE = 1e-3


class _Coordinate:
    """One parameter's coordinates as a torch leaf, in the way a method moves them."""

    def __init__(self, problem: Problem, index: int, bent: bool) -> None:
        import torch

        self.variable = variable = problem.study.variables[index]
        self.lower, self.upper = variable.span
        self.bent = bent and math.isfinite(self.lower)
        start = variable.inward(variable.start)
        if self.bent:
            self.middle, self.half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
            share = np.clip((start - self.middle) / self.half, INSIDE - 1.0, 1.0 - INSIDE)
            start = self.half * np.arcsin(share)
        self.leaf = torch.tensor(start, dtype=torch.float64, device=problem.study.device, requires_grad=True)

    def coordinate(self) -> Any:
        """Return the coordinate, differentiable."""
        return self.middle + self.half * (self.leaf / self.half).sin() if self.bent else self.leaf

    def project(self) -> None:
        """Put it back between the bounds."""
        if not self.bent and math.isfinite(self.lower):
            self.leaf.data.clamp_(self.lower, self.upper)


class _Descent:
    """What both methods share: loss and gradient, the best so far, state to and from checkpoints."""

    def __init__(self, problem: Problem, session: Session, bent: bool) -> None:
        study = problem.study
        import torch

        try:
            torch.zeros(1, device=study.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise StudyError(f"device: found {study.device!r}, which torch cannot use ({reason})") from None
        torch.manual_seed(study.seed)
        self.torch, self.problem, self.session = torch, problem, session
        self.frozen = problem.frozen.torch(study.device) if problem.frozen is not None else None
        self.loss = RobustLoss.named(study.loss, study.delta)
        self.coordinates = [_Coordinate(problem, index, bent) for index in range(len(study.variables))]
        self.evaluations = 0
        self.best_loss = math.inf
        self.best = problem.start()

    def evaluate(self) -> Any:
        """Compute loss and gradient.

        Raises:
            FitError: one of them is not finite.
        """
        step = len(self.session.losses) + 1
        for coordinate in self.coordinates:
            coordinate.leaf.grad = None
        tensors = {c.variable.name: c.variable.outward(c.coordinate()) for c in self.coordinates}
        values = {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}
        try:
            image = self.problem.image(tensors, self.frozen)
        except ValueError as error:
            check_finite(step, math.nan, values)
            raise FitError(f"step {step}: {error}") from error
        loss = self.loss.rho(self.problem.residual(image).double()).mean() * self.loss.factor
        number = float(loss.detach())
        check_finite(step, number, values)
        loss.backward()
        # An image that does not depend on a parameter (all of it behind an opaque one, say) has no gradient for it.
        for coordinate in self.coordinates:
            if coordinate.leaf.grad is None:
                coordinate.leaf.grad = self.torch.zeros_like(coordinate.leaf)
        check_finite(step, number, values, {c.variable.name: c.leaf.grad.cpu().numpy() for c in self.coordinates})
        self.evaluations += 1
        if number < self.best_loss:
            self.best_loss, self.best = number, self.vector()
        return loss.detach()

    def vector(self) -> np.ndarray:
        """Return all coordinates as one vector."""
        return np.concatenate([c.coordinate().detach().cpu().numpy().reshape(-1) for c in self.coordinates])

    def values(self) -> dict[str, np.ndarray]:
        """Return the parameters where the leaves are."""
        return self.problem.values(self.vector())

    def state(self, optimizer: Any) -> dict[str, Any]:
        """Return all that is needed to go on."""
        return {
            "leaves": [coordinate.leaf.detach().clone() for coordinate in self.coordinates],
            "optimizer": optimizer.state_dict(),
            "losses": list(self.session.losses),
            "evaluations": self.evaluations,
            "best_loss": self.best_loss,
            "best": self.torch.tensor(self.best),
        }

    def restore(self, optimizer: Any) -> None:
        """Take up the session's state, if there is one."""
        state = self.session.state
        if not state:
            return
        for coordinate, leaf in zip(self.coordinates, state["leaves"], strict=True):
            coordinate.leaf.data.copy_(leaf)
        optimizer.load_state_dict(state["optimizer"])
        self.session.losses[:] = state["losses"]
        self.evaluations, self.best_loss = state["evaluations"], state["best_loss"]
        self.best = state["best"].cpu().numpy()

    def outcome(self, optimizer: Any, converged: bool, reason: str) -> Outcome:
        """Return the best that was found."""
        self.session.state = self.state(optimizer)
        compressed = None
        if self.problem.study.is_global:
            compressed = Evaluation(self.problem, self.loss, self.best).compress()
        return Outcome(self.best, self.best_loss, converged, reason, self.evaluations, compressed)


def adam(problem: Problem, session: Session) -> Outcome:
    """Fit by Adam."""
    with _one_torch_thread():
        return _adam(problem, session)


def lbfgs(problem: Problem, session: Session) -> Outcome:
    """Fit by L-BFGS with a strong Wolfe line search."""
    with _one_torch_thread():
        return _lbfgs(problem, session)


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Keep torch to one thread within the block; the kernels have threads of their own.

    Its sums then have the same bits on any machine. What is left to torch is small, and where another process keeps a
    core busy its threads wait for one another: 0.16 s a step were measured for 0.04.
    """
    torch = need("torch", "torch", "Adam and L-BFGS")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _adam(problem: Problem, session: Session) -> Outcome:
    study = problem.study
    descent = _Descent(problem, session, bent=False)
    groups = [{"params": [c.leaf], "lr": c.variable.learning_rate or study.learning_rate} for c in descent.coordinates]
    optimizer = descent.torch.optim.Adam(groups)
    descent.restore(optimizer)
    losses = session.losses
    while len(losses) < int(study.steps or 0):
        if _stalled(losses, study.tolerance):
            return descent.outcome(optimizer, True, f"{ADAM_PATIENCE} steps brought nothing better")
        loss = float(descent.evaluate())
        values = descent.values()
        optimizer.step()
        for coordinate in descent.coordinates:
            coordinate.project()
        session.step(loss, values, lambda: descent.state(optimizer))
    return descent.outcome(optimizer, False, "the largest number of steps was reached")


def _lbfgs(problem: Problem, session: Session) -> Outcome:
    study = problem.study
    descent = _Descent(problem, session, bent=True)
    optimizer = descent.torch.optim.LBFGS(
        [c.leaf for c in descent.coordinates],
        lr=1.0,
        max_iter=1,
        max_eval=LBFGS_EVALUATIONS,
        # The rule below stops it.
        tolerance_grad=0.0,
        tolerance_change=0.0,
        history_size=10,
        line_search_fn="strong_wolfe",
    )
    descent.restore(optimizer)
    losses = session.losses
    while len(losses) < int(study.steps or 0):
        if _settled(losses, study.tolerance):
            return descent.outcome(optimizer, True, "the loss stopped changing")
        loss = float(optimizer.step(descent.evaluate))
        session.step(loss, descent.values(), lambda: descent.state(optimizer))
    return descent.outcome(optimizer, False, "the largest number of steps was reached")


def _stalled(losses: list[float], tolerance: float) -> bool:
    if len(losses) <= ADAM_PATIENCE:
        return False
    return min(losses[-ADAM_PATIENCE:]) > (1.0 - tolerance) * min(losses[:-ADAM_PATIENCE])


def _settled(losses: list[float], tolerance: float) -> bool:
    if len(losses) <= LBFGS_PATIENCE:
        return False
    recent = losses[-LBFGS_PATIENCE - 1 :]
    return all(abs(a - b) <= tolerance * abs(a) for a, b in pairwise(recent))
