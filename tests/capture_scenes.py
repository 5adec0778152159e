"""Small scenes for the tests of capture, in the axes of camera space: x right, y down, z forward from the eye."""

import numpy as np

from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject

AHEAD = {"eye": (0.0, 0.0, 0.0), "target": (0.0, 0.0, 1.0), "up": (0.0, -1.0, 0.0)}
"""A camera whose space is world space."""


def perspective(size: tuple[int, int] = (32, 32), fov: float = 60.0, near: float = 0.01, far: float = 100.0) -> Camera:
    """Return a perspective camera at the origin that looks along z."""
    return Camera(**AHEAD, fov=fov, near=near, far=far, size=size)


def orthographic(size: tuple[int, int] = (32, 32), height: float | None = None) -> Camera:
    """Return an orthographic camera along z, by default of one scene unit per pixel."""
    return Camera(**AHEAD, height=height or size[1], near=0.01, far=100.0, size=size)


def surface(vertices, faces, name: str = "surface", **look) -> SceneObject:
    """Return an object of triangles; thickness is in scene units unless said otherwise."""
    look = {"thickness": 0.1, "thickness_unit": "scene", **look}
    return SceneObject(name, np.asarray(vertices, np.float32), np.asarray(faces, np.int32).reshape(-1, 3), **look)


def quad(depth: float, half: float = 10.0, name: str = "quad", **look) -> SceneObject:
    """Return a square across the line of sight."""
    corners = [[x * half, y * half, depth] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return surface(corners, [[0, 1, 2], [0, 2, 3]], name, **look)


def soup(seed: int, count: int = 12, name: str = "soup", z: tuple[float, float] = (1.5, 3.0), **look) -> SceneObject:
    """Return random triangles in front of a perspective camera of 60 degrees, each with vertices of its own."""
    random = np.random.default_rng(seed)
    vertices = random.uniform([-1.0, -1.0, z[0]], [1.0, 1.0, z[1]], (3 * count, 3))
    defaults = {
        "color": random.uniform(0, 1, (3 * count, 3)),
        "opacity": random.uniform(0.1, 0.9, 3 * count),
        "thickness": random.uniform(0.05, 0.5, 3 * count),
    }
    return surface(vertices, np.arange(3 * count), name, **{**defaults, **look})


def scene(camera: Camera, *objects: SceneObject, **options) -> Scene:
    """Return a scene of some objects."""
    return Scene(camera, list(objects), **options)


def pixels_of(fragments) -> np.ndarray:
    """Return the pixel of each fragment."""
    return np.repeat(np.arange(fragments.pixel_count), np.diff(fragments.offsets))


def rays_through(camera: Camera) -> np.ndarray:
    """Return the direction of each pixel's ray, (H, W, 3), of planar depth 1."""
    height, width = camera.shape
    x = (np.arange(width) + 0.5 - width / 2) / camera.focal
    y = (np.arange(height) + 0.5 - height / 2) / camera.focal
    return np.stack([*np.meshgrid(x, y), np.ones((height, width))], -1)


def stretch_of(camera: Camera) -> np.ndarray:
    """Return how much longer a pixel's ray is than the planar depth that it reaches, (H, W)."""
    height, width = camera.shape
    x, y = np.meshgrid(np.arange(width) + 0.5 - 0.5 * width, np.arange(height) + 0.5 - 0.5 * height)
    return np.sqrt(1.0 + (x**2 + y**2) / camera.focal**2)
