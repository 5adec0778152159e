"""The course of a fit: its history, checkpoints, progress reports, and what Ctrl-C does.

A checkpoint is written every few seconds and at every end, under another name first, so that one is always whole. It
holds the method's state and a fingerprint of the study: a resumed fit goes through the same numbers as an unbroken one.

The first Ctrl-C lets the running step come to its end, writes a checkpoint and stops; the second stops at once, which
loses what happened since the last checkpoint.
"""

import contextlib
import hashlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from warpfrag.files.saving import replacing
from warpfrag.fit.parameters import values_wording
from warpfrag.fit.processes import Processes
from warpfrag.fit.study import PreparedStudy, Study

CHECKPOINT = "checkpoint.dat"
# Of the file's layout; another one is not read.
_VERSION = 3


class FitError(ValueError):
    """A fit that cannot go on, in one line."""


@dataclass(frozen=True)
class Progress:
    """What a fit reports after each step.

    Attributes:
        step: steps done: evaluations of least squares, iterations of the other methods; of all starts together.
        steps: most steps.
        loss: the loss of this step; with a batch of views theirs alone.
        parameters: the values of this step, by name.
        message: something to tell the user, such as what Ctrl-C has begun; empty for a step that is done.
    """

    step: int
    steps: int
    loss: float
    parameters: Mapping[str, Any]
    message: str = ""


class Session:
    """The course of one fit.

    Args:
        study: the study.
        fingerprint: of the study, see `fingerprint`.
        folder: where this process writes the checkpoint; None writes none.
        report: called after each step, None for nothing.
        started: when the fit began, by the monotonic clock.
        processes: those that fit together; None for this one alone.
    """

    def __init__(
        self,
        study: Study,
        fingerprint: str,
        folder: Path | None,
        report: Callable[[Progress], None] | None,
        started: float,
        processes: Processes | None = None,
    ) -> None:
        self.study, self.fingerprint, self.folder = study.prepared, fingerprint, folder
        self.report, self.processes = report, processes
        self.losses: list[float] = []
        self.state: dict[str, Any] = {}
        self.seconds_before = 0.0
        self.started, self.written = started, time.monotonic()
        self.interrupted = False
        self.last: Progress | None = None

    @property
    def seconds(self) -> float:
        """Time spent on the fit, that before a resume included."""
        return self.seconds_before + time.monotonic() - self.started

    def load(self, folder: Path) -> None:
        """Take up the checkpoint in a folder.

        Raises:
            FitError: it cannot be read, or it belongs to another study.
        """
        path = folder / CHECKPOINT
        expected = "the one of this study (scene, reference, parameters, method); start without resume"
        try:
            saved = _read(path, self.study)
            known = (int(saved.pop("version")), str(saved.pop("fingerprint"))) == (_VERSION, self.fingerprint)
            seconds = float(saved.pop("seconds"))
        except Exception as error:
            raise FitError(f"{path}: got a checkpoint that cannot be read, expected {expected}") from error
        if not known:
            raise FitError(f"{path}: got the checkpoint of another study, expected {expected}")
        self.state, self.seconds_before = saved, seconds

    def save(self) -> None:
        """Write the checkpoint."""
        if self.folder is None:
            return
        content = {**self.state, "version": _VERSION, "fingerprint": self.fingerprint, "seconds": self.seconds}
        with replacing(self.folder / CHECKPOINT) as partial, partial.open("wb") as file:
            if self.study.method == "least_squares":
                np.savez(file, **content)
            else:
                import torch

                torch.save(content, file)
        self.written = time.monotonic()

    def step(self, loss: float, values: Mapping[str, Any], state: Callable[[], dict[str, Any]]) -> None:
        """Take note of a step that is done: history, checkpoint when due, report.

        Args:
            loss: the loss of the step.
            values: the parameters of the step.
            state: returns all that the method needs to go on from here.

        Raises:
            KeyboardInterrupt: the user asked to stop; the checkpoint is written.
        """
        self.losses.append(loss)
        if self.processes is not None:
            # A wish to stop in one of them is one in all.
            self.interrupted = bool(self.processes.sum(np.array([float(self.interrupted)]))[0])
        due = time.monotonic() - self.written >= self.study.asked.checkpoint_seconds
        if self.folder is not None and (due or self.interrupted):
            self.state = state()
            self.save()
        steps = self.study.steps * (1 + self.study.asked.restarts)
        self.last = Progress(len(self.losses), steps, loss, dict(values))
        if self.report is not None:
            self.report(self.last)
        if self.interrupted:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Within the block, the first Ctrl-C waits for the end of the step."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = signal.getsignal(signal.SIGINT)

        def stop(number: int, frame: FrameType | None) -> None:
            # Nothing is lost before the first step is done; and whoever presses twice means now.
            if self.interrupted or not self.losses:
                raise KeyboardInterrupt
            self.interrupted = True
            if self.report is not None and self.last is not None:
                self.report(replace(self.last, message="stopping after this step (Ctrl-C again: at once)"))

        signal.signal(signal.SIGINT, stop)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


def _read(path: Path, study: PreparedStudy) -> dict[str, Any]:
    # Neither of the two runs code that a file may hold.
    if study.method == "least_squares":
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    import torch

    return torch.load(path, weights_only=True, map_location=study.asked.device)


def check_finite(step: int, loss: float, values: Mapping[str, Any], gradients: Mapping[str, Any] | None = None) -> None:
    """Raise if the loss, a parameter or a gradient is not finite.

    Raises:
        FitError: with the step and the parameter.
    """
    for kind, group in (("", values), ("the gradient in ", gradients or {})):
        for name, value in group.items():
            if not np.isfinite(np.asarray(value, dtype=np.float64)).all():
                raise FitError(f"step {step}: {kind}{name} is not finite (loss {loss:g})")
    if not np.isfinite(loss):
        raise FitError(f"step {step}: the loss is {loss:g} at {values_wording(values)}")


def fingerprint(study: Study, references: Sequence[np.ndarray]) -> str:
    """Return a digest of all that decides the numbers of a fit, but for how long it goes on.

    Args:
        study: the study.
        references: the images of the views that are fitted.
    """
    digest = hashlib.sha256()

    def add(*things: Any) -> None:
        for thing in things:
            array = isinstance(thing, np.ndarray)
            digest.update(str((thing.dtype, thing.shape)).encode() if array else repr(thing).encode())
            if array:
                digest.update(np.ascontiguousarray(thing).tobytes())

    prepared = study.prepared
    scene = prepared.scene
    add(scene.background, scene.beta, scene.layers, scene.merge, scene.mix, scene.light, study.resolve)
    add(*(view.camera for view in prepared.fitted_views), *references)
    for item in scene.objects:
        add(item.name, item.thickness_unit, item.faces, item.matrix)
        own = (item.vertices, item.color, item.opacity, item.thickness, item.uv, item.texture_index, item.shade)
        for value in (*own, item.normals):
            add(None if value is None else np.asarray(value))
        add(*item.textures)
    for each in prepared.parameters:
        add(each.name, each.start, each.lower, each.upper, each.unit, each.learning_rate)
        add(each.per, each.smoothness, each.levels)
    add(prepared.image_loss, prepared.method, study.seed, study.restarts, study.learning_rate, study.tolerance)
    add(study.device, prepared.patience, study.batch)
    if study.batch is not None or any(each.levels > 1 for each in prepared.parameters):
        # How many steps there are then decides when the stages change, and when all views are looked at.
        add(prepared.steps)
    return digest.hexdigest()
