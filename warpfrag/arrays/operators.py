"""What an operator is: a differentiable function of arrays with named inputs, outputs and options.

It is written once, on Warp arrays; `apply` calls it with arrays of any kind. Shapes are texts of sizes, such as "F 4":
a number stands for itself, a name for what it is in the inputs (the first that has it says; "P+1" makes P one less), or
for what the options say in their `sizes`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from types import SimpleNamespace
from typing import Any, Literal

import warp as wp

Dtype = Literal["float", "int"]
Shape = tuple[int, ...]


@dataclass(frozen=True)
class Input:
    """An array argument, which may be None in a call.

    Attributes:
        name: what it is called in `inputs` and `targets`.
        shape: its sizes.
        dtype: "float" is the precision that all float inputs share; "int" is int32; None is anything of the library's
            own (a table).
        gradient: whether there is a gradient in it.
    """

    name: str
    shape: str
    dtype: Dtype | None = "float"
    gradient: bool = False


@dataclass(frozen=True)
class Output:
    """An array that an operator returns; see `Input`."""

    name: str
    shape: str
    dtype: Dtype = "float"


@dataclass(frozen=True)
class NoOptions:
    """The options of an operator that has none."""


@dataclass(frozen=True, eq=False)
class Operator:
    """One differentiable function of arrays.

    Attributes:
        name: name under which torch knows it, `torch.ops.warpfrag.<name>`.
        inputs: the array arguments of a call.
        outputs: what it returns.
        forward: `(inputs, outputs, options)`: fills the allocated outputs; inputs that were not given are None.
        backward: `(inputs, grads, targets, options)`: fills the allocated gradients `targets` of the inputs, where they
            are not None, given those of the outputs, `grads`; one that is None stands for zeros. None: not
            differentiable.
        options: a frozen dataclass of numbers and texts; a method `sizes` may say what names in shapes are.
        tables: arrays of the library's own that a call takes as well: Warp arrays whatever the kind of the inputs; they
            have no gradient.
        arguments: all array arguments: inputs, then tables.
        option_names: the names of the options, in order.
    """

    name: str
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    forward: Callable[..., None]
    backward: Callable[..., None] | None = None
    options: type = NoOptions
    tables: tuple[Input, ...] = ()
    arguments: tuple[Input, ...] = field(init=False)
    option_names: tuple[str, ...] = field(init=False)

    def __post_init__(self):
        # Once: torch.compile cannot look at the fields of a class.
        object.__setattr__(self, "arguments", (*self.inputs, *self.tables))
        object.__setattr__(self, "option_names", tuple(option.name for option in fields(self.options)))
        OPERATORS[self.name] = self
        for register in LISTENERS:
            register(self)

    def output_shapes(self, arrays: SimpleNamespace, options: Any) -> list[Shape]:
        """Return the shapes of the outputs, from those of the inputs and the options alone."""
        sizes: dict[str, int] = dict(options.sizes()) if hasattr(options, "sizes") else {}
        for argument in self.arguments:
            array = getattr(arrays, argument.name)
            if array is not None:
                for text, size in zip(argument.shape.split(), array.shape, strict=True):
                    name, _, more = text.partition("+")
                    if not name.isdecimal():
                        sizes.setdefault(name, size - int(more or 0))
        return [
            tuple(int(text) if text.isdecimal() else sizes[text] for text in output.shape.split())
            for output in self.outputs
        ]


# Every operator by name, and who wants to hear of further ones: array libraries that have their own registries.
OPERATORS: dict[str, Operator] = {}
LISTENERS: list[Callable[[Operator], None]] = []


def named(names: Any, values: Any) -> SimpleNamespace:
    """Return values under the names of inputs or outputs."""
    return SimpleNamespace(**{each.name: value for each, value in zip(names, values, strict=True)})


def number_type(operator: Operator, arrays: SimpleNamespace) -> Any:
    """Return the Warp number type of an operator's float inputs."""
    return next(
        getattr(arrays, each.name).dtype
        for each in operator.inputs
        if each.dtype == "float" and getattr(arrays, each.name) is not None
    )


def empty_outputs(operator: Operator, arrays: SimpleNamespace, options: Any, *, requires_grad: bool) -> SimpleNamespace:
    """Allocate an operator's outputs for inputs that are Warp arrays."""
    number = number_type(operator, arrays)
    device = next(array.device for array in vars(arrays).values() if array is not None)
    shapes = operator.output_shapes(arrays, options)
    return named(
        operator.outputs,
        [
            wp.empty(shape, dtype=number, device=device, requires_grad=requires_grad)
            if output.dtype == "float"
            else wp.empty(shape, dtype=wp.int32, device=device)
            for output, shape in zip(operator.outputs, shapes, strict=True)
        ],
    )
