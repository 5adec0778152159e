"""Constructive solid geometry on fragments: the surface of what objects are together, minus others, or in common.

Along a pixel's ray every surface of a closed object is an entry or an exit. Counted up to a depth they tell whether
that lies inside of the object (the winding number), and the expression tells whether it lies inside of the whole: where
this changes there is a surface. All fragments of one depth are one event, so that it is right where faces coincide
(peeling paper, Fig. 2 and 12b): two blocks side by side have no wall between them, one cut off flush has no skin left.

An eye inside of an object, or a near plane that cuts it, leaves exits without entries: what a ray leaves without having
entered it, it has begun in. Which fragments are surfaces is held fixed; their colours and depths are differentiable.
"""

import ast
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from warpfrag.arrays.kinds import common_kind
from warpfrag.capture.surfaces import surfaces_of
from warpfrag.errors import check_number, shorten, suggest
from warpfrag.fragments import Fragments
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene

_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.BitOr: np.logical_or,
    ast.BitAnd: np.logical_and,
    ast.Sub: lambda a, b: a & ~b,
    ast.BitXor: np.logical_xor,
}
_ARRAYS = ("rgba", "depth", "thickness", "opacity_sum", "object_id", "primitive_id")


def csg(
    fragments: Fragments,
    expression: str,
    *,
    names: Sequence[str] | Mapping[str, int] | None = None,
    scene: Scene | None = None,
    camera: Camera | None = None,
    tolerance: float = 0.0,
) -> Fragments:
    """Return the fragments that are the surface of a boolean expression of closed objects.

    Where several fragments share a depth, the surface is the one whose object comes first in the expression.

    Args:
        fragments: all fragments, of closed objects, with object ids; torch or NumPy.
        expression: names of objects joined by | (one or the other), & (both), - (without) and ^ (one of two), with
            parentheses; - binds closest, then &, ^ and |. Names that are no identifiers stand in quotes.
        names: those of the objects, in order of their ids, or a mapping from names to ids; default the scene's.
        scene: what the fragments are of. With it, entries and exits are told apart by the triangles' sides, so that
            an object may overlap itself; without it, they take turns. Primitive ids are needed.
        camera: where from; default the scene's.
        tolerance: fragments share a depth if each is at most this far behind the one before [scene units].

    Returns:
        The fragments of the surface, those of a pixel in order of depth.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an expression that cannot be read, or with a name that there is not; fragments without ids.

    Example:
        >>> scene = wf.load_scene("scenes/sphere_pair.toml")
        >>> both = csg(wf.capture(scene), "red & green", scene=scene)
    """
    if not isinstance(fragments, Fragments):
        raise TypeError(f"fragments: got {type(fragments).__name__}, expected Fragments")
    if fragments.kind == "warp":
        raise TypeError("fragments: got Warp arrays, expected torch tensors or NumPy arrays")
    if fragments.object_id is None:
        raise ValueError("fragments: got none of object_id, expected the object of each fragment (capture gives them)")
    tolerance = check_number("tolerance", tolerance, 0.0)
    numbers = _numbers_of(names, scene)
    tree = _parsed(expression)
    used = list(dict.fromkeys(_names_in(tree, expression)))
    for name in used:
        if name not in numbers:
            raise ValueError(
                f"expression: got {shorten(name)}, expected the name of an object ({suggest(name, numbers)})"
            )
    host = fragments.numpy()
    pixel = fragments.pixel
    order = np.lexsort((np.arange(fragments.count), host.depth, pixel))
    pixel, depth, owner = pixel[order], host.depth[order].astype(np.float64), host.object_id[order]
    first_of_pixel = np.diff(pixel, prepend=-1) != 0
    first_of_event = first_of_pixel | (np.diff(depth, prepend=0.0) > tolerance)
    event = np.cumsum(first_of_event) - 1
    begins = first_of_pixel[first_of_event]
    steps = None if scene is None else _entries(host, scene, camera)[order]
    before, after = {}, {}
    for name in used:
        own = owner == numbers[name]
        before[name], after[name] = _inside(own, steps, event, begins)
    changes = _value(tree, before) != _value(tree, after)
    # Of each event that is a surface, the fragment whose object comes first.
    rank = np.full(len(owner), len(used))
    for place, name in enumerate(used):
        own = owner == numbers[name]
        rank[own & (before[name] != after[name])[event]] = place
    best = np.lexsort((np.arange(len(owner)), rank, event))
    chosen = np.sort(best[first_of_event][changes])
    return _taken(fragments, order[chosen], pixel[chosen])


def _inside(
    own: np.ndarray, steps: np.ndarray | None, event: np.ndarray, begins: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return before and after which events a ray is inside of an object.

    Args:
        own: which fragments are the object's.
        steps: 1 for entries, -1 for exits, by fragment; None where they take turns.
        event: number of each fragment's event.
        begins: which events are the first of their pixel.
    """
    change = np.bincount(event, np.where(own, 1 if steps is None else steps, 0), len(begins)).astype(np.int64)
    total = np.cumsum(change)
    firsts = np.flatnonzero(begins)
    lengths = np.diff([*firsts, len(begins)])
    after = total - np.repeat((total - change)[firsts], lengths)
    if steps is None:
        # As many entries as exits: an odd number of both is one that the ray has begun in.
        last = after[firsts + lengths - 1] if len(firsts) else after
        after = (after + np.repeat(last, lengths)) % 2
        change = change % 2
        return (after ^ change) > 0, after > 0
    least = np.minimum.reduceat(after, firsts) if len(firsts) else after
    after = after - np.repeat(np.minimum(least, 0), lengths)
    return (after - change) > 0, after > 0


def _entries(fragments: Fragments, scene: Scene, camera: Camera | None) -> np.ndarray:
    """Return 1 for each fragment that is an entry, -1 for each exit, (F,)."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: got {type(scene).__name__}, expected a Scene")
    if fragments.primitive_id is None:
        raise ValueError("fragments: got none of primitive_id, expected the triangle of each fragment")
    surfaces = surfaces_of(scene, camera or scene.camera)
    corners = np.asarray(surfaces.points, np.float64)[surfaces.tables.faces.numpy().reshape(-1, 3)]
    a, b, c = (corners[:, corner] for corner in range(3))
    normals = np.cross(b - a, c - a)
    # Towards the eye, which is at the origin, or all the way in front.
    towards = -np.einsum("ij,ij->i", a, np.cross(b, c)) if surfaces.camera.is_perspective else -normals[:, 2]
    object_id = surfaces.tables.object_id.numpy()
    count = len(surfaces.tables.first_face)
    sums = [np.bincount(object_id, corners.mean(axis=1)[:, axis], count) for axis in range(3)]
    middle = np.stack(sums, 1) / np.maximum(np.bincount(object_id, minlength=count), 1)[:, None]
    # Of a mesh with its outer sides inwards, or in a mirrored place, the volume is negative.
    volume = np.bincount(object_id, np.einsum("ij,ij->i", a - middle[object_id], normals), count)
    side = np.where(towards * np.where(volume < 0.0, -1.0, 1.0)[object_id] > 0.0, 1, -1)
    first_face = surfaces.tables.first_face
    if fragments.count and (fragments.object_id.max() >= count):
        raise ValueError(f"fragments: got object {fragments.object_id.max()}, expected one of the scene's {count}")
    return side[first_face[fragments.object_id] + fragments.primitive_id]


def _taken(fragments: Fragments, chosen: np.ndarray, pixel: np.ndarray) -> Fragments:
    """Return some of the fragments, given their numbers, in order, and their pixels."""
    kind = common_kind({"rgba": fragments.rgba})
    counts = np.bincount(pixel, minlength=fragments.pixel_count)
    offsets = np.cumsum([0, *counts]).astype(np.int32)
    if kind.name == "numpy":
        index, offsets = chosen, offsets.astype(fragments.offsets.dtype)
    else:
        index = kind.xp.as_tensor(chosen, device=fragments.rgba.device)
        offsets = kind.xp.as_tensor(offsets, device=fragments.rgba.device, dtype=fragments.offsets.dtype)
    arrays = {name: getattr(fragments, name) for name in _ARRAYS}
    parts = {name: None if array is None else array[index] for name, array in arrays.items()}
    return Fragments(**parts, offsets=offsets, shape=fragments.shape)


def _numbers_of(names: Any, scene: Scene | None) -> dict[str, int]:
    if names is None and scene is None:
        raise TypeError("names: got none, expected the names of the objects, or the scene")
    if names is None:
        names = [item.name for item in scene.objects]  # type: ignore[union-attr]
    if isinstance(names, Mapping):
        return {str(name): int(number) for name, number in names.items()}
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"names: got {shorten(names)}, expected a list of names, or a mapping from names to ids")
    return {name: number for number, name in enumerate(names)}


def _parsed(expression: Any) -> ast.expr:
    if not isinstance(expression, str):
        raise TypeError(f"expression: got {type(expression).__name__}, expected a text")
    try:
        return ast.parse(expression.strip(), mode="eval").body
    except SyntaxError:
        raise _unreadable(expression) from None


def _names_in(tree: ast.expr, expression: str) -> Iterator[str]:
    if isinstance(tree, ast.BinOp) and type(tree.op) in _OPERATORS:
        yield from _names_in(tree.left, expression)
        yield from _names_in(tree.right, expression)
    elif isinstance(tree, ast.Name):
        yield tree.id
    elif isinstance(tree, ast.Constant) and isinstance(tree.value, str):
        yield tree.value
    else:
        raise _unreadable(expression)


def _value(tree: ast.expr, inside: Mapping[str, np.ndarray]) -> np.ndarray:
    if isinstance(tree, ast.BinOp):
        return _OPERATORS[type(tree.op)](_value(tree.left, inside), _value(tree.right, inside))
    return inside[tree.id if isinstance(tree, ast.Name) else tree.value]  # type: ignore[attr-defined]


def _unreadable(expression: str) -> ValueError:
    return ValueError(f"expression: got {shorten(expression)}, expected names of objects joined by |, &, - and ^")
