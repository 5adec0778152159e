"""`fit`: from a study to a result."""

import os
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.files.saving import remove_partial
from warpfrag.fit.certainty import assess
from warpfrag.fit.descent import LBFGS, Adam
from warpfrag.fit.jacobian import Evaluation
from warpfrag.fit.least_squares import LeastSquares
from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.parameters import value_wording, with_places
from warpfrag.fit.problem import Problem
from warpfrag.fit.processes import is_first_process
from warpfrag.fit.progress import progress_bar
from warpfrag.fit.result import FitResult, ViewResult, plain_value
from warpfrag.fit.saving import save_result
from warpfrag.fit.second_look import JUMPS, falling_steps, unseen_changes
from warpfrag.fit.session import CHECKPOINT, FitError, Progress, Session, fingerprint
from warpfrag.fit.study import PreparedStudy, Study
from warpfrag.fit.study_file import load_study
from warpfrag.scene.visibility import why_empty

METHODS: dict[str, Any] = {"least_squares": LeastSquares, "adam": Adam, "lbfgs": LBFGS}


def fit(
    study: Study | str | os.PathLike,
    *,
    resume: bool = False,
    output: str | os.PathLike | None = None,
    progress: Callable[[Progress], None] | bool | None = None,
) -> FitResult:
    """Fit the parameters of a scene to one image or several.

    With few values per object the default is bounded least squares with the exact Jacobian (see `fit.jacobian`); Adam
    and L-BFGS take any parameters. Coverage is held fixed in gradients: vertices, transforms and cameras move by what
    they do to depth and attributes inside of triangles; the images themselves are always those of the moved scene.

    At the end small steps are tried: a fit that they would carry on has not converged. Parameters with which the images
    change by what the gradient does not see, and jumps of smooth merging where they matter, are named (see
    `fit.second_look`).

    Started by `torchrun`, the processes share the views among themselves and come to the same result as one, to
    rounding; only the first of them writes files and shows progress.

    Args:
        study: a study, or the path of a study file.
        resume: go on from the checkpoint in `output`; ends at the same bits as an unbroken fit.
        output: folder for images, plots, result.json and the checkpoint, made if need be; None writes nothing.
        progress: True shows a bar on standard error; a function is called after each step.

    Returns:
        The parameters found, how well they are known, and the images.

    Raises:
        StudyError: the study cannot be run.
        FitError: the loss, a parameter or a gradient is not finite; or there is nothing to resume.
        KeyboardInterrupt: the user stopped it; the checkpoint is written.
        ImportError: SciPy, torch (for Adam and L-BFGS) or matplotlib is not installed.

    Example:
        >>> wf.fit("scenes/studies/three_spheres.toml").found["beta"]
        0.4999…
    """
    if isinstance(study, (str, os.PathLike)):
        study = load_study(study)
    if not isinstance(study, Study):
        raise TypeError(f"study: got {type(study).__name__}, expected a Study or the path of a study file")
    if resume and output is None:
        raise FitError("resume: got it without output, expected the folder with the checkpoint")
    if resume and not (Path(str(output)) / CHECKPOINT).is_file():
        path = Path(str(output)) / CHECKPOINT
        raise FitError(f"{path}: got no checkpoint to resume, expected one; start without resume")
    if output is not None:
        # What will be needed at the end is asked for at the beginning.
        need("matplotlib", "fit", "The report of a fit")
        output = Path(output)
        output.mkdir(parents=True, exist_ok=True)
        if is_first_process():
            remove_partial(output)
    first = is_first_process()
    with progress_bar(study.name) if progress is True and first else nullcontext(progress or None) as report:
        result = _run(study, resume, output, report if callable(report) and first else None)
    if output is not None and first:
        save_result(result, output)
    return result


def _run(study: Study, resume: bool, output: Path | None, report: Callable[[Progress], None] | None) -> FitResult:
    started = time.monotonic()
    problem = Problem(study)
    prepared = problem.study
    digest = fingerprint(study, [view.reference for view in problem.views])
    folder = output if is_first_process() else None
    session = Session(study, digest, folder, report, started, problem.processes)
    if resume:
        assert output is not None
        session.load(output)
    before = _images(problem, problem.values(problem.start()))
    notes: list[str] = []
    with session.interruptible():
        method = METHODS[prepared.method](problem, session)
        runs = [method.run(start) for start in _starts(problem, notes)]
        session.save()
    best = min(runs, key=lambda run: run.loss)
    notes += [
        f"{view.view.name}: {why_empty(view.scene)}"
        for view, image in zip([*problem.views, *problem.held_out], before, strict=True)
        if not view.sees_something(image)
    ]
    falling = falling_steps(problem, method, best.coordinates, best.loss) if best.converged else []
    if falling:
        reason = f"{best.reason}; yet a step of a thousandth of its range lowers the loss in {', '.join(falling)}"
        best = replace(best, converged=False, reason=reason)
    found = problem.values(best.coordinates)
    certainty = _certainty(problem, best.coordinates, found, notes)
    after = _images(problem, found)
    views = [
        ViewResult(view.view.name, view.view.held_out, view.reference, *images)
        for view, *images in zip([*problem.views, *problem.held_out], before, after, strict=True)
    ]
    true = prepared.true
    return FitResult(
        start={each.name: plain_value(each.start) for each in prepared.parameters},
        found=best.found,
        true=None if true is None else {name: plain_value(value) for name, value in true.items()},
        standard_errors=certainty.standard_errors,
        condition_number=certainty.condition_number,
        undetermined=certainty.undetermined,
        loss=best.loss,
        losses=best.losses,
        evaluations=sum(run.evaluations for run in runs),
        seconds=session.seconds,
        converged=best.converged,
        reason=best.reason,
        views=tuple(views),
        runs=tuple(runs),
        setting=_setting(prepared, problem.processes.count),
        unseen=certainty.unseen,
        notes=tuple(notes),
    )


def _images(problem: Problem, values: dict[str, Any]) -> list[np.ndarray]:
    return [np.asarray(view.image(values)) for view in (*problem.views, *problem.held_out)]


@dataclass(frozen=True)
class _Certainty:
    """How well parameters are known, by name; see `FitResult`."""

    standard_errors: dict[str, Any] | None = None
    condition_number: float | None = None
    undetermined: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()


def _certainty(problem: Problem, coordinates: np.ndarray, found: dict[str, Any], notes: list[str]) -> _Certainty:
    """Return how well parameters are known; nothing where some of them are not global."""
    study = problem.study
    if not study.is_global:
        return _Certainty()
    # Whatever the loss: how far images may differ by noise is a matter of squares, at the scale that has the noise.
    evaluation = Evaluation(problem, RobustLoss.named("l2", study.asked.delta), coordinates, scales=1)
    residual_count = sum(view.reference.size for view in problem.views)
    certainty = assess(evaluation.compress(), study.parameters, residual_count, *evaluation.covered_residuals())
    unseen = unseen_changes(problem, coordinates, evaluation, set(certainty.undetermined))
    if unseen.jumps > JUMPS:
        notes.append(
            f'merge "smooth" jumps where slabs begin to overlap: {100.0 * unseen.jumps:.0f} % of the images\' change '
            'with thickness is not in the gradient; merge = "exact" has no jumps'
        )
    errors = {}
    for each, place in with_places(study.parameters):
        error = certainty.standard_errors[place].reshape(each.start.shape)
        errors[each.name] = plain_value(error * (found[each.name] if each.is_logarithmic else each.unit))
    undetermined = tuple(name for name in certainty.undetermined if name not in unseen.components)
    return _Certainty(errors, certainty.condition_number, undetermined, unseen.components)


def _starts(problem: Problem, notes: list[str]) -> list[np.ndarray]:
    """Return where a method starts from, inside of bounds where it would not move away from them."""
    starts = problem.starts()
    if problem.study.method == "adam":
        return starts
    inside = problem.inside(starts[0])
    for each, place in with_places(problem.study.parameters):
        if (inside[place] != starts[0][place]).any():
            at = value_wording(each.to_value(inside[place].reshape(each.start.shape)))
            notes.append(f"{each.name}: the start lies on a bound, from which this method does not move; began at {at}")
    return [inside, *starts[1:]]


def _setting(study: PreparedStudy, processes: int) -> dict[str, Any]:
    asked, scene, loss = study.asked, study.scene, study.asked.loss
    wording = loss if isinstance(loss, str) else " + ".join(f"{weight:g} {name}" for name, weight in loss.items())
    return {
        "study": asked.name,
        "method": study.method,
        "loss_name": wording,
        "scales": asked.scales,
        "size": list(study.views[0].camera.size),
        "resolve": asked.resolve,
        "merge": scene.merge,
        "mix": scene.mix,
        "layers": scene.layers,
        "tolerance": asked.tolerance,
        "patience": study.patience,
        "batch": asked.batch,
        "seed": asked.seed,
        "restarts": asked.restarts,
        "device": asked.device,
        "processes": processes,
    }
