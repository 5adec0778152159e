"""Coverage held fixed: shading for other values, also of moved geometry, and derivatives in rigid motions."""

import numpy as np
import pytest
import torch
import warp as wp
from capture_scenes import orthographic, perspective, pixels_of, quad, scene, soup, surface

from warpfrag.capture.coverage import Coverage, capture
from warpfrag.scene.camera import Camera
from warpfrag.scene.pose import pose_matrix

SLANTED = Camera((0.4, 0.3, -0.5), (0.1, 0.0, 2.0), (0.1, -1.0, 0.2), fov=60.0, near=0.5, far=4.0, size=(24, 20))
FLAT = Camera((0.2, 0.1, 0.0), (0.1, 0.0, 2.0), (0.1, -1.0, 0.2), height=2.2, near=0.5, far=4.0, size=(24, 20))
CAMERAS = {"perspective": SLANTED, "orthographic": FLAT}
OUTPUTS = ("rgba", "depth", "thickness")


def crowd(camera: Camera = SLANTED, seed: int = 0):
    """Return textured, mapped and plain surfaces, with thickness in both units."""
    random = np.random.default_rng(seed)
    texture = {"uv": random.uniform(-1, 2, (36, 2)), "texture": random.uniform(0.2, 1.0, (4, 3, 4))}
    mapped = {"thickness": random.uniform(1e4, 2e4, camera.shape), "thickness_unit": "P"}
    return scene(
        camera, soup(seed, 12), soup(seed + 1, 12, name="textured", **texture), quad(2.2, 1.5, name="mapped", **mapped)
    )


def poses(setting, seed: int = 0, size: float = 1.0) -> dict[str, torch.Tensor]:
    """Return random poses of all objects and of the camera, float64 leaves of a graph."""
    random = np.random.default_rng(seed)
    owners = [*(item.name for item in setting.objects), "camera"]
    values = {f"{owner}.translation": size * random.uniform(-0.1, 0.1, 3) for owner in owners}
    values.update({f"{owner}.rotation": size * random.uniform(-30.0, 30.0, 3) for owner in owners})
    return {name: torch.tensor(value, requires_grad=True) for name, value in values.items()}


def cotangents(fragments, seed: int = 0) -> list[np.ndarray]:
    """Return random gradients of colour and opacity, depth and z-thickness."""
    random = np.random.default_rng(seed)
    return [random.normal(size=tuple(getattr(fragments, name).shape)) for name in OUTPUTS]


def names_of(fragments) -> np.ndarray:
    """Return a number for each fragment that tells its pixel and triangle."""
    return (pixels_of(fragments) * 100 + fragments.object_id) * 1000 + fragments.primitive_id


@pytest.mark.parametrize("sort", [True, False])
@pytest.mark.parametrize("kind", ["own", "float64", "torch"])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_same_parameters_give_the_bits_of_capture(camera, kind, sort):
    """Coverage and its shading are the two halves of a capture."""
    setting = crowd(camera)
    parameters = {
        "own": None,
        "float64": {"soup.rotation": np.array([1.0, 2.0, 3.0]), "soup.opacity": 0.3},
        "torch": {"camera.translation": torch.tensor([0.1, 0.0, -0.2]), "textured.color": [0.1, 0.2, 0.3]},
    }[kind]
    expected = capture(setting, sort=sort, parameters=parameters)
    found = Coverage.of(setting, sort=sort, parameters=parameters).shade(parameters)
    assert found.kind == expected.kind
    assert found.shape == expected.shape == (20, 24)
    for name in (*OUTPUTS, "offsets", "object_id", "primitive_id"):
        assert (getattr(found, name) == getattr(expected, name)).all()
        assert getattr(found, name).dtype == getattr(expected, name).dtype


def test_other_looks_on_the_same_coverage():
    """Colour, opacity and thickness change nothing else: shading equals a capture with them; kinds may differ."""
    setting = crowd()
    coverage = Coverage.of(setting)
    looks = {"soup.color": [0.1, 0.2, 0.3], "soup.opacity": torch.tensor(0.3), "thickness": 0.25}
    found, expected = coverage.shade(looks), capture(setting, parameters=looks)
    assert coverage.count == expected.count
    for name in (*OUTPUTS, "offsets", "object_id", "primitive_id"):
        assert torch.equal(getattr(found, name), getattr(expected, name))


def test_moved_geometry_is_seen_in_the_planes_of_its_triangles():
    """A fragment stays in its pixel at the depth of its moved triangle's plane, with extrapolated attributes."""
    setting = scene(orthographic((8, 8), 2.0), surface([[0, 0, 1], [1, 0, 1], [0, 1, 1.5]], [[0, 1, 2]], "corner",
                    color=[[0, 0, 0], [1, 0, 0], [0, 1, 0]]))  # fmt: skip
    coverage = Coverage.of(setting)
    shift = np.array([10.0, 0.0, 0.25])
    found, still = coverage.shade({"corner.translation": shift}), coverage.shade()
    assert coverage.count == 6
    np.testing.assert_array_equal(found.offsets, still.offsets)
    y = ((pixels_of(found) // 8) - 3.5) / 4
    x = ((pixels_of(found) % 8) - 3.5) / 4
    np.testing.assert_allclose(found.depth, 1.25 + 0.5 * y, rtol=1e-12)
    np.testing.assert_allclose(found.rgba[:, :3], np.stack([x - 10.0, y, 0 * x], 1), rtol=1e-12, atol=1e-12)
    assert capture(setting, parameters={"corner.translation": shift}).count == 0


@pytest.mark.parametrize("camera", ["perspective", "orthographic"])
def test_gradients_in_moved_geometry(camera):
    """Shading is differentiable in all that moves, also of fragments whose triangles have left their pixels."""
    setting = crowd(CAMERAS[camera].resized((8, 7)), 3)
    setting.objects[2].thickness = setting.objects[2].thickness[:7, :8]
    coverage = Coverage.of(setting)
    values = poses(setting, 1, 0.3)
    looks = {"soup.color": [0.2, 0.9, 0.5], "soup.opacity": 0.4, "textured.thickness": 0.3, "mapped.opacity": 0.9}
    values.update({n: torch.tensor(look, dtype=torch.float64, requires_grad=True) for n, look in looks.items()})
    fragments = coverage.shade(values)
    left = np.setdiff1d(names_of(fragments.numpy()), names_of(capture(setting, parameters=values).numpy()))
    assert len(left) > 10
    random = np.random.default_rng(5)
    weights = {name: torch.tensor(random.normal(size=(3, *getattr(fragments, name).shape))) for name in OUTPUTS}

    def weighted(*tensors):
        found = coverage.shade(dict(zip(values, tensors, strict=True)))
        return sum((weights[name] * getattr(found, name)).reshape(3, -1).sum(1) for name in OUTPUTS)

    assert torch.autograd.gradcheck(weighted, tuple(values.values()), eps=1e-6, atol=2e-5, rtol=1e-4)


def test_gradients_of_a_moved_triangle_of_many_strips():
    """A triangle that has left the image altogether keeps its gradient: that of the function of all its fragments."""
    vertices = np.array([[-8.0, -8, 2], [9, -7, 3], [0, 9, 4]])
    setting = scene(perspective((90, 80), 50.0), surface(vertices, [[0, 1, 2]], "large", thickness=[0.1, 0.2, 0.3]))
    coverage = Coverage.of(setting)
    assert coverage.count == 90 * 80
    weights = torch.tensor(np.random.default_rng(0).normal(size=coverage.count))

    def weighted(moved):
        found = coverage.shade({"large.vertices": moved})
        return (weights * (found.depth + found.thickness)).sum()

    leaf = torch.tensor(vertices + np.array([0.0, 30.0, 5.0]), requires_grad=True)
    assert capture(setting, parameters={"large.vertices": leaf}).count == 0
    direction = torch.tensor(np.random.default_rng(1).normal(size=(3, 3)))
    (grad,) = torch.autograd.grad(weighted(leaf), leaf)
    with torch.no_grad():
        step = 1e-5 * direction
        difference = (weighted(leaf + step) - weighted(leaf - step)) / 2e-5
    torch.testing.assert_close((grad * direction).sum(), difference, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("posed", [False, True], ids=["zero", "posed"])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_motions_sum_up_to_the_gradients_of_poses(camera, posed):
    """For each pose parameter, the columns of its fragments sum up to what autograd finds."""
    setting = crowd(camera)
    coverage = Coverage.of(setting)
    values = poses(setting, size=float(posed))
    fragments = coverage.shade(values)
    seeds = cotangents(fragments)
    total = sum((torch.tensor(s) * getattr(fragments, n)).sum() for s, n in zip(seeds, OUTPUTS, strict=True))
    expected = dict(zip(values, torch.autograd.grad(total, list(values.values())), strict=True))
    motions = coverage.motion_gradients(values, *seeds)
    assert motions.shape == (coverage.count, 6)
    assert motions.dtype == np.float64
    owners = fragments.object_id.numpy()
    for name, gradient in expected.items():
        numbers = [number for number, item in enumerate(setting.objects) if name.startswith(item.name + ".")]
        members = np.isin(owners, numbers) if numbers else np.full(len(owners), True)
        columns = motions[members] @ pose_matrix(name, setting, camera, values)
        assert gradient.abs().max() > 1e-3
        # Sums of some thousand terms in float64.
        np.testing.assert_allclose(columns.sum(axis=0), gradient, rtol=0, atol=1e-11 * np.abs(columns).sum())


def test_motions_are_those_of_each_pixel():
    """Seeded in one pixel, autograd finds what the motions of that pixel's fragments say; all pixels, in one pass."""
    setting = crowd(SLANTED.resized((6, 5)))
    setting.objects[2].thickness = 1e4
    coverage = Coverage.of(setting)
    values = poses(setting, 4)
    fragments = coverage.shade(values)
    seeds = cotangents(fragments)
    motions = coverage.motion_gradients(values, *seeds)
    pixels, owners = pixels_of(fragments.numpy()), fragments.object_id.numpy()
    products = sum(
        (torch.tensor(s) * getattr(fragments, n)).reshape(coverage.count, -1).sum(1)
        for s, n in zip(seeds, OUTPUTS, strict=True)
    )
    names = ("textured.rotation", "camera.rotation", "camera.translation", "textured.translation")
    for pixel in range(30):
        if not (pixels == pixel).any():
            continue
        grads = torch.autograd.grad(products[torch.tensor(pixels == pixel)].sum(), [values[n] for n in names],
                                    retain_graph=True)  # fmt: skip
        for name, grad in zip(names, grads, strict=True):
            members = (pixels == pixel) & ((owners == 1) | name.startswith("camera"))
            columns = motions[members] @ pose_matrix(name, setting, parameters=values)
            scale = np.abs(columns).sum()
            np.testing.assert_allclose(columns.sum(axis=0), grad, rtol=0, atol=1e-12 * scale)


def test_force_and_torque_by_hand():
    """The depth of a plane across an orthographic view grows with z alone; turned about x, with y."""
    setting = scene(orthographic((4, 4)), quad(2.0))
    coverage = Coverage.of(setting)
    motions = coverage.motion_gradients(None, None, np.ones(16), None)
    np.testing.assert_allclose(motions[:, :3], np.tile([0.0, 0.0, 1.0], (16, 1)), atol=1e-12)
    x, y = np.meshgrid(np.arange(4) - 1.5, np.arange(4) - 1.5)
    # Turned by a small angle about x, the point (x, y, 2) rises by y; about y, by -x.
    np.testing.assert_allclose(motions[:, 3:], np.stack([y.ravel(), -x.ravel(), 0 * y.ravel()], 1), atol=1e-12)


def test_gradients_come_in_any_kind_and_may_be_none():
    """NumPy, Warp and torch cotangents of either precision give the same; those left out count as zeros."""
    setting = crowd()
    coverage = Coverage.of(setting)
    parts = cotangents(coverage.shade())
    parts = [part.astype(np.float32) for part in parts]
    expected = coverage.motion_gradients(None, *parts)
    kinds = [
        [part.astype(np.float64) for part in parts],
        [torch.tensor(part) for part in parts],
        [wp.array(part, dtype=wp.float32, device="cpu") for part in parts],
        [wp.array(part, dtype=wp.float64, device="cpu") for part in parts],
    ]
    for given in kinds:
        np.testing.assert_array_equal(coverage.motion_gradients({}, *given), expected)
    alone = [coverage.motion_gradients(None, *(p if n == i else None for n, p in enumerate(parts))) for i in range(3)]
    assert all(np.abs(part).max() > 0.0 for part in alone)
    np.testing.assert_allclose(sum(alone), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert not coverage.motion_gradients(None, None, None, None).any()


def test_single_precision_parameters():
    """float32 values give the motions of their own rounded corners, in float64 from there."""
    setting = crowd()
    coverage = Coverage.of(setting)
    seeds = cotangents(coverage.shade())
    double = coverage.motion_gradients({"soup.opacity": np.asarray(setting.objects[0].opacity, np.float64)}, *seeds)
    single = coverage.motion_gradients(None, *seeds)
    # Slivers amplify the rounding of their corners.
    close = np.abs(single - double).max(axis=1) <= 1e-3 * (1.0 + np.abs(double).max(axis=1))
    assert close.mean() > 0.99


@pytest.mark.parametrize("threads", [2, 3])
def test_bits_do_not_depend_on_threads(threads, monkeypatch):
    """Gradients in moved geometry and motions have the same bits for any number of threads."""
    setting = crowd(SLANTED.resized((90, 80)))
    setting.objects[2].thickness = 1e4
    coverage = Coverage.of(setting)

    def run(count):
        monkeypatch.setenv("WARPFRAG_THREADS", str(count))
        values = torch.tensor(setting.objects[0].vertices + np.float32(0.1), requires_grad=True)
        fragments = coverage.shade({"soup.vertices": values})
        seeds = cotangents(fragments)
        total = sum((torch.tensor(s) * getattr(fragments, n)).sum() for s, n in zip(seeds, OUTPUTS, strict=True))
        (grad,) = torch.autograd.grad(total, values)
        return grad.numpy(), coverage.motion_gradients({"soup.vertices": values}, *seeds)

    for one, other in zip(run(1), run(threads), strict=True):
        np.testing.assert_array_equal(one, other)


def test_nothing_to_see():
    """A scene out of view has coverage, fragments, gradients and motions of length 0."""
    setting = scene(SLANTED, quad(-3.0))
    coverage = Coverage.of(setting)
    assert coverage.count == 0
    values = poses(setting)
    fragments = coverage.shade(values)
    assert coverage.motion_gradients(values, *cotangents(fragments)).shape == (0, 6)
    for grad in torch.autograd.grad(fragments.depth.sum(), list(values.values())):
        assert not grad.any()


def test_arguments_are_checked():
    """Wrong arguments are named."""
    setting = crowd()
    with pytest.raises(TypeError, match="scene: got dict"):
        Coverage.of({})
    with pytest.raises(MemoryError, match=r"fragments would take .* expected at most"):
        Coverage.of(setting, memory_limit=20_000)
    with pytest.raises(ValueError, match="unknown name"):
        Coverage.of(setting, parameters={"soup.rotations": 0.0})
    coverage = Coverage.of(setting)
    with pytest.raises(ValueError, match=r"soup.translation: got shape \(2,\), expected shape \(3,\)"):
        coverage.shade({"soup.translation": (0.0, 1.0)})
    with pytest.raises(ValueError, match=r"grad_depth: got shape \(3,\), expected \("):
        coverage.motion_gradients(None, None, np.zeros(3), None)
    with pytest.raises(TypeError, match=r"grad_rgba: got list, expected a NumPy array, wp\.array"):
        coverage.motion_gradients(None, [1.0], None, None)
    with pytest.raises(TypeError, match="grad_thickness: got int64, expected"):
        coverage.motion_gradients(None, None, None, np.zeros(coverage.count, int))
