"""Coverage: which triangles each pixel sees, in which order, held fixed while what they look like changes.

`capture` is both halves at once, what is seen and what it looks like.

    coverage = Coverage.of(scene)
    fragments = coverage.shade({"ball.translation": torch.tensor([0.0, 0.0, 0.1])})

Geometry may move too: a fragment then stays where its pixel's ray meets the plane of its triangle, with barycentric
coordinates that reach outside 0 … 1 (extrapolated) if the triangle no longer covers the pixel. That is the function
whose gradient `capture` gives: near the parameters at which coverage was found both agree, up to what crosses an edge
or changes its place in the order.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.apply import apply
from warpfrag.arrays.devices import check_device
from warpfrag.arrays.kinds import WARP, dtype_name, kind_of
from warpfrag.arrays.launch import launch
from warpfrag.arrays.warp_calls import call_with_warp, named_values
from warpfrag.capture.batch import check_views, stack_fragments
from warpfrag.capture.memory import Budget, CaptureSizes
from warpfrag.capture.motions import motion_bwd
from warpfrag.capture.shade import SHADE, shaded_gradients
from warpfrag.capture.surfaces import (
    CameraSurfaces,
    SurfaceTables,
    check_scene,
    surface_arrays,
    surfaces_of,
)
from warpfrag.errors import is_whole
from warpfrag.fragments import Fragments
from warpfrag.raster.ray import Window
from warpfrag.raster.triangles import RasterTriangles
from warpfrag.scene.camera import Camera
from warpfrag.scene.parameters import Bounds
from warpfrag.scene.scene import Scene
from warpfrag.scene.visibility import warn_if_empty
from warpfrag.storage.lists import DYNAMIC, sort_lists
from warpfrag.storage.method import Room, Storage, count_fragments, fill, total_of
from warpfrag.storage.methods import METHODS, check_method, storage_of
from warpfrag.storage.request import Request


@dataclass(frozen=True, eq=False)
class Coverage:
    """Which triangles each pixel of an image, or of some of its rows, sees, in order.

    Attributes:
        scene: the scene.
        camera: where from.
        window: the pixels.
        corners: vertices of each triangle, (N, 3) int32 Warp array.
        faces: triangle of each fragment, (F,) int32 Warp array.
        offsets: pixel p sees the fragments offsets[p] : offsets[p + 1], (P + 1,) int32 Warp array.
        points: where the vertices were, in camera space [scene units], (V, 3) Warp array.
        tables: what of the scene's surfaces no parameter changes.

    Example:
        >>> coverage = Coverage.of(wf.load_scene("scenes/three_spheres.toml"))
        >>> coverage.shade({"thickness": 0.5}).shape
        (512, 512)
    """

    scene: Scene
    camera: Camera
    window: Window
    corners: wp.array
    faces: wp.array
    offsets: wp.array
    points: wp.array
    tables: SurfaceTables

    @staticmethod
    def of(
        scene: Scene,
        camera: Camera | None = None,
        *,
        parameters: Mapping[str, Any] | None = None,
        sort: bool = True,
        method: str = "dfb",
        memory_limit: float | None = None,
    ) -> "Coverage":
        """Find out which triangles each pixel sees.

        Args:
            scene: what to capture.
            camera: where from; default the scene's.
            parameters: as for `capture`; gradients are not recorded. Arrays lie on the device of the tensors.
            sort: order of a pixel's fragments: by depth, or as submitted.
            method: as for `capture`.
            memory_limit: as for `capture`.

        Raises:
            TypeError: an argument is of the wrong type.
            ValueError: an argument is out of its range.
            MemoryError: there would be more fragments than the limit allows; nothing has been stored yet.
        """
        camera = check_scene(scene, camera)
        surfaces = surfaces_of(scene, camera, parameters)
        with surfaces.in_order():
            window = Window.of(surfaces.camera)
            seen = (scene, surfaces.camera, surfaces, window)
            return find_coverage(*seen, sort=sort, method=method, memory_limit=memory_limit)

    @property
    def count(self) -> int:
        """Number of fragments, F."""
        return self.faces.shape[0]

    def shade(self, parameters: Mapping[str, Any] | None = None) -> Fragments:
        """Shade the fragments for parameter values; at those of `of` the result is that of `capture`, to the bit.

        Differentiable in all that `capture` is. Opacity and z-thickness that extrapolation takes out of their ranges
        are clamped, and have no gradient there.

        Args:
            parameters: as for `capture`.

        Returns:
            Fragments of shape (H, W), of the kind and precision that `capture` would give.

        Raises:
            TypeError: an argument is of the wrong type.
            ValueError: an argument is out of its range.
        """
        surfaces = surfaces_of(self.scene, self.camera, parameters, self.tables)
        if surfaces.camera != self.camera:
            raise ValueError("parameters: got another lens than coverage was found with, expected the same")
        with surfaces.in_order():
            return self.to(surfaces.device).shade_surfaces(surfaces)

    def shade_surfaces(self, surfaces: CameraSurfaces, *, moved: bool = True) -> Fragments:
        """Shade the fragments by surfaces on the same device; `moved` unless coverage was found with these."""
        inputs = {name: getattr(surfaces, name) for name in ("points", "rgba", "thickness", "maps", "objects")}
        tables = {name: getattr(self.tables, name) for name in ("object_id", "uv", "texture_id", "texels", "textures")}
        found = {"corners": self.corners, "faces": self.faces, "offsets": self.offsets}
        covered = self.points if moved else None
        shaded = apply(SHADE, {**inputs, **tables, **found, "covered": covered}, self.window)
        offsets = surfaces.kind.from_warp(self.offsets)
        return Fragments(**vars(shaded), offsets=offsets, shape=(self.window.row_count, self.window.width))

    def is_of(self, surfaces: CameraSurfaces) -> bool:
        """Tell whether surfaces of this scene and camera have the vertices that coverage was found with, to the bit."""
        points = surfaces.kind.to_warp(surfaces.points)
        alike = surfaces.camera == self.camera and points.dtype == self.points.dtype
        return alike and np.array_equal(points.numpy(), self.points.numpy())

    def to(self, device: wp.Device) -> "Coverage":
        """Return the same coverage on a device, itself if it is there."""
        if self.faces.device == device:
            return self
        moved = {name: value.to(device) for name, value in vars(self).items() if isinstance(value, wp.array)}
        return replace(self, **moved, tables=self.tables.to(device))

    def motion_gradients(
        self, parameters: Mapping[str, Any] | None, grad_rgba: Any, grad_depth: Any, grad_thickness: Any
    ) -> np.ndarray:
        """Return the derivatives of all fragments in rigid motions of their surfaces.

        For gradients g_i in the corners p_i of a fragment's triangle, in camera space, these are the force Σ g_i, the
        derivative in a translation, and the torque Σ p_i × g_i, that in a rotation about the camera's eye. Times
        `warpfrag.scene.pose.pose_matrix` they are the derivatives in an object's or the camera's pose.

        Args:
            parameters: values at which to differentiate, as for `shade`.
            grad_rgba: gradient in the fragments' colour and opacity, (F, 4): NumPy array, Warp array or torch tensor;
                None for zeros.
            grad_depth: gradient in their depth, (F,), or None.
            grad_thickness: gradient in their z-thickness, (F,), or None.

        Returns:
            Force [1 / scene unit] and torque [1 / radian] of each fragment, (F, 6) float64.

        Raises:
            TypeError: an argument is of the wrong type.
            ValueError: an argument has the wrong shape or is out of its range.
        """
        surfaces = surfaces_of(self.scene, self.camera, parameters, self.tables)
        with surfaces.in_order():
            here, number = self.to(surfaces.device), surfaces.number
            grads = SimpleNamespace(
                rgba=_cotangent("grad_rgba", grad_rgba, (self.count, 4), surfaces),
                depth=_cotangent("grad_depth", grad_depth, (self.count,), surfaces),
                thickness=_cotangent("grad_thickness", grad_thickness, (self.count,), surfaces),
            )
            motions = wp.empty((self.count, 2), dtype=wp.vec3d, device=surfaces.device)
            if self.count:
                arrays = {name: getattr(surfaces, name) for name in ("points", "rgba", "thickness", "maps")}
                shared = {name: None if a is None else surfaces.kind.to_warp(a) for name, a in arrays.items()}
                own = {"corners": here.corners, "objects": surfaces.objects, **shared}
                surface = surface_arrays({**vars(here.tables), **own}, self.window)
                inputs = [surface, here.faces, here.offsets, shaded_gradients(number, grads), motions]
                launch(motion_bwd(number), self.window.pixel_count, inputs, surfaces.device)
            return motions.numpy().reshape(self.count, 6)


def find_coverage(
    scene: Scene,
    camera: Camera,
    surfaces: CameraSurfaces,
    window: Window,
    *,
    sort: bool,
    method: str = "dfb",
    memory_limit: float | None,
) -> Coverage:
    """Find out which of the surfaces the pixels of a window see; arguments are those of `Coverage.of`."""
    storage = storage_of(method, Request(check_method(method, {}), window.rays()))
    triangles = surfaces.triangles(window)
    budget, counts = Budget.of(CaptureSizes.of(triangles, surfaces), memory_limit, surfaces), count_fragments(triangles)
    coverage = store_coverage(scene, camera, surfaces, triangles, counts, budget, sort=sort, storage=storage)
    if storage.loses and coverage.count < (seen := total_of(counts)):
        warnings.warn(
            f"method: {method} captured {coverage.count} of {seen} fragments; it loses {METHODS[method].loses}",
            stacklevel=3,
        )
    return coverage


def store_coverage(
    scene: Scene,
    camera: Camera,
    surfaces: CameraSurfaces,
    triangles: RasterTriangles,
    counts: wp.array,
    budget: Budget,
    *,
    sort: bool,
    storage: Storage = DYNAMIC,
) -> Coverage:
    """Store which triangles the pixels of a window see.

    Args:
        scene: the scene.
        camera: where from.
        surfaces: its surfaces.
        triangles: these as rasterising takes them.
        counts: number of fragments of each pixel, (P,) int32.
        budget: what may be taken.
        sort: order of a pixel's fragments: by depth, or as submitted.
        storage: how to store them.

    Raises:
        MemoryError: there would be more fragments than the budget allows.
    """

    def reserve(storage_bytes: int, what: str, fragment_count: int) -> None:
        budget.check(fragment_count, counts.shape[0], what, storage_bytes)

    room = Room(counts.shape[0], triangles.points.dtype, triangles.device, reserve, sort, counts)
    lists = fill(storage, triangles, room)
    sort_lists(lists)
    found = (triangles.corners, lists.items, lists.offsets, triangles.points)
    return Coverage(scene, camera, triangles.window, *found, surfaces.tables)


def capture(
    scene: Scene,
    camera: Camera | Sequence[Camera] | None = None,
    sort: bool = True,
    *,
    method: str = "dfb",
    parameters: Mapping[str, Any] | None = None,
    rows: tuple[int, int] | None = None,
    bounds: Bounds = "clamp",
    memory_limit: float | None = None,
    device: Any = None,
) -> Fragments:
    """Capture every surface that a pixel's ray meets as a fragment.

    A triangle covers a pixel if the pixel's centre lies in its projection: by the top-left rule on edges, from both
    sides, between the near and far planes. Differentiable in vertices, translations and rotations of objects and
    camera, colour, opacity and thickness; which pixels a triangle covers, the order of the fragments, the texels that a
    lookup takes and the factors of light are held fixed: a gradient in vertices or poses moves depths and
    attributes inside outlines, not the outlines.

    Args:
        scene: what to capture.
        camera: where from; default the scene's. Several, of one size, give fragments of shape (N, H, W).
        sort: order of a pixel's fragments: by (depth, object, primitive), or as submitted, by (object, primitive).
        method: how to find the fragments, one of `warpfrag.storage.methods` with its own defaults; default the dynamic
            fragment buffer. A warning tells how many fragments a method has lost; `wf.storage.capture` tells more.
        parameters: values in place of the scene's own, by the names of `scene.parameters()`: numbers, NumPy arrays,
            torch tensors or Warp arrays, in which the fragments are then differentiable (Warp arrays on an active tape,
            which takes torch). `"thickness"` is that of all objects without a value of their own here. `"beta"` is not
            used here.
        rows: capture only these rows [begin, end) of the image; default all.
        bounds: what becomes of parameters out of their range: "clamp" puts them on its end, with a gradient that leads
            back in but not farther out; "error" refuses them.
        memory_limit: most memory that fragments and their gradients may take [bytes]; default half of what is free.
        device: where to compute, "cpu", "cuda" or "cuda:<number>"; default that of the arrays among the parameters, or
            else "cpu".

    Returns:
        Fragments of shape (H, W), or (end - begin, W), with object and primitive ids; torch tensors or Warp arrays if
        any parameter is one, else NumPy arrays; float64 if any parameter is an array of that, else float32.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range.
        MemoryError: there would be more fragments than the limit allows; nothing has been stored yet.

    Example:
        >>> wf.capture(wf.load_scene("scenes/three_spheres.toml")).shape
        (512, 512)
    """
    views, several = check_views(scene, camera)
    checked_rows = _check_rows(rows, views[0])

    def shade(values: Mapping[str, Any], place: str | None) -> Fragments:
        found = []
        for view in views:
            surfaces = surfaces_of(scene, view, values, bounds=bounds, device=place)
            window = Window.of(surfaces.camera, checked_rows)
            with surfaces.in_order():
                seen = (scene, surfaces.camera, surfaces, window)
                coverage = find_coverage(*seen, sort=sort, method=method, memory_limit=memory_limit)
                if rows is None:
                    warn_if_empty(coverage.count, scene, view)
                found.append(surfaces.given(coverage.shade_surfaces(surfaces, moved=False)))
        return stack_fragments(found) if several else found[0]

    return call_with_warp(shade, named_values(parameters), scene.value_shapes(), check_device(device))


def _check_rows(rows: Any, camera: Camera) -> tuple[int, int]:
    height = camera.shape[0]
    if rows is None:
        return 0, height
    begin, end = rows
    if not all(map(is_whole, (begin, end))) or not 0 <= begin <= end <= height:
        raise ValueError(f"rows: got {rows!r}, expected whole numbers (begin, end) with 0 <= begin <= end <= {height}")
    return int(begin), int(end)


def _cotangent(name: str, grad: Any, shape: tuple[int, ...], surfaces: CameraSurfaces) -> wp.array | None:
    """Return a gradient as a Warp array in the precision and on the device of surfaces; None stays."""
    if grad is None:
        return None
    kind = kind_of(grad)
    if kind is None or dtype_name(grad) not in ("float32", "float64"):
        got = type(grad).__name__ if kind is None else dtype_name(grad)
        raise TypeError(f"{name}: got {got}, expected a NumPy array, wp.array or torch.Tensor of floats")
    if tuple(grad.shape) != shape:
        raise ValueError(f"{name}: got shape {tuple(grad.shape)}, expected {shape}")
    return WARP.astype(kind.to_warp(grad), dtype_name(surfaces.points)).to(surfaces.device)
