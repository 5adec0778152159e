"""What `render` gives beside the colour: the foremost surface and the layers."""

import numpy as np
import pytest
import torch
from capture_scenes import orthographic, perspective, quad, rays_through, scene, soup, surface

from warpfrag.capture.coverage import capture
from warpfrag.fragments import Layers
from warpfrag.render import render
from warpfrag.renderer import OUTPUTS, Renderer
from warpfrag.resolve.resolve import resolve


def crowd(size=(20, 18), **options):
    """Return a scene of overlapping translucent triangles."""
    return scene(perspective(size), soup(1, 20), soup(2, 20, name="more"), **{"beta": 0.4, **options})


def test_foremost_surface_by_hand():
    """The nearest surface that is seen at all: depth along the ray, object, normal towards the eye."""
    tilted = surface([[-9, -9, 2], [9, -9, 2], [9, 9, 20], [-9, 9, 20]], [[0, 2, 1], [0, 3, 2]], "tilted")
    setting = scene(perspective((8, 6)), quad(0.5, name="unseen", opacity=0.0), tilted, quad(30.0, 0.5, name="behind"))
    found = render(setting, output=("normal", "depth", "object_id"))
    assert list(found) == ["normal", "depth", "object_id"]
    # The plane y = z - 11 (y down) from the eye: depth t along the ray (x, y, 1) with t y = t - 11.
    rays = rays_through(setting.camera)
    planar = 11.0 / (1.0 - rays[..., 1])
    inside = (np.abs(planar * rays[..., 0]) < 9) & (np.abs(planar * rays[..., 1]) < 9)
    assert inside.any()
    assert not inside.all()
    expected = np.where(inside, planar * np.linalg.norm(rays, axis=-1), 0.0)
    np.testing.assert_allclose(found["depth"], expected, rtol=1e-5)
    np.testing.assert_array_equal(found["object_id"], np.where(inside, 1, -1))
    assert found["object_id"].dtype == np.int32
    normal = np.where(inside[..., None], np.array([0.0, 1.0, -1.0]) / np.sqrt(2.0), 0.0)
    np.testing.assert_allclose(found["normal"], normal, atol=1e-6)


def test_normals_of_an_orthographic_camera_face_it():
    """All rays are parallel there: a normal faces the camera wherever its surface lies."""
    square = surface([[-9, -9, 5], [9, -9, 5.5], [9, 9, 5.5], [-9, 9, 5]], [[0, 1, 2], [0, 2, 3]])
    normal = render(scene(orthographic((6, 4)), square), output="normal")
    assert (normal[..., 2] < -0.99).all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=1e-6)


@pytest.mark.parametrize("options", [{}, {"merge": "none", "max_layers": 2}, {"merge": "exact", "beta": 0.2}])
def test_layers_are_those_of_resolve(options):
    """Layers and their number are what `resolve` makes of the scene's fragments; the colour is that of `render`."""
    setting = crowd()
    chosen = {"beta": 0.4, "max_layers": 8, "merge": "smooth", **options}
    expected = resolve(capture(setting), **chosen)
    found = render(setting, output=["layers", "count", "color"], **options)
    assert isinstance(found["layers"], Layers)
    for name, array in vars(found["layers"]).items():
        np.testing.assert_array_equal(array, getattr(expected, name))
    np.testing.assert_array_equal(found["count"], expected.count)
    np.testing.assert_array_equal(found["color"], render(setting, **options))


@pytest.mark.parametrize("options", [{}, {"resolve": "kbuffer", "merge": "order_independent", "max_layers": 3}])
def test_bands_have_the_same_outputs(options):
    """Where memory is short, every output is that of the whole image, to the bit."""
    setting = crowd((40, 36))
    setting.objects.extend(quad(2.0 + 0.01 * i, name=f"quad{i}", opacity=0.1) for i in range(40))
    whole = render(setting, output=OUTPUTS, **options)
    limit = 0.4 * 36 * capture(setting).count
    with pytest.raises(MemoryError):
        capture(setting, memory_limit=limit)
    banded = render(setting, output=OUTPUTS, memory_limit=limit, **options)
    banded["layers"], whole["layers"] = vars(banded["layers"]), vars(whole["layers"])
    np.testing.assert_equal(banded, whole)


def test_outputs_but_the_colour_are_of_the_centre():
    """Whatever the number of samples; the colour beside them is the mean."""
    setting = crowd()
    found = render(setting, output=("depth", "color", "object_id"), samples=3)
    assert list(found) == ["depth", "color", "object_id"]
    np.testing.assert_array_equal(found["color"], render(setting, samples=3))
    for name in ("depth", "object_id"):
        np.testing.assert_array_equal(found[name], render(setting, output=name))
    renderer = Renderer(setting, samples=3)
    np.testing.assert_array_equal(renderer.image({"thickness": 0.1}, "count"), render(
        setting, parameters={"thickness": 0.1}, output="count"))  # fmt: skip


def test_depth_and_layers_are_differentiable():
    """The gradient of the foremost depth, of all pixels away from edges, equals central differences."""
    setting = scene(perspective((6, 6)), quad(2.0, 9.0, name="front"), quad(3.0, 9.0, name="back"))
    own = torch.tensor(setting.parameters()["front.vertices"], dtype=torch.float64, requires_grad=True)

    def depth(vertices):
        return render(setting, parameters={"front.vertices": vertices}, output="depth")

    assert torch.autograd.gradcheck(depth, (own,), eps=1e-6, atol=1e-6)
    turn = torch.zeros(3, dtype=torch.float64, requires_grad=True)

    def layers(rotation):
        return render(setting, parameters={"camera.rotation": rotation}, output="layers").depth

    assert torch.autograd.gradcheck(layers, (turn,), eps=1e-4, atol=1e-5)
    found = render(setting, parameters={"front.vertices": own}, output=("normal", "object_id", "count"))
    assert not any(tensor.requires_grad for tensor in found.values())


@pytest.mark.parametrize(
    ("output", "error", "message"),
    [
        ("colour", ValueError, 'output: got "colour", expected one of .*did you mean "color"'),
        ((), ValueError, "one or more names, each once"),
        (("depth", "depth"), ValueError, "one or more names, each once"),
        (3, TypeError, "output: got 3, expected a name or a sequence of names"),
    ],
)
def test_names_are_checked(output, error, message):
    """What does not exist is named."""
    with pytest.raises(error, match=message):
        render(crowd(), output=output)
