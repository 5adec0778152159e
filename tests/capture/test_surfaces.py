"""The surfaces of a scene in camera space: one rounding, maps that are shared, tables that are kept."""

import numpy as np
import pytest
import torch
from capture_scenes import perspective, quad, scene, soup

from warpfrag.capture.coverage import capture
from warpfrag.capture.surfaces import surfaces_of, to_camera_space
from warpfrag.scene.camera import Camera
from warpfrag.scene.surface import SceneObject

# Somewhere in the north of Europe, in metres of the Universal Transverse Mercator system.
FAR_AWAY = np.array([500_000.0, 5_000_000.0, 100.0])
SLANTED = Camera((0.4, 0.3, -0.5), (0.1, 0.0, 2.0), (0.1, -1.0, 0.2), fov=60.0, size=(24, 20))


def far_away(item: SceneObject) -> SceneObject:
    """Return the same surface with vertices far away and a matrix that takes them back."""
    back = np.eye(4)
    back[:3, 3] = -FAR_AWAY
    return SceneObject(item.name, item.vertices + FAR_AWAY, item.faces, back, thickness=0.1, thickness_unit="scene")


@pytest.mark.parametrize("parameters", [{}, {"soup.opacity": torch.tensor(1.0)}, {"soup.rotation": [5.0, 0.0, 0.0]}])
def test_mesh_in_far_coordinates_lands_where_it_belongs(parameters):
    """Vertices of 5e6 that the matrix takes back land to 1e-6, whatever the precision of the image."""
    item = soup(1, 40)
    near = SceneObject("soup", item.vertices, item.faces)
    points = [surfaces_of(scene(SLANTED, each), SLANTED, parameters).points for each in (near, far_away(near))]
    assert str(points[0].dtype).endswith("float32")
    np.testing.assert_allclose(np.asarray(points[1]), np.asarray(points[0]), rtol=0, atol=1e-6)
    found, expected = (capture(scene(SLANTED, each), parameters=parameters) for each in (far_away(near), near))
    assert abs(found.count - expected.count) <= 1
    assert expected.count > 400


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_points_are_rounded_once(precision):
    """Camera space is the float64 product with the view, rounded to the image's precision, in NumPy and torch alike."""
    vertices = np.random.default_rng(0).uniform(-2, 2, (100, 3)) + 1e4
    view = SLANTED.view_matrix()
    # In the order of the sums.
    expected = np.stack(
        [r[0] * vertices[:, 0] + r[1] * vertices[:, 1] + r[2] * vertices[:, 2] + r[3] for r in view[:3]], 1
    )
    found = to_camera_space(vertices, SLANTED, precision=precision)
    np.testing.assert_array_equal(found, expected.astype(precision))
    tensor = to_camera_space(torch.tensor(vertices), SLANTED, precision=precision)
    np.testing.assert_array_equal(tensor.numpy(), found)


def test_gradients_flow_through_the_rounding():
    """A single-precision image is differentiable in vertices of either precision, with the view's own axes."""
    setting = scene(SLANTED, quad(2.0))
    for dtype in (torch.float32, torch.float64):
        leaf = torch.tensor(setting.objects[0].vertices, dtype=dtype, requires_grad=True)
        points = surfaces_of(setting, SLANTED, {"quad.vertices": leaf}).points
        (grad,) = torch.autograd.grad(points[:, 2].sum(), leaf)
        np.testing.assert_allclose(grad.numpy(), np.tile(SLANTED.view_matrix()[2, :3], (4, 1)), rtol=1e-6)


def test_map_for_all_objects_is_there_once():
    """A thickness map that objects share is one row, another one another."""
    setting = scene(perspective((6, 5)), *(quad(2.0 + i, name=f"quad{i}") for i in range(4)))
    common, own = np.full((5, 6), 0.1, np.float32), np.full((5, 6), 0.2, np.float32)
    surfaces = surfaces_of(
        setting, setting.camera, {"thickness": common, "quad1.thickness": own, "quad3.thickness": 0.3}
    )
    np.testing.assert_array_equal(surfaces.objects.numpy()[:, 1], [0, 1, 0, -1])
    np.testing.assert_array_equal(surfaces.maps, np.stack([common.reshape(-1), own.reshape(-1)]))


def test_tables_are_made_once():
    """What no parameter changes is taken over from surfaces of the same scene."""
    setting = scene(perspective((6, 5)), quad(2.0))
    first = surfaces_of(setting, setting.camera)
    again = surfaces_of(setting, setting.camera, {"quad.translation": [0.1, 0.0, 0.0]}, first.tables)
    assert again.tables is first.tables
    assert (again.points != first.points).any()
