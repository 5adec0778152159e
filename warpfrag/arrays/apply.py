"""Calling an operator with arrays of whatever kind."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

from warpfrag.arrays.kinds import common_kind
from warpfrag.arrays.operators import NoOptions, Operator


def apply(operator: Operator, arrays: Mapping[str, Any], options: Any = None) -> SimpleNamespace:
    """Call an operator on arrays of one kind and return its outputs, by name, in that kind.

    Args:
        operator: what to compute.
        arrays: the arguments by name: inputs of one kind, dtype and device, and tables (Warp arrays); what is left out
            is None.
        options: the operator's options.
    """
    kind = common_kind({each.name: arrays.get(each.name) for each in operator.inputs})
    inputs = SimpleNamespace(**{each.name: arrays.get(each.name) for each in operator.arguments})
    return kind.call(operator, inputs, NoOptions() if options is None else options)
