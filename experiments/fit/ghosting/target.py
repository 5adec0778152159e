"""The target: a render in which the outer surface is made transparent inside a region drawn by hand."""

from dataclasses import dataclass, replace

import numpy as np

import warpfrag as wf
from warpfrag.samples import over_background
from warpfrag.scene.scene import Scene

# Points that the pen went through, as shares of the image's width and height, and the breadth of the soft edge.
DRAWN = (
    *((0.355, 0.470), (0.430, 0.425), (0.500, 0.435), (0.560, 0.415), (0.640, 0.440), (0.700, 0.500)),
    *((0.745, 0.585), (0.755, 0.670), (0.710, 0.745), (0.640, 0.775), (0.580, 0.830), (0.500, 0.845)),
    *((0.425, 0.800), (0.385, 0.725), (0.335, 0.650), (0.310, 0.550)),
)
EDGE = 0.05
# How much of the outer surface's opacity is taken away in the middle of the region.
MODULATION = 0.9
OUTER, INNER = 0, (1, 2)


@dataclass(frozen=True)
class Target:
    """The image to approach, and where what of it is seen.

    Attributes:
        image: linear colour over the background, (H, W, 3) float32.
        region: 0 outside the drawn region ... 1 inside, (H, W).
        areas: pixels to compare apart, by name, each (H, W) bool.
    """

    image: np.ndarray
    region: np.ndarray
    areas: dict[str, np.ndarray]


def make_target(scene: Scene) -> Target:
    """Render the scene without merging, the foremost fragment of the outer object as transparent as the region says."""
    shape = scene.camera.shape
    fragments = wf.capture(scene)
    region = soft_region(shape)
    covered = np.diff(fragments.offsets) > 0
    first = fragments.offsets[:-1][covered]
    outside = fragments.object_id[first] == OUTER
    rgba = fragments.rgba.copy()
    rgba[first[outside]] *= (1.0 - MODULATION * region.ravel()[covered][outside])[:, None].astype(np.float32)
    image = wf.composite(replace(fragments, rgba=rgba), 1.0, merge="none").reshape(*shape, 4)
    image = over_background(image, scene.background)[..., :3]
    inner = np.bincount(fragments.pixel, np.isin(fragments.object_id, INNER), covered.size).reshape(shape) > 0
    covered = covered.reshape(shape)
    return Target(
        image=image,
        region=region,
        areas={
            "inner parts": (region > 0.5) & inner,
            "back wall": (region > 0.5) & covered & ~inner,
            "outside": (region == 0.0) & covered,
            "all": covered,
        },
    )


def soft_region(shape: tuple[int, int]) -> np.ndarray:
    """Return the drawn region with a soft edge, 0 ... 1, (H, W)."""
    from matplotlib.path import Path

    outline = pen_line()
    row, column = np.mgrid[: shape[0], : shape[1]] + 0.5
    places = np.stack([column.ravel() / shape[1], row.ravel() / shape[0]], -1)
    distance = np.full(len(places), np.inf)
    for begin, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        along = end - begin
        share = np.clip((places - begin) @ along / (along @ along), 0.0, 1.0)
        distance = np.minimum(distance, np.linalg.norm(places - begin - share[:, None] * along, axis=1))
    signed = np.where(Path(outline).contains_points(places), distance, -distance)
    step = np.clip(signed / EDGE + 0.5, 0.0, 1.0)
    return (step * step * (3.0 - 2.0 * step)).reshape(shape)


def pen_line(samples: int = 12) -> np.ndarray:
    """Return the closed curve through the drawn points (Catmull and Rom), (n, 2) shares of width and height."""
    points = np.array(DRAWN)
    before, here, after, later = (np.roll(points, shift, axis=0)[:, None] for shift in (1, 0, -1, -2))
    s = np.linspace(0.0, 1.0, samples, endpoint=False)[:, None]
    curve = here + 0.5 * s * (
        after
        - before
        + s * (2.0 * before - 5.0 * here + 4.0 * after - later + s * (3.0 * (here - after) + later - before))
    )
    return curve.reshape(-1, 2)
