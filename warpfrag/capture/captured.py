"""A capture by any method of the papers, and what it took: passes, memory, time, and what the method has lost.

How fragments are found has no part in what they look like: shading and gradients are those of every capture.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
import warp as wp

from warpfrag.capture.coverage import store_coverage
from warpfrag.capture.memory import Budget, CaptureSizes
from warpfrag.capture.surfaces import CameraSurfaces, check_scene, surfaces_of
from warpfrag.fragments import Fragments
from warpfrag.raster.ray import Window
from warpfrag.raster.triangles import RasterTriangles
from warpfrag.scene.camera import Camera
from warpfrag.scene.parameters import Bounds
from warpfrag.scene.scene import Scene
from warpfrag.scene.visibility import warn_if_empty
from warpfrag.storage.equal_depths import largest_groups
from warpfrag.storage.method import PixelLists, Room, Stage, Storage, count_fragments
from warpfrag.storage.methods import METHODS, Counted, check_method, losses, paper_bytes, storage_of
from warpfrag.storage.request import Request


@dataclass(frozen=True, eq=False)
class Captured:
    """Fragments that a method has captured.

    Attributes:
        fragments: the fragments.
        method: the method.
        passes: passes over the geometry.
        seen: number of fragments that there are.
        captured: number of fragments that were captured.
        loses: what the method may lose; empty for nothing.
        bytes: memory of each buffer [bytes].
        formula: the memory that the method's paper says it takes, in words of 4 bytes a pixel; see
            `warpfrag.storage.methods`.
        paper_bytes: the same for this capture [bytes].
        seconds: time of each pass; that of a count includes finding where the lists begin.
        sort_seconds: time that sorting took, and putting lists in the order of their pixels.
        objects: number of objects that each pass was given.
    """

    fragments: Fragments
    method: str
    passes: int
    seen: int
    captured: int
    loses: str
    bytes: dict[str, int]
    formula: str
    paper_bytes: int
    seconds: tuple[float, ...]
    sort_seconds: float
    objects: tuple[int, ...]

    @property
    def robustness(self) -> float:
        """Share of the fragments that were captured, R_h; 1 where there are none."""
        return self.captured / self.seen if self.seen else 1.0

    @property
    def lost(self) -> int:
        """Number of fragments that were not captured."""
        return self.seen - self.captured

    def __repr__(self) -> str:
        lost = f", {self.lost} lost ({self.loses})" if self.lost else ""
        return f"Captured({self.captured} fragments by {self.method} in {self.passes} passes{lost})"


class Watch:
    """What is noted while a storage is filled.

    Attributes:
        seconds: time of each pass.
        objects: number of objects that each pass was given.
        arrays: buffers of the storage and of what it collects, by name.
    """

    def __init__(self, device: wp.Device, objects: Callable[[], int]):
        self.device, self._objects = device, objects
        self.seconds: list[float] = []
        self.objects: list[int] = []
        self.arrays: dict[str, wp.array] = {}
        self.start()

    def start(self) -> None:
        """Begin to time a pass."""
        wp.synchronize_device(self.device)
        self._begin, self._given = perf_counter(), self._objects()

    def end(self) -> None:
        """Note a pass."""
        self.seconds.append(self.elapsed())
        self.objects.append(self._given)

    def elapsed(self) -> float:
        """Return the time since a pass has begun, or since the last one."""
        wp.synchronize_device(self.device)
        return perf_counter() - self._begin

    def over(self, storage: Storage) -> Storage:
        """Return the same storage, watched."""

        def repeat(stage: Stage, arrays: Any, room: Room) -> bool:
            self.end()
            again = stage.repeat is not None and stage.repeat(arrays, room)
            self.start()
            return again

        def allocate(room: Room) -> Any:
            arrays = storage.allocate(room)
            if storage.counted:
                self.end()
            self.start()
            return arrays

        def collect(arrays: Any, room: Room) -> Any:
            lists = storage.collect(arrays, room)
            assert isinstance(lists, PixelLists)
            counts = {"counts": room.counts} if storage.counted else {}
            self.arrays = {**counts, **_arrays_of(arrays), **_named("lists", vars(lists))}
            return lists

        stages = tuple(replace(stage, repeat=partial(repeat, stage)) for stage in storage.stages)
        return replace(storage, allocate=allocate, stages=stages, collect=collect)

    def bytes(self) -> dict[str, int]:
        """Return the memory of each buffer, parts of others left out [bytes]."""
        found: dict[str, int] = {}
        taken: list[tuple[int, int]] = []
        for name, array in sorted(self.arrays.items(), key=lambda each: -each[1].capacity):
            begin, end = array.ptr or 0, (array.ptr or 0) + array.capacity
            if begin < end and not any(begin < other_end and other < end for other, other_end in taken):
                taken.append((begin, end))
                found[name] = array.size * wp.types.type_size_in_bytes(array.dtype)
        return found


class ObjectCulling:
    """Objects that are left out once every pixel has peeled them (geometry culling, peeling paper 3.3).

    An object is as far from the eye, along any ray, as the farthest of its vertices at most. Its triangles then get
    empty boxes of pixels, so that a pass has nothing to do with them.

    Args:
        triangles: the triangles, whose boxes will change.
        surfaces: what they are of.
    """

    def __init__(self, triangles: RasterTriangles, surfaces: CameraSurfaces):
        self._triangles = triangles
        self._object_of = surfaces.tables.object_id.numpy()
        self._boxes = triangles.boxes.numpy().reshape(-1, 4).copy()
        points = triangles.points.numpy().reshape(-1, 3).astype(np.float64)
        reach = np.linalg.norm(points, axis=1) if triangles.window.perspective else points[:, 2]
        # Depths are rounded once more than vertices.
        reach = reach * (1.0 + 4.0 * np.finfo(triangles.points.numpy().dtype).eps)
        count = len(surfaces.tables.first_face)
        self.left = np.full(count, True)
        self._farthest = np.full(count, -np.inf)
        corners = triangles.corners.numpy().reshape(-1, 3)
        np.maximum.at(self._farthest, self._object_of, reach[corners].max(axis=1, initial=-np.inf))

    def count(self) -> int:
        """Return the number of objects that are left."""
        return int(self.left.sum())

    def hide(self, peeled: np.ndarray) -> None:
        """Leave out what lies in front of where each pixel is peeled up to, (P,)."""
        window = self._triangles.window
        image = peeled.reshape(window.row_count, window.width)
        before = self.count()
        for item in np.flatnonzero(self.left):
            boxes = self._boxes[(self._object_of == item) & (self._boxes[:, 1] > self._boxes[:, 0])]
            if len(boxes):
                (top, _, left, _), (_, bottom, _, right) = boxes.min(axis=0), boxes.max(axis=0)
                self.left[item] = image[top:bottom, left:right].min(initial=np.inf) < self._farthest[item]
            else:
                self.left[item] = False
        if self.count() < before:
            self._boxes[~self.left[self._object_of]] = 0
            wp.copy(self._triangles.boxes, wp.array(self._boxes, dtype=int, device=self._triangles.device))


def capture(
    scene: Scene,
    camera: Camera | None = None,
    *,
    method: str = "dfb",
    sort: bool = True,
    parameters: Mapping[str, Any] | None = None,
    bounds: Bounds = "clamp",
    memory_limit: float | None = None,
    **options: Any,
) -> Captured:
    """Capture a scene by a method of the papers, and tell what that took.

    Methods, what each loses and which options it takes: `warpfrag.storage.methods`; options: `Options` in
    `warpfrag.storage.request`. Differentiable in all that `wf.capture` is, whatever the method; which fragments are
    captured is held fixed.

    Args:
        scene: what to capture.
        camera: where from; default the scene's.
        method: how to find the fragments.
        sort: see `wf.capture`, as all that follow; where not sorted, fragments are as submitted.
        parameters: values in place of the scene's own.
        bounds: what becomes of parameters out of their range.
        memory_limit: most memory that fragments, or the method's buffers, may take [bytes]; default half of what is
            free.
        options: those of the method.

    Raises:
        TypeError: an argument is of the wrong type, or an option is none of the method's.
        ValueError: an argument is out of its range, or does not go with another.
        MemoryError: it would take more memory than allowed; refused before that is allocated.

    Example:
        >>> captured = wf.storage.capture(wf.load_scene("scenes/coplanar_cubes.toml"), method="f2b")
        >>> captured.robustness < 1.0
        True
    """
    camera = check_scene(scene, camera)
    checked = check_method(method, options)
    surfaces = surfaces_of(scene, camera, parameters, bounds=bounds)
    with surfaces.in_order():
        window = Window.of(surfaces.camera)
        triangles = surfaces.triangles(window)
        culling = ObjectCulling(triangles, surfaces) if checked.cull_objects else None
        storage = storage_of(method, Request(checked, window.rays(), culling.hide if culling else None))
        watch = Watch(triangles.device, culling.count if culling else lambda: len(surfaces.tables.first_face))
        counts = count_fragments(triangles)
        if not storage.counted:
            watch.start()
        budget = Budget.of(CaptureSizes.of(triangles, surfaces), memory_limit, surfaces)
        seen = (scene, surfaces.camera, surfaces, triangles, counts, budget)
        coverage = store_coverage(*seen, sort=sort, storage=watch.over(storage))
        sort_seconds = watch.elapsed()
        fragments = coverage.shade_surfaces(surfaces, moved=False)
    per_pixel = counts.numpy()
    warn_if_empty(int(per_pixel.any()), scene, camera)
    return Captured(
        fragments,
        method,
        len(watch.seconds),
        int(per_pixel.sum(dtype=np.int64)),
        fragments.count,
        losses(method, checked),
        watch.bytes(),
        METHODS[method].formula,
        paper_bytes(method, checked, _counted(fragments, per_pixel), len(per_pixel)),
        tuple(watch.seconds),
        sort_seconds,
        tuple(watch.objects),
    )


def _counted(fragments: Fragments, per_pixel: np.ndarray) -> Counted:
    pixel_count = max(len(per_pixel), 1)
    groups = largest_groups(fragments.pixel, fragments.numpy().depth, len(per_pixel))
    return Counted(
        per_pixel.sum(dtype=np.int64) / pixel_count,
        int(per_pixel.max(initial=0)),
        np.count_nonzero(per_pixel) / pixel_count,
        groups.sum() / pixel_count,
    )


def _arrays_of(arrays: Any) -> dict[str, wp.array]:
    """Return the arrays of a structure and of the structures in it, by name."""
    found: dict[str, wp.array] = {}
    for name in arrays._cls.vars:
        value = getattr(arrays, name)
        if hasattr(value, "_cls"):
            found.update(_named(name, _arrays_of(value)))
        elif isinstance(value, wp.array):
            found[name] = value
    return found


def _named(name: str, arrays: Mapping[str, Any]) -> dict[str, wp.array]:
    return {f"{name}.{part}": array for part, array in arrays.items() if isinstance(array, wp.array)}
