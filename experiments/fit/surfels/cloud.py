"""A coloured bunny, renders of it, and points on its surface."""

from pathlib import Path

import numpy as np
import trimesh

import warpfrag as wf
from warpfrag.colors import linear_to_srgb
from warpfrag.files.meshes import load_mesh
from warpfrag.scene.camera import Camera
from warpfrag.scene.light import lambert
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes.mesh import Mesh, smooth_normals
from warpfrag.shapes.surfels import PointSet

# Times that the mesh's edges are halved: colours between vertices are then close to `paint`.
HALVINGS = 2
# Samples along each edge of a pixel of a reference.
SAMPLES = 4
LIGHT, AMBIENT = (0.4, 0.8, 0.6), 0.35
# Distance of the dark bands [scene units].
BAND = 0.16


def load_bunny() -> Mesh:
    """Return the bunny with its middle at the origin, 1.6 units high, with normals and lit colours."""
    mesh = load_mesh("warp:bunny.usd")
    vertices, faces = mesh.vertices - 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)), mesh.faces
    attributes = {"normals": smooth_normals(vertices, faces)}
    for _ in range(HALVINGS):
        vertices, faces, attributes = trimesh.remesh.subdivide(vertices, faces, vertex_attributes=attributes)
    normals = attributes["normals"]
    return Mesh(vertices, faces.astype(np.int32), normals, paint(vertices, normals))


def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the lit colour of a surface at points (P, 3), straight linear RGB (P, 3): washes with dark bands."""
    x, y, z = points.T
    red = 0.5 + 0.4 * np.sin(3.5 * x + 1.0 + 1.5 * np.sin(2.0 * y))
    green = 0.45 + 0.35 * np.sin(3.0 * y + 0.5)
    blue = 0.5 + 0.4 * np.cos(3.0 * z - 2.5 * x)
    bands = 0.5 + 0.5 * np.sin(2.0 * np.pi / BAND * (y + 0.25 * np.sin(3.0 * x) + 0.2 * np.cos(4.0 * z)))
    light = lambert(normals, np.array(LIGHT), AMBIENT) * (0.35 + 0.65 * bands)
    return np.stack([red, green, blue], axis=-1) * light[:, None]


def render_mesh(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Return the image of a mesh with `SAMPLES`² samples a pixel, (H, W, 4) float32."""
    height, width = camera.shape
    item = SceneObject("mesh", mesh.vertices, mesh.faces, color=mesh.color)
    fine = wf.render(Scene(camera.resized((SAMPLES * width, SAMPLES * height)), [item], merge="none"))
    return fine.reshape(height, SAMPLES, width, SAMPLES, 4).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


def sample_points(mesh: Mesh, count: int) -> PointSet:
    """Return points spread evenly over a mesh, with its normals and lit colours; about as many as asked for."""
    assert mesh.normals is not None
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface_even(surface, count, seed=0)
    shares = trimesh.triangles.points_to_barycentric(surface.triangles[face], points)
    normals = np.einsum("pk,pki->pi", shares, mesh.normals[mesh.faces[face]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointSet(points, normals, paint(points, normals))


def write_points(path: Path, points: PointSet) -> None:
    """Write points as a binary ply file, with normals and sRGB colours of 8 bits."""
    assert points.normals is not None
    assert points.color is not None
    floats, bytes_ = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    columns = np.hstack([points.points, points.normals, np.rint(255.0 * linear_to_srgb(points.color))]).T
    rows = np.empty(len(points.points), [*((name, "<f4") for name in floats), *((name, "u1") for name in bytes_)])
    for name, column in zip((*floats, *bytes_), columns, strict=True):
        rows[name] = column
    lines = [f"property float {name}" for name in floats] + [f"property uchar {name}" for name in bytes_]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *lines, "end_header\n"]
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
