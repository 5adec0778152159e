"""The exact Jacobian of the images in four adjoint passes, however many parameters there are.

Pixels do not depend on one another: one adjoint pass seeded with ones in a channel yields, for every fragment, the
derivative of its own pixel in that channel. Summed by pixel and object they are the columns of the Jacobian
(`capture.object_gradients`). Where surfaces or the camera move, a fragment's derivatives first become the force and
torque on its surface (see `Coverage.motion_gradients`), and these the columns of a transform.
"""

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warpfrag.capture.coverage import Coverage
from warpfrag.capture.object_gradients import add_object_gradients
from warpfrag.fit.compression import Compressed, compress, triangle_of
from warpfrag.fit.losses import RobustLoss, pyramid
from warpfrag.fit.parameters import with_places
from warpfrag.fit.problem import Problem, ViewProblem
from warpfrag.fit.scaled_fragments import UnitFragments, premultiplied
from warpfrag.fragments import Fragments
from warpfrag.scene.parameters import BETA, COLOR, LOOK_COUNT, OPACITY, THICKNESS
from warpfrag.scene.pose import pose_matrix


class ViewEvaluation:
    """The image of a view for parameter values, and its Jacobian when asked for.

    Args:
        problem: the view.
        loss: the loss of each level.
        values: the parameters.
        scales: levels of the image pyramid.
    """

    def __init__(self, problem: ViewProblem, loss: RobustLoss, values: Mapping[str, Any], scales: int) -> None:
        self.problem, self.loss, self.scales = problem, loss, scales
        self.fitted = problem.study.parameters
        self.values = problem.parameters(values)
        self.coverage, self.unit = self._unit()
        # Of each object: straight colour, opacity and thickness.
        self.look = self.unit.scales(self.values)
        self.fragments = self.unit.scaled(self.look)
        device = problem.device
        # Beta as one value per pixel, so that its gradient stays apart by pixel.
        beta = np.full(problem.scene.camera.shape, self.values.get(BETA.key, problem.scene.beta), np.float32)
        # A scene that is out of sight has no fragments to differentiate by.
        moves = problem.has_motion and bool(self.unit.fragments.count)

        def shared(array: np.ndarray, differentiable: bool) -> wp.array:
            return wp.array(array, device=device, copy=False, requires_grad=differentiable)

        self.rgba = shared(self.fragments.rgba, moves or self._has_look(COLOR.look) or self._has_look(OPACITY.look))
        self.depth = shared(self.fragments.depth, moves)
        self.thickness = shared(self.fragments.thickness, moves or self._has_look(THICKNESS.look))
        self.beta = shared(beta, bool(self.unit.fragments.count) and any(each.kind is BETA for each in self.fitted))
        offsets = shared(self.fragments.offsets, False)
        self.tape = wp.Tape()
        with self.tape:
            fragments = Fragments(self.rgba, self.depth, self.thickness, offsets, self.fragments.shape)
            self.raw = problem.composite(fragments, self.beta)
        self.residual = problem.residual(problem.over_background(self.raw.numpy())).astype(np.float64)
        levels = [loss.rho(level).mean() for level in pyramid(self.residual, scales)]
        self.cost = float(np.mean(levels))

    def blocks(self) -> Iterator[tuple[float, np.ndarray]]:
        """Yield rows [f J] and the weight of their squares in the view's mean; without those whose J is 0."""
        height, width = self.fragments.shape
        covered = self.covered[..., None]
        # Halving needs numbers.
        shares = list(pyramid(covered.astype(np.float64) if self.scales > 1 else covered, self.scales))
        # Once for all channels: fresh memory for each would take as long as filling it.
        memory = self._memory()
        for channel in range(self.problem.channels):
            if self._is_fixed(channel):
                continue
            rows = self._rows(channel, memory).reshape(height, width, -1)
            for level, part in zip(pyramid(rows, self.scales), shares, strict=True):
                # Pixels that no fragment covers do not depend on anything.
                inside = level[part[..., 0] > 0.0]
                if not np.isinf(self.loss.delta):
                    inside *= np.sqrt(self.loss.weight(inside[:, :1]))
                yield 1.0 / (level.shape[0] * level.shape[1] * self.problem.channels * len(shares)), inside

    def channel(self, channel: int) -> np.ndarray:
        """Return the derivatives of one channel of the image in all coordinates, (pixels, coordinates)."""
        return self._rows(channel, self._memory())[:, 1:]

    @cached_property
    def covered(self) -> np.ndarray:
        """Whether any object covers a pixel, (H, W)."""
        return (np.diff(self.fragments.offsets) > 0).reshape(self.fragments.shape)

    def _unit(self) -> tuple[Coverage, UnitFragments]:
        problem = self.problem
        if not problem.has_motion:
            return problem.coverage, problem.unit
        moved = {each.name: self.values[each.name] for each in self.fitted if each.is_motion}
        coverage = Coverage.of(problem.scene, parameters=moved, sort=problem.resolve == "sorted")
        return coverage, UnitFragments(problem.scene, coverage, self.fitted, moved)

    def _has_look(self, look: slice | None) -> bool:
        """Tell whether a part of objects' look is fitted, in a scene that is in sight."""
        return bool(self.unit.fragments.count) and any(each.kind.look == look for each in self.fitted)

    def _memory(self) -> np.ndarray:
        """Return room for the rows of a channel."""
        return np.empty((self.residual[..., 0].size, 1 + sum(each.start.size for each in self.fitted)))

    def _is_fixed(self, channel: int) -> bool:
        """Tell whether a channel cannot change.

        Opacity does not depend on beta, thickness, colour or depth; texture and opacity per vertex move with their
        surface.
        """
        opaque = self.problem.scene.background[3] == 1.0
        moves = self.problem.has_motion or self._has_look(OPACITY.look)
        return not self.fragments.count or (channel == 3 and (opaque or not moves))

    def _rows(self, channel: int, rows: np.ndarray) -> np.ndarray:
        """Fill the rows [f J] of one channel, (pixels, 1 + coordinates) float64, and return them."""
        rows[...] = 0.0
        rows[:, 0] = self.residual[..., channel].reshape(-1)
        if self._is_fixed(channel):
            return rows
        seed = np.zeros(self.raw.shape, np.float32)
        seed[..., channel] = 1.0
        seed[..., 3] -= self.problem.scene.background[channel]
        self.tape.zero()
        self.tape.backward(grads={self.raw: wp.array(seed, device=self.raw.device)})
        sums = rows[:, 1:]
        grads = self.rgba.grad, self.thickness.grad
        add_object_gradients(sums, self.fragments, self.unit.fragments.rgba, self.look, self._columns, grads)
        for each, place in with_places(self.fitted):
            if each.kind is BETA:
                sums[:, place.start] = self.beta.grad.numpy().reshape(-1)
        if self.problem.has_motion:
            self._sum_motions(sums)
        return rows

    @cached_property
    def _columns(self) -> np.ndarray:
        """The columns of each object's colour, opacity and thickness, −1 for none, (objects, 5)."""
        columns = np.full((len(self.unit.names), LOOK_COUNT), -1, np.int32)
        for each, place in with_places(self.fitted):
            if each.kind.look is not None:
                columns[self.unit.owned(each), each.kind.look] = np.arange(place.start, place.stop)
        return columns

    @cached_property
    def _motions(self) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Of each transform its first column, its fragments, and what turns their motions into derivatives (6, 3)."""
        unit, found = self.unit, []
        for each, place in with_places(self.fitted):
            if each.is_motion:
                begin = place.start + (3 * self.problem.index if each.per == "view" else 0)
                members = np.arange(unit.objects.size)
                if each.kind.owner == "object":
                    members = np.flatnonzero(unit.objects == unit.names.index(each.owner))
                matrix = pose_matrix(each.name, self.problem.scene, parameters=unit.parameters) * each.unit
                found.append((begin, members, matrix))
        return found

    def _sum_motions(self, sums: np.ndarray) -> None:
        """Add what transforms of objects and of the camera contribute, by pixel."""
        unit = self.unit
        motions = self.coverage.motion_gradients(
            unit.parameters,
            self.rgba.grad.numpy() * premultiplied(self.look)[unit.objects],
            self.depth.grad.numpy(),
            self.thickness.grad.numpy() * self.look[unit.objects, THICKNESS.look][:, 0],
        )
        for begin, members, matrix in self._motions:
            for index, column in enumerate((motions[members] @ matrix).T):
                sums[:, begin + index] = np.bincount(self._pixels[members], column, len(sums))

    @cached_property
    def _pixels(self) -> np.ndarray:
        """The pixel of each fragment."""
        return self.fragments.pixel


class Evaluation:
    """The images of all views for one vector of coordinates, and their Jacobian when asked for.

    Args:
        problem: the views.
        loss: the loss of each level.
        coordinates: the vector.
        scales: levels of the image pyramid; None takes the study's.
    """

    def __init__(self, problem: Problem, loss: RobustLoss, coordinates: np.ndarray, scales: int | None = None) -> None:
        self.problem, self.size = problem, coordinates.size
        values = problem.values(coordinates)
        mine = problem.processes.share(list(range(len(problem.views))))
        scales = problem.study.image_loss.scales if scales is None else scales
        self.views = [ViewEvaluation(problem.views[index], loss, values, scales) for index in mine]
        total = problem.processes.sum(np.array([sum(view.cost for view in self.views)]))
        self.cost = float(total[0]) / len(problem.views)

    def covered_residuals(self) -> tuple[int, float]:
        """Return the number of residuals in pixels that any object covers, and the sum of their squares."""
        mine = np.zeros(2)
        for view in self.views:
            residual = view.residual[view.covered]
            mine += residual.size, np.square(residual).sum()
        count, squares = self.problem.processes.sum(mine)
        return int(count), float(squares)

    def compress(self) -> Compressed:
        """Return the compressed residuals and Jacobian."""
        triangle = np.zeros((self.size + 1, self.size + 1))
        for view in self.views:
            for weight, rows in view.blocks():
                triangle = triangle_of([triangle, triangle_of([rows]) * np.sqrt(weight / len(self.problem.views))])
        parts = self.problem.processes.gather(triangle)
        return compress(triangle_of(parts) if len(parts) > 1 else triangle, self.cost)
