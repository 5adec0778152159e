"""The exact Jacobian of the images in four adjoint passes, however many parameters there are.

Pixels do not depend on one another: one adjoint pass seeded with ones in a channel yields, for every fragment, the
derivative of its own pixel in that channel. Summed by pixel and object they are the columns of the Jacobian. Where
surfaces or the camera move, a fragment's derivatives first become the force and torque on its surface (see
`Coverage.motion_gradients`), and these the columns of a transform.

Least squares needs of residuals f and Jacobian J only |f|², JᵀJ and Jᵀf. A QR decomposition of [f J] keeps these in as
many rows as there are columns, without squaring the condition number: an evaluation of any number of images fits in a
few hundred bytes, and processes exchange no more.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.launch import Span, launch, share, thread_count
from warpfrag.capture.coverage import Coverage
from warpfrag.fit.losses import RobustLoss, pyramid
from warpfrag.fit.parameters import placed
from warpfrag.fit.problem import Problem, ViewProblem
from warpfrag.fit.scaled_fragments import UnitFragments, premultiplied
from warpfrag.fragments import Fragments
from warpfrag.scene.pose import CAMERA, pose_matrix

wp.set_module_options({"enable_backward": False})

# A QR decomposition of so many rows at a time stays in the cache: four to seven times as fast as all at once.
QR_ROWS = 512
# Columns of the table that says of each object where derivatives go.
_KINDS = ("thickness", "opacity", "color")


@dataclass(frozen=True, eq=False)
class Compressed:
    """Residuals and Jacobian in few rows, scaled by 1/sqrt(number of residuals).

    The residuals are (sqrt(mean rho), 0, 0, …); `jacobian` is such that JᵀJ and Jᵀf are those of the whole images,
    weighted as the loss says.

    Attributes:
        cost: mean of rho over all residuals.
        jacobian: (P + 2, P).
    """

    cost: float
    jacobian: np.ndarray


@cache
def _sum_kernel() -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def sum_columns(
        span: Span,
        offsets: wp.array[int],
        object_id: wp.array[int],
        columns: wp.array[wp.vec3i],
        straight: wp.array[wp.vec4f],
        unit_rgba: wp.array[wp.vec4f],
        thickness: wp.array[float],
        grad_rgba: wp.array[wp.vec4f],
        grad_thickness: wp.array[float],
        sums: wp.array2d[wp.float64],
    ):
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                item = object_id[fragment]
                column = columns[item]
                if column[0] >= 0:
                    # Coordinates are logarithms: dt/dlog t = t.
                    to_log = grad_thickness[fragment] * thickness[fragment]
                    sums[pixel, column[0]] = sums[pixel, column[0]] + wp.float64(to_log)
                if column[1] >= 0 or column[2] >= 0:
                    g = wp.cw_mul(grad_rgba[fragment], unit_rgba[fragment])
                    scale = straight[item]
                    # A fragment's colour is unit · colour · opacity, its opacity unit · opacity.
                    if column[1] >= 0:
                        to_opacity = g[0] * scale[0] + g[1] * scale[1] + g[2] * scale[2] + g[3]
                        sums[pixel, column[1]] = sums[pixel, column[1]] + wp.float64(to_opacity)
                    if column[2] >= 0:
                        for k in range(3):
                            to_color = wp.float64(g[k] * scale[3])
                            sums[pixel, column[2] + k] = sums[pixel, column[2] + k] + to_color

    return sum_columns


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
        self.variables = problem.study.variables
        self.values = problem.parameters(values)
        self.coverage, self.unit = self._unit()
        keys = {variable.key for variable in self.variables}
        # A scene that is out of sight has no fragments to differentiate by.
        keys = keys if self.unit.fragments.count else set()
        # Of each object: straight colour and opacity, and thickness.
        self.object_rgba, self.object_thickness = self.unit.scales(self.values)
        self.fragments = self.unit.scaled(self.object_rgba, self.object_thickness)
        device = problem.device
        # Beta as one value per pixel, so that its gradient stays apart by pixel.
        beta = np.full(problem.scene.camera.shape, self.values.get("beta", problem.scene.beta), np.float32)
        moves = problem.moves and bool(keys)

        def shared(array: np.ndarray, differentiable: bool) -> wp.array:
            return wp.array(array, device=device, copy=False, requires_grad=differentiable)

        self.rgba = shared(self.fragments.rgba, moves or bool(keys & {"opacity", "color"}))
        self.depth = shared(self.fragments.depth, moves)
        self.thickness = shared(self.fragments.thickness, moves or "thickness" in keys)
        self.beta = shared(beta, "beta" in keys)
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

    def _unit(self) -> tuple[Coverage, UnitFragments]:
        problem = self.problem
        if not problem.moves:
            return problem.coverage, problem.unit
        moved = {v.name: self.values[v.name] for v in self.variables if v.moves}
        coverage = Coverage.of(problem.scene, parameters=moved, sort=problem.study.resolve == "sorted")
        return coverage, UnitFragments(problem.scene, coverage, self.variables, moved)

    def channel(self, channel: int) -> np.ndarray:
        """Return the derivatives of one channel of the image in all coordinates, (pixels, coordinates)."""
        return self._rows(channel, self._memory())[:, 1:]

    def _memory(self) -> np.ndarray:
        """Return room for the rows of a channel."""
        return np.empty((self.residual[..., 0].size, 1 + sum(variable.start.size for variable in self.variables)))

    @cached_property
    def covered(self) -> np.ndarray:
        """Whether any object covers a pixel, (H, W)."""
        return (np.diff(self.fragments.offsets) > 0).reshape(self.fragments.shape)

    def _is_fixed(self, channel: int) -> bool:
        """Whether a channel cannot change.

        Opacity does not depend on beta, thickness, colour or depth; texture and opacity per vertex move with their
        surface.
        """
        opaque = self.problem.scene.background[3] == 1.0
        moves = self.problem.moves or any(variable.key == "opacity" for variable in self.variables)
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
        self._sum_objects(sums)
        for variable, place in placed(self.variables):
            if variable.key == "beta":
                sums[:, place.start] = self.beta.grad.numpy().reshape(-1)
        if self.problem.moves:
            self._sum_motions(sums)
        return rows

    @cached_property
    def _columns(self) -> np.ndarray:
        """The column of each object's thickness, opacity and colour, −1 for none, (objects, 3)."""
        columns = np.full((len(self.unit.names), 3), -1, np.int32)
        for variable, place in placed(self.variables):
            if variable.key in _KINDS:
                columns[self.unit.owned(variable.name), _KINDS.index(variable.key)] = place.start
        return columns

    def _sum_objects(self, sums: np.ndarray) -> None:
        """Add what thicknesses, opacities and colours contribute, by pixel."""
        unit, device = self.unit, self.raw.device
        if (self._columns < 0).all():
            return
        none = wp.empty((0,), dtype=wp.vec4f, device=device)
        nothing = wp.empty((0,), dtype=float, device=device)
        target = wp.array(sums, device=device, copy=False)
        inputs = [
            wp.array(self.fragments.offsets, dtype=int, device=device, copy=False),
            wp.array(unit.objects, dtype=int, device=device, copy=False),
            wp.array(self._columns, dtype=wp.vec3i, device=device),
            wp.array(self.object_rgba, dtype=wp.vec4f, device=device),
            wp.array(unit.fragments.rgba, dtype=wp.vec4f, device=device, copy=False),
            self.thickness,
            none if self.rgba.grad is None else self.rgba.grad.view(wp.vec4f),
            nothing if self.thickness.grad is None else self.thickness.grad,
            target,
        ]
        launch(_sum_kernel(), len(sums), inputs, device)
        if not device.is_cpu:
            sums[...] = target.numpy()

    @cached_property
    def _motions(self) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Of each transform its first column, its fragments, and what turns their motions into derivatives (6, 3)."""
        unit, found = self.unit, []
        for variable, place in placed(self.variables):
            if variable.moves:
                begin = place.start + (3 * self.problem.index if variable.per == "view" else 0)
                members = np.arange(unit.objects.size)
                if variable.owner != CAMERA:
                    members = np.flatnonzero(unit.objects == unit.names.index(variable.owner))
                matrix = pose_matrix(variable.name, self.problem.scene, parameters=unit.parameters) * variable.unit
                found.append((begin, members, matrix))
        return found

    def _sum_motions(self, sums: np.ndarray) -> None:
        """Add what transforms of objects and of the camera contribute, by pixel."""
        unit = self.unit
        motions = self.coverage.motion_gradients(
            unit.parameters,
            self.rgba.grad.numpy() * premultiplied(self.object_rgba)[unit.objects],
            self.depth.grad.numpy(),
            self.thickness.grad.numpy() * self.object_thickness[unit.objects],
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
        scales = problem.study.scales if scales is None else scales
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
                triangle = _triangle([triangle, _triangle([rows]) * np.sqrt(weight / len(self.problem.views))])
        parts = self.problem.processes.gather(triangle)
        return _compress(_triangle(parts) if len(parts) > 1 else triangle, self.cost)


def _triangle(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the triangle R of a QR decomposition of rows, square."""
    rows = np.concatenate(parts) if len(parts) > 1 else parts[0]
    columns = rows.shape[1]
    block = max(QR_ROWS, 2 * columns)
    whole = len(rows) // block * block
    if whole > block:
        blocks = np.array_split(rows[:whole].reshape(-1, block, columns), thread_count())
        triangles = share(partial(np.linalg.qr, mode="r"), blocks)
        rows = np.concatenate([*(triangle.reshape(-1, columns) for triangle in triangles), rows[whole:]])
    # With at least as many rows as columns it is square.
    padded = np.concatenate([rows, np.zeros((columns, columns))]) if len(rows) < columns else rows
    return np.asarray(np.linalg.qr(padded, mode="r"))


def _compress(triangle: np.ndarray, cost: float) -> Compressed:
    """Turn the triangle of [f J] so that all of the residual is in the first row.

    The residual's share outside of the triangle (uncovered pixels, and what a robust rho has more than its weighted
    square) is orthogonal to all columns; a rotation of it with the first row moves its norm there and keeps JᵀJ and
    Jᵀf.
    """
    inside, cross = triangle[0, 0], triangle[0, 1:]
    # The sign of a triangle's row is arbitrary: that of the cosine goes with it.
    total = max(np.sqrt(cost), abs(inside))
    cosine = inside / total if total > 0.0 else 1.0
    sine = np.sqrt(max(0.0, 1.0 - cosine**2))
    return Compressed(cost, np.concatenate([cosine * cross[None], triangle[1:, 1:], sine * cross[None]]))
