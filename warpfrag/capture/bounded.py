"""The bounded capture: a scene straight into the slots of a k-buffer, whatever its depth complexity.

Memory is that of the layers, K slots of 28 bytes (in single precision) and a number of 4 bytes a pixel, and the lists
of triangles that rasterising takes. The layers are those of `kbuffer(capture(scene, sort=False))`, to the bit.

Gradients are those of `resolve.kbuffer` and of `capture.shade`. The way back needs the fragments, so it captures them
again, in bands of rows that take `BAND_BYTES` (or one row): between the passes nothing is kept but the scene.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import warp as wp

from warpfrag.arrays.legacy import Operator, add, apply
from warpfrag.capture.capture import Surfaces, as_kind, check_scene, place_surfaces, to_warp
from warpfrag.capture.into_slots import TALLY_ALL, TALLY_BEHIND, TALLY_OCCUPANCY, TALLY_ROWS, stream_triangles
from warpfrag.capture.memory import allowed_memory, fragment_bytes, refuse, split_rows
from warpfrag.capture.shade import SHADE_DIFFERENTIABLE, SHADE_OPTIONS, SHADE_TENSORS, shade_forward, shade_output_like
from warpfrag.capture.shade_adjoint import shade_backward
from warpfrag.fragments import Layers
from warpfrag.raster.ray import Window
from warpfrag.raster.triangles import (
    Triangles,
    count_fragments,
    prepare_triangles,
    scan_counts,
    sort_fragments,
    store_fragments,
)
from warpfrag.resolve.arguments import check_choice
from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.storage.kbuffer import (
    KBUFFER_OPTIONS,
    LAYER_OUTPUTS,
    KMerge,
    Tail,
    as_layers,
    check_kbuffer,
    kbuffer_backward,
    layers_like,
)

Cull = Literal["occupancy"]

# Memory that the fragments of a band take on the way back, with their gradients [bytes].
BAND_BYTES = 1 << 28
# Of a slot: colour and opacity, depth, z-thickness, opacity sum: numbers.
SLOT_NUMBERS = 7

_TABLES = SHADE_TENSORS[SHADE_TENSORS.index("object_id") :]
_TENSORS = (*SHADE_DIFFERENTIABLE, "faces", *_TABLES)


def kbuffer_bytes(pixel_count: int, slots: int, scalar: Any = wp.float32, words: int = 0) -> int:
    """Return the memory of a k-buffer: of its layers, and of the occupancy maps while they are captured [bytes].

    Args:
        pixel_count: number of pixels.
        slots: slots of a pixel, K.
        scalar: Warp type of the numbers.
        words: words of a pixel's occupancy map; 0 for none.
    """
    size = wp.types.type_size_in_bytes(scalar)
    culling = 4 * words + 2 * size + 4 if words else 0
    return pixel_count * (slots * SLOT_NUMBERS * size + 4 + culling)


def _output_like(inputs: Sequence[Any], width: int, row_count: int, slots: int, **options: Any) -> list:
    return layers_like(width * row_count, slots)


def _split(options: Mapping[str, Any]) -> tuple[Window, dict[str, Any]]:
    return Window(**{name: options[name] for name in SHADE_OPTIONS}), {name: options[name] for name in KBUFFER_OPTIONS}


def _inputs(surfaces: Surfaces) -> tuple[Any, ...]:
    """Return a scene's arrays as `_TENSORS`."""
    differentiable = (surfaces.points, surfaces.rgba, surfaces.thickness, surfaces.maps)
    return (*differentiable, as_kind(surfaces.faces, surfaces.points), *surfaces.tables)


def _without_faces(inputs: Sequence[Any]) -> tuple[Any, ...]:
    return (*inputs[:4], *inputs[5:])


def _forward(inputs: Sequence[Any], outputs: Sequence[Any], words: int, **options: Any) -> None:
    window, choice = _split(options)
    triangles = prepare_triangles(inputs[0], inputs[4], window)
    stream_triangles(
        triangles, _without_faces(inputs), outputs, merge=choice["merge"], tail=choice["tail"], words=words
    )


def _backward(
    inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any], words: int, **options: Any
) -> None:
    window, choice = _split(options)
    points, faces = inputs[0], inputs[4]
    counts = count_fragments(prepare_triangles(points, faces, window))
    row_counts = counts.numpy().reshape(window.row_count, window.width).sum(axis=1, dtype=np.int64)
    targets = grad_inputs[:4]
    for target in targets:
        if target is not None:
            target.zero_()
    if not row_counts.any():
        return
    fragment_size = fragment_bytes(points.dtype, gradient=True)
    for begin, end in split_rows(
        row_counts, 0.0, fragment_size, max(BAND_BYTES, int(row_counts.max()) * fragment_size)
    ):
        pixels = slice(begin * window.width, end * window.width)
        band = replace(window, first_row=window.first_row + begin, row_count=end - begin)
        grads = [None if grad is None else grad[pixels] for grad in grad_outputs]
        partial = [None if target is None else wp.empty_like(target) for target in targets]
        _backward_band(inputs, counts[pixels], prepare_triangles(points, faces, band), grads, partial, choice)
        for target, part in zip(targets, partial, strict=True):
            if target is not None and part is not None:
                add(target.flatten(), part.flatten())


def _backward_band(
    inputs: Sequence[Any],
    counts: wp.array,
    triangles: Triangles,
    grad_layers: Sequence[Any],
    targets: Sequence[Any],
    choice: Mapping[str, Any],
) -> None:
    """Fill the gradients of points, rgba, thickness and maps by the pixels of a window."""
    device, scalar = triangles.device, triangles.points.dtype
    options = asdict(triangles.window)
    starts, total = scan_counts(counts)
    faces, depths = store_fragments(triangles, starts, total, False)
    sort_fragments(starts, faces, depths)
    surfaces = (*inputs[:4], triangles.corners, faces, starts, *inputs[5:])
    like = shade_output_like(surfaces, **options)
    shaded = [wp.empty(shape, dtype=scalar if kind == "float" else int, device=device) for shape, kind in like]
    shade_forward(surfaces, shaded, **options)
    grads = [wp.empty_like(array) for array in shaded[:3]]
    kbuffer_backward((*shaded[:3], starts, None), grad_layers, (*grads, None, None), **choice)
    shade_backward(surfaces, (*grads, None, None), (*targets, *[None] * len(surfaces[4:])), **options)


_CAPTURE_KBUFFER = Operator(
    name="capture_kbuffer",
    tensors=_TENSORS,
    differentiable=SHADE_DIFFERENTIABLE,
    outputs=LAYER_OUTPUTS,
    output_like=_output_like,
    forward=_forward,
    backward=_backward,
    options={**SHADE_OPTIONS, **KBUFFER_OPTIONS, "words": "int"},
)


def capture_kbuffer(
    scene: Scene,
    camera: Camera | None = None,
    slots: int = 8,
    *,
    merge: KMerge = "order_independent",
    tail: Tail = "mix",
    cull: Cull | None = None,
    words: int = 8,
    parameters: Mapping[str, Any] | None = None,
    memory_limit: float | None = None,
) -> Layers:
    """Capture a scene straight into a k-buffer: memory does not grow with the number of fragments.

    Fragments are streamed as they are rasterised, in order of submission, by the rules of `kbuffer`: the layers are
    those of `kbuffer(capture(scene, sort=False), slots)`, to the bit. With `tail="discard"` a fragment behind all slots
    is not shaded (fragment culling of the k+-buffer).

    Differentiable in vertices, translations and rotations, colour, opacity and thickness, as `capture` and `kbuffer`
    are; the gradient captures the fragments again, a few rows of the image at a time.

    Args:
        scene: what to capture.
        camera: where from; default the scene's.
        slots: number K of slots of each pixel.
        merge: see `kbuffer`.
        tail: see `kbuffer`.
        cull: "occupancy" finds out beforehand about where the K-th fragment of a pixel lies, and does not shade what is
            behind; two more passes over the triangles, the same layers. Only without merging and with
            `tail="discard"`: else what lies behind counts as well.
        words: words d of 32 bits of a pixel's occupancy map; 32 d buckets must be more than the slots.
        parameters: see `capture`.
        memory_limit: most memory that the slots may take [bytes]; default half of what is free.

    Returns:
        Layers of shape (H, W), of the kind and precision that `capture` would give fragments.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range, or does not go with another.
        MemoryError: the slots would take more memory than the limit allows; nothing has been stored yet.

    Example:
        >>> wf.capture_kbuffer(wf.load_scene("scenes/three_spheres.toml"), slots=4).depth.shape
        (512, 512, 4)
    """
    camera = check_scene(scene, camera)
    words = _check_options(slots, merge, tail, cull, words)
    surfaces = place_surfaces(assemble(scene, parameters, camera=camera), camera)
    window = Window.of(camera)
    scalar = wp.float64 if "64" in str(surfaces.points.dtype) else wp.float32
    needed = kbuffer_bytes(window.pixel_count, slots, scalar, words)
    allowed = allowed_memory(memory_limit, surfaces.faces.device)
    if needed > allowed:
        refuse(needed, allowed, f"{slots} slots for each of {window.pixel_count} pixels")
    options = {**asdict(window), "slots": int(slots), "merge": merge, "tail": tail, "words": words}
    with surfaces.stream():
        return as_layers(apply(_CAPTURE_KBUFFER, _inputs(surfaces), **options), camera.shape, slots)


@dataclass(frozen=True, eq=False)
class Culling:
    """How many fragments of each pixel a k-buffer need not shade.

    Attributes:
        fragments: all fragments, (H, W) int32.
        occupancy: those that the occupancy map culls, (H, W) int32.
        behind: those that lie behind all slots when they arrive (the k+-buffer's own test), (H, W) int32.
    """

    fragments: np.ndarray
    occupancy: np.ndarray
    behind: np.ndarray

    @property
    def shaded(self) -> np.ndarray:
        """Fragments that are shaded and enter a slot, (H, W) int32."""
        return self.fragments - self.occupancy - self.behind


def count_culled(
    scene: Scene,
    camera: Camera | None = None,
    slots: int = 8,
    *,
    merge: KMerge = "none",
    tail: Tail = "discard",
    cull: Cull | None = None,
    words: int = 8,
    parameters: Mapping[str, Any] | None = None,
) -> Culling:
    """Count the fragments that `capture_kbuffer` culls with the same arguments.

    Returns:
        The counts, NumPy.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range, or does not go with another.

    Example:
        >>> counts = count_culled(wf.load_scene("scenes/spheres_in_sphere.toml"), slots=2, cull="occupancy")
        >>> int(counts.occupancy.sum()), int(counts.fragments.sum())
        (76290, 357178)
    """
    camera = check_scene(scene, camera)
    words = _check_options(slots, merge, tail, cull, words)
    surfaces = place_surfaces(assemble(scene, parameters, camera=camera), camera)
    inputs = [None if array is None else to_warp(array) for array in _inputs(surfaces)]
    triangles = prepare_triangles(inputs[0], inputs[4], Window.of(camera))
    device, scalar, pixel_count = triangles.device, triangles.points.dtype, triangles.window.pixel_count
    outputs = [
        wp.empty(shape, dtype=scalar if kind == "float" else int, device=device)
        for shape, kind in layers_like(pixel_count, slots)
    ]
    tally = wp.zeros((TALLY_ROWS, pixel_count), dtype=int, device=device)
    stream_triangles(triangles, _without_faces(inputs), outputs, merge=merge, tail=tail, words=words, tally=tally)
    rows = tally.numpy().reshape(TALLY_ROWS, *camera.shape)
    return Culling(*(rows[int(row)] for row in (TALLY_ALL, TALLY_OCCUPANCY, TALLY_BEHIND)))


def _check_options(slots: Any, merge: Any, tail: Any, cull: Any, words: Any) -> int:
    """Check the options and return how many words an occupancy map has, 0 without."""
    check_kbuffer(slots, merge, tail)
    if cull is None:
        return 0
    check_choice("cull", cull, get_args(Cull))
    if merge != "none" or tail != "discard":
        raise ValueError(
            f'cull: got {cull!r} with merge={merge!r} and tail={tail!r}, expected merge="none" and tail="discard" '
            "(else fragments behind the K nearest count as well)"
        )
    if isinstance(words, bool) or not isinstance(words, (int, np.integer)):
        raise TypeError(f"words: got {words!r}, expected a whole number")
    if 32 * words <= slots:
        raise ValueError(f"words: got {words}, expected more than {slots // 32}, for {slots} slots")
    return int(words)
