"""Poses of objects and of the camera: rotations, what they move, zeros, and the gradients of images in them."""

import numpy as np
import pytest
import torch
from capture_scenes import orthographic, perspective, pixels_of, quad, scene, soup, surface

from warpfrag.capture.bounded import capture_kbuffer
from warpfrag.capture.coverage import capture
from warpfrag.render import render
from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.pose import pose_matrix, posed
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject
from warpfrag.shapes.primitives import cube

POSES = ("soup.translation", "soup.rotation", "camera.translation", "camera.rotation")


SLANTED = Camera((0.4, 0.3, -0.5), (0.1, 0.0, 2.0), (0.1, -1.0, 0.2), fov=60.0, size=(24, 20))


def block(**pose) -> np.ndarray:
    """Return the world vertices of a box of 2 × 4 × 6 about (1, 2, 3), in float64, with a pose."""
    matrix = np.diag([2.0, 4.0, 6.0, 1.0])
    matrix[:3, 3] = 1, 2, 3
    mesh = cube()
    setting = Scene(SLANTED, [SceneObject("box", mesh.vertices, mesh.faces, matrix)])
    parameters = {f"box.{key}": np.array(value, np.float64) for key, value in pose.items()}
    return assemble(setting, {"beta": np.array(0.5), **parameters}).vertices


def test_objects_move_by_hand():
    """An object turns about the middle of its box, along the world's axes, then moves."""
    own = block()
    np.testing.assert_allclose(own.min(axis=0), [0, 0, 0])
    np.testing.assert_allclose(own.max(axis=0), [2, 4, 6])
    shift = np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(block(translation=shift), own + shift, atol=1e-15)
    x, y, z = own.T
    turned = np.stack([1 - (y - 2), 2 + (x - 1), z], 1)
    np.testing.assert_allclose(block(rotation=(0, 0, 90)), turned, atol=1e-14)
    np.testing.assert_allclose(block(rotation=(0, 0, 90), translation=shift), turned + shift, atol=1e-14)


def test_the_middle_stays_with_the_scene():
    """The point to turn about is that of the scene's own vertices, whatever vertices are given."""
    vertices = np.array([[0.0, 0, 2], [1, 0, 2], [0, 1, 2]])
    setting = scene(SLANTED, surface(vertices, [[0, 1, 2]], "flat"))
    np.testing.assert_array_equal(setting.objects[0].middle(), [0.5, 0.5, 2])
    elsewhere = vertices + np.array([9.0, 0.0, 0.0])
    given = {"flat.vertices": elsewhere, "flat.rotation": np.array([0.0, 0, 180])}
    expected = np.array([1.0, 1.0, 0.0]) + elsewhere * np.array([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(assemble(setting, given).vertices, expected, atol=1e-14)


def test_camera_moves_as_the_scene_does_the_other_way():
    """Right, down and forward are the camera's own; turned to the right, what lay ahead lies to the left."""
    setting = scene(perspective((16, 12)), quad(2.0, 0.5))

    def depths(**parameters):
        return capture(setting, parameters=parameters)

    ahead = depths(**{"camera.translation": np.array([0.0, 0.0, 1.0])})
    np.testing.assert_allclose(ahead.depth, capture(scene(perspective((16, 12)), quad(1.0, 0.5))).depth)
    vertices = np.asarray(setting.objects[0].vertices, np.float64)
    right = depths(**{"camera.translation": np.array([0.25, 0.125, 0.0])})
    moved = depths(**{"quad.vertices": vertices - [0.25, 0.125, 0.0]})
    np.testing.assert_array_equal(right.offsets, moved.offsets)
    np.testing.assert_array_equal(right.depth, moved.depth)
    # About the axis that points down, positive is to the right.
    wide = scene(perspective((60, 20), 90.0), quad(2.0, 0.5))
    columns = [
        np.mean(pixels_of(capture(wide, parameters={"camera.rotation": (0, angle, 0)})) % 60)
        for angle in (-20.0, 0.0, 20.0)
    ]
    assert columns[0] > columns[1] + 2
    assert columns[2] < columns[1] - 2


@pytest.mark.parametrize("camera", [SLANTED, orthographic((24, 20), 2.5)], ids=["perspective", "orthographic"])
def test_posed_scene_is_the_scene_with_parameters(camera):
    """Poses built into matrices and camera give the same fragments; a camera given beside the scene is moved too."""
    setting = scene(camera, soup(1, 12), soup(2, 12, name="more"))
    parameters = {
        **{"soup.translation": (0.1, -0.05, 0.2), "soup.rotation": (20.0, -10.0, 30.0)},
        **{"camera.translation": (-0.1, 0.05, -0.2), "camera.rotation": (3.0, -4.0, 10.0)},
    }
    expected = capture(setting, parameters=parameters)
    assert expected.count > 200
    for found in (
        capture(posed(setting, parameters)),
        capture(scene(perspective(), *setting.objects), camera, parameters=parameters),
    ):
        np.testing.assert_array_equal(found.offsets, expected.offsets)
        np.testing.assert_array_equal(found.primitive_id, expected.primitive_id)
        for name in ("rgba", "depth", "thickness"):
            # World coordinates are rounded to float32 once more, or elsewhere.
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-5)
    still = posed(setting, {"soup.opacity": 0.5, "more.rotation": (0, 0, 1)})
    assert still.camera is setting.camera
    assert still.objects[0] is setting.objects[0]
    with pytest.raises(ValueError, match=r"more.rotation: got nan, expected numbers that are finite"):
        posed(setting, {"more.rotation": (0, float("nan"), 0)})


@pytest.mark.parametrize("kind", [np.float32, np.float64, torch.float32, torch.float64], ids=str)
def test_zeros_change_no_bit(kind):
    """Poses of zeros give the same fragments, layers and image to the bit."""
    setting = scene(SLANTED, soup(1, 12), soup(2, 12, name="more"), beta=0.4)
    zeros = np.zeros(3, kind) if not isinstance(kind, torch.dtype) else torch.zeros(3, dtype=kind)
    beta = np.array(0.4, kind) if not isinstance(kind, torch.dtype) else torch.tensor(0.4, dtype=kind)
    still = {"beta": beta}
    zero = {"beta": beta, **dict.fromkeys((*POSES, "more.translation", "more.rotation"), zeros)}
    for call in (capture, capture_kbuffer):
        found, expected = call(setting, parameters=zero), call(setting, parameters=still)
        for name in ("rgba", "depth", "thickness"):
            assert (getattr(found, name) == getattr(expected, name)).all()
    assert (render(setting, parameters=zero) == render(setting, parameters=still)).all()


def translucent(camera: Camera) -> Scene:
    """Return overlapping slabs with vertex colours, a texture, and a thickness in multiples of P."""
    random = np.random.default_rng(3)
    texture = {"uv": random.uniform(0, 1, (4, 2)), "texture": random.uniform(0.2, 1.0, (3, 4, 4))}
    look = {"color": random.uniform(0, 1, (18, 3)), "thickness_unit": "P", "thickness": 2e4}
    return scene(
        camera,
        soup(4, 6, z=(1.6, 2.4), **look),
        quad(2.1, 1.5, name="quad", opacity=0.5, color=(0.9, 0.8, 0.3), thickness=0.5, **texture),
        surface([[-2, -2, 1.9], [2, -2, 2.3], [0.1, 3, 2.2]], [[0, 1, 2]], "tilted", color=np.eye(3), opacity=0.6),
        background=(0.1, 0.2, 0.3, 1.0),
        beta=0.3,
    )


@pytest.mark.parametrize("turned", [False, True], ids=["zero", "posed"])
@pytest.mark.parametrize("camera", ["perspective", "orthographic"])
def test_images_are_differentiable_in_poses(camera, turned):
    """The gradient in all four poses at once equals central differences, at zero and away from it."""
    views = {
        "perspective": Camera((0.1, 0.2, -0.2), (0.0, 0.0, 2.0), (0, -1, 0), fov=50.0, near=0.5, far=4.0, size=(7, 6)),
        "orthographic": Camera((0, 0.1, 0), (0, 0, 2), (0, -1, 0), height=1.6, near=0.5, far=4.0, size=(7, 6)),
    }
    setting = translucent(views[camera])
    names = (*POSES, "quad.translation", "quad.rotation")
    values = np.zeros((6, 3))
    if turned:
        values[::2] = np.random.default_rng(0).uniform(-0.1, 0.1, (3, 3))
        values[1::2] = np.random.default_rng(1).uniform(-20, 20, (3, 3))
    leaves = tuple(torch.tensor(value, requires_grad=True) for value in values)

    weights = torch.tensor(np.random.default_rng(2).normal(size=(4, 6, 7, 4)))

    def weighted(*tensors):
        image = render(setting, parameters=dict(zip(names, tensors, strict=True)))
        return (weights * image).sum(dim=(1, 2, 3))

    # Steps of 1e-6 move no edge over a pixel centre and change no order in these scenes.
    assert torch.autograd.gradcheck(weighted, leaves, eps=1e-6, atol=1e-6, rtol=1e-4)
    for name, grad in zip(names, torch.autograd.grad(weighted(*leaves)[0], leaves), strict=True):
        assert (grad.abs() > 1e-6).sum() >= 2, name


def test_kbuffer_is_differentiable_in_poses():
    """The gradient of the bounded capture is that of the stored fragments' k-buffer."""
    from warpfrag.storage.kbuffer import kbuffer

    setting = scene(SLANTED, soup(1, 30), soup(2, 10, name="more"))

    def gradients(layers_of):
        leaves = {name: torch.full((3,), 0.1, dtype=torch.float64, requires_grad=True) for name in POSES}
        layers = layers_of(leaves)
        total = layers.rgba.square().sum() + layers.depth.square().sum() + layers.thickness.sum()
        return torch.autograd.grad(total, list(leaves.values()))

    bounded = gradients(lambda values: capture_kbuffer(setting, slots=3, parameters=values))
    stored = gradients(lambda values: kbuffer(capture(setting, sort=False, parameters=values), slots=3))
    for one, other in zip(bounded, stored, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9 * float(other.abs().max()))


@pytest.mark.parametrize("name", ["ball.rotation", "soup.color", "camera.fov", "beta"])
def test_pose_matrix_names_what_it_takes(name):
    """Only poses of the scene have a matrix."""
    with pytest.raises(ValueError, match=f'name: got "{name}", expected the translation or rotation'):
        pose_matrix(name, scene(SLANTED, soup(1)))
