"""Fits from random starts under a budget of renders, which go on until one has arrived.

References are renders of the model that is fitted: at the true values the loss is 0, so that a fit knows by its loss
whether it has arrived, and starts anew where it has not. Cost is counted in renders (the images of all views): one for
an image, and `PASS` for each pass back through it, one for a gradient and three, one a colour, for a Jacobian.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from cases import Case

from warpfrag.fit import FitParameter, Reference, Study
from warpfrag.fit.descent import LBFGS, Adam
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.least_squares import LeastSquares
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.outcome import SMALLEST_NOISE, assess
from warpfrag.fit.problem import Problem, ViewProblem
from warpfrag.fit.session import Progress, Session

# What a pass back costs [renders]: measured, 2.1 for a gradient and 5.7 for a Jacobian's three at 40².
PASS = 2
# True betas, and thicknesses as shares of the scene's depth, the latter log-uniform; starts are drawn alike.
BETAS = (0.05, 0.95)
THICKNESSES = (0.02, 1.0)
# Bounds of the fits are wider by this factor.
ROOM = 4.0
# A fit has arrived when the root mean square of image minus reference is that of float32's rounding.
ARRIVED = SMALLEST_NOISE**2
# Recovered: every parameter that the image determines is as near as this, relative to the truth.
RECOVERED = 0.01


class Enough(Exception):
    """The fit has arrived, or its budget is spent."""


class FrozenView(ViewProblem):
    """A view whose torch image is made from fragments that were shaded once, as that of least squares is."""

    def image(self, values: Any) -> Any:
        """Return the image for parameter values; torch tensors get their gradient."""
        parameters = self.parameters(values)
        if isinstance(parameters["beta"], np.ndarray):
            fragments = self.unit.scaled(parameters, self.study.variables)
        else:
            import torch

            unit = self.unit.fragments.torch("cpu")
            by_object = torch.stack([parameters[f"{name}.thickness"] for name in self.unit.names])
            fragments = replace(unit, thickness=unit.thickness * by_object[torch.as_tensor(self.unit.objects).long()])
        return self.over_background(self.composite(fragments, parameters["beta"]))


@dataclass(frozen=True)
class Method:
    """A way of fitting.

    Attributes:
        name: what the tables call it.
        kind: of the study's method, or "cma".
        stages: options of the study, of fits that start where the one before has ended.
        passes: of a derivative.
    """

    name: str
    kind: str
    stages: tuple[dict[str, Any], ...]
    passes: int = 1


ROBUST = ({"loss": "l1", "steps": 40}, {"loss": "huber", "delta": 1e-5, "steps": 40})
METHODS = {
    "robust": Method("least squares, l1", "least_squares", ROBUST, 3),
    "squares": Method("least squares, l2", "least_squares", ({"loss": "l2", "steps": 80},), 3),
    "adam": Method("Adam", "adam", ({"loss": "l1", "steps": 10**6, "learning_rate": 0.05},)),
    "lbfgs": Method("L-BFGS", "lbfgs", ({"loss": "l1", "steps": 10**6},)),
    "cma": Method("CMA-ES", "cma", ({"loss": "l1"},)),
}


@dataclass
class Meter:
    """What a fit from all of its starts has cost, and the best it has found."""

    budget: float
    images: int = 0
    derivatives: int = 0
    spent: float = 0.0
    cost: float = np.inf
    coordinates: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def keep(self, cost: float, coordinates: np.ndarray) -> None:
        """Keep the better end: of the mean of rho."""
        if cost < self.cost:
            self.cost, self.coordinates = cost, coordinates


class Setting:
    """A case by one way of merging, captured once.

    Args:
        case: the case.
        merge: how its fragments merge.
        size: width and height of the images.
    """

    def __init__(self, case: Case, merge: str, size: int) -> None:
        self.case, self.scene = case, case.scene(size, merge)
        self.names = ["beta", *(f"{item.name}.thickness" for item in self.scene.objects)]
        self.thinnest, self.thickest = (share * case.depth for share in THICKNESSES)
        self.views = case.views(self.scene)
        blank = [np.zeros((size, size, 4), np.float32)] * len(self.views)
        study = self.study(dict.fromkeys(self.names, 0.5), blank)
        self.frozen = [FrozenView(study, view, index) for index, view in enumerate(study.all_views)]

    def draw(self, generator: np.random.Generator) -> dict[str, float]:
        """Draw parameter values."""
        low, high = np.log([self.thinnest, self.thickest])
        values = {name: float(np.exp(generator.uniform(low, high))) for name in self.names[1:]}
        return {"beta": float(generator.uniform(*BETAS)), **values}

    def images(self, values: dict[str, float]) -> list[np.ndarray]:
        """Return the images of all views."""
        arrays = {name: np.asarray(value) for name, value in values.items()}
        return [np.array(view.image(arrays)) for view in self.frozen]

    def study(self, start: dict[str, float], references: list[np.ndarray], **options: Any) -> Study:
        """Return the study of a fit from a start."""
        lower, upper = self.thinnest / ROOM, self.thickest * ROOM
        parameters = {
            name: FitParameter(value) if name == "beta" else FitParameter(value, lower, upper)
            for name, value in start.items()
        }
        views = [
            replace(view, reference=Reference(image)) for view, image in zip(self.views, references, strict=True)
        ]
        return Study(self.scene, None, parameters, views=views, **options)

    def problem(self, study: Study) -> Problem:
        """Return a study's problem, with what has been captured already."""
        problem = Problem(study)
        problem.views = [FrozenView(study, view.view, view.index) for view in problem.views]
        for view, frozen in zip(problem.views, self.frozen, strict=True):
            view.coverage, view.unit = frozen.coverage, frozen.unit
        return problem

    def standard_errors(self, true: dict[str, float]) -> dict[str, float]:
        """Return the relative standard errors of all parameters at the truth, for noise of float32's rounding."""
        problem = self.problem(self.study(true, self.images(true)))
        evaluation = Evaluation(problem, RobustLoss.named("l2", 1.0), problem.start())
        count = sum(view.reference.size for view in problem.views)
        found = assess(evaluation.compress(), problem.study.variables, count, evaluation.covered_count)
        # Those of thicknesses are relative already.
        return {
            name: float(error) / (true[name] if name == "beta" else 1.0)
            for name, error in zip(self.names, found.standard_errors, strict=True)
        }

    def recover(self, method: Method, true: dict[str, float], starts: Iterator[dict], budget: float) -> dict[str, Any]:
        """Fit from one start after the other until one has arrived or the budget is spent."""
        references, meter, ends = self.images(true), Meter(budget), []
        while meter.cost > ARRIVED and meter.spent < budget:
            own = Meter(budget - meter.spent)
            self._fit(method, own, self.study(next(starts), references, **_options(method, 0)))
            values = dict(zip(self.names, own.coordinates.tolist(), strict=True))
            found = {name: value if name == "beta" else float(np.exp(value)) for name, value in values.items()}
            errors = {name: abs(found[name] - true[name]) / true[name] for name in self.names}
            ends.append({"errors": errors, "cost": own.cost, "spent": own.spent, "images": own.images})
            meter.spent += own.spent
            meter.cost = min(meter.cost, own.cost)
        best = min(ends, key=lambda end: end["cost"])
        return {
            "errors": best["errors"],
            "arrived": meter.cost <= ARRIVED,
            "spent": meter.spent,
            "images": sum(end["images"] for end in ends),
            "starts": len(ends),
            "first": ends[0],
        }

    def _fit(self, method: Method, meter: Meter, study: Study) -> None:
        """Fit from one start, stage by stage."""
        fits: dict[str, Callable] = {"least_squares": _least_squares, "cma": _cma}
        problem = self.problem(study)
        for stage in range(len(method.stages)):
            if stage:
                problem.study = replace(study, **_options(method, stage))
                problem = self.problem(self._moved(problem.study, meter.coordinates))
            meter.cost = np.inf
            try:
                fits.get(method.kind, _descent)(problem, method, meter)
            except Enough:
                return

    def _moved(self, study: Study, coordinates: np.ndarray) -> Study:
        """Return a study that starts elsewhere."""
        starts = [v.outward(c) for v, c in zip(study.variables, coordinates, strict=True)]
        parameters = {
            name: replace(parameter, start=float(start))
            for (name, parameter), start in zip(study.parameters.items(), starts, strict=True)
        }
        return replace(study, parameters=parameters)


def _options(method: Method, stage: int) -> dict[str, Any]:
    return {**method.stages[stage], "method": "least_squares" if method.kind == "cma" else method.kind}


def _session(problem: Problem, report: Callable[[Progress], None]) -> Session:
    return Session(problem.study, "", None, report, 0.0)


def _least_squares(problem: Problem, method: Method, meter: Meter) -> None:
    before = meter.spent, meter.images

    def look(progress: Progress) -> None:
        images, jacobians = len(fit.costs), len(fit.jacobians)
        meter.images = before[1] + images
        meter.spent = before[0] + images + PASS * method.passes * jacobians
        key, cost = min(fit.costs.items(), key=lambda item: item[1])
        meter.keep(cost, np.frombuffer(key))
        if meter.spent >= meter.budget:
            raise Enough

    fit = LeastSquares(problem, _session(problem, look))
    fit.run(problem.start())


def _descent(problem: Problem, method: Method, meter: Meter) -> None:
    factor = RobustLoss.named(str(problem.study.loss), problem.study.delta).factor

    def look(progress: Progress) -> None:
        meter.images = fit.evaluations
        meter.spent = (1 + PASS) * fit.evaluations
        meter.keep(fit.best_loss / factor, fit.best)
        if meter.spent >= meter.budget:
            raise Enough

    fit = {"adam": Adam, "lbfgs": LBFGS}[method.kind](problem, _session(problem, look))
    fit.run(problem.start())


def _cma(problem: Problem, method: Method, meter: Meter) -> None:
    """Search in a box of unit size."""
    import cma

    loss = problem.study.image_loss.robust
    assert loss is not None
    lower, upper = problem.bounds()
    options = {"bounds": [0.0, 1.0], "verbose": -9, "seed": 1, "tolfun": 1e-8, "tolfunhist": 1e-8, "tolx": 1e-7}
    search = cma.CMAEvolutionStrategy((problem.start() - lower) / (upper - lower), 0.25, options)
    while not search.stop():
        shares = search.ask()
        costs = []
        for share in shares:
            coordinates = lower + np.clip(share, 0.0, 1.0) * (upper - lower)
            values = problem.values(coordinates)
            residuals = [view.residual(view.image(values)) for view in problem.views]
            costs.append(float(np.mean([loss.rho(residual.astype(np.float64)).mean() for residual in residuals])))
            meter.images += 1
            meter.spent += 1
            meter.keep(costs[-1], coordinates)
            if meter.spent >= meter.budget:
                raise Enough
        search.tell(shares, np.sqrt(costs))
