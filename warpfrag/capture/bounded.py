"""The bounded capture: a scene straight into the slots of a k-buffer, whatever its depth complexity.

Memory is that of the layers, K slots of 28 bytes (in single precision) and a number of 4 bytes a pixel, and the lists
of triangles that rasterising takes. The layers are those of `kbuffer(capture(scene, sort=False))`, to the bit.

Gradients are those of `resolve.kbuffer` and of `capture.shade`. The way back needs the fragments, so it captures them
again, in bands of rows that take `BAND_BYTES` (or one row): between the passes nothing is kept but the scene.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from types import SimpleNamespace
from typing import Any, Literal, get_args

import numpy as np
import warp as wp

from warpfrag.arrays.apply import apply
from warpfrag.arrays.kinds import add_in_place
from warpfrag.arrays.operators import Input, Operator, empty_outputs
from warpfrag.capture.interpolation import hit_of, shade_color, shade_thickness
from warpfrag.capture.memory import allowed_memory, fragment_bytes, refuse, split_rows
from warpfrag.capture.shade import SHADE, shade_backward, shade_forward
from warpfrag.capture.surfaces import CameraSurfaces, SurfaceArrays, check_scene, surface_arrays, surfaces_of
from warpfrag.errors import check_choice, check_whole
from warpfrag.fragments import LAYER_OUTPUTS, Layers, as_layers
from warpfrag.raster.ray import Window, centre_x, centre_y, stretch
from warpfrag.raster.triangles import prepare_triangles
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.storage.into_slots import (
    KMerge,
    Source,
    Tail,
    check_kbuffer,
    kbuffer_bytes,
    kbuffer_storage,
)
from warpfrag.storage.kbuffer import KBufferOptions, kbuffer_backward
from warpfrag.storage.lists import DYNAMIC, sort_lists
from warpfrag.storage.method import Room, count_fragments, fill
from warpfrag.storage.occupancy import TALLY_ALL, TALLY_BEHIND, TALLY_OCCUPANCY, TALLY_ROWS

wp.set_module_options({"enable_backward": False})

Cull = Literal["occupancy"]

# Memory that the fragments of a band take on the way back, with their gradients [bytes].
BAND_BYTES = 1 << 28


@wp.struct
class Place:
    """Where the ray of a pixel meets a triangle: its corners, `hit_weights`, `stretch`, and the depth along the ray."""

    corner: wp.vec3i
    hit: wp.vec3d
    along: wp.float64
    depth: wp.float64


@wp.func(inline=True)
def locate(surface: Any, pixel: int, face: int) -> Place:
    """Return where the ray of a pixel meets a triangle."""
    rays = surface.rays
    row = pixel // rays.width
    x = centre_x(rays, pixel - row * rays.width)
    y = centre_y(rays, row)
    place = Place()
    place.corner = surface.corners[face]
    place.hit = hit_of(surface, place.corner, x, y)
    place.along = stretch(x, y, rays.scale, rays.perspective)
    place.depth = place.hit[2] * place.along
    return place


@wp.func(inline=True)
def front_of(surface: Any, pixel: int, face: int, place: Place, depth: Any):
    """Return the front of the fragment of a triangle."""
    item = surface.objects[surface.object_id[face]]
    return depth - type(depth)(shade_thickness(surface, item, place.corner, place.hit, place.along, pixel))


@wp.func(inline=True)
def color_of(surface: Any, pixel: int, face: int, place: Place, depth: Any):
    """Return the colour and opacity of the fragment of a triangle, and its opacity sum."""
    shaded = shade_color(surface, face, place.corner, place.hit)
    opacity = type(depth)(shaded[3])
    return wp.vector(type(depth)(shaded[0]), type(depth)(shaded[1]), type(depth)(shaded[2]), opacity), opacity


TRIANGLES = Source(SurfaceArrays, locate, front_of, color_of)


@dataclass(frozen=True)
class BoundedWindow(Window):
    """A window that is captured into a k-buffer.

    Attributes:
        slots: see `kbuffer`, as merge and tail.
        map_words: words of 32 bits of a pixel's occupancy map; 0 for no culling by it.
    """

    slots: int
    merge: str
    tail: str
    map_words: int

    def sizes(self) -> dict[str, int]:
        """Return the sizes of outputs that no input has."""
        return {"P": self.pixel_count, "M": self.slots}


def operator_arrays(surfaces: CameraSurfaces) -> dict[str, Any]:
    """Return surfaces as the arrays of `CAPTURE_KBUFFER`."""
    return {
        each.name: getattr(surfaces, each.name, getattr(surfaces.tables, each.name, None))
        for each in CAPTURE_KBUFFER.arguments
    }


def _stream_triangles(
    inputs: SimpleNamespace, outputs: SimpleNamespace, options: BoundedWindow, tally_rows: wp.array | None = None
) -> None:
    """Rasterise and shade all triangles into the slots of their pixels, which become layers."""
    triangles = prepare_triangles(inputs.points, inputs.faces, options)
    storage = kbuffer_storage(
        TRIANGLES,
        surface_arrays({**vars(inputs), "corners": triangles.corners}, options),
        outputs,
        merge=options.merge,
        tail=options.tail,
        map_words=options.map_words,
        tally_rows=tally_rows,
    )
    # The layers are there already; there is nothing to reserve.
    fill(storage, triangles, Room(options.pixel_count, triangles.points.dtype, triangles.device, lambda *told: None))


def _backward(
    inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, options: BoundedWindow
) -> None:
    counts = count_fragments(prepare_triangles(inputs.points, inputs.faces, options))
    row_counts = counts.numpy().reshape(options.row_count, options.width).sum(axis=1, dtype=np.int64)
    wanted = {name: target for name, target in vars(targets).items() if target is not None}
    for target in wanted.values():
        target.zero_()
    if not row_counts.any():
        return
    fragment_size = fragment_bytes(inputs.points.dtype, gradient=True)
    allowed = max(BAND_BYTES, int(row_counts.max()) * fragment_size)
    for begin, end in split_rows(row_counts, row_counts * fragment_size, allowed):
        pixels = slice(begin * options.width, end * options.width)
        band = replace(options, first_row=options.first_row + begin, row_count=end - begin)
        own = {name: None if grad is None else grad[pixels] for name, grad in vars(grads).items()}
        partial = {name: wp.empty_like(target) for name, target in wanted.items()}
        parts = SimpleNamespace(**{name: partial.get(name) for name in vars(targets)})
        _backward_band(inputs, counts[pixels], SimpleNamespace(**own), parts, band)
        for name, target in wanted.items():
            add_in_place(target.flatten(), partial[name].flatten())


def _backward_band(
    inputs: SimpleNamespace, counts: wp.array, grads: SimpleNamespace, targets: SimpleNamespace, band: BoundedWindow
) -> None:
    """Fill the gradients of points, rgba, thickness and maps by the pixels of a window."""
    number, device = inputs.points.dtype, inputs.points.device
    triangles = prepare_triangles(inputs.points, inputs.faces, band)
    room = Room(band.pixel_count, number, device, lambda *told: None, keep_depths=False, counts=counts)
    lists = fill(DYNAMIC, triangles, room)
    sort_lists(lists)
    surfaces = SimpleNamespace(**vars(inputs), corners=triangles.corners, offsets=lists.offsets, covered=None)
    surfaces.faces = lists.items
    shaded = empty_outputs(SHADE, surfaces, band, requires_grad=False)
    shade_forward(surfaces, shaded, band)
    fragments = SimpleNamespace(
        rgba=shaded.rgba, depth=shaded.depth, thickness=shaded.thickness, offsets=lists.offsets, opacity_sum=None
    )
    own = {name: wp.empty_like(getattr(shaded, name)) for name in ("rgba", "depth", "thickness")}
    fragment_grads = SimpleNamespace(**own, opacity_sum=None)
    kbuffer_backward(fragments, grads, fragment_grads, KBufferOptions(band.slots, band.merge, band.tail))
    shade_backward(surfaces, fragment_grads, targets, band)


CAPTURE_KBUFFER = Operator(
    name="capture_kbuffer",
    inputs=SHADE.inputs,
    tables=(
        Input("faces", "N 3", None),
        *(each for each in SHADE.tables if each.name not in ("corners", "faces", "offsets", "covered")),
    ),
    outputs=LAYER_OUTPUTS,
    options=BoundedWindow,
    forward=_stream_triangles,
    backward=_backward,
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
        >>> wf.storage.capture_kbuffer(wf.load_scene("scenes/three_spheres.toml"), slots=4).depth.shape
        (512, 512, 4)
    """
    camera = check_scene(scene, camera)
    map_words = _check_options(slots, merge, tail, cull, words)
    surfaces = surfaces_of(scene, camera, parameters)
    with surfaces.in_order():
        return kbuffer_of_surfaces(
            surfaces,
            Window.of(surfaces.camera),
            memory_limit,
            slots=int(slots),
            merge=merge,
            tail=tail,
            map_words=map_words,
        )


def kbuffer_of_surfaces(
    surfaces: CameraSurfaces,
    window: Window,
    memory_limit: float | None,
    *,
    slots: int,
    merge: str,
    tail: str,
    map_words: int = 0,
) -> Layers:
    """Return the layers of surfaces in a window; arguments are those of `capture_kbuffer`, checked."""
    needed = kbuffer_bytes(window.pixel_count, slots, surfaces.number, map_words)
    allowed = allowed_memory(memory_limit, surfaces.device)
    if needed > allowed:
        refuse(needed, allowed, f"{slots} slots for each of {window.pixel_count} pixels")
    options = BoundedWindow(**asdict(window), slots=slots, merge=merge, tail=tail, map_words=map_words)
    outputs = apply(CAPTURE_KBUFFER, operator_arrays(surfaces), options)
    return as_layers(outputs, (window.row_count, window.width))


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
        >>> counts = wf.storage.count_culled(wf.load_scene("scenes/spheres_in_sphere.toml"), slots=2, cull="occupancy")
        >>> int(counts.occupancy.sum()), int(counts.fragments.sum())
        (76290, 357178)
    """
    camera = check_scene(scene, camera)
    map_words = _check_options(slots, merge, tail, cull, words)
    surfaces = surfaces_of(scene, camera, parameters)
    window = Window.of(surfaces.camera)
    options = BoundedWindow(**asdict(window), slots=int(slots), merge=merge, tail=tail, map_words=map_words)
    kind, arrays = surfaces.kind, operator_arrays(surfaces)
    for name in ("points", "rgba", "thickness", "maps"):
        arrays[name] = None if arrays[name] is None else kind.to_warp(arrays[name])
    inputs = SimpleNamespace(**arrays)
    outputs = empty_outputs(CAPTURE_KBUFFER, inputs, options, requires_grad=False)
    rows = wp.zeros((TALLY_ROWS, window.pixel_count), dtype=int, device=surfaces.device)
    _stream_triangles(inputs, outputs, options, rows)
    counts = rows.numpy().reshape(TALLY_ROWS, *camera.shape)
    return Culling(*(counts[int(row)] for row in (TALLY_ALL, TALLY_OCCUPANCY, TALLY_BEHIND)))


def _check_options(slots: Any, merge: Any, tail: Any, cull: Any, words: Any) -> int:
    """Check the options and return how many words an occupancy map has, 0 without."""
    check_kbuffer(slots, merge, tail)
    if cull is None:
        return 0
    check_choice("cull", cull, get_args(Cull))
    if merge != "none" or tail != "discard":
        raise ValueError(
            f'cull: got "{cull}" with merge="{merge}" and tail="{tail}", expected merge="none" and tail="discard" '
            "(else fragments behind the K nearest count as well)"
        )
    # A map of no more buckets than slots culls nothing.
    return check_whole("words", words, slots // 32 + 1)
