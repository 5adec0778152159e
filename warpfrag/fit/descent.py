"""First-order methods for any parameters, maps and vertices included: Adam and L-BFGS of torch.

Bounds. Adam moves the coordinates and is put back on the bound after a step that crosses it: its step has the length of
the learning rate, so nothing is lost. L-BFGS learns the curvature from the gradients and must not be pushed about: it
moves w with coordinate = middle + half·sin(w/half), which cannot leave the bounds, has slope 1 in the middle and
slope 0 at the bounds (as in MINUIT).

Maps are fitted from coarse to fine in stages, each with an equal share of the steps that are left (`maps`). With
several processes each computes the loss of its share of the views; what they exchange are gradients in the parameters.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.fit.coordinates import Coordinate, Course, values_and_priors
from warpfrag.fit.parameters import with_places
from warpfrag.fit.problem import Problem, describe_run
from warpfrag.fit.result import Run
from warpfrag.fit.session import FitError, Session, check_finite
from warpfrag.fit.views import StudyError

LBFGS_EVALUATIONS = 25


class Descent(ABC):
    """What both methods share: loss and gradient, stages, the best so far, state to and from checkpoints.

    Args:
        problem: what to fit.
        session: the course of the fit; what is in its state is taken up.
    """

    bent = False

    def __init__(self, problem: Problem, session: Session) -> None:
        study = problem.study
        self.torch = torch = need("torch", "torch", "Adam and L-BFGS")
        try:
            torch.zeros(1, device=study.asked.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise StudyError(f"device: got {study.asked.device!r}, which torch cannot use ({reason})") from None
        self.problem, self.session, self.study = problem, session, study
        self.coordinates = [Coordinate(problem, index, self.bent) for index in range(len(study.parameters))]
        self.stages = max(each.levels for each in study.parameters)
        # Where each start has come to.
        self.states: list[dict[str, Any]] = list(session.state.get("runs", []))
        self.index = -1

    @abstractmethod
    def optimizer(self) -> Any:
        """Return a new optimiser of the leaves."""

    @abstractmethod
    def step(self) -> float:
        """Take one step and return the loss before it."""

    @abstractmethod
    def settled(self) -> str | None:
        """Return why the stage has come to its end, if it has."""

    def run(self, start: np.ndarray) -> Run:
        """Fit from a start, or go on from where the checkpoint has come to from there."""
        self.index += 1
        with _one_torch_thread():
            return self._run(start)

    def _run(self, start: np.ndarray) -> Run:
        steps = self.study.steps
        self.begin(start)
        if self.index < len(self.states):
            self._restore(self.states[self.index])
        converged, reason = False, "the largest number of steps was reached"
        while True:
            why = self.settled()
            last = self.course.stage + 1 == self.stages
            if last and (why is not None or self.done >= steps):
                converged, reason = why is not None, why or reason
                break
            if not last and (why is not None or self.done >= self.course.stage_end):
                left = (steps - self.done) // (self.stages - self.course.stage - 1)
                self._enter(self.course.stage + 1, self.vector(), self.done + left)
                continue
            values = self.values()
            loss = self.step()
            for coordinate in self.coordinates:
                coordinate.project()
            self._score(loss)
            self.session.step(loss, values, self._state)
        self.session.state = self._state()
        self.states = self.session.state["runs"]
        course = self.course
        return describe_run(
            self.problem,
            start,
            course.best,
            loss=course.best_loss,
            losses=self.session.losses[course.begin :],
            evaluations=course.evaluations,
            converged=converged,
            reason=reason,
        )

    def begin(self, start: np.ndarray) -> None:
        """Begin the course from a start, in the first stage."""
        self.course = Course(len(self.session.losses), start)
        self._enter(0, start, self.study.steps // self.stages)

    @property
    def done(self) -> int:
        """Steps done from this start."""
        return len(self.session.losses) - self.course.begin

    def evaluate(self, views: list[int]) -> Any:
        """Compute the loss of some views and its gradient in the leaves.

        Raises:
            FitError: one of them is not finite.
        """
        torch, step = self.torch, len(self.session.losses) + 1
        for coordinate in self.coordinates:
            coordinate.leaf.grad = None
        whole, priors = self._values_and_priors()
        # Leaves of their own, so that each view's graph is gone before the next is made.
        leaves = {name: tensor.detach().requires_grad_() for name, tensor in whole.items()}
        values = {name: leaf.detach().cpu().numpy() for name, leaf in leaves.items()}
        total = 0.0
        for index in self.problem.processes.share(views):
            try:
                view = self.problem.views[index]
                loss = view.loss(view.image(leaves)) / len(views)
            except ValueError as error:
                check_finite(step, math.nan, values)
                raise FitError(f"step {step}: {error}") from error
            total += float(loss.detach())
            # An image that depends on no parameter (all of it out of sight, say) has no gradient.
            if loss.requires_grad:
                loss.backward()
        gradients = [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves.values()]
        total, gradients = self._over_processes(total, gradients)
        check_finite(step, total, values, {n: g.cpu().numpy() for n, g in zip(leaves, gradients, strict=True)})
        torch.autograd.backward([*whole.values(), *priors], [*gradients, *(torch.ones_like(prior) for prior in priors)])
        self.course.evaluations += 1
        return total + sum(float(prior.detach()) for prior in priors)

    def _over_processes(self, total: float, gradients: list[Any]) -> tuple[float, list[Any]]:
        """Add up loss and gradients of all processes."""
        if self.problem.processes.count == 1:
            return total, gradients
        torch = self.torch
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients]).cpu().numpy()
        summed = self.problem.processes.sum(np.concatenate([[total], flat]))
        parts = torch.as_tensor(summed[1:], device=gradients[0].device).split([g.numel() for g in gradients])
        return float(summed[0]), [part.reshape(g.shape) for part, g in zip(parts, gradients, strict=True)]

    def full_loss(self) -> float:
        """Return the loss of all views, prior included, without a gradient."""
        with self.torch.no_grad():
            return self._loss_of(*self._values_and_priors())

    def loss_at(self, coordinates: np.ndarray) -> float:
        """Return the same at some coordinates."""
        with self.torch.no_grad(), _one_torch_thread():
            moved = [
                (each, self.torch.as_tensor(coordinates[place].reshape(fitted.start.shape), device=each.device))
                for each, (fitted, place) in zip(self.coordinates, with_places(self.study.parameters), strict=True)
            ]
            return self._loss_of(*values_and_priors(moved))

    def _loss_of(self, values: Mapping[str, Any], priors: list[Any]) -> float:
        mine = self.problem.processes.share(list(range(len(self.problem.views))))
        views = [self.problem.views[index] for index in mine]
        total = sum(float(view.loss(view.image(values))) for view in views) / len(self.problem.views)
        return float(self.problem.processes.sum(np.array([total]))[0]) + sum(float(prior) for prior in priors)

    def _values_and_priors(self) -> tuple[dict[str, Any], list[Any]]:
        """Return the parameters by name, and the priors of those that have one, differentiable in the leaves."""
        return values_and_priors([(coordinate, coordinate.coordinate()) for coordinate in self.coordinates])

    def vector(self) -> np.ndarray:
        """Return all coordinates as one vector."""
        return np.concatenate([c.coordinate().detach().cpu().numpy().reshape(-1) for c in self.coordinates])

    def values(self) -> dict[str, np.ndarray]:
        """Return the parameters where the leaves are."""
        return self.problem.values(self.vector())

    def keep(self, loss: float) -> None:
        """Keep the coordinates if none before had a smaller loss."""
        if loss < self.course.best_loss:
            self.course.best_loss, self.course.best = loss, self.vector()

    def _score(self, loss: float) -> None:
        """Take note of the loss that the stopping rule goes by."""
        self.course.scores.append(loss)

    def _enter(self, stage: int, vector: np.ndarray, end: int) -> None:
        """Begin a stage from a vector of coordinates."""
        self.course.stage, self.course.stage_end, self.course.scores = stage, end, []
        for coordinate, (_, place) in zip(self.coordinates, with_places(self.study.parameters), strict=True):
            coordinate.put(vector[place], stage)
        self.torch_optimizer = self.optimizer()

    def _state(self) -> dict[str, Any]:
        """Return all that is needed to go on."""
        current = {
            "leaves": [coordinate.leaf.detach().clone() for coordinate in self.coordinates],
            "optimizer": self.torch_optimizer.state_dict(),
            "losses": self.session.losses[self.course.begin :],
            "course": self.course.to_state(),
        }
        return {"runs": [*self.states[: self.index], current, *self.states[self.index + 1 :]]}

    def _restore(self, state: dict[str, Any]) -> None:
        """Take up where a checkpoint was written."""
        course = Course.from_state(state["course"])
        self._enter(course.stage, self.vector(), course.stage_end)
        self.course = course
        for coordinate, leaf in zip(self.coordinates, state["leaves"], strict=True):
            coordinate.leaf.data.copy_(leaf)
        self.torch_optimizer.load_state_dict(state["optimizer"])
        self.session.losses += state["losses"]


class Adam(Descent):
    """Adam, on all views or on a batch of them in each step.

    With batches the losses of single steps say little: after each round through all views the loss of all of them is
    computed, by which the best is kept and the fit stopped.
    """

    def optimizer(self) -> Any:
        """Return a new optimiser of the leaves."""
        rate = self.study.asked.learning_rate
        groups = [{"params": [c.leaf], "lr": c.fitted.learning_rate or rate} for c in self.coordinates]
        return self.torch.optim.Adam(groups)

    def step(self) -> float:
        """Take one step and return the loss before it, of its batch."""
        loss = self.evaluate(self._batch())
        if self.study.asked.batch is None:
            self.keep(loss)
        self.torch_optimizer.step()
        return loss

    def settled(self) -> str | None:
        """Return why the stage has come to its end, if it has."""
        patience = -(-self.study.patience // self._round)
        if len(self.course.scores) <= patience:
            return None
        best, before = min(self.course.scores[-patience:]), min(self.course.scores[:-patience])
        stalled = best >= (1.0 - self.study.asked.tolerance) * before
        return f"{self.study.patience} steps brought nothing better" if stalled else None

    @property
    def _round(self) -> int:
        """Steps in which all views have their turn."""
        return -(-len(self.problem.views) // (self.study.asked.batch or len(self.problem.views)))

    def _batch(self) -> list[int]:
        count = len(self.problem.views)
        if self.study.asked.batch is None:
            return list(range(count))
        turn, place = divmod(self.done, self._round)
        order = np.random.default_rng([self.study.asked.seed, turn]).permutation(count)
        return sorted(order[place * self.study.asked.batch : (place + 1) * self.study.asked.batch].tolist())

    def _score(self, loss: float) -> None:
        if self.study.asked.batch is None:
            self.course.scores.append(loss)
        # The step at hand is not yet in the history.
        elif (self.done + 1) % self._round == 0 or self.done + 1 == self.study.steps:
            full = self.full_loss()
            self.course.scores.append(full)
            self.keep(full)


class LBFGS(Descent):
    """L-BFGS with a strong Wolfe line search.

    Its first step is as long as the gradient: of losses divided by the first one, so that how small they are does not
    matter.
    """

    bent = True

    def optimizer(self) -> Any:
        """Return a new optimiser of the leaves."""
        return self.torch.optim.LBFGS(
            [c.leaf for c in self.coordinates],
            lr=1.0,
            max_iter=1,
            max_eval=LBFGS_EVALUATIONS,
            # The rule below stops it.
            tolerance_grad=0.0,
            tolerance_change=0.0,
            history_size=10,
            line_search_fn="strong_wolfe",
        )

    def step(self) -> float:
        """Take one step and return the loss before it."""
        self.losses: list[float] = []
        self.torch_optimizer.step(self._closure)
        return self.losses[0]

    def settled(self) -> str | None:
        """Return why the stage has come to its end, if it has."""
        patience = self.study.patience
        if len(self.course.scores) <= patience:
            return None
        recent = self.course.scores[-patience - 1 :]
        same = all(abs(a - b) <= self.study.asked.tolerance * abs(a) for a, b in pairwise(recent))
        return "the loss stopped changing" if same else None

    def _closure(self) -> float:
        loss = self.evaluate(list(range(len(self.problem.views))))
        self.keep(loss)
        self.losses.append(loss)
        self.course.scale = self.course.scale or loss or 1.0
        for coordinate in self.coordinates:
            coordinate.leaf.grad /= self.course.scale
        return loss / self.course.scale


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
