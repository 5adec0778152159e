"""What fragments look like: interpolation, textures, z-thickness, and the gradients of all that."""

import numpy as np
import pytest
import torch
from capture_scenes import orthographic, perspective, pixels_of, quad, rays_through, scene, soup, stretch_of, surface

from warpfrag.capture.coverage import capture
from warpfrag.scene.camera import Camera
from warpfrag.scene.depth_resolution import z_resolution
from warpfrag.shapes.primitives import sphere

TILTED = np.array([[-6.0, -5.0, 2.0], [7.0, -4.0, 3.0], [5.0, 6.0, 9.0], [-8.0, 7.0, 8.0]])
"""Corners of a tilted square-like patch, not of one plane."""


def hits(found, camera) -> np.ndarray:
    """Return where the fragments lie in camera space."""
    rays = rays_through(camera).reshape(-1, 3)[pixels_of(found)]
    return rays * (found.depth.astype(float) / np.linalg.norm(rays, axis=-1))[:, None]


def test_sphere_depth_is_analytic():
    """Front and back of a fine sphere lie where the ray meets the exact one, along the ray."""
    camera = Camera(eye=(1.0, 2.0, 3.0), target=(0.1, 0.0, 0.0), fov=40.0, size=(64, 48))
    mesh = sphere(1.0, 512)
    found = capture(scene(camera, surface(mesh.vertices, mesh.faces)))
    rays = rays_through(camera)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ camera.view_matrix()[:3, :3]
    eye = np.array(camera.eye)
    along = -(rays @ eye)
    nearest = np.linalg.norm(eye + along[..., None] * rays, axis=-1)
    half = np.sqrt(np.maximum(0, 1 - nearest**2))
    # Off the silhouette, where the facets' distance from the sphere (7e-5) shows little.
    inside = nearest < 0.9
    counts = np.diff(found.offsets).reshape(48, 64)
    assert (counts[inside] == 2).all()
    assert (counts[nearest > 1] == 0).all()
    begins = found.offsets[:-1].reshape(48, 64)[inside]
    np.testing.assert_allclose(found.depth[begins], (along - half)[inside], atol=3e-4)
    np.testing.assert_allclose(found.depth[begins + 1], (along + half)[inside], atol=3e-4)


def test_orthographic_depth_is_along_the_axis():
    """An orthographic camera's depth is the planar depth, and columns and rows are multiples of a pixel."""
    camera = Camera(eye=(0, 0, 0), target=(0, 0, 1), up=(0, -1, 0), height=4.0, size=(20, 10))
    patch = surface([[-4, -2, 1], [4, -2, 5], [4, 2, 9], [-4, 2, 5]], [[0, 1, 2], [0, 2, 3]])
    found = capture(scene(camera, patch))
    assert found.count == 200
    x = (np.arange(20) + 0.5 - 10) * 0.4
    y = (np.arange(10) + 0.5 - 5) * 0.4
    expected = 5 + 0.5 * x[None, :] + y[:, None]
    np.testing.assert_allclose(found.depth.reshape(10, 20), expected, rtol=1e-6)


def test_attributes_are_perspective_correct():
    """What is linear in space on a plane is found so at the hits: colour, opacity and thickness."""
    camera = perspective((48, 48), 70.0)
    plane = TILTED.copy()
    plane[:, 2] = 4.0 + 0.3 * plane[:, 0] + 0.2 * plane[:, 1]
    linear = 0.5 + plane @ [0.03, 0.01, 0.02]
    found = capture(
        scene(camera, surface(plane, [[0, 1, 2], [2, 0, 3]], color=np.stack([linear] * 3, 1), opacity=linear * 0.5,
                              thickness=linear))
    )  # fmt: skip
    assert found.count > 1000
    value = 0.5 + hits(found, camera) @ [0.03, 0.01, 0.02]
    np.testing.assert_allclose(found.thickness, value, rtol=1e-6)
    np.testing.assert_allclose(found.rgba[:, 3], 0.5 * value, rtol=1e-6)
    np.testing.assert_allclose(found.rgba[:, :3], (0.5 * value * value)[:, None].repeat(3, 1), rtol=1e-6)


def test_constant_attributes_stay_exact():
    """Equal corners give exactly their value, opacity 1 and thickness 0 at the ends of their ranges included."""
    found = capture(scene(perspective(), soup(1, opacity=1.0, thickness=0.0, color=(0.1, 0.2, 0.3))))
    assert found.count > 100
    np.testing.assert_array_equal(found.rgba, np.tile(np.float32([0.1, 0.2, 0.3, 1.0]), (found.count, 1)))
    np.testing.assert_array_equal(found.thickness, 0.0)


def test_texture_multiplies_color_and_opacity():
    """A texture is read bilinearly between texel centres, v up, repeating, and multiplies colour and opacity."""
    random = np.random.default_rng(0)
    texture = random.uniform(0.1, 1.0, (3, 5, 4)).astype(np.float32)
    camera = orthographic((20, 20))
    corners = np.array([[-10, -10, 2], [10, -10, 2], [10, 10, 2], [-10, 10, 2]])
    uv = np.array([[-0.5, 1.7], [1.5, 1.7], [1.5, -0.6], [-0.5, -0.6]])
    item = surface(corners, [[0, 1, 2], [0, 2, 3]], color=(0.5, 1.0, 0.25), opacity=0.5, uv=uv, texture=texture)
    plain = quad(3.0, name="plain", color=(1.0, 1.0, 1.0), opacity=0.25)
    found = capture(scene(camera, item, plain))
    centre = (np.arange(20) + 0.5) / 20
    u, v = np.meshgrid(-0.5 + 2.0 * centre, 1.7 - 2.3 * centre)
    x, y = u * 5 - 0.5, (1 - v) * 3 - 0.5
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - column)[..., None], (y - row)[..., None]
    upper = texture[row % 3, column % 5] * (1 - fx) + texture[row % 3, (column + 1) % 5] * fx
    lower = texture[(row + 1) % 3, column % 5] * (1 - fx) + texture[(row + 1) % 3, (column + 1) % 5] * fx
    expected = (upper * (1 - fy) + lower * fy) * [0.5, 1.0, 0.25, 0.5]
    expected[..., :3] *= expected[..., 3:]
    textured = found.object_id == 0
    np.testing.assert_allclose(found.rgba[textured].reshape(20, 20, 4), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found.rgba[~textured], 0.25)


def test_thickness_map_is_taken_per_pixel():
    """An object with a thickness map takes each pixel's value; the others keep their own; rows take the map's rows."""
    random = np.random.default_rng(0)
    first, second = (random.uniform(0, 1, (10, 16)).astype(np.float32) for _ in range(2))
    plain = quad(2.0, name="plain", thickness=0.25)
    objects = [quad(1.0, name="a", thickness=first), plain, quad(3.0, name="b", thickness=second)]
    found = capture(scene(perspective((16, 10)), *objects), rows=(2, 9))
    by_object = found.thickness.reshape(7, 16, 3)
    np.testing.assert_array_equal(by_object[..., 0], first[2:9])
    np.testing.assert_array_equal(by_object[..., 1], 0.25)
    np.testing.assert_array_equal(by_object[..., 2], second[2:9])


def test_thickness_in_multiples_of_depth_resolution():
    """A thickness in the unit P is its factor times P of the planar depth, seen along the ray."""
    camera = perspective((16, 10), near=0.1, far=50.0)
    factors = np.linspace(1, 3, 160).reshape(10, 16)
    objects = [quad(2.0, thickness=2.0, thickness_unit="P"), quad(3.0, name="b", thickness=factors, thickness_unit="P")]
    found = capture(scene(camera, *objects))
    along = stretch_of(camera)[..., None]
    resolution = along * z_resolution(found.depth.reshape(10, 16, 2) / along, 0.1, 50.0)
    expected = resolution * np.stack([np.full((10, 16), 2.0), factors], -1)
    np.testing.assert_allclose(found.thickness.reshape(10, 16, 2), expected, rtol=1e-6)


def test_thickness_in_multiples_of_an_orthographic_depth_resolution():
    """There P is (far − near)·2^−24 at every depth: the slope is zero, a factor's derivative P itself."""
    objects = [quad(2.0, thickness=2.0, thickness_unit="P"), quad(3.0, name="b", thickness=10.0, thickness_unit="P")]
    camera = orthographic((6, 4))
    setting = scene(camera, *objects)
    p = (camera.far - camera.near) * 2.0**-24
    found = capture(setting)
    np.testing.assert_allclose(found.thickness, np.where(found.object_id == 0, 2.0, 10.0) * p, rtol=1e-6)
    values = leaves(setting, "quad.vertices", "b.thickness")
    thickness = capture(setting, parameters=values).thickness
    by_vertex, by_factor = torch.autograd.grad(thickness.sum(), list(values.values()))
    assert by_vertex.abs().max() < 1e-12 * p
    assert by_factor.sum().item() == pytest.approx(24 * p)


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_precision_follows_the_parameters(kind):
    """float64 parameters give float64 fragments, equal to the float32 ones up to rounding."""
    setting = scene(perspective(), soup(4))
    vertices = setting.objects[0].vertices
    single = capture(setting)
    double = vertices.astype(np.float64) if kind == "numpy" else torch.tensor(vertices, dtype=torch.float64)
    found = capture(setting, parameters={"soup.vertices": double})
    assert found.kind == kind
    assert str(found.rgba.dtype).endswith("float64")
    found = found.numpy()
    np.testing.assert_array_equal(found.primitive_id, single.primitive_id)
    for name in ("rgba", "depth", "thickness"):
        np.testing.assert_allclose(getattr(found, name), getattr(single, name), rtol=1e-6, atol=1e-7)


def test_torch_and_numpy_have_the_same_bits():
    """A torch parameter equal to the scene's own value changes the kind of the arrays, not their bits."""
    setting = scene(Camera((1.0, 2.0, -3.0), (0.0, 0.0, 2.0), fov=50.0, size=(40, 40)), soup(4, 40))
    own = capture(setting)
    found = capture(setting, parameters={"soup.vertices": torch.tensor(setting.objects[0].vertices)}).numpy()
    for name in ("rgba", "depth", "thickness", "offsets", "object_id", "primitive_id"):
        np.testing.assert_array_equal(getattr(found, name), getattr(own, name))


def leaves(setting, *names) -> dict:
    """Return the named parameters of a scene as float64 leaves of a graph."""
    values = setting.parameters()
    return {name: torch.tensor(values[name], dtype=torch.float64, requires_grad=True) for name in names}


def check_gradients(setting, *names):
    """Compare the gradients of all fragments in the named parameters with central differences."""
    values = leaves(setting, *names)

    def fragments_of(*tensors):
        found = capture(setting, parameters=dict(zip(names, tensors, strict=True)))
        return found.rgba, found.depth, found.thickness

    assert fragments_of(*values.values())[1].shape[0] > 20
    # Steps of 1e-6 move no edge over a pixel centre and change no order in these scenes.
    assert torch.autograd.gradcheck(fragments_of, tuple(values.values()), eps=1e-6, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize(
    "camera", [perspective((8, 8)), orthographic((8, 8), 2.0)], ids=["perspective", "orthographic"]
)
def test_gradients_equal_differences(camera):
    """Fragments are differentiable in vertices, colour, opacity and thickness, while coverage stays."""
    setting = scene(camera, soup(7, 5))
    check_gradients(setting, "soup.vertices", "soup.color", "soup.opacity", "soup.thickness")


def test_gradients_with_a_moved_camera_and_global_parameters():
    """One colour, opacity and thickness per object sum up over all its fragments."""
    camera = Camera((0.5, 0.4, -0.5), (0.0, 0.0, 2.0), fov=60.0, size=(9, 11))
    setting = scene(camera, soup(2, 6, color=(0.2, 0.3, 0.4), opacity=0.3, thickness=0.2), soup(3, 3, name="more"))
    check_gradients(setting, "soup.vertices", "soup.color", "soup.opacity", "soup.thickness", "more.opacity")


def test_gradients_with_textures():
    """The place in a texture moves with the vertices; texels differ, so its gradient shows."""
    random = np.random.default_rng(1)
    look = {"uv": random.uniform(-1, 2, (18, 2)), "texture": random.uniform(0.2, 1.0, (4, 3, 4))}
    check_gradients(scene(perspective((10, 10)), soup(11, 6, **look)), "soup.vertices", "soup.color", "soup.opacity")


def test_gradients_of_thickness_maps_and_multiples_of_p():
    """Thickness is differentiable per pixel, and in the depth where it is given in multiples of P."""
    camera = perspective((9, 8), near=0.5, far=4.0)
    big = {"thickness_unit": "P", "thickness": np.random.default_rng(0).uniform(1e5, 2e5, (8, 9))}
    setting = scene(camera, soup(5, 4, **big), soup(6, 4, name="factor", thickness=1e5, thickness_unit="P"))
    check_gradients(setting, "soup.thickness", "soup.vertices", "factor.vertices")
    # The factor's own derivative is P itself, too small next to these thicknesses for differences: it is linear.
    values = leaves(setting, "factor.thickness")
    found = capture(setting, parameters=values)
    (grad,) = torch.autograd.grad(found.thickness[found.object_id == 1].sum(), list(values.values()))
    fragments = found.numpy()
    own = fragments.object_id == 1
    along = stretch_of(camera).reshape(-1)[fragments.pixel][own]
    expected = (along * z_resolution(fragments.depth[own] / along, 0.5, 4.0)).sum()
    np.testing.assert_allclose(float(grad), expected, rtol=1e-6)


def test_large_triangle_in_strips():
    """A triangle of many strips has the gradient that differences give in one direction."""
    setting = scene(perspective((90, 80), 50.0), surface(TILTED, [[0, 1, 2], [0, 2, 3]]))
    values = leaves(setting, "surface.vertices")
    weights = torch.tensor(np.random.default_rng(0).normal(size=80 * 90))

    def weighted(vertices):
        return (capture(setting, parameters={"surface.vertices": vertices}).depth * weights).sum()

    vertices = values["surface.vertices"]
    direction = torch.tensor(np.random.default_rng(1).normal(size=(4, 3)))
    (grad,) = torch.autograd.grad(weighted(vertices), vertices)
    step = 1e-6 * direction
    with torch.no_grad():
        difference = (weighted(vertices + step) - weighted(vertices - step)) / 2e-6
    torch.testing.assert_close((grad * direction).sum(), difference, rtol=1e-6, atol=1e-6)


def test_only_needed_gradients_and_unused_outputs():
    """Any subset of parameters and outputs gives the same gradients as all together."""
    setting = scene(perspective((12, 12)), soup(8, 6))
    names = ["soup.vertices", "soup.color", "soup.opacity", "soup.thickness"]
    values = leaves(setting, *names)
    found = capture(setting, parameters=values)
    together = torch.autograd.grad(found.rgba.square().sum(), values.values(), retain_graph=True, allow_unused=True)
    for name, grad in zip(names, together, strict=True):
        alone = leaves(setting, name)
        rgba = capture(setting, parameters=alone).rgba
        if name == "soup.thickness":
            assert not grad.any()
            continue
        (only,) = torch.autograd.grad(rgba.square().sum(), alone.values())
        torch.testing.assert_close(only, grad, rtol=0, atol=0)
    for output in ("depth", "thickness"):
        grads = torch.autograd.grad(getattr(found, output).sum(), values.values(), retain_graph=True)
        assert [bool(grad.any()) for grad in grads] == [True, False, False, output == "thickness"]


def test_gradients_of_nothing_are_zero():
    """A scene out of view has gradients, and they are zero."""
    setting = scene(perspective((12, 12)), quad(-3.0))
    values = leaves(setting, "quad.vertices", "quad.opacity")
    found = capture(setting, parameters=values)
    for grad in torch.autograd.grad(found.rgba.sum() + found.depth.sum(), values.values()):
        assert not grad.any()


def test_no_gradients_are_recorded_without_need():
    """Under no_grad, and with parameters that need no gradient, fragments have no graph."""
    setting = scene(perspective((12, 12)), soup(8, 6))
    values = leaves(setting, "soup.vertices")
    with torch.no_grad():
        assert not capture(setting, parameters=values).rgba.requires_grad
    assert not capture(setting, parameters={"soup.opacity": torch.tensor(0.5)}).rgba.requires_grad
    found = capture(setting, parameters={"soup.opacity": torch.tensor(0.5, requires_grad=True)})
    assert found.rgba.requires_grad


@pytest.mark.parametrize("threads", [2, 3, 8])
def test_bits_do_not_depend_on_threads(threads, monkeypatch):
    """Fragments and gradients have the same bits for any number of threads."""
    random = np.random.default_rng(0)
    mesh = sphere(0.8, 60)
    setting = scene(
        perspective((90, 80)),
        soup(1, 40),
        surface(mesh.vertices + np.array([0, 0, 2.5]), mesh.faces, "ball"),
        quad(3.5, thickness=random.uniform(0, 1, (80, 90))),
    )
    names = ["soup.vertices", "ball.vertices", "ball.color", "soup.opacity", "soup.thickness", "quad.thickness"]

    def run(count):
        monkeypatch.setenv("WARPFRAG_THREADS", str(count))
        values = {n: torch.tensor(setting.parameters()[n], dtype=torch.float32, requires_grad=True) for n in names}
        found = capture(setting, parameters=values)
        weight = torch.linspace(0, 1, found.count)
        total = (found.rgba * weight[:, None]).sum() + (found.depth * weight).sum() + (found.thickness * weight).sum()
        return [getattr(found, n) for n in ("rgba", "depth", "thickness", "offsets")], torch.autograd.grad(
            total, list(values.values())
        )

    for one, other in zip(run(1), run(threads), strict=True):
        for first, second in zip(one, other, strict=True):
            assert torch.equal(first, second)
