"""What is asked of a method of capture: its options, and by what the depths of fragments are compared.

Depths are compared as they are, or rounded first, as the fixed-point depth buffers of the papers do: the *key* of a
fragment is then its window depth in steps of such a buffer. Fragments are at the same depth if their keys are equal.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp

from warpfrag.raster.ray import Rays, centre_x, centre_y, stretch

wp.set_module_options({"enable_backward": False})

Cull = Literal["occupancy"]

# Most bits of a depth buffer: single precision holds no more whole numbers.
MOST_DEPTH_BITS = 24


@dataclass(frozen=True)
class Options:
    """Options of the methods, each of which takes some of them.

    Attributes:
        slots: entries of a pixel's array, K.
        pool: fragments that all lists of the image have room for at first; None for two a pixel.
        grow: whether a pool that overflows is doubled and the pass repeated; else what finds no room is lost.
        page: fragments of a page of a paged list.
        buckets: depth ranges of a pixel, B.
        packed: whether attributes are packed: more slots (4 K where fragments of one depth are peeled, else 2 K).
        hazard: fragments of a pixel that read the same state before they write; 1 for no hazard.
        depth_bits: bits of the depth buffer; None compares depths as they are.
        max_passes: most passes over the geometry; None until nothing is left.
        cull_objects: whether objects that are peeled completely are left out of later passes.
        cull: "occupancy" leaves out what an occupancy map knows to lie behind the K nearest.
        words: words of 32 bits of a pixel's occupancy map, d.
    """

    slots: int = 8
    pool: int | None = None
    grow: bool = True
    page: int = 4
    buckets: int = 8
    packed: bool = False
    hazard: int = 1
    depth_bits: int | None = None
    max_passes: int | None = None
    cull_objects: bool = False
    cull: Cull | None = None
    words: int = 8


@wp.struct
class Keys:
    """By what depths are compared: in steps of a depth buffer of `levels` + 1 of them, or as they are, with 0."""

    rays: Rays
    levels: wp.float64


@dataclass(frozen=True, eq=False)
class Request:
    """What is asked of a method.

    Attributes:
        options: its options, checked.
        rays: the pixels.
        hide: told after each layer up to which depth every pixel is peeled, (P,); leaves out of later passes what lies
            in front of that. None where nothing is left out.
    """

    options: Options
    rays: Rays
    hide: Callable[[np.ndarray], None] | None = None

    def keys(self) -> Any:
        """Return by what depths are compared."""
        keys = Keys()
        keys.rays = self.rays
        keys.levels = 2.0**self.options.depth_bits - 1.0 if self.options.depth_bits else 0.0
        return keys

    def allows(self, passes: int) -> bool:
        """Tell whether there may be one pass more than so many."""
        return self.options.max_passes is None or passes < self.options.max_passes


@wp.func(inline=True)
def key_of(keys: Keys, pixel: int, depth: Any):
    """Return what a depth is compared by; it never falls as the depth grows."""
    key = depth
    if keys.levels > wp.float64(0.0):
        rays = keys.rays
        row = pixel // rays.width
        x = centre_x(rays, pixel - row * rays.width)
        y = centre_y(rays, row)
        z = wp.float64(depth) / stretch(x, y, rays.scale, rays.perspective)
        window = (z - rays.near) / (rays.far - rays.near)
        if rays.perspective != 0:
            window = window * rays.far / z
        key = type(depth)(wp.floor(window * keys.levels + wp.float64(0.5)))
    return key
