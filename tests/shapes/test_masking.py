"""Masks cut triangles along straight lines; meshes keep their outside when they are moved."""

import numpy as np
import pytest

from warpfrag.shapes.masking import cut_at_opacity
from warpfrag.shapes.mesh import Mesh, placed

TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
FACE = np.array([[0, 1, 2]], dtype=np.int32)


def area(mesh):
    """Return the signed area of a mesh in the x–y plane."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return 0.5 * np.cross(b - a, c - a)[:, 2].sum()


@pytest.mark.parametrize(
    ("opacity", "expected"),
    [
        # One corner kept: the triangle of half its sides; one cut off: the rest.
        ([1.0, 0.0, 0.0], 0.125),
        ([0.0, 1.0, 0.0], 0.125),
        ([0.0, 1.0, 1.0], 0.375),
        ([1.0, 1.0, 0.0], 0.375),
        ([1.0, 1.0, 1.0], 0.5),
        ([0.0, 0.1, 0.2], 0.0),
    ],
)
def test_triangles_are_cut_where_opacity_reaches_the_limit(opacity, expected):
    """What is left has the right area and sense; attributes are those of the place."""
    mesh = Mesh(TRIANGLE, FACE, color=TRIANGLE, opacity=np.array(opacity), uv=TRIANGLE[:, :2].astype(np.float32))
    cut = cut_at_opacity(mesh, 0.5)
    assert area(cut) == pytest.approx(expected)
    assert cut.opacity == 1.0
    np.testing.assert_allclose(cut.color, cut.vertices, atol=1e-12)
    np.testing.assert_allclose(cut.uv, cut.vertices[:, :2], atol=1e-6)


def test_even_opacity_is_all_or_nothing():
    """Without differences nothing is cut: all is opaque, or transparent."""
    assert cut_at_opacity(Mesh(TRIANGLE, FACE, opacity=0.5), 0.5).opacity == 1.0
    assert cut_at_opacity(Mesh(TRIANGLE, FACE, opacity=0.4), 0.5).opacity == 0.0


def test_mirrors_keep_the_outside():
    """The normal, and the sense of the corners, are those of the mirrored outside."""
    mesh = Mesh(TRIANGLE, FACE, normals=np.tile([0.0, 0.0, 1.0], (3, 1)))
    mirrored = placed(mesh, np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert area(mirrored) == pytest.approx(0.5)
    assert (mirrored.normals[:, 2] > 0).all()
