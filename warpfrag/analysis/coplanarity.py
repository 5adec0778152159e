"""Coplanarity: where fragments of a pixel share a depth, of which peeling captures one (Vasilakis and Fudos 2013)."""

from dataclasses import dataclass

import numpy as np

from warpfrag.colors import parse_hex
from warpfrag.errors import check_number
from warpfrag.fragments import Fragments
from warpfrag.storage.equal_depths import largest_groups

# Of a pixel whose largest group has 1, 2, … fragments, as in Fig. 13 of the paper: gray, red, blue, green, cyan,
# aquamarine, fuchsia, yellow, brown; larger groups are brown as well.
COLORS = ("#808080", "#ff0000", "#0000ff", "#008000", "#00ffff", "#7fffd4", "#ff00ff", "#ffff00", "#a52a2a")


@dataclass(frozen=True, eq=False)
class Coplanarity:
    """How many fragments of each pixel share a depth.

    Attributes:
        counts: fragments at the depth that most of a pixel's fragments have: 1 where all differ, 0 where there are
            none, int32, of the shape of the pixel grid.
    """

    counts: np.ndarray

    @property
    def share(self) -> float:
        """Share of the covered pixels in which some depth occurs more than once, C_p; 0 where none is covered."""
        covered = np.count_nonzero(self.counts)
        return float(np.count_nonzero(self.counts > 1) / covered) if covered else 0.0

    def __repr__(self) -> str:
        return f"Coplanarity(share {self.share:.3g}, up to {self.counts.max(initial=0)} fragments of one depth)"

    def map(self) -> np.ndarray:
        """Return a picture of the counts as Fig. 13 of the paper has it: gray, and a colour for each count from 2.

        Returns:
            Linear RGBA, transparent where there are no fragments, (…, 4) float32.
        """
        palette = np.array([(0.0, 0.0, 0.0, 0.0), *(parse_hex(color) for color in COLORS)], np.float32)
        return palette[np.minimum(self.counts, len(COLORS))]


def coplanarity(fragments: Fragments, tolerance: float = 0.0) -> Coplanarity:
    """Find out how many fragments of each pixel share a depth.

    Args:
        fragments: all fragments that there are, such as those of `capture`.
        tolerance: fragments share a depth if each is at most this far behind the one before [scene units].

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: the tolerance is negative or not finite.

    Example:
        >>> found = coplanarity(Fragments.from_lists([[(0, 0, 0, 1, 2, 0)] * 3, [(0, 0, 0, 1, 2, 0)]], (1, 2)))
        >>> found.counts.tolist(), found.share
        ([[3, 1]], 0.5)
    """
    if not isinstance(fragments, Fragments):
        raise TypeError(f"fragments: got {type(fragments).__name__}, expected Fragments")
    tolerance = check_number("tolerance", tolerance, 0.0)
    counts = largest_groups(fragments.pixel, fragments.numpy().depth, fragments.pixel_count, tolerance)
    return Coplanarity(counts.reshape(fragments.shape))
