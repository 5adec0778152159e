"""The surfaces of a scene as a camera sees them: what triangles are found and shaded by.

World space is taken to camera space in float64 and rounded once, to the precision of the image.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.kinds import NUMPY, WARP, Kind, as_vectors, dtype_name, kind_of
from warpfrag.arrays.precisions import Array, Array2, Number, Vector3, Vector4, in_precisions
from warpfrag.raster.ray import Rays, Window
from warpfrag.raster.triangles import RasterTriangles, prepare_triangles
from warpfrag.scene.assemble import Geometry, assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.lens import Lens
from warpfrag.scene.parameters import Bounds
from warpfrag.scene.pose import move_camera
from warpfrag.scene.scene import Scene

# Columns of the table of objects.
OBJECT_FIRST_FACE = wp.constant(0)
OBJECT_MAP = wp.constant(1)
OBJECT_IN_P = wp.constant(2)


@in_precisions
class SurfaceArrays:
    """Surfaces seen through the rays of an image, as kernels take them; what there is not is empty.

    By vertex: `points` in camera space [scene units], `rgba` straight, `thickness` [scene units or multiples of P],
    `uv` texture coordinates. By triangle: `corners` (vertices), `object_id`, `texture_id`. By object: `objects` (first
    triangle, thickness map or -1, whether thickness is in multiples of P). `maps`: thickness by map and pixel of the
    whole image. `texels`: all textures one after the other; `textures` (first texel, height, width).
    """

    rays: Rays
    points: Array[Vector3]
    rgba: Array[Vector4]
    thickness: Array[Number]
    maps: Array2[Number]
    corners: Array[wp.vec3i]
    object_id: Array[wp.int32]
    objects: Array[wp.vec3i]
    uv: Array[wp.vec2f]
    texture_id: Array[wp.int32]
    texels: Array[wp.vec4f]
    textures: Array[wp.vec3i]


_VECTORS = ("points", "rgba", "corners", "objects", "uv", "texels", "textures")


def surface_arrays(arrays: Mapping[str, Any], window: Window) -> Any:
    """Return surfaces, Warp arrays by the names of `SurfaceArrays`, as kernels take them; None stays empty."""
    structure = SurfaceArrays[arrays["points"].dtype]
    surface = structure()
    surface.rays = window.rays()
    for name in structure.vars:
        array = arrays.get(name)
        if array is not None:
            setattr(surface, name, as_vectors(array) if name in _VECTORS else array)
    return surface


@dataclass(frozen=True, eq=False)
class SurfaceTables:
    """What of a scene's surfaces no parameter changes, as Warp arrays on one device; see `SurfaceArrays`.

    Attributes:
        faces: vertices of each triangle as the scene has them, (N, 3) int32.
        object_id: (N,) int32.
        first_face: first triangle of each object, (objects,) int32, NumPy.
        in_p: whether an object's thickness is in multiples of P, (objects,) bool, NumPy.
        uv: (V, 2) float32; this and all that follows None where nothing is textured.
        texture_id: (N,) int32.
        texels: (texels, 4) float32.
        textures: (images, 3) int32.
    """

    faces: wp.array
    object_id: wp.array
    first_face: np.ndarray
    in_p: np.ndarray
    uv: wp.array | None = None
    texture_id: wp.array | None = None
    texels: wp.array | None = None
    textures: wp.array | None = None

    @staticmethod
    def of(geometry: Geometry, device: Any) -> "SurfaceTables":
        """Return the tables of a scene's geometry on a device."""

        def table(array: np.ndarray) -> wp.array:
            return wp.array(np.ascontiguousarray(array), device=device, copy=False)

        textured: dict[str, wp.array] = {}
        if geometry.uv is not None and len(geometry.textures):
            sizes = np.array([image.shape[:2] for image in geometry.textures], np.int32)
            begins = np.cumsum([0, *(len(image) * image.shape[1] for image in geometry.textures)])[:-1]
            texels = np.concatenate([image.reshape(-1, 4) for image in geometry.textures]).astype(np.float32)
            textured = {
                "uv": table(geometry.uv),
                "texture_id": table(geometry.texture_id),
                "texels": table(texels),
                "textures": table(np.column_stack([begins, sizes]).astype(np.int32)),
            }
        return SurfaceTables(
            table(geometry.faces),
            table(geometry.object_id),
            geometry.first_face[:-1],
            geometry.thickness_in_p,
            **textured,
        )

    @property
    def device(self) -> wp.Device:
        """Where the arrays are."""
        return self.faces.device

    def to(self, device: wp.Device) -> "SurfaceTables":
        """Return the same tables on a device."""
        moved = {name: value.to(device) for name, value in vars(self).items() if isinstance(value, wp.array)}
        return replace(self, **moved)

    def objects(self, map_rows: np.ndarray) -> wp.array:
        """Return the table of objects, given the thickness map of each or -1, (objects, 3) int32."""
        table = np.column_stack([self.first_face, map_rows, self.in_p]).astype(np.int32)
        return wp.array(table, shape=(len(table), 3), dtype=int, device=self.device)


@dataclass(frozen=True, eq=False)
class CameraSurfaces:
    """All surfaces of a scene, seen from a camera: arrays of one kind, on one device, and the scene's tables.

    Attributes:
        points: camera space [scene units], (V, 3).
        rgba: straight colour and opacity, (V, 4).
        thickness: [scene units or multiples of P], (V,).
        maps: thickness maps, (maps, H·W), or None.
        objects: table of objects, (objects, 3) int32, Warp array.
        tables: what no parameter changes.
        camera: the one that sees them, with the lens that parameters give it.
    """

    points: Any
    rgba: Any
    thickness: Any
    maps: Any
    objects: wp.array
    tables: SurfaceTables
    camera: Camera

    @property
    def kind(self) -> Kind:
        """The kind of the arrays."""
        kind = kind_of(self.points)
        assert kind is not None
        return kind

    @property
    def device(self) -> wp.Device:
        """Where the arrays are."""
        return self.tables.device

    @property
    def number(self) -> Any:
        """Warp type of the arrays' numbers."""
        return getattr(wp, dtype_name(self.points))

    @property
    def differentiable(self) -> bool:
        """Whether gradients are recorded in any of the arrays."""
        return self.kind.records((self.points, self.rgba, self.thickness, self.maps))

    def triangles(self, window: Window) -> RasterTriangles:
        """Return the triangles as rasterising takes them."""
        return prepare_triangles(self.kind.to_warp(self.points), self.tables.faces, window)

    def given(self, result: Any) -> Any:
        """Return arrays made of these, or fragments or layers, as they are given away: Warp arrays become NumPy's."""
        if self.kind is not WARP:
            return result
        return result.numpy()

    def in_order(self) -> AbstractContextManager[Any]:
        """Return a context in which kernels run in order with the array library's own work on the device."""
        return self.kind.in_order(self.points)


def check_scene(scene: Any, camera: Any) -> Camera:
    """Return the camera to use, once both arguments are checked."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: got {type(scene).__name__}, expected a Scene (load_scene reads one from a file)")
    if camera is not None and not isinstance(camera, Camera):
        raise TypeError(f"camera: got {type(camera).__name__}, expected a Camera")
    return camera or scene.camera


def surfaces_of(
    scene: Scene,
    camera: Camera,
    parameters: Mapping[str, Any] | None = None,
    tables: SurfaceTables | None = None,
    *,
    bounds: Bounds = "clamp",
    device: str | None = None,
) -> CameraSurfaces:
    """Return a scene's surfaces for parameter values; `tables` are those of the scene, if there are any yet."""
    return place_surfaces(assemble(scene, parameters, camera=camera, bounds=bounds), tables, device)


def place_surfaces(
    geometry: Geometry, tables: SurfaceTables | None = None, device_name: str | None = None
) -> CameraSurfaces:
    """Take a scene's geometry from world to camera space, and its tables to the device of its arrays.

    Args:
        geometry: the scene's.
        tables: those of the scene, if there are any yet.
        device_name: where surfaces are to be; None for where the arrays are. NumPy's go there as Warp arrays.

    Raises:
        ValueError: the arrays are on another device.
    """
    kind, camera = kind_of(geometry.rgba), geometry.camera
    assert kind is not None
    place = kind.device_of(geometry.rgba)
    device = wp.get_device(str(place or device_name or "cpu"))
    if device_name is not None and wp.get_device(device_name) != device:
        raise ValueError(f'device: got "{device_name}", expected {place} like the parameters')
    if tables is None or tables.device != device:
        tables = SurfaceTables.of(geometry, device)
    distinct: list[Any] = []
    map_rows = np.full(len(geometry.thickness_in_p), -1, np.int32)
    for item, thickness_map in geometry.thickness_maps.items():
        # A map that all objects share is there once.
        shared = [row for row, other in enumerate(distinct) if other is thickness_map]
        map_rows[item] = shared[0] if shared else len(distinct)
        if not shared:
            distinct.append(thickness_map)
    maps = None
    if distinct:
        maps = kind.xp.stack(distinct).reshape((len(distinct), camera.shape[0] * camera.shape[1]))
    points = to_camera_space(geometry.vertices, camera, geometry.camera_pose, geometry.precision, geometry.lens)
    rgba, thickness = geometry.rgba, geometry.thickness
    if kind is NUMPY and not is_host(device):
        points, rgba, thickness = (wp.array(array, device=device) for array in (points, rgba, thickness))
        maps = None if maps is None else wp.array(maps, device=device)
    return CameraSurfaces(points, rgba, thickness, maps, tables.objects(map_rows), tables, camera)


def is_host(device: wp.Device) -> bool:
    """Tell whether NumPy's arrays are on a device."""
    return device.is_cpu


def to_camera_space(
    vertices: Any,
    camera: Camera,
    pose: tuple[Any, Any] | None = None,
    precision: str = "float32",
    lens: Lens | None = None,
) -> Any:
    """Return world vertices in camera space, computed in float64 and rounded once; differentiable in torch.

    Component by component, so that NumPy and torch round alike.

    Args:
        vertices: world space [scene units], (V, 3), NumPy or torch.
        camera: where from.
        pose: translation and rotation of the camera in its own axes, see `warpfrag.scene.pose`; None where it stays.
        precision: that of the result, "float32" or "float64".
        lens: how points move with the parameters of the camera's lens; None for not at all.
    """
    kind = kind_of(vertices)
    assert kind is not None
    double = kind.astype(vertices, "float64")
    x, y, z = double[:, 0], double[:, 1], double[:, 2]
    # Python's own floats: torch would turn NumPy's into arrays.
    rows = [[float(value) for value in row] for row in camera.view_matrix()[:3]]
    coordinates = [row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows]
    if pose is not None:
        coordinates = move_camera(coordinates, *pose)
    if lens is not None:
        coordinates = lens.apply(coordinates)
    return kind.astype(kind.xp.stack(coordinates, 1), precision)
