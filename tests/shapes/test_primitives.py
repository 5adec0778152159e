"""Primitives and mesh normals: closed, right way round, right size, NaN-free."""

import numpy as np
import pytest

from warpfrag.scene.light import lambert, transformed_normals
from warpfrag.shapes import primitives
from warpfrag.shapes.mesh import Mesh, smooth_normals, split_faces, weld

SHAPES = {
    "sphere": (lambda **k: primitives.sphere(1.5, 128, **k), 4 / 3 * np.pi * 1.5**3),
    "torus": (lambda **k: primitives.torus(1.0, 0.3, 128, **k), 2 * np.pi**2 * 0.09),
    "cylinder": (lambda **k: primitives.cylinder(1.2, 3.0, 128, **k), np.pi * 1.44 * 3),
    "cone": (lambda **k: primitives.cone(1.2, 3.0, 128, **k), np.pi * 1.44),
    "cube": (lambda **k: primitives.cube((1.0, 2.0, 3.0)), 6.0),
}


def corners(mesh):
    """Return the first, second and third corners of all faces."""
    return (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))


@pytest.mark.parametrize("uv", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_solids_are_closed_and_have_their_volume(shape, uv):
    """Every edge is shared by two faces that run through it both ways, and the signed volume is the solid's."""
    build, volume = SHAPES[shape]
    mesh = build(uv=uv)
    _, faces = weld(mesh.vertices, mesh.faces)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()
    assert {tuple(key) for key in keys} == {tuple(key[::-1]) for key in keys}
    a, b, c = corners(mesh)
    # 128 segments leave out less than 0.3 % of a round solid.
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=3e-3)


@pytest.mark.parametrize("uv", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_normals_are_unit_and_agree_with_the_faces(shape, uv):
    """Each corner's normal points the way its face does, but for the curvature within one face."""
    mesh = SHAPES[shape][0](uv=uv)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-12)
    a, b, c = corners(mesh)
    face = np.cross(b - a, c - a)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    assert np.einsum("ij,ikj->ik", face, mesh.normals[mesh.faces]).min() > 0.998


def test_smooth_shapes_have_one_vertex_a_position():
    """Without texture coordinates a sphere and a torus have no seam."""
    for mesh in (primitives.sphere(1.0, 16), primitives.torus(1.0, 0.25, 16)):
        assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    np.testing.assert_allclose(np.linalg.norm(primitives.sphere(2.0, 16).vertices, axis=1), 2.0, rtol=1e-12)


def test_plane_and_grid_face_z():
    """They lie in the x-y plane, span their size, and have (0, 0) of their texture at the lower left."""
    mesh = primitives.grid((2.0, 4.0), (3, 5))
    assert (len(mesh.vertices), len(mesh.faces)) == (24, 30)
    a, b, c = corners(mesh)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    np.testing.assert_array_equal(mesh.vertices[np.argmin(mesh.uv.sum(1))], [-1, -2, 0])
    assert len(primitives.plane().faces) == 2


def test_smooth_normals_ignore_degenerate_faces_and_seams():
    """A cube's corner gets the mean of its three sides whatever the triangulation; degenerate faces add no NaN."""
    mesh = primitives.cube()
    faces = np.concatenate([mesh.faces, [[0, 0, 1], [2, 2, 2]]])
    normals = smooth_normals(mesh.vertices, faces)
    np.testing.assert_allclose(normals, np.sign(mesh.vertices) / np.sqrt(3), atol=1e-12)


def test_smooth_normals_of_tiny_and_two_sided_meshes():
    """Neither tiny areas nor faces that cancel lose the normal; an unused vertex has none."""
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], dtype=float)
    both = np.array([[0, 1, 2], [0, 2, 1]])
    for scale in (1.0, 1e-30):
        normals = smooth_normals(triangle * scale, both)
        np.testing.assert_allclose(np.abs(normals), [[0, 0, 1]] * 3 + [[0, 0, 0]], atol=1e-12)


def test_lambert_is_two_sided_and_never_nan():
    """By hand, ambient + (1 - ambient) |n.l|: facing, averted, grazing, no normal."""
    normals = np.array([[0, 0, 2], [0, 0, -1], [1, 0, 0], [0, 0, 0], [1, 0, 1]], dtype=float)
    expected = [1.0, 1.0, 0.25, 0.25, 0.25 + 0.75 * np.sqrt(0.5)]
    np.testing.assert_allclose(lambert(normals, np.array([0, 0, 7.0]), 0.25), expected, rtol=1e-6)


def test_normals_follow_a_stretched_surface():
    """Under a non-uniform scale the normal stays at right angles to the surface."""
    mesh, matrix = primitives.sphere(1.0, 256), np.diag([1.0, 3.0, 0.5, 1.0])
    moved = mesh.vertices @ matrix[:3, :3].T
    given = transformed_normals(mesh.normals, matrix)
    given /= np.linalg.norm(given, axis=1, keepdims=True)
    # Normals averaged over the faces approach the exact ones with the size of the faces.
    assert np.einsum("ij,ij->i", given, smooth_normals(moved, mesh.faces)).min() > 0.999


def test_split_faces_carries_everything_per_corner():
    """Each face gets three vertices with their own position, colour, opacity and uv, and its flat normal."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    color = np.arange(12.0).reshape(4, 3)
    mesh = split_faces(Mesh(vertices, faces, None, color, np.arange(4.0), vertices[:, :2].astype(np.float32)))
    np.testing.assert_array_equal(mesh.vertices, vertices[faces.reshape(-1)])
    np.testing.assert_array_equal(mesh.color, color[faces.reshape(-1)])
    np.testing.assert_array_equal(mesh.opacity, faces.reshape(-1))
    np.testing.assert_array_equal(mesh.normals, [[0, 0, 1]] * 3 + [[1, 0, 0]] * 3)
    assert mesh.uv.shape == (6, 2)
