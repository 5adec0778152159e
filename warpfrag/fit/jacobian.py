"""The exact Jacobian of the whole image in four adjoint passes, however many parameters there are.

Pixels do not depend on one another: one adjoint pass seeded with ones in a channel yields, for every fragment, the
derivative of its own pixel in that channel. Summed by pixel and object they are the columns of the Jacobian.

Least squares needs of residuals f and Jacobian J only |f|², JᵀJ and Jᵀf. A QR decomposition of [f J] keeps these in as
many rows as there are columns, without squaring the condition number: an evaluation of any image fits in a few hundred
bytes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.fit.losses import RobustLoss
from warpfrag.fit.parameters import Variable
from warpfrag.fit.problem import FrozenGeometry, Problem


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
        self.problem, self.loss, self.frozen = problem, loss, problem.frozen
        self.values = problem.values(coordinates)
        keys = {variable.key for variable in problem.study.variables}
        self.tensors = problem.tensors(self.values)
        self.rgba, self.thickness = self.frozen.arrays(self.tensors)
        beta: Any = float(problem.scene.beta)
        if "beta" in keys:
            # One value per pixel, so that its gradient stays apart by pixel.
            beta = self.tensors["beta"].expand(problem.scene.camera.shape).contiguous()
        wanted = (
            ("beta" in keys, beta),
            ("thickness" in keys, self.thickness),
            (bool(keys & {"opacity", "color"}), self.rgba),
        )
        self.leaves = [leaf.detach().requires_grad_(True) if need else leaf for need, leaf in wanted]
        beta, self.thickness, self.rgba = self.leaves
        fragments = self.frozen.with_arrays(self.rgba, self.thickness)
        self.raw = problem.composite(fragments, beta)
        image = problem.over_background(self.raw.detach())
        self.residual = problem.residual(image).cpu().numpy().astype(np.float64).reshape(-1, problem.channels)
        self.cost = float(loss.rho(self.residual).mean())

    def compress(self) -> Compressed:
        """Return the compressed residuals and Jacobian."""
        covered, count = self.frozen.covered, self.residual.size
        columns = sum(variable.start.size for variable in self.problem.study.variables)
        triangle = np.zeros((columns + 1, columns + 1))
        for channel in range(self.problem.channels):
            jacobian = self._channel(channel)[covered]
            residual = self.residual[covered, channel]
            weight = np.sqrt(self.loss.weight(residual))
            rows = np.concatenate([residual[:, None], jacobian], axis=1) * weight[:, None]
            triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, rows]), mode="r"))
        return _compress(triangle / np.sqrt(count), self.cost)

    def _channel(self, channel: int) -> np.ndarray:
        """Return the derivatives of one channel of the image in all coordinates, (pixels, P)."""
        torch, background = self.problem.torch, self.problem.background
        variables = self.problem.study.variables
        pixels = self.residual.shape[0]
        # Opacity does not depend on beta, thickness or colour: no pass where it cannot change.
        fixed = channel == 3 and (background[3] == 1.0 or all(variable.key != "opacity" for variable in variables))
        if fixed:
            return np.zeros((pixels, sum(variable.start.size for variable in variables)))
        seed = torch.zeros_like(self.raw)
        seed[..., channel] = 1.0
        seed[..., 3] -= float(background[channel])
        needed = [leaf for leaf in self.leaves if isinstance(leaf, torch.Tensor) and leaf.requires_grad]
        grads = iter(torch.autograd.grad(self.raw, needed, seed, retain_graph=True))
        grad_beta, grad_thickness, grad_rgba = (  # type: ignore[var-annotated]
            next(grads).cpu().numpy() if isinstance(leaf, torch.Tensor) and leaf.requires_grad else None
            for leaf in self.leaves
        )
        columns = [
            grad_beta.astype(np.float64).reshape(-1, 1)
            if variable.key == "beta"
            else self._object(variable, grad_thickness, grad_rgba)
            for variable in variables
        ]
        return np.concatenate(columns, axis=1)

    def _object(self, variable: Variable, grad_thickness: Any, grad_rgba: Any) -> np.ndarray:
        """Sum what the fragments of an object contribute, by pixel: (pixels, 1), or (pixels, 3) for a colour."""
        owner, frozen = variable.owner, self.frozen
        members = frozen.members[owner]
        unit = _numpy(frozen.fragments.rgba)[members]
        value = self.values[variable.name]
        if variable.key == "thickness":
            # Coordinates are logarithms: dt/dlog = t.
            each = (grad_thickness[members] * _numpy(frozen.fragments.thickness)[members] * value)[:, None]
        elif variable.key == "opacity":
            color = np.asarray(self.values.get(f"{owner}.color", np.ones(3)))
            each = np.sum(grad_rgba[members] * unit * np.append(color, 1.0), axis=1, keepdims=True)
        else:
            each = grad_rgba[members, :3] * unit[:, :3] * float(self.values.get(f"{owner}.opacity", 1.0))
        return _sum_by_pixel(each, frozen, owner, self.residual.shape[0])


def _sum_by_pixel(each: np.ndarray, frozen: FrozenGeometry, owner: str, pixels: int) -> np.ndarray:
    columns = each.astype(np.float64).T
    return np.stack([np.bincount(frozen.member_pixels[owner], column, pixels) for column in columns], axis=1)


def _numpy(tensor: Any) -> np.ndarray:
    return tensor.detach().cpu().numpy()


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
