"""Numbers: structures and kernels of both precisions from one definition.

A structure is written once, with placeholders for what depends on the precision, and is then a mapping from Warp's
number type to the structure in it:

    @in_precisions
    class Slab:
        color: Vector3
        opacity: Number

    Slab[wp.float32], Slab[wp.float64]

A kernel is made by a factory of its precision and other ingredients (functions and constants, which it captures):

    @kernels
    def scale_fwd(number, factor):
        def kernel(span: Span, slabs: wp.array(dtype=Slab[number])): ...
        return kernel

The same ingredients give the same kernel. Each is a module of its own, as a module is what Warp compiles, and has no
automatic adjoint: those are written by hand.
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, NamedTuple

import warp as wp

FLOAT32, FLOAT64 = wp.float32, wp.float64
NUMBERS: tuple[Any, ...] = (FLOAT32, FLOAT64)


class _Placeholder(NamedTuple):
    """Stands for a type that depends on the precision: a number, a vector of them, or a structure."""

    name: str
    of: Callable[[Any], Any]


class _ArrayOf(NamedTuple):
    """Stands for an array of a placeholder's type, of a structure in both precisions, or of a type of its own."""

    element: Any
    ndim: int


class _Array:
    def __init__(self, ndim: int):
        self.ndim = ndim

    def __getitem__(self, element: Any) -> _ArrayOf:
        return _ArrayOf(element, self.ndim)


# What annotations of a structure in both precisions are written with. (Any: to a type checker they are values.)
Number: Any = _Placeholder("Number", lambda number: number)
Vector3: Any = _Placeholder("Vector3", lambda number: wp.types.vector(3, number))
Vector4: Any = _Placeholder("Vector4", lambda number: wp.types.vector(4, number))
Array: Any = _Array(1)
Array2: Any = _Array(2)
Array3: Any = _Array(3)


class Precisions:
    """A structure in both precisions; `structure[number]` is the one of a Warp number type."""

    def __init__(self, definition: type):
        self.name, self.__doc__ = definition.__name__, definition.__doc__
        self._structures = {number: _structure(definition, number) for number in NUMBERS}

    def __getitem__(self, number: Any) -> Any:
        return self._structures[number]


def in_precisions(definition: type) -> Precisions:
    """Turn a class of annotated fields into a Warp structure of each precision."""
    return Precisions(definition)


def resolved(annotation: Any, number: Any) -> Any:
    """Return the type that a placeholder, or anything else, stands for in a precision."""
    if isinstance(annotation, _Placeholder):
        return annotation.of(number)
    if isinstance(annotation, Precisions):
        return annotation[number]
    if isinstance(annotation, _ArrayOf):
        return wp.array(dtype=resolved(annotation.element, number), ndim=annotation.ndim)
    return annotation


def _structure(definition: type, number: Any) -> Any:
    bits = 8 * wp.types.type_size_in_bytes(number)
    fields = {name: resolved(annotation, number) for name, annotation in definition.__annotations__.items()}
    name = f"{definition.__name__}{bits}"
    # Warp names the structure in its code by module and name.
    body = {
        "__annotations__": fields,
        "__doc__": definition.__doc__,
        "__module__": definition.__module__,
        "__qualname__": name,
    }
    return wp.struct(type(name, (), body))


def kernels(factory: Callable[..., Any]) -> Callable[..., wp.Kernel]:
    """Make a factory of kernel functions one of kernels: each made once, a module of its own, without an adjoint."""

    @cache
    @wraps(factory)
    def make(*ingredients: Any) -> wp.Kernel:
        function = factory(*ingredients)
        function.__name__ = factory.__name__
        return wp.kernel(function, module="unique", enable_backward=False)

    return make
