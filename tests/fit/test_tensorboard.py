"""The TensorBoard log: what is written for which parameter, and that a resumed fit goes on in it.

What needs the package `tensorboard` to read a log back is skipped without it.
"""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_scene import spheres

from warpfrag.fit import FitParameter, Reference, Study, fit
from warpfrag.fit import tensorboard as tensorboard_module
from warpfrag.fit.session import Progress
from warpfrag.fit.tensorboard import TensorBoard

MAP = np.linspace(0.2, 0.6, 48).reshape(6, 8)
PARAMETERS = {
    "beta": np.float64(0.5),
    "red.color": np.array([0.1, 0.2, 0.3]),
    "red.thickness": MAP,
    "blue.thickness": np.full((6, 8), 0.25),
    "blue.color": np.tile(MAP.reshape(-1, 1), 3),
    "blue.vertices": np.ones((30, 3)),
}


class Recorder:
    """A SummaryWriter that keeps what it is given."""

    made: list["Recorder"]

    def __init__(self, folder: str, purge_step: int) -> None:
        self.folder, self.purge_step, self.closed = folder, purge_step, 0
        self.scalars, self.histograms, self.images = {}, {}, {}
        self.made.append(self)

    def add_scalar(self, tag, value, step):
        """Keep a number."""
        assert type(value) is float
        self.scalars[tag, step] = value

    def add_histogram(self, tag, values, step):
        """Keep many numbers."""
        self.histograms[tag, step] = values

    def add_image(self, tag, image, step, dataformats):
        """Keep an image."""
        assert dataformats == "HW"
        self.images[tag, step] = image

    def close(self):
        """Count how often it is closed."""
        self.closed += 1


@pytest.fixture
def made(monkeypatch) -> list[Recorder]:
    """The writers that were made, all of them recorders."""
    monkeypatch.setattr(Recorder, "made", [], raising=False)
    monkeypatch.setattr(tensorboard_module, "need", lambda *_: SimpleNamespace(SummaryWriter=Recorder))
    return Recorder.made


def progress(step: int, message: str = "") -> Progress:
    """Return the report of a step."""
    return Progress(step, 10, 1.0 / step, PARAMETERS, message)


def test_numbers_and_arrays(tmp_path, made):
    """Few numbers are scalars, many a histogram and their mean."""
    with TensorBoard(tmp_path) as board:
        board(progress(2))
    (writer,) = made
    assert {tag: value for (tag, _), value in writer.scalars.items()} == {
        "loss": 0.5,
        "beta": 0.5,
        "red.color/0": 0.1,
        "red.color/1": 0.2,
        "red.color/2": 0.3,
        "red.thickness/mean": pytest.approx(0.4),
        "blue.thickness/mean": 0.25,
        "blue.color/mean": pytest.approx(0.4),
        "blue.vertices/mean": 1.0,
    }
    assert {step for _, step in writer.scalars} == {2}
    assert {tag for tag, _ in writer.histograms} == {"red.thickness", "blue.thickness", "blue.color", "blue.vertices"}
    np.testing.assert_array_equal(writer.histograms["red.thickness", 2], MAP.reshape(-1))


def test_maps_are_shown_now_and_then(tmp_path, made):
    """Maps, but not colours or vertices, are images from black to white: first, every few steps, and last."""
    with TensorBoard(tmp_path, image_steps=4) as board:
        for step in range(1, 11):
            board(progress(step))
    (writer,) = made
    assert {tag for tag, _ in writer.images} == {"red.thickness", "blue.thickness"}
    assert [step for tag, step in writer.images if tag == "red.thickness"] == [1, 4, 8, 10]
    shown = writer.images["red.thickness", 1]
    assert (shown.dtype, shown.shape, shown[0, 0], shown[-1, -1]) == (np.uint8, (6, 8), 0, 255)
    np.testing.assert_array_equal(shown.reshape(-1), np.rint(np.linspace(0.0, 255.0, 48)))
    assert not writer.images["blue.thickness", 1].any()


def test_last_image_is_not_shown_twice(tmp_path, made):
    """A log that ends at a step with images does not repeat them, nor when it is closed again."""
    board = TensorBoard(tmp_path, image_steps=2)
    board(progress(1))
    board(progress(2))
    made[0].images.clear()
    board.close()
    board.close()
    assert (made[0].images, made[0].closed) == ({}, 1)


def test_messages_are_not_steps(tmp_path, made):
    """A report with a message repeats a step, and is not logged."""
    with TensorBoard(tmp_path) as board:
        board(progress(3, "stopping after this step"))
        assert made == []
        board(progress(4))
    assert {step for _, step in made[0].scalars} == {4}


def test_log_goes_on_where_the_fit_does(tmp_path, made):
    """What an earlier log holds from the first step on is purged; without a step nothing is opened."""
    with TensorBoard(tmp_path / "log") as board:
        board(progress(7))
        board(progress(8))
    with TensorBoard(tmp_path / "log"):
        pass
    assert [(writer.folder, writer.purge_step, writer.closed) for writer in made] == [(str(tmp_path / "log"), 7, 1)]


def fail_within(board: TensorBoard) -> None:
    """Log a step, then fail."""
    with board:
        board(progress(1))
        raise RuntimeError("stopped")


def test_log_is_closed_when_a_fit_fails(tmp_path, made):
    """What was logged is written out though the block is left by an error."""
    with pytest.raises(RuntimeError, match="stopped"):
        fail_within(TensorBoard(tmp_path))
    assert made[0].closed == 1


@pytest.mark.parametrize(("module", "extra"), [("tensorboard", "tensorboard"), ("torch", "torch")])
def test_missing_package_is_named(tmp_path, monkeypatch, module, extra):
    """Before a fit begins, one line says what is missing and how to install it."""
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError) as caught:
        TensorBoard(tmp_path)
    expected = f"Logging to TensorBoard needs {module}, which is missing: pip install 'warpfrag[{extra}]'"
    assert str(caught.value) == expected


def test_mistakes_get_one_line(tmp_path, made):
    """A file in place of the folder, and steps below 1, are refused."""
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="file: got a file, expected a folder"):
        TensorBoard(tmp_path / "file")
    with pytest.raises(ValueError, match="image_steps: got 0"):
        TensorBoard(tmp_path, image_steps=0)


class Killed(BaseException):
    """What ends a fit as suddenly as a signal."""


def test_resumed_fit_has_every_step_once(tmp_path):
    """Read back, the log of a fit that was killed and resumed holds each step once, with its loss and parameters."""
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    scene = spheres(2)
    parameters = {"beta": 0.8, "green.thickness": FitParameter(0.2, 0.1, 0.35, per="pixel")}
    study = Study(scene, Reference(true={}), parameters, method="adam", steps=6, checkpoint_seconds=1e6)

    def killed_after(board: TensorBoard, step: int):
        def report(progress: Progress) -> None:
            board(progress)
            if progress.step == step:
                raise Killed

        return report

    # The checkpoint is that of step 2, the log reaches step 4.
    with TensorBoard(tmp_path / "log", image_steps=3) as board:
        fit(replace(study, steps=2), output=tmp_path / "fit", progress=board)
    with TensorBoard(tmp_path / "log", image_steps=3) as board, pytest.raises(Killed):
        fit(study, output=tmp_path / "fit", resume=True, progress=killed_after(board, 4))
    with TensorBoard(tmp_path / "log", image_steps=3) as board:
        result = fit(study, output=tmp_path / "fit", resume=True, progress=board)
    # Zero: keep all of them.
    log = events.EventAccumulator(str(tmp_path / "log"), dict.fromkeys(events.DEFAULT_SIZE_GUIDANCE, 0))
    log.Reload()
    logged = log.Scalars("loss")
    assert [event.step for event in logged] == [1, 2, 3, 4, 5, 6]
    # Stored as float32.
    np.testing.assert_allclose([event.value for event in logged], result.losses, rtol=1e-6)
    assert [event.step for event in log.Scalars("green.thickness/mean")] == [1, 2, 3, 4, 5, 6]
    assert [event.step for event in log.Histograms("green.thickness")] == [1, 2, 3, 4, 5, 6]
    assert [event.step for event in log.Images("green.thickness")] == [1, 2, 3, 6]
    assert (log.Images("green.thickness")[0].height, log.Images("green.thickness")[0].width) == scene.camera.shape
