"""How many fragments of a pixel share a depth."""

import numpy as np


def largest_groups(pixels: np.ndarray, depths: np.ndarray, pixel_count: int, tolerance: float = 0.0) -> np.ndarray:
    """Return the number of fragments at the depth that most fragments of a pixel have, 0 where there are none, (P,).

    Args:
        pixels: the pixel of each fragment, (F,).
        depths: the depth of each fragment, (F,).
        pixel_count: number of pixels, P.
        tolerance: fragments share a depth if each is within this of the next [units of the depths].
    """
    largest = np.zeros(pixel_count, np.int32)
    if len(pixels):
        order = np.lexsort((depths, pixels))
        sorted_pixels, sorted_depths = pixels[order], depths[order].astype(np.float64)
        begins = (np.diff(sorted_pixels) != 0) | (np.diff(sorted_depths) > tolerance)
        firsts = np.concatenate([[0], np.flatnonzero(begins) + 1])
        np.maximum.at(largest, sorted_pixels[firsts], np.diff([*firsts, len(pixels)]).astype(np.int32))
    return largest
