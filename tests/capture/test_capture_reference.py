"""Coverage and depth of real meshes, against an independent ray caster (Embree) and rasteriser (OpenGL)."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from capture_scenes import rays_through, scene, surface
from opengl_depth import NO_OPENGL

from warpfrag.capture.coverage import capture
from warpfrag.files.meshes import load_mesh, warp_asset
from warpfrag.scene.camera import Camera


@pytest.fixture(scope="module")
def bunny():
    """The Stanford bunny of Warp's examples, in a unit box around the origin."""
    pytest.importorskip("pxr", reason="usd-core is not installed")
    mesh = load_mesh(warp_asset("bunny.usd"))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    vertices = (mesh.vertices - 0.5 * (low + high)) / (high - low).max()
    return surface(vertices, mesh.faces, "bunny")


CAMERA = Camera(eye=(0.5, 0.4, 1.6), target=(0.0, 0.0, 0.0), fov=40.0, near=0.05, far=10.0, size=(256, 240))


def first_and_count(found) -> tuple[np.ndarray, np.ndarray]:
    """Return the first fragment's depth, infinity where there is none, and the number of fragments, (H, W)."""
    first = np.full(found.pixel_count, np.inf)
    counts = np.diff(found.offsets)
    first[counts > 0] = found.depth[found.offsets[:-1][counts > 0]]
    return first.reshape(found.shape), counts.reshape(found.shape)


def test_embree_agrees_at_pixel_centres(bunny):
    """Embree's first hits through the pixel centres are the first fragments."""
    embreex = pytest.importorskip("embreex.rtcore_scene", reason="embreex is not installed")
    from embreex.mesh_construction import TriangleMesh

    found = capture(scene(CAMERA, bunny))
    first, _ = first_and_count(found)
    target = embreex.EmbreeScene()
    TriangleMesh(target, np.ascontiguousarray(bunny.vertices), np.ascontiguousarray(bunny.faces))
    rays = rays_through(CAMERA) @ CAMERA.view_matrix()[:3, :3]
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3).astype(np.float32)
    eyes = np.tile(np.float32(CAMERA.eye), (len(rays), 1))
    hit = target.run(eyes, rays, query="INTERSECT", output=True)
    covered = (hit["primID"] >= 0).reshape(CAMERA.shape)
    # Embree casts in single precision: rays that graze an edge to 1e-6 may go either way.
    assert (covered != np.isfinite(first)).sum() <= 3
    both = covered & np.isfinite(first)
    assert both.sum() > 15000
    error = np.abs(hit["tfar"].reshape(CAMERA.shape)[both] - first[both])
    assert np.median(error) < 2e-7
    assert (error > 1e-5).sum() <= 10
    triangle = np.full(found.pixel_count, -1)
    triangle[np.isfinite(first).reshape(-1)] = found.primitive_id[found.offsets[:-1][np.diff(found.offsets) > 0]]
    assert (triangle.reshape(CAMERA.shape)[both] != hit["primID"].reshape(CAMERA.shape)[both]).sum() <= 10


def test_every_layer_agrees_with_ray_casting(bunny):
    """All fragments of some pixels are the hits that ray casting in float64 finds, triangle by triangle."""
    found = capture(scene(CAMERA, bunny))
    view = CAMERA.view_matrix()
    corners = (bunny.vertices.astype(float) @ view[:3, :3].T + view[:3, 3]).astype(np.float32).astype(float)
    a, b, c = (corners[bunny.faces[:, k]] for k in range(3))
    busy = np.argsort(-np.diff(found.offsets))[:40]
    assert np.diff(found.offsets)[busy].min() >= 4
    for pixel in busy:
        ray = rays_through(CAMERA).reshape(-1, 3)[pixel]
        volumes = np.stack([np.cross(p, q) @ ray for p, q in ((b, c), (c, a), (a, b))])
        inside = (np.sign(volumes) == np.sign(volumes[0])).all(axis=0) & (volumes[0] != 0)
        depth = np.einsum("ij,ij->i", a, np.cross(b, c))[inside] / volumes[:, inside].sum(axis=0) * np.linalg.norm(ray)
        order = np.argsort(depth)
        own = slice(found.offsets[pixel], found.offsets[pixel + 1])
        np.testing.assert_array_equal(found.primitive_id[own], np.flatnonzero(inside)[order])
        np.testing.assert_allclose(found.depth[own], depth[order], rtol=2e-7)


def test_closed_parts_are_left_as_often_as_entered(bunny):
    """The bunny's mesh has holes only at its base: seen from above it, rays meet it an even number of times."""
    camera = Camera(eye=(0.3, 2.0, 0.5), target=(0.0, 0.0, 0.0), fov=40.0, size=(200, 200))
    counts = np.diff(capture(scene(camera, bunny)).offsets)
    edges = np.sort(bunny.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    if (uses != 2).any():
        pytest.skip("the mesh is not closed")
    assert (counts % 2 == 0).all()


def test_opengl_agrees(bunny, tmp_path):
    """The depth buffer of pyrender holds the planar depths of the first fragments."""
    if importlib.util.find_spec("pyrender") is None:
        pytest.skip("pyrender is not installed")
    camera = {name: getattr(CAMERA, name) for name in ("size", "focal", "near", "far")}
    np.savez(tmp_path / "scene.npz", vertices=bunny.vertices, faces=bunny.faces, view=CAMERA.view_matrix(), **camera)
    script = Path(__file__).with_name("opengl_depth.py")
    command = [sys.executable, script, tmp_path / "scene.npz", tmp_path / "depth.npy"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    if done.returncode == NO_OPENGL:
        pytest.skip(f"no OpenGL context without a screen (EGL): {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    depth = np.load(tmp_path / "depth.npy")
    first, _ = first_and_count(capture(scene(CAMERA, bunny)))
    planar = first / np.linalg.norm(rays_through(CAMERA), axis=-1)
    covered = depth > 0
    # Sub-pixel positions are rounded to 1/256 pixel there: silhouettes may differ in some pixels, depth by 1e-4.
    assert (covered != np.isfinite(planar)).sum() < 0.002 * covered.sum()
    both = covered & np.isfinite(planar)
    error = np.abs(depth - planar)[both]
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.99) < 2e-4
