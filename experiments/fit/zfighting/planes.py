"""Two planes of different triangles, and what depth buffers make of their depths.

The planes are coplanar, or one lies a little behind the other along the middle ray; both fill the image and are tilted
against the view. `stored_depths` is what a depth buffer keeps, taken back to distances; `true_depths` has no noise.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

import warpfrag as wf
from warpfrag.capture.surfaces import to_camera_space
from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes import primitives

BUFFERS = ("eye", "fixed", "float", "rasteriser")
# Columns, rows and turn in the plane [degrees] of the two planes' triangles: none in common.
TRIANGLES = ((29, 23, 0.0), (27, 41, 31.0))
COLORS = ((0.9, 0.05, 0.04), (0.04, 0.1, 0.9))
# Vertical opening [degrees]: small, so that the depth in the middle stands for that of all pixels.
FOV = 8.0
# Steps in a pixel to which rasterisers round the corners of triangles (Direct3D 11: fixed point, 8 bits).
SUBPIXELS = 256.0


@dataclass(frozen=True)
class Setting:
    """Where the planes are, and how they are seen.

    Attributes:
        z: distance of their middle from the eye [near].
        far: distance of the far plane [near].
        tilt: angle between their normal and the middle ray [degrees].
        offset: how far the first is behind the second along the middle ray [P(z)]: where rounding makes their depths
            equal, order of submission then gets it wrong.
        origin: distance of the eye from the origin of world space [z].
        opacity: of both.
        bits: of the depth buffer, and of P.
        size: width and height of the image [pixels].
    """

    z: float = 10.0
    far: float = 1e4
    tilt: float = 55.0
    offset: float = 0.0
    origin: float = 0.0
    opacity: float = 0.8
    bits: int = 24
    size: int = 128

    @property
    def resolution(self) -> float:
        """P(z) in the middle [near]."""
        return wf.z_resolution(self.z, 1.0, self.far, self.bits)

    @property
    def footprint(self) -> float:
        """How far the planes recede from one pixel to the next, in the middle [near]."""
        pixel = 2.0 * self.z * np.tan(np.radians(FOV) / 2.0) / self.size
        return float(pixel * np.tan(np.radians(self.tilt)))


@dataclass(frozen=True)
class Pair:
    """The two fragments of every pixel: of the first plane, then of the second.

    Attributes:
        setting: where the planes are.
        rgba: premultiplied colour and opacity, (2 H W, 4) float64.
        true_depth: distance without any noise [near], (2 H W,) float64.
        depths: distance as each of `BUFFERS` keeps it [near], (2 H W,); "eye" in float32, the others in float64.
    """

    setting: Setting
    rgba: np.ndarray
    true_depth: np.ndarray
    depths: dict[str, np.ndarray]


def make_pair(setting: Setting) -> Pair:
    """Capture the planes, and work out their depths."""
    scene = make_scene(setting)
    fragments = wf.capture(scene, sort=False)
    if not (np.diff(fragments.offsets) == 2).all():
        raise RuntimeError(f"planes: found pixels without two fragments at {setting}, expected both planes everywhere")
    return Pair(
        setting=setting,
        rgba=fragments.rgba.astype(np.float64),
        true_depth=true_depths(setting, scene),
        depths={buffer: stored_depths(buffer, setting, scene, fragments) for buffer in BUFFERS},
    )


def make_scene(setting: Setting) -> Scene:
    """Build the planes and the camera, the near plane at 1."""
    turned = _rotation(1, 20.0) @ _rotation(0, -setting.tilt)
    eye = setting.origin * setting.z * np.array([0.6, 0.48, 0.64])
    # Wide enough to fill the image to its corners, with room for the turn in the plane.
    corner = np.tan(np.radians(FOV) / 2.0) * np.sqrt(2.0)
    reach = corner / (np.cos(np.radians(setting.tilt)) * (1.0 - corner * np.tan(np.radians(setting.tilt))))
    objects = []
    for index, (columns, rows, turn) in enumerate(TRIANGLES):
        mesh = primitives.grid((3.0 * reach * setting.z, 3.0 * reach * setting.z), (columns, rows))
        matrix = np.eye(4)
        matrix[:3, :3] = turned @ _rotation(2, turn)
        matrix[:3, 3] = eye + _middle(setting, index)
        item = SceneObject(
            ("first", "second")[index], mesh.vertices, mesh.faces, matrix, COLORS[index], setting.opacity
        )
        objects.append(item)
    size = (setting.size, setting.size)
    target = eye - [0.0, 0.0, setting.z]
    return Scene(Camera(tuple(eye), tuple(target), fov=FOV, near=1.0, far=setting.far, size=size), objects)


def true_depths(setting: Setting, scene: Scene) -> np.ndarray:
    """Return where the rays meet the planes themselves [near], (2 H W,) float64."""
    x, y = _pixels(scene.camera)
    directions = np.stack([x, -y, -np.ones_like(x)], -1) / [scene.camera.focal, scene.camera.focal, 1.0]
    depths = []
    for index, item in enumerate(scene.objects):
        normal = item.matrix[:3, 2]
        depths.append(normal @ _middle(setting, index) / (directions @ normal))
    # Distance along the ray, not the planar depth.
    return (np.stack(depths, -1) * np.linalg.norm(directions, axis=-1)[:, None]).ravel()


def stored_depths(buffer: str, setting: Setting, scene: Scene, fragments: wf.Fragments) -> np.ndarray:
    """Return the distances that a kind of depth buffer gives back [near], (2 H W,).

    Args:
        buffer: "eye": the distance from the eye in float32, as warpfrag keeps it. The others keep what projection
            makes of the planar depth z, far / (far - near) (1 - near / z): "fixed" in fixed point of `bits` and
            "float" in float32, each rounded just once; "rasteriser" in fixed point after what a graphics pipeline
            does: projection of the corners in float32, their places rounded to 1/256 pixel, interpolation between.
        setting: where the planes are.
        scene: the planes.
        fragments: of the scene, by pixel and object.
    """
    if buffer == "eye":
        return fragments.depth
    camera = scene.camera
    corners = _corners(scene, fragments)
    x, y = (np.repeat(part, 2) for part in _pixels(camera))
    stretch = np.sqrt(1.0 + (x * x + y * y) / camera.focal**2)
    if buffer == "rasteriser":
        window = _interpolated(corners, x, y, camera)
    else:
        planar = _planar_depths(corners, x, y, camera)
        window = camera.far / (camera.far - camera.near) * (1.0 - camera.near / planar)
    step = 2.0**-setting.bits
    kept = window.astype(np.float32).astype(np.float64) if buffer == "float" else np.rint(window / step) * step
    return camera.near * camera.far / (camera.far - kept * (camera.far - camera.near)) * stretch


def _planar_depths(corners: np.ndarray, x: np.ndarray, y: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the planar depth of fragments on triangles (n, 3, 3) in camera space, at pixels [from the middle]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    directions = np.stack([x / camera.focal, y / camera.focal, np.ones_like(x)], -1)
    return (normal * corners[:, 0]).sum(-1) / (normal * directions).sum(-1)


def _interpolated(corners: np.ndarray, x: np.ndarray, y: np.ndarray, camera: Camera) -> np.ndarray:
    single = corners.astype(np.float32)
    near, far = np.float32(camera.near), np.float32(camera.far)
    z = single[..., 2]
    window = ((far / (far - near) * z - far * near / (far - near)) / z).astype(np.float64)
    places = np.rint(SUBPIXELS * camera.focal * corners[..., :2] / corners[..., 2:]) / SUBPIXELS
    # The plane through the three corners (place, window depth), at the pixel's centre.
    one, two = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    here = np.stack([x, y], -1) - places[:, 0]
    area = _cross(one, two)
    second, third = _cross(here, two) / area, _cross(one, here) / area
    return window[:, 0] + second * (window[:, 1] - window[:, 0]) + third * (window[:, 2] - window[:, 0])


def _corners(scene: Scene, fragments: wf.Fragments) -> np.ndarray:
    """Return the corners of each fragment's triangle in camera space, rounded to float32 as capture does."""
    geometry = assemble(scene)
    points = to_camera_space(geometry.vertices, scene.camera).astype(np.float64)
    return points[geometry.faces[geometry.first_face[fragments.object_id] + fragments.primitive_id]]


def _middle(setting: Setting, index: int) -> np.ndarray:
    """Return where the middle of a plane is, seen from the eye [near], (3,)."""
    behind = setting.offset * setting.resolution if index == 0 else 0.0
    return np.array([0.0, 0.0, -setting.z - behind])


def _pixels(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return column and row of the pixels' centres, from the middle of the image, (H W,) each."""
    row, column = np.mgrid[: camera.shape[0], : camera.shape[1]] + 0.5
    return (column - 0.5 * camera.shape[1]).ravel(), (row - 0.5 * camera.shape[0]).ravel()


def _cross(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    return one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]


def _rotation(axis: int, degrees: float) -> np.ndarray:
    first, second = (axis + 1) % 3, (axis + 2) % 3
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix: Any = np.eye(3)
    matrix[[first, second], [first, second]] = cosine
    matrix[first, second], matrix[second, first] = -sine, sine
    return matrix
