"""A scene as fragments: what stands in camera space, and which of it each pixel sees."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.legacy import apply, dtype_name, kind_of
from warpfrag.capture.memory import allowed_memory, fixed_bytes, fragment_bytes, refuse
from warpfrag.capture.shade_adjoint import SHADE, SHADE_COVERED
from warpfrag.fragments import Fragments
from warpfrag.raster.ray import Window
from warpfrag.raster.triangles import (
    Triangles,
    count_fragments,
    prepare_triangles,
    scan_counts,
    sort_fragments,
    store_fragments,
)
from warpfrag.scene.assemble import Geometry, assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.pose import move_camera
from warpfrag.scene.scene import Scene


@dataclass(frozen=True)
class Surfaces:
    """All triangles of a scene, seen from a camera: what `shade` interpolates, as arrays of one kind, on one device.

    Attributes:
        points: camera space [scene units], (V, 3); rgba (V, 4) straight, thickness (V,), maps (maps, H·W) or None.
        faces: indices into `points`, (N, 3) int32.
        tables: the index arrays and textures that `shade` takes after `offsets`.
    """

    points: Any
    rgba: Any
    thickness: Any
    maps: Any
    faces: wp.array
    tables: tuple[Any, ...]

    @property
    def differentiable(self) -> bool:
        """Whether torch records gradients in any of the arrays."""
        arrays = [a for a in (self.points, self.rgba, self.thickness, self.maps) if a is not None]
        if kind_of(self.points) != "torch" or not any(array.requires_grad for array in arrays):
            return False
        import torch

        return torch.is_grad_enabled()

    def triangles(self, window: Window) -> Triangles:
        """Return the triangles as rasterising takes them."""
        return prepare_triangles(to_warp(self.points), self.faces, window)

    def stream(self) -> AbstractContextManager[Any]:
        """Return a context in which kernels run in order with torch's own work on the device."""
        if kind_of(self.points) != "torch" or self.points.device.type != "cuda":
            return nullcontext()
        import torch

        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.points.device)))


def place_surfaces(geometry: Geometry, camera: Camera) -> Surfaces:
    """Take a scene's geometry from world to camera space, and its tables to the device of its arrays."""
    device = wp.get_device(str(geometry.vertices.device)) if kind_of(geometry.vertices) == "torch" else "cpu"
    mapped = sorted(geometry.thickness_maps)
    # One map for all objects is there once.
    distinct = list({id(geometry.thickness_maps[item]): geometry.thickness_maps[item] for item in mapped}.values())
    rows = {id(each): row for row, each in enumerate(distinct)}
    maps = None
    if mapped:
        maps = _namespace(geometry.vertices).stack(distinct).reshape((len(distinct), camera.shape[0] * camera.shape[1]))
    objects = np.full((len(geometry.thickness_in_p), 3), -1, np.int32)
    objects[:, 0] = geometry.first_face[:-1]
    objects[mapped, 1] = [rows[id(geometry.thickness_maps[item])] for item in mapped]
    objects[:, 2] = geometry.thickness_in_p
    tables: list[Any] = [geometry.object_id, objects, None, None, None, None]
    if geometry.uv is not None and len(geometry.textures):
        sizes = np.array([image.shape[:2] for image in geometry.textures], np.int32)
        begins = np.cumsum([0, *(len(image) * image.shape[1] for image in geometry.textures)])[:-1]
        texels = np.concatenate([image.reshape(-1, 4) for image in geometry.textures]).astype(np.float32)
        tables[2:] = geometry.uv, geometry.texture_id, texels, np.column_stack([begins, sizes]).astype(np.int32)
    return Surfaces(
        points=to_camera_space(geometry.vertices, camera, geometry.camera_pose, geometry.precision),
        rgba=geometry.rgba,
        thickness=geometry.thickness,
        maps=maps,
        faces=_on_device(geometry.faces, device),
        tables=tuple(as_kind(_on_device(table, device), geometry.vertices) for table in tables),
    )


def to_camera_space(
    vertices: Any, camera: Camera, pose: tuple[Any, Any] | None = None, precision: str | None = None
) -> Any:
    """Return world vertices in camera space, computed in float64 whatever their precision; differentiable in torch.

    Component by component, so that NumPy and torch round alike.

    Args:
        vertices: world space [scene units], (V, 3), NumPy or torch.
        camera: where from.
        pose: translation and rotation of the camera in its own axes, see `warpfrag.scene.pose`; None where it stays.
        precision: of the result; None takes that of the vertices.
    """
    view = camera.view_matrix()
    xp = _namespace(vertices)
    double = vertices.astype(np.float64) if xp is np else vertices.double()
    x, y, z = double[:, 0], double[:, 1], double[:, 2]
    # Python's own floats: torch would turn NumPy's into arrays.
    rows = [[float(value) for value in row] for row in view[:3]]
    coordinates = [row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows]
    points = xp.stack(coordinates if pose is None else move_camera(coordinates, *pose), 1)
    precision = precision or dtype_name(vertices)
    return points.astype(precision) if xp is np else points.to(getattr(xp, precision))


def count_within(surfaces: Surfaces, window: Window, memory_limit: float | None) -> tuple[Triangles, wp.array, int]:
    """Return the triangles of some rows, where each pixel's fragments begin, and how many there are.

    Raises:
        MemoryError: there are more than the limit allows.
    """
    triangles = surfaces.triangles(window)
    allowed = allowed_memory(memory_limit, triangles.device)
    starts, total = scan_counts(count_fragments(triangles))
    gradient = surfaces.differentiable
    needed = fixed_bytes(triangles, gradient) + total * fragment_bytes(triangles.points.dtype, gradient)
    if needed > allowed:
        refuse(needed, allowed, f"{total} fragments")
    return triangles, starts, total


def faces_of_fragments(triangles: Triangles, starts: wp.array, total: int, sort: bool) -> wp.array:
    """Store and sort what `scan_counts` has counted, as the triangle of each fragment; turns `starts` into offsets."""
    faces, depths = store_fragments(triangles, starts, total, sort)
    sort_fragments(starts, faces, depths)
    return faces


def shade_fragments(
    surfaces: Surfaces,
    window: Window,
    corners: wp.array,
    faces: wp.array,
    offsets: wp.array,
    covered: wp.array | None = None,
) -> Fragments:
    """Shade fragments whose triangles are known.

    Args:
        surfaces: what to interpolate.
        window: the pixels.
        corners: of each triangle, in the order in which `prepare_triangles` put them, (N, 3) int32.
        faces: triangle of each fragment, (F,) int32.
        offsets: see `Fragments`.
        covered: where the vertices were when coverage was found, (V, 3) float64, if not where they are now.
    """
    like = surfaces.points
    own_offsets = as_kind(offsets, like)
    inputs = (
        *(like, surfaces.rgba, surfaces.thickness, surfaces.maps),
        *(as_kind(corners, like), as_kind(faces, like), own_offsets, *surfaces.tables),
    )
    options = asdict(window)
    if covered is None:
        outputs = apply(SHADE, inputs, **options)
    else:
        outputs = apply(SHADE_COVERED, (*inputs, as_kind(covered, like)), **options)
    rgba, depth, thickness, object_id, primitive_id = outputs
    shape = (window.row_count, window.width)
    return Fragments(rgba, depth, thickness, own_offsets, shape, object_id=object_id, primitive_id=primitive_id)


def fragments_of_rows(surfaces: Surfaces, triangles: Triangles, starts: wp.array, total: int, sort: bool) -> Fragments:
    """Store, sort and shade what `scan_counts` has counted; turns `starts` into offsets."""
    faces = faces_of_fragments(triangles, starts, total, sort)
    return shade_fragments(surfaces, triangles.window, triangles.corners, faces, starts)


def capture(
    scene: Scene,
    camera: Camera | None = None,
    sort: bool = True,
    *,
    parameters: Mapping[str, Any] | None = None,
    rows: tuple[int, int] | None = None,
    memory_limit: float | None = None,
) -> Fragments:
    """Capture every surface that a pixel's ray meets as a fragment (the dynamic fragment buffer).

    A triangle covers a pixel if the pixel's centre lies in its projection: by the top-left rule on edges, from both
    sides, between the near and far planes. Differentiable in vertices, translations and rotations of objects and
    camera, colour, opacity and thickness; which pixels a triangle covers, the order of the fragments, the texels that a
    lookup takes and the baked Lambert factors are held fixed: a gradient in vertices or poses moves depths and
    attributes inside outlines, not the outlines.

    Args:
        scene: what to capture.
        camera: where from; default the scene's.
        sort: order of a pixel's fragments: by (depth, object, primitive), or as submitted, by (object, primitive).
        parameters: values in place of the scene's own, by the names of `scene.parameters()`: numbers, NumPy arrays, or
            torch tensors, in which the fragments are then differentiable. `"thickness"` is that of all objects without
            a value of their own here. `"beta"` is not used here.
        rows: capture only these rows [begin, end) of the image; default all.
        memory_limit: most memory that fragments and their gradients may take [bytes]; default half of what is free.

    Returns:
        Fragments of shape (H, W), or (end - begin, W), with object and primitive ids; torch tensors if any parameter is
        one, else NumPy arrays; float64 if any parameter is an array of that, else float32.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range.
        MemoryError: there would be more fragments than the limit allows; nothing has been stored yet.

    Example:
        >>> wf.capture(wf.load_scene("scenes/three_spheres.toml")).shape
        (512, 512)
    """
    camera = check_scene(scene, camera)
    window = Window.of(camera, _check_rows(rows, camera))
    surfaces = place_surfaces(assemble(scene, parameters, camera=camera), camera)
    with surfaces.stream():
        return fragments_of_rows(surfaces, *count_within(surfaces, window, memory_limit), sort)


def check_scene(scene: Any, camera: Any) -> Camera:
    """Return the camera to use, once both arguments are checked."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: got {type(scene).__name__}, expected a Scene (load_scene reads one from a file)")
    if camera is not None and not isinstance(camera, Camera):
        raise TypeError(f"camera: got {type(camera).__name__}, expected a Camera")
    return camera or scene.camera


def _check_rows(rows: Any, camera: Camera) -> tuple[int, int]:
    height = camera.shape[0]
    if rows is None:
        return 0, height
    begin, end = rows
    if not all(isinstance(row, (int, np.integer)) for row in (begin, end)) or not 0 <= begin <= end <= height:
        raise ValueError(f"rows: got {rows!r}, expected whole numbers (begin, end) with 0 <= begin <= end <= {height}")
    return int(begin), int(end)


def _namespace(array: Any) -> Any:
    if kind_of(array) == "torch":
        import torch

        return torch
    return np


def _on_device(table: np.ndarray | None, device: Any) -> wp.array | None:
    return None if table is None else wp.array(np.ascontiguousarray(table), device=device, copy=False)


def as_kind(array: wp.array | None, like: Any) -> Any:
    """Return a Warp array as the kind of another one, sharing its memory."""
    if array is None:
        return None
    return wp.to_torch(array) if kind_of(like) == "torch" else array.numpy()


def to_warp(array: Any) -> wp.array:
    """Return a NumPy array or torch tensor as a Warp array, sharing its memory where it is contiguous."""
    if kind_of(array) == "torch":
        return wp.from_torch(array.detach().contiguous())
    return wp.array(np.ascontiguousarray(array), device="cpu", copy=False)
