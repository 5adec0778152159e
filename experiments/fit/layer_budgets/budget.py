"""What M layers make of a scene: their image, and their images with a surface put among them, against all fragments.

An image alone does not show what layers are kept for: the methods that sort hand what is too much to the tail by over,
and lose nothing. A renderer that keeps layers goes on to put things among them (volumes, ambient occlusion, depth of
field). Here it is an opaque surface in the colour of the background, all of it at one distance from the eye. It hides
what is behind, and of a slab it cuts there remains the part in front, in proportion to its length (β = 1).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

import warpfrag as wf

METHODS = ("SFM", "exact", "SKB+OFM")
MEASURES = ("image", "inserted")
# What there is something to choose for. Without a surface inserted, methods that sort want no thickness at all.
OPEN = (*((method, "inserted") for method in METHODS), ("SKB+OFM", "image"))
# Numbers of layers.
BUDGETS = (2, 4, 8)
BETA = 1.0
# Distances that the surface is put at, evenly between the nearest and the farthest fragment of the scene.
DISTANCE_COUNT = 8
LEVELS = 255.0
# What a slab must be longer than a gap to bridge it, as a share of the depth: a few times the rounding of float32.
ROUNDING = 2.0**-21
# Method, measure and number of layers.
Key = tuple[str, str, int]


@dataclass(eq=False)
class Case:
    """A scene with its fragments, and what all of them look like.

    Attributes:
        name: of the scene.
        scene: what is captured, with thicknesses in multiples of P(z).
        fragments: sorted by depth, and as submitted; of thickness P(z).
        reference: images of all fragments by distance of the surface, the last without it, (P, D + 1, 3).
    """

    name: str
    scene: wf.Scene
    fragments: dict[bool, wf.Fragments] = field(init=False)
    reference: Any = field(init=False)

    def __post_init__(self) -> None:
        ones = {f"{item.name}.thickness": 1.0 for item in self.scene.objects}
        captured = {sort: wf.capture(self.scene, sort=sort, parameters=ones) for sort in (True, False)}
        self.fragments = {sort: fragments.torch() for sort, fragments in captured.items()}
        sheets = replace(self.fragments[True], thickness=torch.zeros_like(self.fragments[True].thickness))
        every = wf.resolve(sheets, max_layers=int(self.counts.max()), merge="none")
        self.reference = with_surface(every, self.distances, self.scene.background)

    @cached_property
    def counts(self) -> np.ndarray:
        """Number of fragments of each pixel, (P,)."""
        return np.diff(self.fragments[True].offsets.numpy())

    @cached_property
    def covered(self) -> np.ndarray:
        """Whether a pixel has fragments, (P,) bool; errors are those of the pixels that have."""
        return self.counts > 0

    @cached_property
    def owner(self) -> Any:
        """The pixel of each fragment, the same in both orders, (F,)."""
        return torch.as_tensor(self.fragments[True].pixel)

    @cached_property
    def extent(self) -> np.ndarray:
        """Depth from the first to the last fragment of each pixel [scene units], (P,)."""
        depth, offsets = self.fragments[True].depth.numpy(), self.fragments[True].offsets.numpy()
        extent = np.zeros(len(self.counts))
        extent[self.covered] = depth[offsets[1:][self.covered] - 1] - depth[offsets[:-1][self.covered]]
        return extent

    @cached_property
    def gaps(self) -> np.ndarray:
        """Gaps between successive fragments of each pixel, the largest first, then 0 [scene units], (P, G)."""
        first = self.fragments[True].offsets.numpy()[:-1]
        owner = self.owner.numpy()
        place = np.arange(len(owner)) - first[owner]
        depth = np.full((len(self.counts), int(self.counts.max())), np.nan)
        depth[owner, place] = self.fragments[True].depth.numpy()
        return -np.sort(-np.nan_to_num(np.diff(depth, axis=1)), axis=1)

    def gap(self, rank: int) -> np.ndarray:
        """Return the thickness that bridges a pixel's gap of this rank and all smaller ones [scene units], (P,)."""
        if rank > self.gaps.shape[1]:
            return np.full(len(self.counts), ROUNDING * self.span[1])
        # Slabs that only touch do not overlap.
        return self.gaps[:, rank - 1] + ROUNDING * self.span[1]

    @cached_property
    def span(self) -> tuple[float, float]:
        """Distances of the nearest and the farthest fragment [scene units]."""
        depth = self.fragments[True].depth
        return float(depth.min()), float(depth.max())

    @property
    def resolution(self) -> float:
        """Mean P(z) of the fragments [scene units]."""
        return float(self.fragments[True].thickness.mean())

    @property
    def distances(self) -> np.ndarray:
        """Distances of the surface [scene units], (D,)."""
        return np.linspace(*self.span, DISTANCE_COUNT + 2)[1:-1]

    def layers(self, method: str, layer_count: int, thickness: Any) -> wf.Layers:
        """Resolve the scene into layers.

        Args:
            method: one of `METHODS`.
            layer_count: largest number of layers.
            thickness: a map [scene units], (P,); or a number, in multiples of P(z).
        """
        fragments = self.fragments[method != "SKB+OFM"]
        if np.ndim(thickness) == 0:
            thickness = thickness * fragments.thickness
        else:
            thickness = torch.as_tensor(thickness)[self.owner].float()
        fragments = replace(fragments, thickness=thickness)
        if method == "SKB+OFM":
            return wf.kbuffer(fragments, layer_count)
        merge: Any = {"SFM": "smooth", "exact": "exact"}[method]
        return wf.resolve(fragments, BETA, max_layers=layer_count, merge=merge)

    def differences(self, method: str, layer_count: int, thickness: Any) -> Any:
        """Return how far the images of layers are from those of all fragments, see `layers`, (P, D + 1, 3)."""
        layers = self.layers(method, layer_count, thickness)
        return with_surface(layers, self.distances, self.scene.background) - self.reference

    def squares(self, method: str, layer_count: int, thickness: Any) -> dict[str, np.ndarray]:
        """Return the mean square of `differences` of each pixel by measure, (P,)."""
        squares = self.differences(method, layer_count, thickness).square().mean(dim=2).double().numpy()
        return {"image": squares[:, -1], "inserted": squares[:, :-1].mean(axis=1)}

    def scores(self, method: str, layer_count: int, thickness: Any) -> dict[str, dict[str, float]]:
        """Return by measure how far layers are from all fragments, see `score`."""
        differences = self.differences(method, layer_count, thickness)
        return {"image": self.score(differences[:, -1:]), "inserted": self.score(differences[:, :-1])}

    def score(self, differences: Any) -> dict[str, float]:
        """Return what differences of images amount to where there are fragments [levels of 255, linear light].

        Args:
            differences: of any number of images, (P, images, 3).

        Returns:
            "rms", and "mean" and "p99" of the absolute difference, the mean of the channels.
        """
        levels = LEVELS * differences[self.covered].double().numpy()
        apart = np.abs(levels).mean(axis=2)
        rms = float(np.sqrt(np.square(levels).mean()))
        return {"rms": rms, "mean": float(apart.mean()), "p99": float(np.percentile(apart, 99.0))}

    def rms(self, squares: np.ndarray) -> float:
        """Return the root of the mean of squares (P,) where there are fragments [levels of 255]."""
        return LEVELS * float(np.sqrt(squares[self.covered].mean()))


def with_surface(layers: wf.Layers, distances: np.ndarray, background: tuple[float, ...]) -> Any:
    """Composite layers with an opaque surface among them, in the colour of the background.

    Args:
        layers: torch tensors, in which the images are differentiable.
        distances: of the surface from the eye [scene units], (D,).
        background: RGBA, opaque.

    Returns:
        Linear colour by distance, and last without the surface, (P, D + 1, 3).
    """
    most = layers.max_layers
    rgba, depth, thickness = (
        layers.rgba.reshape(-1, most, 4),
        layers.depth.view(-1, most),
        layers.thickness.view(-1, most),
    )
    behind = torch.tensor(background[:3])
    length = thickness.clamp_min(1e-12)
    images = []
    for distance in [*distances, None]:
        part = rgba
        if distance is not None:
            inside = ((distance - depth + thickness) / length).clamp(0.0, 1.0)
            part = torch.where(depth <= distance, 1.0, torch.where(thickness > 0.0, inside, 0.0))[..., None] * rgba
        through = torch.cumprod(1.0 - part[..., 3], dim=1)
        before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
        images.append((before[..., None] * part[..., :3]).sum(dim=1) + through[:, -1:] * behind)
    return torch.stack(images, dim=1)


def psnr(rms: float) -> float:
    """Return the peak signal-to-noise ratio of a root mean square error in levels of 255 [dB]."""
    return float(20.0 * np.log10(LEVELS / max(rms, 1e-9)))
