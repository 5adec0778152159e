"""What the study compares: each method as a function to an image, and how far an image is from another."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

import warpfrag as wf
from warpfrag.colors import linear_to_srgb

# The paper's K and M.
SLOTS = 8
# A smooth transition, as the paper has it wherever it says so.
BETA = 1.0
LEVELS = 255.0


class Capture(NamedTuple):
    """The fragments of a scene, in both orders: by depth, and as they were submitted."""

    fragments: wf.Fragments
    stream: wf.Fragments


Method = Callable[[Capture], np.ndarray]


def reference(capture: Capture) -> np.ndarray:
    """Return the image of the A-buffer: all fragments, sorted, composited by over (DFB)."""
    return wf.composite(capture.fragments, merge="none")


def moments(count: int) -> Method:
    """Return moment-based transparency with a number of power moments (MBT)."""
    return lambda capture: wf.baselines.moment_based(capture.fragments, moments=count)


def kbuffer(merge: str, tail: str = "mix", slots: int = SLOTS) -> Method:
    """Return the bounded k-buffer, plain (SKB) or with order-independent merging (SKB+OFM)."""
    return lambda capture: wf.composite(wf.kbuffer(capture.stream, slots, merge=merge, tail=tail))


def merged(merge: str) -> Method:
    """Return sorted merging of all fragments into a few layers: DFB+SFM, or exact."""
    return lambda capture: wf.composite(capture.fragments, BETA, max_layers=SLOTS, merge=merge)


# Those of the paper's Fig. 10, and exact merging.
COMPARED: dict[str, Method] = {
    "MBT": moments(4),
    "SKB": kbuffer("none"),
    "SKB+OFM": kbuffer("order_independent"),
    "DFB+SFM": merged("smooth"),
    "exact": merged("exact"),
}
OTHERS: dict[str, Method] = {
    "MBT, 6 moments": moments(6),
    "MBT, 8 moments": moments(8),
    "SKB, tail discarded": kbuffer("none", "discard"),
    "SKB+OFM, tail discarded": kbuffer("order_independent", "discard"),
    "weighted blended": lambda capture: wf.baselines.weighted_blended(capture.fragments),
    "multi-layer alpha blending": lambda capture: wf.baselines.multi_layer_alpha_blending(capture.stream, nodes=SLOTS),
    "adaptive transparency": lambda capture: wf.baselines.adaptive_transparency(capture.stream, nodes=SLOTS),
    "hybrid transparency": lambda capture: wf.baselines.hybrid_transparency(capture.stream, core=SLOTS - 1),
    "stochastic transparency": lambda capture: wf.baselines.stochastic_transparency(capture.stream, samples=SLOTS),
}


def capture(scene: wf.Scene) -> Capture:
    """Capture a scene once, and sort a copy of its fragments."""
    stream = wf.capture(scene, sort=False)
    owner = stream.pixel
    # Stable: fragments of equal depth stay in order of submission.
    order = np.lexsort((stream.depth, owner))
    names = ("rgba", "depth", "thickness", "object_id", "primitive_id")
    sorted_arrays = {name: getattr(stream, name)[order] for name in names}
    return Capture(replace(stream, **sorted_arrays), stream)


def scaled_thickness(capture: Capture, factor: float) -> Capture:
    """Return the same fragments with another thickness."""
    return Capture(*(replace(part, thickness=part.thickness * np.float32(factor)) for part in capture))


def over_background(image: np.ndarray, scene: wf.Scene) -> np.ndarray:
    """Return an image over the scene's background in sRGB, 0 ... 255 without rounding, (H, W, 3) float32."""
    background = np.asarray(scene.background[:3], np.float32)
    linear = image[..., :3] + (1.0 - image[..., 3:]) * background
    return (LEVELS * linear_to_srgb(np.clip(linear, 0.0, 1.0))).astype(np.float32)


def difference(image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference of a pixel's three channels [levels of 255], (H, W)."""
    return np.abs(image - other).mean(axis=-1)


def errors(image: np.ndarray, other: np.ndarray, covered: np.ndarray) -> dict[str, float]:
    """Return how far two images differ where there are fragments [levels of 255]."""
    map = difference(image, other)[covered].astype(np.float64)
    squares = ((image - other)[covered].astype(np.float64) ** 2).mean()
    return {
        "mean": float(map.mean()),
        "rmse": float(np.sqrt(squares)),
        "p99": float(np.percentile(map, 99.0)),
        "max": float(map.max()),
    }


def layer_counts(fragments: wf.Fragments) -> dict[str, Any]:
    """Return the depth complexity of an image: most layers, mean where there are any, and at its centre."""
    counts = np.diff(fragments.offsets).reshape(fragments.shape)
    middle = tuple(slice(size // 2 - max(size // 64, 1), size // 2 + max(size // 64, 1)) for size in counts.shape)
    return {
        "max": int(counts.max()),
        "mean": float(counts[counts > 0].mean()),
        "centre": float(counts[middle].mean()),
        "fragments": fragments.count,
    }
