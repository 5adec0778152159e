"""A scene of opaque, flat-coloured faces rendered by pyrender and by us, and where the samples may differ."""

import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyrender_image import NO_OPENGL

import warpfrag as wf
from warpfrag.scene.assemble import assemble

SCRIPT = Path(__file__).with_name("pyrender_image.py")
# OpenGL rounds the projected corners of triangles to so many parts of a pixel (GL_SUBPIXEL_BITS is 8 here).
PARTS = 256
# Depths as near to each other as so many P(z) may come in either order: both are rounded.
DEPTH_STEPS = 2.0
# Two colours are the same sample's if they differ by less; colours come as 16 bits, half a step of which is 8e-6.
SAME = 1e-4


class NoOpenGLError(RuntimeError):
    """pyrender cannot render here; the message is one line that says what to install."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two images of one scene, from the same sample positions.

    Attributes:
        theirs: by pyrender, mean of a pixel's samples, linear, (H, W, 3).
        ours: the same by us, plain sorted over.
        differing: samples of a pixel that show another colour, (H, W).
        crossing: whether within the pixel the front surfaces of two objects change places, or the two foremost ones are
            nearer to each other than OpenGL's depth buffer resolves, (H, W) bool.
    """

    theirs: np.ndarray
    ours: np.ndarray
    differing: np.ndarray
    crossing: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """Largest difference over the channels, (H, W)."""
        return np.abs(self.theirs - self.ours).max(axis=-1)


def compare(scene: wf.Scene, samples: int) -> Comparison:
    """Render a scene by both, with a number of samples along each edge of a pixel.

    Raises:
        NoOpenGLError: pyrender or OpenGL is missing.
    """
    fine = replace(scene, camera=resampled(scene.camera, samples))
    theirs, ours = pyrender_image(fine), wf.render(fine, merge="none")[..., :3]
    height, width = scene.camera.shape

    def by_pixel(image: np.ndarray) -> np.ndarray:
        return image.reshape(height, samples, width, samples, *image.shape[2:])

    differ = by_pixel(np.abs(theirs - ours).max(axis=-1) > SAME).sum(axis=(1, 3))
    means = [by_pixel(image).mean(axis=(1, 3), dtype=np.float64) for image in (theirs, ours)]
    order = by_pixel(front_order(fine))
    crossing = (order == 1).any(axis=(1, 3)) & (order == -1).any(axis=(1, 3))
    crossing |= by_pixel(unresolved(fine)).any(axis=(1, 3))
    return Comparison(*means, differ, crossing)


def resampled(camera: wf.Camera, samples: int) -> wf.Camera:
    """Return a camera whose pixels are the samples of another's."""
    height, width = camera.shape
    return camera.resized((width * samples, height * samples))


def pyrender_image(scene: wf.Scene) -> np.ndarray:
    """Render opaque objects with faces of one colour each by pyrender, (H, W, 3) linear float32.

    Raises:
        NoOpenGLError: pyrender or OpenGL is missing.
    """
    camera = scene.camera
    geometry = assemble(scene)
    triangles, colors = geometry.vertices[geometry.faces], geometry.rgba[geometry.faces[:, 0], :3]
    lens = {"view": camera.view_matrix(), **{key: getattr(camera, key) for key in ("size", "focal", "near", "far")}}
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "scene.npz", Path(folder) / "image.npy"
        np.savez(source, triangles=triangles, colors=colors, background=scene.background[:3], **lens)
        done = subprocess.run([sys.executable, SCRIPT, source, target], capture_output=True, text=True)
        if done.returncode == NO_OPENGL:
            found = done.stderr.strip().splitlines()[-1]
            raise NoOpenGLError(
                f"pyrender: found {found}, expected it and EGL: uv sync --all-extras; "
                "apt-get install libegl1 libgl1 libgl1-mesa-dri"
            )
        if done.returncode:
            raise RuntimeError(f"{SCRIPT.name}: {done.stderr.strip()}")
        return np.load(target)


def on_grid(scene: wf.Scene, samples: int) -> wf.Scene:
    """Return a scene with its vertices where OpenGL would round them to: moved by less than 1/256 of a sample.

    Args:
        scene: what to move, seen by its own camera.
        samples: along each edge of a pixel.
    """
    camera = resampled(scene.camera, samples)
    view = camera.view_matrix()
    rotation, shift = view[:3, :3], view[:3, 3]
    moved = []
    for item in scene.objects:
        points = item.world_vertices() @ rotation.T + shift
        scale = camera.focal / points[:, 2:]
        points[:, :2] = np.rint(points[:, :2] * scale * PARTS) / PARTS / scale
        moved.append(replace(item, vertices=(points - shift) @ rotation, matrix=np.eye(4)))
    return replace(scene, objects=moved)


def front_order(scene: wf.Scene) -> np.ndarray:
    """Return for two objects which is in front in each pixel: 1 the first, -1 the second, 0 where not both are."""
    fragments = wf.capture(scene).numpy()
    pixel = fragments.pixel
    first = np.full((2, fragments.pixel_count), np.inf)
    for index in (0, 1):
        members = fragments.object_id == index
        np.minimum.at(first[index], pixel[members], fragments.depth[members])
    both = np.isfinite(first).all(axis=0)
    return np.where(both, np.where(first[0] < first[1], 1, -1), 0).reshape(fragments.shape)


def unresolved(scene: wf.Scene) -> np.ndarray:
    """Return whether a depth buffer of 24 bits may not tell the two foremost surfaces apart, by pixel (H, W)."""
    fragments, camera = wf.capture(scene).numpy(), scene.camera
    several = np.diff(fragments.offsets) > 1
    first = fragments.offsets[:-1][several]
    near = fragments.depth[first].astype(np.float64)
    close = np.zeros(fragments.pixel_count, bool)
    close[several] = fragments.depth[first + 1] - near < DEPTH_STEPS * wf.z_resolution(near, camera.near, camera.far)
    return close.reshape(fragments.shape)
