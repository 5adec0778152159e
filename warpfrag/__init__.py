"""A differentiable multi-fragment compositor."""

from warpfrag.composite import composite
from warpfrag.fragments import Fragments, Layers
from warpfrag.resolve.smooth import resolve

__all__ = ["Fragments", "Layers", "composite", "resolve"]
