"""The reference of the OpenGL study: pyrender's image of flat-coloured faces is ours, sample by sample."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from study_modules import EXPERIMENTS, study_modules

import warpfrag as wf

FOLDER = EXPERIMENTS / "fit" / "opengl"
MODULES = ("comparison", "pyrender_image")
SIZE, SAMPLES = (40, 32), 8


@pytest.fixture(scope="module")
def study():
    """The study's modules."""
    with study_modules(FOLDER, MODULES) as modules:
        yield modules


@pytest.fixture(scope="module")
def scene():
    """The study's scene, small, and no square."""
    scene = wf.load_scene(FOLDER / "cube_and_sphere.toml")
    return replace(scene, camera=scene.camera.resized(SIZE))


@pytest.fixture(scope="module")
def compared(study, scene):
    """Both images with the vertices where OpenGL rounds them to; skips where there is no OpenGL."""
    if importlib.util.find_spec("pyrender") is None:
        pytest.skip("pyrender is not installed")
    try:
        return study.comparison.compare(study.comparison.on_grid(scene, SAMPLES), SAMPLES)
    except study.comparison.NoOpenGLError as error:
        pytest.skip(str(error))


def test_outside_intersections_pixels_agree(compared):
    """The residual outside intersections is below 1/255, and nearly everywhere that of colours of 16 bits."""
    residual, outside = compared.residual, ~compared.crossing
    assert residual[outside].max() < 1.0 / 255.0
    # At a silhouette a sample may meet front and back nearer to each other than 24 bits of depth resolve.
    assert compared.differing[outside].sum() <= 2
    # Half a step of 16 bits, and float32 of colours up to 1.
    assert residual[outside & (compared.differing == 0)].max() < 0.5 / 65535 + 1e-6
    assert compared.theirs.std() > 0.1


def test_at_intersections_a_sample_may_differ(compared):
    """Depths of 24 bits tell surfaces apart in all but a few samples of the pixels they cross in."""
    samples = compared.crossing.sum() * SAMPLES**2
    assert compared.crossing.sum() > 50
    assert compared.differing.sum() < 0.005 * samples


def test_vertices_move_less_than_the_grid(study, scene):
    """Rounding moves no projected vertex by more than half a step, in either direction, and no depth."""
    camera = study.comparison.resampled(scene.camera, SAMPLES)
    view = camera.view_matrix()
    moved = study.comparison.on_grid(scene, SAMPLES)
    for before, after in zip(scene.objects, moved.objects, strict=True):
        here, there = (item.world_vertices() @ view[:3, :3].T + view[:3, 3] for item in (before, after))
        apart = camera.focal * (there[:, :2] / there[:, 2:] - here[:, :2] / here[:, 2:])
        # Vertices are float32: 1e-7 of a unit at a distance of 3 is 1e-5 of a sample here.
        assert 0.3 / 256 < np.abs(apart).max() < 0.5 / 256 + 1e-4
        np.testing.assert_allclose(there[:, 2], here[:, 2], atol=1e-6)


def test_front_order_tells_who_is_in_front(study):
    """The first of two objects in front is 1, the second -1, and one alone 0."""
    camera = wf.Camera(eye=(0.0, 0.0, 4.0), target=(0.0, 0.0, 0.0), height=1.0, size=(4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    # Over columns 0 to 2, leaning back to the right; over columns 1 to 3, upright.
    leaning = np.array([[-2, -3, 2], [1, -3, -1], [1, 3, -1], [-2, 3, 2]])
    upright = np.array([[-1, -3, 0], [2, -3, 0], [2, 3, 0], [-1, 3, 0]])
    objects = [wf.SceneObject("leaning", leaning, faces), wf.SceneObject("upright", upright, faces)]
    order = study.comparison.front_order(wf.Scene(camera, objects))
    np.testing.assert_array_equal(order, [[0, 1, -1, 0]])


def test_unresolved_where_the_foremost_two_are_near(study):
    """Planes 1 P(z) apart are unresolved, 3 P(z) apart and alone they are not; what is behind plays no part."""
    camera = wf.Camera(eye=(0.0, 0.0, 4.0), target=(0.0, 0.0, 0.0), height=1.0, near=1.0, far=50.0, size=(3, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    step = float(wf.z_resolution(4.0, 1.0, 50.0))

    def plane(name: str, left: float, right: float, z: float) -> wf.SceneObject:
        corners = np.array([[left, -3, z], [right, -3, z], [right, 3, z], [left, 3, z]])
        return wf.SceneObject(name, corners, faces)

    # Columns are 1 wide and begin at -1.5: the first and second over columns 0 and 1, the third over 1 and 2.
    objects = [plane("a", -2, 0.5, 0.0), plane("b", -2, -0.5, -step), plane("c", -0.5, 2, -3.0 * step)]
    np.testing.assert_array_equal(study.comparison.unresolved(wf.Scene(camera, objects)), [[True, False, False]])
