"""The lens as parameters: other values are another camera, and images are differentiable in them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scene import spheres

from warpfrag.capture.coverage import Coverage, capture
from warpfrag.fit import FitParameter, Reference, Study, StudyError, fit
from warpfrag.render import render
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene
from warpfrag.scene.surface import SceneObject

PERSPECTIVE = Camera((0.1, 0.2, 3.0), (0.0, 0.1, 0.0), fov=50.0, size=(14, 12))
ORTHOGRAPHIC = Camera((0.1, 0.2, 3.0), (0.0, 0.1, 0.0), height=2.5, size=(14, 12))


def painted(camera: Camera) -> Scene:
    """Return two tilted triangles that fill the image, with colours and opacities by vertex, one behind the other."""
    corners = np.array([[-9.0, -8.0, 0.5], [9.0, -7.0, -0.4], [0.5, 12.0, 0.2]])
    colors = np.array([[1.0, 0.0, 0.2], [0.0, 1.0, 0.4], [0.3, 0.2, 1.0]])
    objects = [
        SceneObject("front", corners, [[0, 1, 2]], color=colors, opacity=[0.2, 0.5, 0.8]),
        SceneObject("back", corners[:, [1, 0, 2]] - [0, 0, 1.0], [[0, 1, 2]], color=colors[::-1], opacity=0.9),
    ]
    return Scene(camera, objects, merge="none")


CASES = {
    "fov": (PERSPECTIVE, "camera.fov", 40.0),
    "height": (ORTHOGRAPHIC, "camera.height", 2.0),
    "principal": (PERSPECTIVE, "camera.principal", (8.0, 5.5)),
    "principal, orthographic": (ORTHOGRAPHIC, "camera.principal", (8.0, 5.5)),
}


@pytest.mark.parametrize("case", CASES)
def test_values_are_those_of_another_camera(case):
    """In fragments and image, as numbers and as tensors, and built into the scene."""
    camera, name, value = CASES[case]
    scene = painted(camera)
    other = replace(camera, **{name.removeprefix("camera."): value})
    for given in (value, torch.tensor(value, dtype=torch.float64, requires_grad=True)):
        found = capture(scene, parameters={name: given, "beta": np.array(0.5)})
        expected = capture(scene, other, parameters={"beta": np.array(0.5)})
        for key in ("rgba", "depth", "offsets"):
            one = getattr(found, key)
            np.testing.assert_array_equal(one.detach() if hasattr(one, "detach") else one, getattr(expected, key))
    assert scene.with_parameters({name: value}).camera == other
    np.testing.assert_array_equal(render(scene, parameters={name: value}), render(scene, other))


@pytest.mark.parametrize("case", CASES)
def test_images_are_differentiable(case):
    """The gradient is that of differences: nothing crosses an edge, and depth has no say without merging."""
    camera, name, value = CASES[case]
    leaf = torch.tensor(value, dtype=torch.float64, requires_grad=True)
    scene = painted(camera)
    assert torch.autograd.gradcheck(lambda v: render(scene, parameters={name: v}), leaf, eps=1e-5, atol=1e-6)


def test_the_opening_angle_is_fitted():
    """By Adam and L-BFGS; least squares has no column for it."""
    scene = spheres()
    for item in scene.objects:
        item.color = (0.5 + 0.45 * np.sin(9.0 * item.vertices + np.arange(3.0))).astype(np.float32)
    start = {"camera.fov": FitParameter(41.0)}
    study = Study(scene, Reference(true={}), start, loss="l1", steps=40, learning_rate=2e-3)
    assert study.prepared.method == "adam"
    assert fit(study).found["camera.fov"] == pytest.approx(40.0, abs=0.1)
    with pytest.raises(StudyError, match=r'method: got "least_squares" for camera\.fov'):
        replace(study, method="least_squares")


def test_names_and_refusals():
    """A perspective camera has an angle, an orthographic one a height; coverage keeps its lens."""
    assert {"camera.fov", "camera.principal"} <= painted(PERSPECTIVE).parameter_names()
    assert "camera.height" in painted(ORTHOGRAPHIC).parameter_names()
    assert painted(PERSPECTIVE).parameters()["camera.principal"].tolist() == [7.0, 6.0]
    with pytest.raises(ValueError, match=r'unknown name "camera.height"'):
        render(painted(PERSPECTIVE), parameters={"camera.height": 1.0})
    with pytest.raises(ValueError, match="another lens"):
        Coverage.of(painted(PERSPECTIVE)).shade({"camera.fov": 20.0})
