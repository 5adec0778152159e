"""The antialiasing study's footprints and its band, on planes, where both are known."""

import numpy as np
import pytest
from study_modules import EXPERIMENTS, study_modules

import warpfrag as wf

FOLDER = EXPERIMENTS / "fit" / "antialiasing"
EYE, SIZE = (0.3, 0.2, 5.0), (24, 20)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture(scope="module")
def footprint():
    """The study's module."""
    with study_modules(FOLDER, ["footprint"]) as modules:
        yield modules.footprint


def plane(name, rise):
    """Return a large plane through the origin: z = rise·(x, y)."""
    corners = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])
    return wf.SceneObject(name, np.column_stack([corners, corners @ rise]), FACES)


def crossing_planes(one=(0.5, 0.1), other=(-0.4, 0.2)):
    """Return two planes that cross in the middle of the image."""
    camera = wf.Camera(eye=EYE, target=(0.0, 0.0, 0.0), fov=30.0, size=SIZE)
    return wf.Scene(camera, [plane("one", one), plane("other", other)])


def test_slopes_are_differences_of_depth(footprint):
    """The slope of a plane is half the difference of the depths right and left, and below and above."""
    scene = crossing_planes()
    fragments = wf.capture(scene, sort=False).numpy()
    slopes, sizes = footprint.slopes_of(scene, fragments)
    width, height = SIZE
    depth = fragments.depth.astype(np.float64).reshape(height, width, 2)
    slopes, sizes = slopes.reshape(height, width, 2, 2), sizes.reshape(height, width, 2)
    right, down = 0.5 * (depth[:, 2:] - depth[:, :-2]), 0.5 * (depth[2:] - depth[:-2])
    # Depth bends along a plane: 2e-4 of a pixel's slope here; float32 depths add 1e-6.
    np.testing.assert_allclose(slopes[:, 1:-1, :, 0], right, rtol=1e-3, atol=2e-5)
    np.testing.assert_allclose(slopes[1:-1, :, :, 1], down, rtol=1e-3, atol=2e-5)
    # At the origin, 5 units away.
    middle = np.linalg.norm(EYE) / scene.camera.focal
    assert sizes[height // 2, width // 2] == pytest.approx([middle, middle], rel=0.02)


def test_the_nearest_pair_tells_how_far_away_the_curve_is(footprint):
    """Along a row the distance to the line in which two planes cross falls by a pixel a pixel, and rises again."""
    # The line is vertical in the image where both rise only in x.
    scene = crossing_planes((0.5, 0.0), (-0.4, 0.0))
    scene.camera = wf.Camera(eye=(0.0, 0.0, 5.0), target=(0.0, 0.0, 0.0), fov=30.0, size=SIZE)
    pairs = footprint.nearest_pairs(scene, wf.capture(scene).numpy())
    distance = pairs.distance.reshape(SIZE[::-1])
    columns = np.abs(np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2)
    # Depth along the ray is not linear in the pixel: some per cent away from the line.
    near = columns < 5
    np.testing.assert_allclose(distance[:, near], np.tile(columns[near], (SIZE[1], 1)), rtol=0.1)


def test_crossing_pixels_are_those_that_the_line_passes_through(footprint):
    """The order of two planes changes in the pixels that their line of intersection passes through, and in no other."""
    scene = crossing_planes()
    crossing, band = footprint.intersection_band(scene, 8)
    view = scene.camera.view_matrix()
    # Points (x, y, z) of both planes: (0.9, −0.1)·(x, y) = 0.
    x = np.linspace(-3.0, 3.0, 20001)
    points = np.column_stack([x * 0.1, x * 0.9, 0.5 * x * 0.1 + 0.1 * x * 0.9]) @ view[:3, :3].T + view[:3, 3]
    column, row = scene.camera.focal * points[:, :2].T / points[:, 2] + np.array([[SIZE[0] / 2], [SIZE[1] / 2]])
    inside = (column >= 0) & (column < SIZE[0]) & (row >= 0) & (row < SIZE[1])
    passed = np.zeros_like(crossing)
    passed[row[inside].astype(int), column[inside].astype(int)] = True
    assert not (crossing & ~passed).any()
    # Where the line cuts a corner it may miss all samples but one side's.
    assert (passed & ~crossing).sum() <= 0.15 * passed.sum()
    assert (band.sum(axis=1) >= 2 * footprint.MARGIN + 1).all()


def test_edges_are_not_in_the_band(footprint):
    """Pixels in which samples see one side of a fold or the other, or no surface at all, belong to no band."""
    scene = crossing_planes()
    corners = np.array([[-9.0, -9, 0], [0, -9, 0], [0, 9, 0], [-9, 9, 0], [9, -9, -9], [9, 9, -9]])
    folded = wf.SceneObject("folded", corners, np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]))
    scene.objects = [folded, plane("other", (0.1, 0.2))]
    scene.camera = wf.Camera(eye=(0.05, 0.0, 5.0), target=(0.05, 0.0, 0.0), fov=30.0, size=SIZE)
    crossing, band = footprint.intersection_band(scene, 4)
    fold = int(SIZE[0] / 2 - 0.05 * scene.camera.focal / 5.0)
    assert crossing[:, :fold].any()
    assert not band[:, fold].any()
