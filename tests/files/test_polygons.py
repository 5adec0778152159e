"""Polygons are cut so that their triangles cover them, and nothing else, once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from warpfrag.files.meshes import load_mesh
from warpfrag.files.polygons import cut_polygons

ARROW = [(0, 0), (2, 1), (0, 2), (1, 1)]
L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]


def signed_areas(points, triangles):
    """Return twice the signed area of each triangle in the x–y plane."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


@pytest.mark.parametrize("shape", [ARROW, L_SHAPE, [(0, 0), (1, 0), (1, 1), (0, 1)]])
@pytest.mark.parametrize("turn", range(6))
@pytest.mark.parametrize("reverse", [False, True])
def test_concave_polygons_are_covered_once(shape, turn, reverse):
    """Whatever corner comes first, areas add up, and every triangle runs the way the polygon does."""
    points = np.array([(*point, 0.0) for point in np.roll(shape, turn, axis=0)])
    points = points[::-1] if reverse else points
    _, places = cut_polygons(points, np.array([len(points)]), np.arange(len(points)))
    areas = signed_areas(points[:, :2], places)
    total = sum(
        points[i, 0] * points[(i + 1) % len(points), 1] - points[i, 1] * points[(i + 1) % len(points), 0]
        for i in range(len(points))
    )
    assert len(places) == len(points) - 2
    assert areas.sum() == pytest.approx(total)
    assert (areas * np.sign(total) > 0).all()


@given(st.integers(3, 9), st.integers(0, 2**31))
def test_stars_are_covered_once(count, seed):
    """Random star-shaped polygons, in a random plane of space, among others: areas are those of the polygon."""
    generator = np.random.default_rng(seed)
    # Angles close enough that the star holds its middle, so that it does not cross itself.
    angle = (np.arange(2 * count) + generator.uniform(0.0, 0.9, 2 * count)) * np.pi / count
    flat = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * generator.uniform(0.2, 1.0, (2 * count, 1))
    axes = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    points = flat @ axes[:2] + generator.normal(size=3)
    counts = np.array([3, 2 * count, 4])
    corners = np.concatenate([[0, 1, 2], np.arange(2 * count), [0, 1, 2, 3]])
    polygon, places = cut_polygons(points, counts, corners)
    own = places[polygon == 1] - 3
    following = np.roll(flat, -1, axis=0)
    total = (flat[:, 0] * following[:, 1] - flat[:, 1] * following[:, 0]).sum()
    areas = signed_areas(flat, own)
    assert np.abs(areas).sum() == pytest.approx(abs(total), rel=1e-6, abs=1e-9)


def test_files_with_concave_polygons(tmp_path):
    """An arrow head of an obj, a ply and an off file covers its area, not that of its hull."""
    text = {
        "a.obj": "".join(f"v {x} {y} 0\n" for x, y in ARROW) + "f 1 2 3 4\n",
        "a.off": "OFF\n4 1 0\n" + "".join(f"{x} {y} 0\n" for x, y in ARROW) + "4 0 1 2 3\n",
        "a.ply": "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        + "".join(f"{x} {y} 0\n" for x, y in ARROW)
        + "4 0 1 2 3\n",
    }
    for name, content in text.items():
        (tmp_path / name).write_text(content)
        mesh = load_mesh(tmp_path / name)
        assert signed_areas(mesh.vertices[:, :2], mesh.faces).tolist() == [1.0, 1.0]


def test_corners_that_are_not_there():
    """A corner that names no point is refused; polygons of two corners are nothing."""
    with pytest.raises(ValueError, match="a face names vertex 7, there are 3"):
        cut_polygons(np.zeros((3, 3)), np.array([3]), np.array([0, 1, 7]))
    assert len(cut_polygons(np.zeros((3, 3)), np.array([2, 0]), np.array([0, 1]))[1]) == 0
