"""The exact Jacobian of the whole image in four adjoint passes, however many parameters there are.

Pixels do not depend on one another: one adjoint pass seeded with ones in a channel yields, for every fragment, the
derivative of its own pixel in that channel. Summed by pixel and object they are the columns of the Jacobian.

Least squares needs of residuals f and Jacobian J only |f|², JᵀJ and Jᵀf. A QR decomposition of [f J] keeps these in as
many rows as there are columns, without squaring the condition number: an evaluation of any image fits in a few hundred
bytes.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.parameters import Variable
from warpfrag.fit.problem import Problem
from warpfrag.fragments import Fragments


@dataclass(frozen=True, eq=False)
class Compressed:
    """Residuals and Jacobian in few rows, scaled by 1/sqrt(number of residuals).

    The residuals are (sqrt(mean rho), 0, 0, …); `jacobian` is such that JᵀJ and Jᵀf are those of the whole image,
    weighted as the loss says.

    Attributes:
        cost: mean of rho over all residuals.
        jacobian: (P + 2, P).
    """

    cost: float
    jacobian: np.ndarray


class Evaluation:
    """The image for one vector of coordinates, and its Jacobian when asked for."""

    def __init__(self, problem: Problem, loss: RobustLoss, coordinates: np.ndarray) -> None:
        assert problem.frozen is not None
        self.problem, self.loss, self.unit = problem, loss, problem.frozen
        self.values = problem.values(coordinates)
        self.variables = problem.study.variables
        keys = {variable.key for variable in self.variables}
        # A scene that is out of sight has no fragments to differentiate by.
        keys = keys if self.unit.fragments.count else set()
        single = {name: value.astype(np.float32) for name, value in self.values.items()}
        fragments = self.unit.scaled(single)
        device = problem.study.device
        # Beta as one value per pixel, so that its gradient stays apart by pixel.
        beta = np.full(problem.scene.camera.shape, single.get("beta", problem.scene.beta), np.float32)
        self.rgba = wp.array(fragments.rgba, device=device, requires_grad=bool(keys & {"opacity", "color"}))
        self.thickness = wp.array(fragments.thickness, device=device, requires_grad="thickness" in keys)
        self.beta = wp.array(beta, device=device, requires_grad="beta" in keys)
        shared = Fragments(
            self.rgba,
            wp.array(fragments.depth, device=device),
            self.thickness,
            wp.array(fragments.offsets, device=device),
            fragments.shape,
        )
        self.tape = wp.Tape()
        with self.tape:
            self.raw = problem.composite(shared, self.beta)
        image = problem.over_background(self.raw.numpy())
        self.residual = problem.residual(image).astype(np.float64).reshape(-1, problem.channels)
        self.cost = float(loss.rho(self.residual).mean())

    def compress(self) -> Compressed:
        """Return the compressed residuals and Jacobian."""
        # Pixels that no fragment covers do not depend on anything.
        counts = np.diff(self.unit.fragments.offsets)
        covered = np.flatnonzero(counts)
        pixels = np.repeat(np.arange(counts.size), counts)
        columns = sum(variable.start.size for variable in self.variables)
        triangle = np.zeros((columns + 1, columns + 1))
        for channel in range(self.problem.channels):
            jacobian = self.channel(channel, pixels)[covered]
            residual = self.residual[covered, channel]
            weight = np.sqrt(self.loss.weight(residual))
            rows = np.concatenate([residual[:, None], jacobian], axis=1) * weight[:, None]
            triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, rows]), mode="r"))
        return _compress(triangle / np.sqrt(self.residual.size), self.cost)

    def channel(self, channel: int, pixels: np.ndarray) -> np.ndarray:
        """Return the derivatives of one channel of the image in all coordinates, (P, coordinates).

        Args:
            channel: 0 to 3.
            pixels: the pixel of each fragment.
        """
        background = self.problem.background
        # Opacity does not depend on beta, thickness or colour: no pass where it cannot change.
        fixed = channel == 3 and (background[3] == 1.0 or all(v.key != "opacity" for v in self.variables))
        if fixed or not self.unit.fragments.count:
            return np.zeros((len(self.residual), sum(variable.start.size for variable in self.variables)))
        seed = np.zeros(self.raw.shape, np.float32)
        seed[..., channel] = 1.0
        seed[..., 3] -= background[channel]
        self.tape.zero()
        self.tape.backward(grads={self.raw: wp.array(seed, device=self.raw.device)})
        columns = [
            self.beta.grad.numpy().astype(np.float64).reshape(-1, 1)
            if variable.key == "beta"
            else self._object(variable, pixels)
            for variable in self.variables
        ]
        return np.concatenate(columns, axis=1)

    def _object(self, variable: Variable, pixels: np.ndarray) -> np.ndarray:
        """Sum what the fragments of an object contribute, by pixel: (P, 1), or (P, 3) for a colour."""
        owner, value = variable.owner, self.values[variable.name]
        members = np.flatnonzero(self.unit.masks[owner])
        if variable.key == "thickness":
            # Coordinates are logarithms: dt/dlog = t.
            unit = self.unit.fragments.thickness[members]
            each = (self.thickness.grad.numpy()[members] * unit * value)[:, None]
        else:
            unit, grad = self.unit.fragments.rgba[members], self.rgba.grad.numpy()[members]
            if variable.key == "opacity":
                color = self.values.get(f"{owner}.color", np.ones(3))
                each = np.sum(grad * unit * np.append(color, 1.0), axis=1, keepdims=True)
            else:
                each = grad[:, :3] * unit[:, :3] * float(self.values.get(f"{owner}.opacity", 1.0))
        sums = [np.bincount(pixels[members], column, len(self.residual)) for column in each.astype(np.float64).T]
        return np.stack(sums, axis=1)


def _compress(triangle: np.ndarray, cost: float) -> Compressed:
    """Turn the triangle of [f J] so that all of the residual is in the first row.

    The residual's share outside of the triangle (uncovered pixels, and what a robust rho has more than its weighted
    square) is orthogonal to all columns; a rotation of it with the first row moves its norm there and keeps JᵀJ and
    Jᵀf.
    """
    inside, cross = triangle[0, 0], triangle[0, 1:]
    if inside < 0.0:
        inside, cross = -inside, -cross
    total = max(np.sqrt(cost), inside)
    cosine = inside / total if total > 0.0 else 1.0
    sine = np.sqrt(max(0.0, 1.0 - cosine**2))
    return Compressed(cost, np.concatenate([cosine * cross[None], triangle[1:, 1:], sine * cross[None]]))
