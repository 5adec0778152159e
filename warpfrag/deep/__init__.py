"""Deep images, `Fragments` to `Fragments`: put together, sorted, divided by object, held out by one another."""

from warpfrag.deep.holding import holdout
from warpfrag.deep.lists import concat, split, tidy

__all__ = ["concat", "holdout", "split", "tidy"]
