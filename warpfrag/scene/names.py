"""The names that scenes, options and messages share."""

from typing import Literal, get_args

Merge = Literal["none", "smooth", "order_independent", "exact"]
Mix = Literal["opacity", "average", "optical_depth"]
MERGES: tuple[str, ...] = get_args(Merge)
MIXES: tuple[str, ...] = get_args(Mix)
