"""Cameras: conventions of camera space, sizes, and refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest

from warpfrag.render import render
from warpfrag.scene.camera import Camera
from warpfrag.scene.rotation import rotation_matrix
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject

TRIANGLE = np.array([[-0.8, -0.6, 0.0], [0.9, -0.5, 0.2], [0.1, 0.8, -0.1]]), [[0, 1, 2]]


def project(camera, point):
    """Pixel coordinates (column, row) of a world point."""
    x, y, z = (camera.view_matrix() @ [*point, 1.0])[:3]
    width, height = camera.size
    if camera.is_perspective:
        return x / z * camera.focal + camera.middle[0], y / z * camera.focal + camera.middle[1]
    return x / camera.pixel_size + width / 2, y / camera.pixel_size + height / 2


def test_view_matrix_of_a_camera_on_the_z_axis():
    """From +z towards the origin: x right, y down, z forward, worked by hand."""
    camera = Camera(eye=(0, 0, 3), target=(0, 0, 0), fov=60)
    np.testing.assert_allclose(
        camera.view_matrix(), [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]], atol=1e-15
    )


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 1e-200, 0), (0.3, 1e150, 0)])
def test_view_matrix_is_a_rotation(up):
    """The axes are orthonormal and right-handed, for every length of up."""
    rotation = Camera(eye=(1, 2, 3), target=(-1, 0.5, 2), up=up, fov=60).view_matrix()[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_perspective_projects_the_edges_of_the_field_of_view():
    """A point on the upper edge of the vertical field of view lands on row 0, the target in the middle."""
    camera = Camera(eye=(0, 0, 2), target=(0, 0, 0), fov=90, size=(64, 48))
    assert camera.focal == pytest.approx(24.0)
    assert project(camera, (0, 0, 0)) == pytest.approx((32, 24))
    assert project(camera, (0, 2, 0)) == pytest.approx((32, 0))
    assert project(camera, (1, 0, 0))[0] > 32


def test_orthographic_height_spans_the_image():
    """`height` is the vertical extent in scene units; depth does not matter."""
    camera = Camera(eye=(0, 0, 2), target=(0, 0, 0), height=3.0, size=(60, 30))
    assert camera.pixel_size == pytest.approx(0.1)
    assert not camera.is_perspective
    for depth in (-5, 0, 1):
        assert project(camera, (3, 1.5, depth)) == pytest.approx((60, 0))


def test_shape_and_resized():
    """Size is (width, height), shape is (H, W); resizing keeps the vertical field of view."""
    camera = Camera(eye=(0, 0, 2), target=(0, 0, 0), fov=40, size=(64, 48)).resized((128, 96))
    assert (camera.width, camera.shape) == (128, (96, 128))
    assert camera.focal == pytest.approx(48 / math.tan(math.radians(20)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fov": None}, "camera: got neither of fov and height"),
        ({"height": 1.0}, "camera: got both of fov and height"),
        ({"fov": 180}, "camera.fov: got 180"),
        ({"fov": None, "height": 0}, "camera.height: got 0"),
        ({"near": 0}, "camera.near: got 0"),
        ({"near": 2, "far": 2}, r"camera.far: got 2, expected a number above near \(2\)"),
        ({"target": (0, 0, 2)}, "camera.target: got the eye itself"),
        ({"up": (0, 0, -3)}, "camera.up"),
        ({"up": (0, 0, 0)}, "camera.up"),
        ({"eye": (0, float("nan"), 2)}, "camera.eye: got nan"),
        ({"eye": (0, 2)}, "camera.eye: got .*expected 3 numbers"),
        ({"near": True}, "camera.near: got true"),
        ({"size": (0, 5)}, "camera.size"),
        ({"size": (5.5, 5)}, "camera.size"),
        ({"size": (65536, 65536)}, "camera.size: got .*, up to 2147483646 pixels in all"),
    ],
)
def test_refusals_name_the_field(change, words):
    """Every value out of range is refused with its name, what was got and what is expected."""
    with pytest.raises(TypeError if change.get("near") is True else ValueError, match=words):
        Camera(**{"eye": (0, 0, 2), "target": (0, 0, 0), "fov": 45.0, **change})


def test_the_other_kind_of_camera_has_no_focal_or_pixel_size():
    """Asking a camera for what it does not have is an error that says so."""
    with pytest.raises(ValueError, match="orthographic camera has none"):
        _ = Camera(eye=(0, 0, 2), target=(0, 0, 0), height=1.0).focal
    with pytest.raises(ValueError, match="perspective camera has none"):
        _ = Camera(eye=(0, 0, 2), target=(0, 0, 0), fov=45.0).pixel_size


def turned() -> np.ndarray:
    """Return a rotation that is no special one."""
    return rotation_matrix(np.array([20.0, -50.0, 130.0]))


def test_camera_from_a_matrix():
    """The matrix is the inverse of the view matrix, in either convention; lengths and far places keep their digits."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turned(), [5e5, -4e6, 200.0]
    camera = Camera.from_matrix(matrix, fov=50.0, size=(30, 20))
    np.testing.assert_allclose(camera.view_matrix() @ matrix, np.eye(4), atol=1e-8)
    np.testing.assert_allclose(camera.view_matrix()[:3, :3], turned().T, atol=1e-14)
    opengl = matrix @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert Camera.from_matrix(opengl, axes="opengl", fov=50.0, size=(30, 20)) == camera
    assert not Camera.from_matrix(np.eye(4), height=2.0).is_perspective


def test_camera_from_intrinsics():
    """A point projects where K (R x + t) says, principal point anywhere; K comes back."""
    intrinsics = np.array([[50.0, 0.0, 11.5], [0.0, 50.0, 21.25], [0.0, 0.0, 1.0]])
    shift = np.array([0.1, -0.2, 3.0])
    camera = Camera.from_intrinsics(intrinsics, turned(), shift, (40, 30), near=0.5)
    point = np.array([0.3, 0.2, -0.4])
    x, y, z = intrinsics @ (turned() @ point + shift)
    assert project(camera, point) == pytest.approx((x / z, y / z))
    np.testing.assert_allclose(camera.intrinsics(), intrinsics, rtol=1e-12)
    assert (camera.near, camera.size) == (0.5, (40, 30))
    half = camera.resized((20, 15))
    assert project(half, point) == pytest.approx((0.5 * x / z, 0.5 * y / z))


@pytest.mark.parametrize("options", [{"fov": 60.0}, {"height": 2.0}])
def test_principal_point_shifts_the_image(options):
    """Three pixels to the right and two up: the same pixels elsewhere."""
    scene = Scene(Camera((0, 0, 3), (0, 0, 0), size=(24, 20), **options), [SceneObject("x", *TRIANGLE)])
    image = render(scene)
    shifted = render(scene, replace(scene.camera, principal=(15.0, 8.0)))
    np.testing.assert_allclose(shifted[:18, 3:], image[2:, :21], atol=1e-6)
    assert image[2:, :21].max() > 0.5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"intrinsics": np.diag([50.0, 60.0, 1.0])}, "got focal lengths 50 and 60 and skew 0, expected square pixels"),
        ({"intrinsics": np.eye(4)}, r"intrinsics: got shape \(4, 4\)"),
        ({"rotation": 2.0 * np.eye(3)}, "rotation: got a matrix that is no rotation"),
        ({"rotation": -np.eye(3)}, "rotation: got a matrix that is no rotation"),
        ({"translation": [1.0, 2.0]}, r"translation: got shape \(2,\)"),
    ],
)
def test_refused_calibrations(change, words):
    """What is no calibration of square pixels is refused with its name."""
    given = {"intrinsics": np.diag([50.0, 50.0, 1.0]), "rotation": np.eye(3), "translation": np.zeros(3)}
    with pytest.raises(ValueError, match=words):
        Camera.from_intrinsics(**{**given, **change}, size=(40, 30))
    with pytest.raises(ValueError, match="axes: got"):
        Camera.from_matrix(np.eye(4), axes="blender", fov=50.0)


def test_look_at_is_the_constructor():
    """With eye, target and up."""
    assert Camera.look_at([0, 0, 3], [0, 0, 0], fov=45.0) == Camera((0, 0, 3), (0, 0, 0), fov=45.0)
