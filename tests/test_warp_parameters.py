"""Scene parameters as Warp arrays: Warp arrays come out, recorded on an active tape."""

import subprocess
import sys

import numpy as np
import pytest
import torch
import warp as wp
from capture_scenes import perspective, scene, soup

from warpfrag.capture.coverage import capture
from warpfrag.render import render
from warpfrag.renderer import Renderer

NAMES = (
    "soup.vertices", "soup.color", "more.color", "soup.opacity", "more.opacity", "soup.thickness", "more.thickness",
    "beta", "soup.translation", "more.rotation", "camera.rotation", "camera.fov",
)  # fmt: skip


def crowd(size=(20, 18), **options):
    """Return a scene of overlapping translucent triangles."""
    return scene(perspective(size), soup(1, 20), soup(2, 20, name="more"), **{"beta": 0.4, **options})


def values_of(setting):
    """Return values of all kinds, by vertex, by pixel and single ones, as NumPy arrays."""
    own = {name: np.asarray(setting.parameters()[name], np.float32) for name in NAMES}
    random = np.random.default_rng(0)
    own["more.opacity"] = np.float32([0.6])
    own["more.thickness"] = random.uniform(0, 1, (18, 20)).astype(np.float32)
    own["beta"], own["camera.fov"] = own["beta"].reshape(1), own["camera.fov"].reshape(1)
    return own


def as_warp(values):
    """Return arrays as Warp's, vertices as vectors."""
    return {
        name: wp.array(
            value, dtype=wp.vec3 if name.endswith("vertices") else wp.float32, device="cpu", requires_grad=True
        )
        for name, value in values.items()
    }


def as_torch(values):
    """Return arrays as torch's, single numbers without dimensions."""
    return {
        name: torch.tensor(value.reshape(()) if value.shape == (1,) else value, requires_grad=True)
        for name, value in values.items()
    }


@pytest.mark.parametrize(
    "options", [{}, {"samples": 2}, {"memory_limit": 6e4}, {"resolve": "kbuffer", "merge": "none"}]
)
def test_gradients_on_a_tape_are_those_of_torch(options):
    """Image and gradient in every kind of parameter; going back twice adds up."""
    setting = crowd()
    given, tensors = as_warp(values_of(setting)), as_torch(values_of(setting))
    with wp.Tape() as tape:
        image = render(setting, parameters=given, **options)
    assert isinstance(image, wp.array)
    expected = render(setting, parameters=tensors, **options)
    np.testing.assert_array_equal(image.numpy(), expected.detach().numpy())
    (expected**2).sum().backward()
    seed = wp.array(2.0 * image.numpy(), device="cpu")
    for turn in (1.0, 2.0):
        tape.backward(grads={image: seed})
        for name in NAMES:
            grad = tensors[name].grad
            if grad is not None:
                found = given[name].grad.numpy().reshape(grad.shape)
                np.testing.assert_allclose(found, turn * grad.numpy(), rtol=1e-5, atol=1e-6, err_msg=name)
    assert given["soup.vertices"].grad.numpy().any()


def test_fragments_on_a_tape_go_on_into_operators():
    """What `capture` gives is composited on the same tape; the gradient goes through both."""
    from warpfrag.composite import composite

    setting = crowd()
    opacity = wp.array([0.4], dtype=wp.float32, device="cpu", requires_grad=True)
    with wp.Tape() as tape:
        fragments = capture(setting, parameters={"soup.opacity": opacity})
        image = composite(fragments, 0.4)
    assert fragments.kind == "warp"
    tape.backward(grads={image: wp.ones_like(image)})
    tensor = torch.tensor(0.4, requires_grad=True)
    render(setting, parameters={"soup.opacity": tensor}).sum().backward()
    np.testing.assert_allclose(opacity.grad.numpy(), [float(tensor.grad)], rtol=1e-5)


def test_without_a_tape_nothing_is_recorded_and_torch_is_not_needed():
    """Warp arrays come out, with the bits of NumPy's."""
    setting = crowd()
    values = values_of(setting)
    plain = {name: value.reshape(()) if value.shape == (1,) else value for name, value in values.items()}
    renderer = Renderer(setting)
    image = renderer.image(as_warp(values), ("color", "layers"))
    assert isinstance(image["color"], wp.array)
    assert image["layers"].kind == "warp"
    np.testing.assert_array_equal(image["color"].numpy(), render(setting, parameters=plain))
    program = """
import sys
sys.modules["torch"] = None
import warp as wp, warpfrag as wf
scene = wf.load_scene("example:three_spheres")
image = wf.render(scene, scene.camera.resized((8, 8)), beta=wp.array([0.5], dtype=float, requires_grad=True))
assert image.shape == (8, 8, 4)
try:
    with wp.Tape():
        wf.render(scene, beta=wp.array([0.5], dtype=float, requires_grad=True))
except ImportError as error:
    print(error)"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "warpfrag[torch]" in done.stdout


def test_warp_arrays_are_checked():
    """Integers, and arrays of two libraries, are refused by name."""
    with pytest.raises(TypeError, match=r"soup\.opacity: got a wp\.array of int32, expected float32 or float64"):
        render(crowd(), parameters={"soup.opacity": wp.zeros(1, dtype=int, device="cpu")})
    mixed = {"soup.opacity": wp.zeros(1, device="cpu"), "beta": torch.tensor(0.5)}
    with pytest.raises(TypeError, match=r"parameters: got soup\.opacity of warp and beta of torch, expected one"):
        render(crowd(), parameters=mixed)
