"""A TensorBoard log of a fit: loss and parameters by step.

A number is a scalar under its parameter's name, a few numbers are scalars `<name>/0`, `<name>/1`, …; more are a
histogram under the name, with their mean as the scalar `<name>/mean`. A map is also shown as an image, now and then and
at the end, its least value black and its largest white.
"""

import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from warpfrag.errors import check_whole
from warpfrag.extras import need
from warpfrag.fit.session import Progress
from warpfrag.scene.parameters import kind_named


class TensorBoard:
    """Writes what a fit reports to a folder that `tensorboard --logdir` shows; to be used in a `with` block.

    A resumed fit goes on in the same folder: steps that it does again take the place of those that are there. So does
    a fit that starts anew.

    Args:
        folder: where event files go, made if need be.
        image_steps: a map is shown as an image after so many steps.
        most_scalars: an array of more numbers is a histogram.

    Raises:
        ImportError: torch or tensorboard is not installed.
        ValueError: the folder is a file, or a number is not from 1.

    Example:
        >>> with TensorBoard("runs/spheres") as board:
        ...     wf.fit("scenes/studies/three_spheres.toml", progress=board)
    """

    def __init__(self, folder: str | os.PathLike, *, image_steps: int = 50, most_scalars: int = 16) -> None:
        need("torch", "torch", "Logging to TensorBoard")
        # Named by itself: what torch raises without it does not say how to install it.
        need("tensorboard", "tensorboard", "Logging to TensorBoard")
        self._module = need("torch.utils.tensorboard", "tensorboard", "Logging to TensorBoard")
        self.folder = Path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{self.folder}: got a file, expected a folder for the TensorBoard log")
        for name, value in (("image_steps", image_steps), ("most_scalars", most_scalars)):
            check_whole(name, value, 1)
        self.image_steps, self.most_scalars = image_steps, most_scalars
        self._writer: Any = None
        self._last: Progress | None = None
        self._images_at = 0

    def __call__(self, progress: Progress) -> None:
        """Log a step."""
        # A message comes with the numbers of a step that was logged before.
        if progress.message:
            return
        if self._writer is None:
            # Only now it is known where a resumed fit goes on; what is logged from there on counts no more.
            self._writer = self._module.SummaryWriter(str(self.folder), purge_step=progress.step)
        self._last = progress
        step = progress.step
        self._writer.add_scalar("loss", progress.loss, step)
        for name, value in progress.parameters.items():
            array = np.asarray(value, dtype=np.float64)
            if array.ndim == 0:
                self._writer.add_scalar(name, float(array), step)
            elif array.size <= self.most_scalars:
                for index, number in enumerate(array.reshape(-1)):
                    self._writer.add_scalar(f"{name}/{index}", float(number), step)
            else:
                self._writer.add_histogram(name, array.reshape(-1), step)
                self._writer.add_scalar(f"{name}/mean", float(array.mean()), step)
        if step == 1 or step % self.image_steps == 0:
            self._show_maps(progress)

    def close(self) -> None:
        """Show the maps of the last step and write out all that waits to be written; may be called again."""
        if self._writer is None:
            return
        if self._last is not None and self._images_at != self._last.step:
            self._show_maps(self._last)
        self._writer.close()
        self._writer = None

    def __enter__(self) -> "TensorBoard":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _show_maps(self, progress: Progress) -> None:
        self._images_at = progress.step
        for name, value in progress.parameters.items():
            array = np.asarray(value, dtype=np.float64)
            # Colours and vertices have rows of three if they have two dimensions.
            if array.ndim != 2 or kind_named(name).value_shape or array.size <= self.most_scalars:
                continue
            low, high = float(array.min()), float(array.max())
            shown = (array - low) / (high - low) if high > low else np.zeros_like(array)
            self._writer.add_image(name, np.rint(255.0 * shown).astype(np.uint8), progress.step, dataformats="HW")
