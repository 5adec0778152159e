"""`fit`: from a study to a result."""

import os
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.fit.bar import progress_bar
from warpfrag.fit.result import FitResult, plain_value
from warpfrag.fit.session import CHECKPOINT, FitError, Progress, Session, fingerprint
from warpfrag.fit.study import Study, load_study
from warpfrag.saving import remove_partial


def fit(
    study: Study | str | os.PathLike,
    *,
    resume: bool = False,
    output: str | os.PathLike | None = None,
    progress: Callable[[Progress], None] | bool | None = None,
) -> FitResult:
    """Fit the parameters of a scene to an image.

    With few values per object the default is bounded least squares with the exact Jacobian (see `fit.jacobian`); Adam
    and L-BFGS take any parameters. Coverage is held fixed in gradients: vertices move by what they do to depth and
    attributes inside of triangles.

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
        raise FitError(f"{path}: found no checkpoint to resume, expected one; start without resume")
    if output is not None:
        # What will be needed at the end is asked for at the beginning.
        need("matplotlib", "fit", "The report of a fit")
        output = Path(output)
        output.mkdir(parents=True, exist_ok=True)
        remove_partial(output)
    with progress_bar(study.name) if progress is True else nullcontext(progress or None) as report:
        result = _run(study, resume, output, report)
    if output is not None:
        result.save(output)
    return result


def _run(study: Study, resume: bool, output: Path | None, report: Callable[[Progress], None] | None) -> FitResult:
    from warpfrag.fit.descent import adam, lbfgs
    from warpfrag.fit.least_squares import least_squares
    from warpfrag.fit.outcome import assess
    from warpfrag.fit.problem import Problem

    started = time.monotonic()
    problem = Problem(study)
    session = Session(study, fingerprint(study, problem.reference), output, report, started)
    if resume:
        session.load()
    before = problem.image(problem.values(problem.start()))
    methods: dict[str, Any] = {"least_squares": least_squares, "adam": adam, "lbfgs": lbfgs}
    with session.interruptible():
        outcome = methods[str(study.method)](problem, session)
        session.save()
    found = problem.values(outcome.coordinates)
    after = problem.image(found)
    errors: dict[str, Any] | None = None
    condition: float | None = None
    undetermined: tuple[str, ...] = ()
    if outcome.compressed is not None and problem.frozen is not None:
        covered = np.count_nonzero(np.diff(problem.frozen.fragments.offsets)) * problem.channels
        certainty = assess(outcome.compressed, study.variables, problem.reference.size, covered)
        errors, condition, undetermined = {}, certainty.condition_number, certainty.undetermined
        first = 0
        for variable in study.variables:
            last = first + variable.start.size
            error = certainty.standard_errors[first:last].reshape(variable.start.shape)
            errors[variable.name] = plain_value(error * (found[variable.name] if variable.logarithm else 1.0))
            first = last
    true = study.true
    return FitResult(
        start={variable.name: plain_value(variable.start) for variable in study.variables},
        found={name: plain_value(value) for name, value in found.items()},
        true=None if true is None else {name: plain_value(value) for name, value in true.items()},
        standard_errors=errors,
        condition_number=condition,
        undetermined=undetermined,
        loss=outcome.loss,
        losses=tuple(session.losses),
        evaluations=outcome.evaluations,
        seconds=session.seconds,
        converged=outcome.converged,
        reason=outcome.reason,
        reference=problem.reference,
        before=np.asarray(before),
        after=np.asarray(after),
        setting=_setting(study),
    )


def _setting(study: Study) -> dict[str, Any]:
    scene = study.scene
    return {
        "study": study.name,
        "method": study.method,
        "loss_name": study.loss,
        "size": list(scene.camera.size),
        "resolve": study.resolve,
        "merge": scene.merge,
        "mix": scene.mix,
        "layers": scene.layers,
        "tolerance": study.tolerance,
        "seed": study.seed,
        "restarts": study.restarts,
        "device": study.device,
    }
