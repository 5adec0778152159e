"""Coverage: which triangles each pixel sees, in which order, held fixed while what they look like changes.

    coverage = Coverage.of(scene)
    fragments = coverage.shade({"ball.translation": torch.tensor([0.0, 0.0, 0.1])})

Geometry may move too: a fragment then stays where its pixel's ray meets the plane of its triangle, with barycentric
coordinates that reach outside 0 … 1 (extrapolated) if the triangle no longer covers the pixel. That is the function
whose gradient `capture` gives: near the parameters at which coverage was found both agree, up to what crosses an edge
or changes its place in the order.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.legacy import dtype_name, kind_of, vectors
from warpfrag.capture.capture import (
    Surfaces,
    check_scene,
    count_within,
    faces_of_fragments,
    place_surfaces,
    shade_fragments,
    to_warp,
)
from warpfrag.capture.fragment_adjoint import fragment_adjoint, load_triangle
from warpfrag.capture.shade import present
from warpfrag.fragments import Fragments
from warpfrag.raster.ray import Rays, Window, centre_x, centre_y
from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class Coverage:
    """Which triangles each pixel of an image sees, in order.

    Attributes:
        scene: the scene.
        camera: where from.
        corners: vertices of each triangle, (N, 3) int32 Warp array.
        faces: triangle of each fragment, (F,) int32 Warp array.
        offsets: pixel p sees the fragments offsets[p] : offsets[p + 1], (P + 1,) int32 Warp array.
        points: where the vertices were, in camera space [scene units], (V, 3) float64 Warp array.

    Example:
        >>> coverage = Coverage.of(wf.load_scene("scenes/three_spheres.toml"))
        >>> coverage.shade({"thickness": 0.5}).shape
        (512, 512)
    """

    scene: Scene
    camera: Camera
    corners: wp.array
    faces: wp.array
    offsets: wp.array
    points: wp.array

    @staticmethod
    def of(
        scene: Scene,
        camera: Camera | None = None,
        *,
        parameters: Mapping[str, Any] | None = None,
        sort: bool = True,
        memory_limit: float | None = None,
    ) -> "Coverage":
        """Find out which triangles each pixel sees.

        Args:
            scene: what to capture.
            camera: where from; default the scene's.
            parameters: as for `capture`; gradients are not recorded. Arrays lie on the device of the tensors.
            sort: order of a pixel's fragments: by depth, or as submitted.
            memory_limit: as for `capture`.

        Raises:
            TypeError: an argument is of the wrong type.
            ValueError: an argument is out of its range.
            MemoryError: there would be more fragments than the limit allows; nothing has been stored yet.
        """
        camera = check_scene(scene, camera)
        surfaces = place_surfaces(assemble(scene, parameters, camera=camera), camera)
        with surfaces.stream():
            triangles, starts, total = count_within(surfaces, Window.of(camera), memory_limit)
            faces = faces_of_fragments(triangles, starts, total, sort)
            return Coverage(scene, camera, triangles.corners, faces, starts, _cast(triangles.points, wp.float64))

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
        surfaces = self._surfaces(parameters)
        with surfaces.stream():
            corners, faces, offsets, points = self._on(surfaces.faces.device)
            return shade_fragments(surfaces, Window.of(self.camera), corners, faces, offsets, points)

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
        surfaces = self._surfaces(parameters)
        device = surfaces.faces.device
        with surfaces.stream():
            corners, faces, offsets, _ = self._on(device)
            points = to_warp(surfaces.points)
            scalar = points.dtype
            others = (surfaces.rgba, surfaces.thickness, surfaces.maps, *surfaces.tables)
            arrays = [points, *(None if array is None else to_warp(array) for array in others)]
            grads = [
                _cotangent(name, grad, shape, scalar, device)
                for name, grad, shape in (
                    ("grad_rgba", grad_rgba, (self.count, 4)),
                    ("grad_depth", grad_depth, (self.count,)),
                    ("grad_thickness", grad_thickness, (self.count,)),
                )
            ]
            grads[0] = vectors(grads[0])
            motions = wp.empty((self.count, 2), dtype=wp.vec3d, device=device)
            if self.count:
                window = Window.of(self.camera)
                tensors = present((*arrays[:4], corners, faces, offsets, *arrays[4:]))
                arguments = [window.rays(), *tensors, *grads, motions]
                launch(_motion_kernel(scalar), window.pixel_count, arguments, device)
            return motions.numpy().reshape(self.count, 6)

    def _surfaces(self, parameters: Mapping[str, Any] | None) -> Surfaces:
        return place_surfaces(assemble(self.scene, parameters, camera=self.camera), self.camera)

    def _on(self, device: wp.Device) -> list[wp.array]:
        return [array.to(device) for array in (self.corners, self.faces, self.offsets, self.points)]


@cache
def _motion_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def motion_bwd(
        span: Span,
        rays: Rays,
        points: wp.array(dtype=wp.types.vector(3, scalar)),
        rgba: wp.array(dtype=wp.types.vector(4, scalar)),
        thickness: wp.array(dtype=scalar),
        maps: wp.array2d(dtype=scalar),
        corners: wp.array(dtype=wp.vec3i),
        fragment_face: wp.array(dtype=int),
        offsets: wp.array(dtype=int),
        object_id: wp.array(dtype=int),
        objects: wp.array(dtype=wp.vec3i),
        uv: wp.array(dtype=wp.vec2f),
        texture_id: wp.array(dtype=int),
        texels: wp.array(dtype=wp.vec4f),
        textures: wp.array(dtype=wp.vec3i),
        grad_fragment_rgba: wp.array(dtype=wp.types.vector(4, scalar)),
        grad_fragment_depth: wp.array(dtype=scalar),
        grad_fragment_thickness: wp.array(dtype=scalar),
        motions: wp.array2d(dtype=wp.vec3d),
    ):
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            row = pixel // rays.width
            x = centre_x(rays, pixel - row * rays.width)
            y = centre_y(rays, row)
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                face = fragment_face[fragment]
                own = load_triangle(points, rgba, thickness, corners, object_id, objects, uv, texture_id, face)
                to = fragment_adjoint(
                    rays, own, maps, texels, textures,
                    grad_fragment_rgba, grad_fragment_depth, grad_fragment_thickness,
                    fragment, pixel, x, y, True,
                )  # fmt: skip
                force = to.point_a + to.point_b + to.point_c
                torque = (
                    wp.cross(own.point_a, to.point_a)
                    + wp.cross(own.point_b, to.point_b)
                    + wp.cross(own.point_c, to.point_c)
                )
                motions[fragment, 0] = force
                motions[fragment, 1] = torque

    return motion_bwd


def _cotangent(name: str, grad: Any, shape: tuple[int, ...], scalar: Any, device: wp.Device) -> wp.array:
    """Return a gradient as a Warp array of a precision on a device, empty for None."""
    if grad is None:
        return wp.empty((0, *shape[1:]), dtype=scalar, device=device)
    if kind_of(grad) is None or dtype_name(grad) not in ("float32", "float64"):
        found = type(grad).__name__ if kind_of(grad) is None else dtype_name(grad)
        raise TypeError(f"{name}: got {found}, expected a NumPy array, wp.array or torch.Tensor of floats")
    if tuple(grad.shape) != shape:
        raise ValueError(f"{name}: got shape {tuple(grad.shape)}, expected {shape}")
    array = grad.contiguous() if kind_of(grad) == "warp" else to_warp(grad)
    return _cast(array, scalar).to(device)


def _cast(array: wp.array, scalar: Any) -> wp.array:
    """Return an array in a precision."""
    if array.dtype == scalar:
        return array
    cast = wp.empty(array.shape, dtype=scalar, device=array.device)
    wp.utils.array_cast(array, cast)
    return cast
