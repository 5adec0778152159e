"""Light: falls as surfaces and camera stand, however they came there."""

from dataclasses import replace

import numpy as np
import pytest

from warpfrag.render import render
from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.light import Light, turned_normals
from warpfrag.scene.rotation import rotation_matrix
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes.mesh import split_faces
from warpfrag.shapes.primitives import cube, sphere

CAMERA = Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov=40.0, size=(24, 20))
OBLIQUE = Light((1.0, 0.3, 0.6), 0.2)
TURN = np.array([0.0, 90.0, 0.0])


def lit(light: Light | None = OBLIQUE, mesh=None, matrix=None, camera: Camera = CAMERA) -> Scene:
    """Return a scene of one lit object, by default a cube."""
    mesh = mesh or split_faces(cube())
    matrix = np.eye(4) if matrix is None else matrix
    return Scene(
        camera, [SceneObject("box", mesh.vertices, mesh.faces, matrix, normals=mesh.normals)], light=light, beta=0.5
    )


def test_a_turn_looks_the_same_however_it_is_given():
    """In the matrix, as a parameter, built into the scene, and as vertices that have been turned."""
    turn = np.array([20.0, -35.0, 10.0])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(turn)
    expected = render(lit(matrix=matrix))
    still = lit()
    vertices = still.objects[0].vertices @ matrix[:3, :3].T
    found = {
        "parameter": render(still, parameters={"box.rotation": turn.tolist()}),
        "scene": render(still.with_parameters({"box.rotation": turn})),
        "vertices": render(still, parameters={"box.vertices": vertices}),
        "scene's vertices": render(still.with_parameters({"box.vertices": vertices})),
    }
    for name, image in found.items():
        np.testing.assert_allclose(image, expected, atol=2e-6, err_msg=name)
    assert np.abs(render(still) - expected).max() > 0.1


def test_the_headlight_goes_with_the_camera_that_renders():
    """A white sphere is brightest in its middle from everywhere, and from where the camera is moved to."""
    ball = lit(Light(), sphere(1.0, 48))
    side = Camera((4.0, 0.0, 0.0), (0.0, 0.0, 0.0), fov=40.0, size=(24, 20))
    images = [
        render(ball),
        render(ball, side),
        render(ball, parameters={"camera.translation": [4.0, 0.0, 4.0], "camera.rotation": [0.0, -90.0, 0.0]}),
    ]
    for image in images:
        assert image[10, 12, 0] == pytest.approx(0.8, abs=0.01)
    np.testing.assert_allclose(images[2], images[1], atol=1e-5)


def test_directions_stay_in_the_world():
    """A light from one side leaves the other to the ambient part alone where it grazes."""
    factor = Light((0.0, 0.0, 1.0), 0.25).factor(np.eye(3), np.zeros((3, 3)), CAMERA)
    np.testing.assert_allclose(factor, [0.25, 0.25, 1.0])


def test_factors_have_no_gradient():
    """They are held fixed: a turn of a lit surface changes depths only."""
    torch = pytest.importorskip("torch")
    turn = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert not assemble(lit(), {"box.rotation": turn}).rgba.requires_grad


def test_normals_turn_with_their_surface():
    """A rigid turn of the vertices turns normals alike, those that are not its own, too."""
    mesh = sphere(1.0, 24)
    rotation = rotation_matrix(np.array([10.0, 40.0, -25.0]))
    found = turned_normals(mesh.normals, mesh.faces, mesh.vertices, mesh.vertices @ rotation.T)
    np.testing.assert_allclose(found, mesh.normals @ rotation.T, atol=0.05)
    same = turned_normals(mesh.normals, mesh.faces, mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(same, mesh.normals)


def test_unlit_objects_stay_as_they_are():
    """Without a light, or without normals."""
    scene = lit(None)
    np.testing.assert_array_equal(
        render(scene), render(replace(scene, objects=[replace(scene.objects[0], normals=None)], light=OBLIQUE))
    )


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"direction": (0, 0, 0)}, ValueError, "light.direction: got"),
        ({"direction": (0, 1)}, ValueError, "light.direction: got"),
        ({"ambient": 1.5}, ValueError, "light.ambient: got 1.5"),
        ({"ambient": "dim"}, TypeError, "light.ambient: got"),
    ],
)
def test_refused_lights(options, error, words):
    """With the value's name."""
    with pytest.raises(error, match=words):
        Light(**options)
    with pytest.raises(TypeError, match="light: got"):
        Scene(CAMERA, light=(0, 0, 1))
