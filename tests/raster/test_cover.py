"""Which pixels a triangle covers, and the order of the fragments there."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from capture_scenes import orthographic, perspective, pixels_of, quad, rays_through, scene, soup, surface
from scipy.spatial import Delaunay

from warpfrag.capture.coverage import capture
from warpfrag.raster.ray import Window
from warpfrag.raster.triangles import prepare_triangles
from warpfrag.shapes.primitives import sphere, torus
from warpfrag.storage.lists import DYNAMIC, sort_lists
from warpfrag.storage.method import Room, count_fragments, fill


def counts_of(points, faces, camera, rows=None) -> np.ndarray:
    """Return how many triangles cover each pixel, given corners in camera space."""
    points = wp.array(np.ascontiguousarray(points), device="cpu")
    faces = wp.array(np.ascontiguousarray(faces, np.int32), device="cpu")
    window = Window.of(camera, rows)
    return count_fragments(prepare_triangles(points, faces, window)).numpy().reshape(window.row_count, window.width)


def shuffled(faces, random) -> np.ndarray:
    """Return the triangles in random order, each with a random first corner and winding."""
    return random.permuted(random.permutation(faces), axis=1)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("width", [40, 41])
def test_edges_through_pixel_centres_are_covered_once(seed, width):
    """A triangulated square covers each centre once, left and top edges in, right and bottom ones out."""
    random = np.random.default_rng(seed)
    inner = random.integers(-31, 32, (150, 2)) / 2.0
    border = np.array([[x, y] for x in (-16, 0, 16) for y in (-16, 0, 16)], float)
    points = np.unique(np.concatenate([inner, border]), axis=0)
    faces = shuffled(Delaunay(points).simplices, random)
    camera = orthographic((width, width))
    found = counts_of(np.column_stack([points, np.full(len(points), 2.0)]), faces, camera)
    centre = np.arange(width) + 0.5 - width / 2
    inside = (centre >= -16) & (centre < 16)
    np.testing.assert_array_equal(found, inside[:, None] & inside[None, :])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("seed", range(6))
def test_perspective_mesh_is_watertight(seed, dtype):
    """A triangulation whose corners lie at random depths covers each centre inside once."""
    random = np.random.default_rng(seed)
    camera = perspective((48, 48), 90.0)
    # Some corners at pixel centres, where many edges meet.
    seen = np.concatenate([random.uniform(-20, 20, (200, 2)), random.integers(-19, 19, (60, 2)) + 0.5])
    border = np.array([[x, y] for x in (-22, 22) for y in (-22, 22)], float)
    seen = np.concatenate([np.unique(seen, axis=0), border])
    depth = random.uniform(0.5, 20.0, len(seen))
    points = np.column_stack([seen / camera.focal * depth[:, None], depth]).astype(dtype)
    found = counts_of(points, shuffled(Delaunay(seen).simplices, random), camera)
    assert (found[2:-2, 2:-2] == 1).all()


@pytest.mark.parametrize("mesh", [sphere(1.0, 40), torus(1.0, 0.4, 50)], ids=["sphere", "torus"])
def test_closed_mesh_is_entered_as_often_as_left(mesh):
    """Every ray from outside meets a closed surface an even number of times."""
    camera = perspective((150, 150), 50.0)
    found = counts_of((mesh.vertices + np.array([0.05, 0.1, 3.0])).astype(np.float32), mesh.faces, camera)
    assert found.max() >= 2
    assert (found % 2 == 0).all()


def test_fan_around_pixel_centre_covers_it_once():
    """Slivers that meet at a pixel centre share it out to one of them."""
    angles = np.sort(np.random.default_rng(3).uniform(0, 2 * np.pi, 60))
    rim = np.column_stack([7 * np.cos(angles), 7 * np.sin(angles)])
    points = np.column_stack([np.concatenate([[[0.5, 0.5]], rim + 0.5]), np.full(61, 3.0)])
    around = np.arange(60)
    faces = np.column_stack([0 * around, around + 1, (around + 1) % 60 + 1])
    found = counts_of(points, faces, orthographic((16, 16)))
    assert found[8, 8] == 1
    assert found.max() == 1


def test_thin_diagonal_triangle_covers_what_its_edges_say():
    """Narrowing each row down loses no pixel of a long thin triangle."""
    camera = orthographic((300, 300))
    points = np.array([[-149.2, -148.7, 1.0], [148.9, 149.3, 1.0], [147.3, 149.4, 1.0]])
    found = counts_of(points, [[0, 1, 2]], camera)
    centre = np.arange(300) + 0.5 - 150
    x, y = np.meshgrid(centre, centre)
    edges = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        (ax, ay, _), (bx, by, _) = points[i], points[j]
        edges.append((bx - ax) * (y - ay) - (by - ay) * (x - ax))
    inside = (np.sign(edges) == np.sign(edges[0])).all(axis=0)
    assert 200 < inside.sum() < 1000
    np.testing.assert_array_equal(found, inside)


def test_ground_is_cut_at_near_and_far_plane():
    """A plane from far behind the eye to beyond the far plane has the analytic coverage and depth."""
    camera = perspective((64, 64), 80.0, near=2.0, far=9.0)
    ground = surface([[-500, 1, -300], [500, 1, -300], [500, 1, 800], [-500, 1, 800]], [[0, 1, 2], [0, 2, 3]])
    found = capture(scene(camera, ground))
    rays = rays_through(camera)
    with np.errstate(divide="ignore"):
        planar = 1.0 / rays[..., 1]
    np.testing.assert_array_equal(np.diff(found.offsets).reshape(64, 64), (planar >= 2.0) & (planar <= 9.0))
    expected = (planar * np.linalg.norm(rays, axis=-1)).reshape(-1)[pixels_of(found)]
    np.testing.assert_allclose(found.depth, expected, rtol=2e-7)


def test_random_triangles_around_the_eye_match_ray_casting():
    """Triangles behind, around and in front of the eye cover what ray casting in float64 says they do."""
    random = np.random.default_rng(5)
    camera = perspective((40, 30), 100.0, near=0.3, far=5.0)
    points = random.uniform(-3, 3, (600, 3))
    faces = np.arange(600).reshape(-1, 3)
    rays = rays_through(camera).reshape(-1, 3)
    expected = np.zeros(len(rays), int)
    for a, b, c in points[faces]:
        weights = rays @ np.linalg.inv(np.array([a, b, c]))
        depth = 1.0 / weights.sum(axis=1)
        expected += (weights >= 0).all(axis=1) & (depth >= 0.3) & (depth <= 5.0)
    assert expected.max() > 3
    np.testing.assert_array_equal(counts_of(points, faces, camera).reshape(-1), expected)


def test_both_faces_are_captured():
    """The winding of a triangle changes nothing."""
    one, other = quad(2.0), quad(2.0)
    other.faces = other.faces[:, ::-1].copy()
    first, second = (capture(scene(perspective(), item)) for item in (one, other))
    assert first.count == 32 * 32
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(first.offsets, second.offsets)


def test_degenerate_and_invalid_triangles_are_skipped():
    """Triangles without area, seen edge on, or with coordinates that are not finite cover nothing."""
    points = np.array(
        [
            *([0, 0, 2], [1, 1, 2], [3, 3, 2], [0.5, 0.5, 2], [-4, 2, 3]),
            *([0, 4, 2], [0, -4, 4], [0, 0, 3], [np.nan, 0, 2], [np.inf, 1, 2], [-np.inf, 1, 2]),
        ],
        np.float64,
    )
    faces = [[0, 1, 2], [0, 1, 3], [0, 0, 0], [4, 4, 1], [5, 6, 7], [0, 4, 8], [0, 4, 9], [9, 10, 4]]
    for camera in (orthographic((17, 17), 17.0), perspective((17, 17))):
        assert counts_of(points, faces, camera).sum() == 0


def test_huge_triangle_covers_everything():
    """A triangle far larger than the image covers every pixel, in single precision too."""
    points = np.array([[-3e7, -1e7, 5.0], [3e7, -1e7, 5.0], [0.0, 4e7, 5.0]], np.float32)
    assert (counts_of(points, [[0, 1, 2]], perspective((33, 20))) == 1).all()


def test_rows_are_those_of_the_image():
    """Capturing rows by themselves gives the fragments that the whole image has there."""
    setting = scene(perspective((32, 40)), soup(1), soup(2, name="more"))
    whole, part = capture(setting), capture(setting, rows=(7, 25))
    assert part.shape == (18, 32)
    begin, end = whole.offsets[7 * 32], whole.offsets[25 * 32]
    np.testing.assert_array_equal(part.offsets, whole.offsets[7 * 32 : 25 * 32 + 1] - begin)
    for name in ("rgba", "depth", "thickness", "object_id", "primitive_id"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[begin:end])


def test_fragments_are_sorted_by_depth_object_primitive():
    """sort=True orders by (depth, object, primitive), coincident triangles included."""
    setting = scene(perspective((40, 40)), soup(1, 60), quad(2.0), quad(2.0, name="twin"), soup(2, 60, name="more"))
    found = capture(setting)
    keys = np.column_stack([pixels_of(found), found.depth.astype(float), found.object_id, found.primitive_id])
    np.testing.assert_array_equal(np.lexsort(keys.T[::-1]), np.arange(found.count))
    assert np.diff(found.offsets).max() > 20
    same_pixel = np.diff(pixels_of(found)) == 0
    assert (same_pixel & (np.diff(found.depth) == 0)).any()


def test_unsorted_fragments_come_as_submitted():
    """sort=False orders by (object, primitive), and holds the same fragments."""
    setting = scene(perspective((40, 40)), soup(1, 60), soup(2, 60, name="more"))
    found, by_depth = capture(setting, sort=False), capture(setting)
    keys = np.column_stack([pixels_of(found), found.object_id, found.primitive_id])
    order = np.lexsort(keys.T[::-1])
    np.testing.assert_array_equal(order, np.arange(found.count))
    keys = np.column_stack([pixels_of(by_depth), by_depth.object_id, by_depth.primitive_id])
    order = np.lexsort(keys.T[::-1])
    for name in ("rgba", "depth", "thickness", "object_id", "primitive_id"):
        np.testing.assert_array_equal(getattr(found, name), getattr(by_depth, name)[order])
    np.testing.assert_array_equal(found.offsets, by_depth.offsets)


@pytest.mark.parametrize("objects", [[], [quad(-2.0)], [quad(200.0)]], ids=["none", "behind", "beyond"])
def test_nothing_in_view(objects):
    """A scene without anything to see has no fragments."""
    found = capture(scene(perspective((20, 10)), *objects))
    assert found.count == 0
    assert found.rgba.shape == (0, 4)
    assert found.shape == (10, 20)
    np.testing.assert_array_equal(found.offsets, np.zeros(201, np.int32))


def test_arguments_are_checked():
    """Wrong arguments are named."""
    setting = scene(perspective((20, 10)), quad(2.0))
    with pytest.raises(TypeError, match="scene: got str"):
        capture("scene.toml")
    with pytest.raises(TypeError, match="camera: got str"):
        capture(setting, "front")
    for rows in ((5, 2), (0, 11), (-1, 3), (0.0, 2.0)):
        with pytest.raises(ValueError, match="rows: got"):
            capture(setting, rows=rows)
    with pytest.raises(ValueError, match="memory_limit: got -1"):
        capture(setting, memory_limit=-1)


def test_a_thread_per_triangle_stores_the_same_fragments(monkeypatch):
    """The way of CUDA, a thread per triangle, gives the fragments that bands of rows give, once they are sorted."""
    # One thread: on the CPU the counters that triangles share are not atomic.
    monkeypatch.setenv("WARPFRAG_THREADS", "1")
    item = soup(1, 60)
    points = wp.array(item.vertices, device="cpu", dtype=wp.float32)
    by_bands = prepare_triangles(points, wp.array(item.faces, device="cpu"), Window.of(perspective((40, 40))))
    found = []
    for triangles in (by_bands, replace(by_bands, listed=None, band_begins=None)):
        room = Room(1600, wp.float32, points.device, lambda *told: None, counts=count_fragments(triangles))
        lists = fill(DYNAMIC, triangles, room)
        sort_lists(lists)
        found.append([array.numpy() for array in (lists.offsets, lists.items, lists.depths)])
    assert found[0][0][-1] > 500
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
