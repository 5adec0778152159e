"""Bounded nonlinear least squares: SciPy's trust-region reflective method on compressed residuals.

SciPy cannot stop in the middle and go on later. But it is deterministic, and what it asks for is small once compressed
(see `jacobian`): all evaluations are kept, and a resumed fit runs SciPy again from the start, answered from memory
until it comes to where it was. So an unbroken and a resumed fit end at the same bits.
"""

from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.problem import Problem, describe_run
from warpfrag.fit.result import Run
from warpfrag.fit.session import FitError, Session, check_finite

# Images are made from float32 values: a relative change below their spacing is none.
SMALLEST_STEP = 2.0**-23
# SciPy takes no tolerance below this.
EPSILON = 1e-15
_REASONS = {
    0: "the largest number of steps was reached",
    1: "the gradient vanished",
    2: "the loss stopped changing",
    3: "the parameters stopped changing",
    4: "loss and parameters stopped changing",
}


class LeastSquares:
    """Fits by least squares: evaluates images and Jacobians for SciPy, and keeps them by coordinates.

    Args:
        problem: what to fit; every parameter global.
        session: the course of the fit; what is in its state is gone through again without computing.
    """

    def __init__(self, problem: Problem, session: Session) -> None:
        self.optimize = need("scipy.optimize", "fit", "Least squares")
        loss = problem.study.image_loss.robust
        assert loss is not None
        self.problem, self.session, self.loss = problem, session, loss
        self.costs: dict[bytes, float] = {}
        self.jacobians: dict[bytes, np.ndarray] = {}
        self.kept: tuple[bytes, Evaluation] | None = None
        state = session.state
        if state:
            keys = [x.tobytes() for x in state["coordinates"]]
            self.costs = dict(zip(keys, state["costs"].tolist(), strict=True))
            self.jacobians = {
                keys[i]: j for i, j in zip(state["jacobian_of"].tolist(), state["jacobians"], strict=True)
            }

    def run(self, start: np.ndarray) -> Run:
        """Fit from a start."""
        study, begin = self.problem.study, len(self.session.losses)
        lower, upper = self.problem.bounds()
        found = self.optimize.least_squares(
            self._residuals,
            start,
            self._jacobian,
            bounds=(lower, upper),
            method="trf",
            x_scale="jac",
            ftol=study.asked.tolerance if study.asked.tolerance > EPSILON else None,
            xtol=max(study.asked.tolerance, SMALLEST_STEP),
            gtol=EPSILON,
            max_nfev=study.steps,
        )
        self.session.state = self._state()
        return describe_run(
            self.problem,
            start,
            found.x,
            loss=self.costs[found.x.tobytes()] * self.loss.factor,
            losses=self.session.losses[begin:],
            evaluations=found.nfev,
            converged=found.status > 0,
            reason=_REASONS[found.status],
        )

    def loss_at(self, coordinates: np.ndarray) -> float:
        """Return the loss at some coordinates."""
        return Evaluation(self.problem, self.loss, coordinates).cost * self.loss.factor

    def _state(self) -> dict[str, Any]:
        """Return everything as arrays."""
        keys = list(self.costs)
        count = len(np.frombuffer(keys[0])) if keys else 0
        order = {key: index for index, key in enumerate(keys)}
        jacobians = np.stack(list(self.jacobians.values())) if self.jacobians else np.zeros((0, count + 2, count))
        return {
            "coordinates": np.stack([np.frombuffer(key) for key in keys]),
            "costs": np.array(list(self.costs.values())),
            "jacobian_of": np.array([order[key] for key in self.jacobians], dtype=np.int64),
            "jacobians": jacobians,
        }

    def _evaluate(self, coordinates: np.ndarray) -> Evaluation:
        """Return the images at some coordinates, once if asked twice in a row."""
        key = coordinates.tobytes()
        if self.kept is None or self.kept[0] != key:
            # Freed before the next is made: each holds as many fragments as the views have.
            self.kept = None
            self.kept = key, Evaluation(self.problem, self.loss, coordinates)
        return self.kept[1]

    def _residuals(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the compressed residuals."""
        key = coordinates.tobytes()
        values = self.problem.values(coordinates)
        step = len(self.session.losses) + 1
        if key not in self.costs:
            cost = self._checked(step, values, lambda: self._evaluate(coordinates).cost)
            check_finite(step, cost, values)
            self.costs[key] = cost
            self.session.step(cost * self.loss.factor, values, self._state)
        else:
            self.session.losses.append(self.costs[key] * self.loss.factor)
        residuals = np.zeros(coordinates.size + 2)
        residuals[0] = np.sqrt(self.costs[key])
        return residuals

    def _jacobian(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the compressed Jacobian."""
        key = coordinates.tobytes()
        if key not in self.jacobians:
            step, values = len(self.session.losses), self.problem.values(coordinates)
            found = self._checked(step, values, lambda: self._evaluate(coordinates).compress())
            names = [each.name for each in self.problem.study.parameters for _ in range(each.start.size)]
            columns = dict(zip(names, np.abs(found.jacobian).max(axis=0), strict=True))
            check_finite(step, found.cost * self.loss.factor, values, columns)
            self.jacobians[key] = found.jacobian
        return self.jacobians[key]

    def _checked(self, step: int, values: dict[str, Any], evaluate: Any) -> Any:
        try:
            return evaluate()
        except ValueError as error:
            check_finite(step, float("nan"), values)
            raise FitError(f"step {step}: {error}") from error
