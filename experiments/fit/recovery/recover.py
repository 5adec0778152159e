"""Fits from random starts under a budget of renders, which go on until one has arrived.

References are renders of the model that is fitted: at the true values nothing is left of the difference, so that a fit
knows whether it has arrived, and starts anew where it has not. Cost is counted in renders (the images of all views):
one for an image, and `PASS` for each pass back through it, one pass for a gradient, one a colour for a Jacobian.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from cases import Case

from warpfrag.fit import FitParameter, Reference, Study
from warpfrag.fit.certainty import SMALLEST_NOISE, assess
from warpfrag.fit.descent import LBFGS, Adam
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.least_squares import LeastSquares
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.problem import Problem, ViewProblem
from warpfrag.fit.session import Progress, Session

# What a pass back costs [renders]: measured at 40², 1 thread: 2.1 for a gradient, 5.7 for the three of a Jacobian.
PASS = 2
COLORS = 3
# True betas are uniform, thicknesses log-uniform between these shares of the scene's depth; starts are drawn alike.
BETAS = (0.05, 0.95)
THICKNESSES = (0.05, 1.0)
# Bounds of fitted thicknesses are wider by this factor.
ROOM = 4.0
# A fit has arrived when the root mean square of image minus reference is below float32's spacing.
ARRIVED = 2.0**-23
# Recovered: every identifiable parameter is as near as this, relative to the truth.
RECOVERED = 0.01
# More steps than any budget has.
UNLIMITED = 10**6


class BudgetError(Exception):
    """A fit has spent all renders that it may."""


@dataclass(frozen=True)
class Method:
    """A way of fitting.

    Attributes:
        name: what tables call it.
        kind: the method of a study, or "cma".
        stages: options of the study, of fits each of which starts where the one before has ended.
    """

    name: str
    kind: str
    stages: tuple[dict[str, Any], ...]


# Losses and learning rate: those of several that recovered most of a few draws.
METHODS = {
    # What is left of l1's rounding below 1e-3, where jumps count again, a smaller one takes out.
    "robust": Method(
        "least squares, l1",
        "least_squares",
        ({"loss": "l1", "steps": 40}, {"loss": "huber", "delta": 1e-5, "steps": 40}),
    ),
    "squares": Method("least squares, l2", "least_squares", ({"loss": "l2", "steps": 80},)),
    "adam": Method("Adam, l1", "adam", ({"loss": "l1", "learning_rate": 0.1, "steps": UNLIMITED},)),
    "lbfgs": Method("L-BFGS, l1", "lbfgs", ({"loss": "l1", "steps": UNLIMITED},)),
    "cma": Method("CMA-ES, l1", "cma", ({"loss": "l1"},)),
}


class FrozenView(ViewProblem):
    """A view whose torch image is made from fragments that were shaded once, as that of least squares is."""

    def image(self, values: Any) -> Any:
        """Return the image for parameter values; torch tensors get their gradient."""
        parameters = self.parameters(values)
        if isinstance(parameters["beta"], np.ndarray):
            fragments = self.unit.scaled(self.unit.scales(parameters))
        else:
            import torch

            unit = self.unit.fragments.torch("cpu")
            thickness = torch.stack([parameters[f"{name}.thickness"] for name in self.unit.names])
            fragments = replace(unit, thickness=unit.thickness * thickness[torch.as_tensor(self.unit.objects).long()])
        return self.over_background(self.composite(fragments, parameters["beta"]))


@dataclass
class Meter:
    """What a fit from one start may spend and has spent, and the best of its last stage."""

    budget: float
    images: int = 0
    passes: int = 0
    cost: float = np.inf
    coordinates: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def spent(self) -> float:
        """Renders spent."""
        return self.images + PASS * self.passes

    def record(self, images: int, passes: int, cost: float, coordinates: np.ndarray) -> None:
        """Take note of what has been spent since, and of an end, if none before in this stage was better.

        Raises:
            BudgetError: nothing is left.
        """
        self.images, self.passes = images, passes
        if cost < self.cost:
            self.cost, self.coordinates = cost, coordinates
        if self.spent >= self.budget:
            raise BudgetError


class Setting:
    """A case by one way of merging, captured once.

    Args:
        case: the case.
        merge: how its fragments merge.
        size: width and height of the images.
    """

    def __init__(self, case: Case, merge: str, size: int) -> None:
        self.scene = case.scene(size, merge)
        self.views = case.views(self.scene)
        self.names = ["beta", *(f"{item.name}.thickness" for item in self.scene.objects)]
        self.thinnest, self.thickest = (share * case.depth for share in THICKNESSES)
        self.residual_count = 4 * size * size * len(self.views)
        study = self.study(dict.fromkeys(self.names, 0.5), [np.zeros((size, size, 4), np.float32)] * len(self.views))
        prepared = study.prepared
        self.frozen = [FrozenView(prepared, view, index, study.device) for index, view in enumerate(prepared.views)]

    def draw(self, generator: np.random.Generator) -> dict[str, float]:
        """Draw parameter values."""
        low, high = np.log([self.thinnest, self.thickest])
        values = {name: float(np.exp(generator.uniform(low, high))) for name in self.names[1:]}
        return {"beta": float(generator.uniform(*BETAS)), **values}

    def images(self, values: dict[str, float]) -> list[np.ndarray]:
        """Return the images of all views."""
        arrays = {name: np.asarray(value) for name, value in values.items()}
        return [np.array(view.image(arrays)) for view in self.frozen]

    def root_mean_square(self, values: dict[str, float], references: list[np.ndarray]) -> float:
        """Return how far the images are from the references."""
        apart = [image.astype(np.float64) - other for image, other in zip(self.images(values), references, strict=True)]
        return float(np.sqrt(np.mean(np.square(apart))))

    def study(self, start: dict[str, float], references: list[np.ndarray], **options: Any) -> Study:
        """Return the study of a fit from a start."""
        lower, upper = self.thinnest / ROOM, self.thickest * ROOM
        parameters = {
            name: FitParameter(value) if name == "beta" else FitParameter(value, lower, upper)
            for name, value in start.items()
        }
        pairs = zip(self.views, references, strict=True)
        views = [replace(view, reference=Reference(image)) for view, image in pairs]
        return Study(self.scene, None, parameters, views=views, **options)

    def problem(self, study: Study) -> Problem:
        """Return a study's problem, with what has been captured already."""
        problem = Problem(study)
        problem.views = [FrozenView(problem.study, view.view, view.index, view.device) for view in problem.views]
        for view, frozen in zip(problem.views, self.frozen, strict=True):
            view.coverage, view.unit = frozen.coverage, frozen.unit
        return problem

    def standard_errors(self, values: dict[str, float]) -> dict[str, float]:
        """Return the standard errors of all parameters, relative to their values, for noise of 1 in the image."""
        problem = self.problem(self.study(values, self.images(values)))
        evaluation = Evaluation(problem, RobustLoss.named("l2", 1.0), problem.start())
        certainty = assess(
            evaluation.compress(), problem.study.parameters, self.residual_count, *evaluation.covered_residuals()
        )
        # The image is its own reference: all noise is what `assess` assumes. Those of thicknesses are relative already.
        return {
            name: float(error) / SMALLEST_NOISE / (values[name] if name == "beta" else 1.0)
            for name, error in zip(self.names, certainty.standard_errors, strict=True)
        }

    def reach(self, values: dict[str, float]) -> dict[str, float]:
        """Return how far off each parameter can be, relative to its value, in images that pass for the same.

        To first order, the farthest point where images differ by a root mean square of `ARRIVED`; inf where the image
        is flat.
        """
        scale = ARRIVED * np.sqrt(self.residual_count)
        return {name: float(scale * error) for name, error in self.standard_errors(values).items()}

    def recover(self, method: Method, true: dict[str, float], starts: Iterator[dict], budget: float) -> dict[str, Any]:
        """Fit from one start after the other until one has arrived or the budget is spent.

        Every second start is the best end so far but for one parameter, in turn: what stays behind is often one
        thickness that few pixels show.

        Args:
            method: how.
            true: the values to find.
            starts: random ones.
            budget: of all starts [renders].

        Returns:
            For JSON: parameters of the best end, their relative errors and the root mean square there; whether it has
            arrived; renders spent, images and starts; and the end from the first start alone.
        """
        references, ends = self.images(true), []
        spent, best = 0.0, {"root_mean_square": np.inf}
        while best["root_mean_square"] > ARRIVED and spent < budget:
            start = next(starts)
            if len(ends) % 2:
                name = self.names[len(ends) // 2 % len(self.names)]
                start = {**best["found"], name: start[name]}
            meter = Meter(budget - spent)
            found = self._fit(method, meter, start, references)
            end = {
                "found": found,
                "errors": {name: abs(found[name] - true[name]) / true[name] for name in self.names},
                "root_mean_square": self.root_mean_square(found, references),
                "spent": meter.spent,
                "images": meter.images,
            }
            spent += meter.spent
            ends.append(end)
            best = min(best, end, key=lambda each: each["root_mean_square"])
        return {
            **best,
            "arrived": best["root_mean_square"] <= ARRIVED,
            "spent": spent,
            "images": sum(end["images"] for end in ends),
            "starts": len(ends),
            "first": ends[0],
        }

    def _fit(
        self, method: Method, meter: Meter, start: dict[str, float], references: list[np.ndarray]
    ) -> dict[str, float]:
        """Fit from one start, stage by stage."""
        kind = "least_squares" if method.kind == "cma" else method.kind
        for stage in method.stages:
            meter.cost = np.inf
            problem = self.problem(self.study(start, references, method=kind, **stage))
            try:
                _FITS[method.kind](problem, meter)
            except BudgetError:
                break
            finally:
                start = {name: float(value) for name, value in problem.values(meter.coordinates).items()}
        return start


def _least_squares(problem: Problem, meter: Meter) -> None:
    images, passes = meter.images, meter.passes

    def look(_: Progress) -> None:
        key, cost = min(fit.costs.items(), key=lambda item: item[1])
        meter.record(images + len(fit.costs), passes + COLORS * len(fit.jacobians), cost, np.frombuffer(key))

    fit = LeastSquares(problem, Session(problem.study.asked, "", None, look, 0.0))
    try:
        fit.run(problem.start())
    finally:
        # A Jacobian may follow the last image.
        meter.images, meter.passes = images + len(fit.costs), passes + COLORS * len(fit.jacobians)


def _descend(problem: Problem, meter: Meter) -> None:
    images, passes = meter.images, meter.passes

    def look(_: Progress) -> None:
        course = fit.course
        meter.record(images + course.evaluations, passes + course.evaluations, course.best_loss, course.best)

    method = {"adam": Adam, "lbfgs": LBFGS}[str(problem.study.method)]
    fit = method(problem, Session(problem.study.asked, "", None, look, 0.0))
    fit.run(problem.start())


def _search(problem: Problem, meter: Meter) -> None:
    """Search by CMA-ES in the box of the bounds, scaled to unit size."""
    import cma

    loss = problem.study.image_loss.robust
    assert loss is not None
    lower, upper = problem.bounds()
    options = {"bounds": [0.0, 1.0], "seed": 1, "verbose": -9, "tolfun": 1e-8, "tolfunhist": 1e-8, "tolx": 1e-7}
    search = cma.CMAEvolutionStrategy((problem.start() - lower) / (upper - lower), 0.25, options)
    while not search.stop():
        shares, costs = search.ask(), []
        for share in shares:
            coordinates = lower + np.clip(share, 0.0, 1.0) * (upper - lower)
            values = problem.values(coordinates)
            residuals = np.array([view.residual(view.image(values)) for view in problem.views], np.float64)
            costs.append(float(loss.rho(residuals).mean()))
            meter.record(meter.images + 1, meter.passes, costs[-1], coordinates)
        # It goes by the order of the costs alone; the root is for its tolerances.
        search.tell(shares, np.sqrt(costs))


_FITS = {"least_squares": _least_squares, "adam": _descend, "lbfgs": _descend, "cma": _search}
