"""From a scene to its image: options, background, gradients, and bands of rows under a memory limit."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_scenes import orthographic, perspective, quad, scene, soup, surface

from warpfrag.capture import memory
from warpfrag.capture.coverage import Coverage, capture
from warpfrag.capture.memory import Budget, CaptureSizes
from warpfrag.capture.surfaces import surfaces_of
from warpfrag.composite import composite
from warpfrag.files.scene_file import load_scene
from warpfrag.raster.ray import Window
from warpfrag.render import Renderer, render
from warpfrag.scene.depth_resolution import z_resolution
from warpfrag.shapes.primitives import sphere
from warpfrag.storage.kbuffer import kbuffer
from warpfrag.storage.method import count_fragments

SCENES = Path(__file__).parents[1] / "scenes"


def crowd(size=(40, 36), **options):
    """Return a scene of overlapping translucent triangles."""
    return scene(perspective(size), soup(1, 30), soup(2, 30, name="more"), **{"beta": 0.4, **options})


def test_two_planes_by_hand():
    """Two half-transparent planes over a background composite as over says."""
    setting = scene(
        perspective((3, 2)),
        quad(2.0, name="far", color=(0.0, 1.0, 0.0), opacity=0.5, thickness=0.0),
        quad(1.0, name="near", color=(1.0, 0.0, 0.0), opacity=0.5, thickness=0.0),
        background=(0.0, 0.0, 0.8, 0.8),
    )
    np.testing.assert_allclose(render(setting), np.tile([0.5, 0.25, 0.2, 0.95], (2, 3, 1)), rtol=1e-6)
    np.testing.assert_allclose(render(setting, background=False), np.tile([0.5, 0.25, 0, 0.75], (2, 3, 1)), rtol=1e-6)


def test_options_come_from_the_scene_then_parameters_then_keywords():
    """The scene's beta, layers, merge and mix hold; parameters override beta, keywords everything."""
    setting = crowd(layers=2, merge="order_independent", mix="average")
    fragments = capture(setting)

    def expected(**changed):
        options = {"beta": 0.4, "max_layers": 2, "merge": "order_independent", "mix": "average", **changed}
        return composite(fragments, **options)

    np.testing.assert_array_equal(render(setting), expected())
    smooth = {"max_layers": 3, "merge": "smooth", "mix": "opacity"}
    np.testing.assert_array_equal(render(setting, **smooth), expected(**smooth))
    np.testing.assert_array_equal(render(setting, parameters={"beta": 0.9}, **smooth), expected(beta=0.9, **smooth))
    both = render(setting, parameters={"beta": 0.9}, beta=0.1, **smooth)
    np.testing.assert_array_equal(both, expected(beta=0.1, **smooth))
    assert (expected(beta=0.1, **smooth) != expected(beta=0.9, **smooth)).any()


def test_kind_and_precision_follow_parameters_and_beta():
    """Any tensor makes the image a tensor; any float64 array makes it float64."""
    setting = crowd()
    own = render(setting)
    assert own.dtype == np.float32
    for values in ({"parameters": {"soup.opacity": torch.tensor(0.5)}}, {"beta": torch.tensor(0.4)}):
        image = render(setting, **values)
        assert isinstance(image, torch.Tensor)
        assert image.dtype == torch.float32
    np.testing.assert_array_equal(image.numpy(), own)
    assert render(setting, beta=np.full((36, 40), 0.4)).dtype == np.float64
    mixed = {"soup.opacity": torch.tensor(0.5, dtype=torch.float64), "beta": torch.tensor(0.5)}
    assert render(setting, parameters=mixed).dtype == torch.float64


def test_image_is_differentiable_in_all_scene_parameters():
    """The gradient of pixels away from edges equals central differences, beta included."""
    setting = scene(
        perspective((6, 6)),
        quad(2.0, 1.5, name="front", color=(0.9, 0.2, 0.1), opacity=0.4, thickness=0.6),
        surface([[-2, -2, 1.9], [2, -2, 2.4], [0.1, 3, 2.2]], [[0, 1, 2]], "tilted", color=(0.1, 0.8, 0.3), opacity=0.7,
                thickness=[0.3, 0.5, 0.4]),
        background=(0.1, 0.2, 0.3, 1.0),
    )  # fmt: skip
    names = [f"{item}.{key}" for item in ("front", "tilted") for key in ("vertices", "color", "opacity", "thickness")]
    values = setting.parameters()
    leaves = [torch.tensor(values[name], dtype=torch.float64, requires_grad=True) for name in names]
    beta = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)

    def image(beta, *tensors):
        return render(setting, parameters={**dict(zip(names, tensors, strict=True)), "beta": beta})

    assert torch.autograd.gradcheck(image, (beta, *leaves), eps=1e-6, atol=1e-6, rtol=1e-4)
    for grad in torch.autograd.grad(image(beta, *leaves).square().sum(), [beta, *leaves]):
        assert grad.any()


def limits(setting, parameters=None) -> list[float]:
    """Return memory limits under which an image falls into a few bands."""
    surfaces = surfaces_of(setting, setting.camera, parameters)
    triangles = surfaces.triangles(Window.of(setting.camera))
    budget = Budget.of(CaptureSizes.of(triangles, surfaces), None, surfaces, image=True)
    counts = count_fragments(triangles).numpy()
    return [budget.fixed + float(budget.needed(counts.sum(), len(counts))) / part for part in (1.5, 3, 6)]


def test_bands_have_the_same_pixels(monkeypatch):
    """An image rendered in bands of rows equals the whole one to the bit, with beta and thickness maps per pixel."""
    random = np.random.default_rng(0)
    setting = scene(perspective((40, 36)), soup(1, 30), soup(2, 30, name="more"),
                    quad(2.2, name="map", opacity=0.5, thickness=random.uniform(0, 1, (36, 40))))  # fmt: skip
    beta = random.uniform(0, 1, (36, 40)).astype(np.float32)
    bands = []

    def split_rows(*arguments):
        bands.append(memory.split_rows(*arguments))
        return bands[-1]

    monkeypatch.setattr(sys.modules[Renderer.__module__], "split_rows", split_rows)
    whole = render(setting, beta=beta)
    assert not bands
    for limit in limits(setting):
        np.testing.assert_array_equal(render(setting, beta=beta, memory_limit=limit), whole)
    assert [len(found) for found in bands] == sorted(len(found) for found in bands)
    assert len(bands) == 3
    assert len(bands[-1]) > 3


def test_bands_have_the_same_gradients():
    """The gradient of an image in bands equals that of the whole up to the order of sums."""
    setting = crowd()
    names = ["soup.vertices", "more.color", "soup.opacity", "beta"]

    def run(limit):
        values = {n: torch.tensor(setting.parameters()[n], dtype=torch.float32, requires_grad=True) for n in names}
        image = render(setting, parameters=values, memory_limit=limit)
        return image, torch.autograd.grad(image.square().sum(), list(values.values()))

    image, grads = run(None)
    opacity = torch.tensor(setting.parameters()["soup.opacity"], requires_grad=True)
    limit = limits(setting, {"soup.opacity": opacity})[2]
    banded, banded_grads = run(limit)
    assert torch.equal(image, banded)
    for one, other in zip(grads, banded_grads, strict=True):
        # Single precision sums over some thousand fragments.
        torch.testing.assert_close(other, one, rtol=1e-3, atol=1e-3 * float(one.abs().max()))


@pytest.mark.parametrize("objects", [[], [quad(-2.0)]], ids=["none", "behind"])
def test_nothing_to_see_is_the_background(objects):
    """A scene without anything in view shows its background, and is differentiable."""
    setting = scene(perspective((5, 4)), *objects, background=(0.1, 0.2, 0.3, 0.5))
    np.testing.assert_array_equal(render(setting), np.tile(np.float32([0.1, 0.2, 0.3, 0.5]), (4, 5, 1)))
    beta = torch.tensor(0.5, requires_grad=True)
    image = render(setting, parameters={"beta": beta})
    (grad,) = torch.autograd.grad(image.sum(), beta)
    assert grad == 0


@pytest.mark.parametrize("threads", [2, 3, 8])
def test_bits_do_not_depend_on_threads(threads, monkeypatch):
    """Images and their gradients have the same bits for any number of threads."""
    mesh = sphere(0.8, 40)
    setting = scene(
        orthographic((64, 60), 3.0), soup(1, 40), surface(mesh.vertices + np.array([0, 0, 2.5]), mesh.faces, "ball")
    )
    names = ["soup.vertices", "ball.opacity", "ball.thickness", "beta"]

    def run(count):
        monkeypatch.setenv("WARPFRAG_THREADS", str(count))
        values = {n: torch.tensor(setting.parameters()[n], dtype=torch.float32, requires_grad=True) for n in names}
        image = render(setting, parameters=values)
        return [image, *torch.autograd.grad(image.square().sum(), list(values.values()))]

    for one, other in zip(run(1), run(threads), strict=True):
        assert torch.equal(one, other)


def test_arguments_are_checked():
    """Wrong arguments are named."""
    setting = crowd()
    with pytest.raises(TypeError, match="scene: got dict"):
        render({})
    with pytest.raises(ValueError, match='merge: got "simple"'):
        render(setting, merge="simple")
    with pytest.raises(ValueError, match="max_layers: got 0"):
        render(setting, max_layers=0)
    with pytest.raises(ValueError, match="beta: got 2"):
        render(setting, beta=2.0, bounds="error")
    with pytest.raises(ValueError, match="beta: got shape"):
        render(setting, beta=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="unknown name"):
        render(setting, parameters={"soup.thicknes": 1.0})


def test_coplanar_cubes_show_speckle_only_without_merging():
    """Where the cubes share faces rounding decides which is in front: colours flip between pixels, unless merged."""
    scene = load_scene(SCENES / "coplanar_cubes.toml")
    camera = scene.camera.resized((256, 256))
    fragments = capture(scene, camera)
    begins, ends = fragments.offsets[:-1], fragments.offsets[1:]
    first = np.minimum(begins, fragments.count - 2)
    closer = np.diff(fragments.depth)[first] < 2.0 * z_resolution(fragments.depth[first], camera.near, camera.far)
    differ = fragments.object_id[first] != fragments.object_id[first + 1]
    shared = ((ends - begins >= 2) & closer & differ).reshape(256, 256)
    assert shared.sum() > 5000

    def sign_changes(merge):
        # Red or blue in front: against the mean of the row's neighbours, so that shading and edges do not count.
        image = render(scene, camera, merge=merge)
        redness = image[..., 0] - image[..., 2]
        excess = redness[:, 1:-1] - 0.5 * (redness[:, 2:] + redness[:, :-2])
        inside = shared[:, 1:-1] & shared[:, 2:] & shared[:, :-2]
        signs = np.where(inside & (np.abs(excess) > 0.02), np.sign(excess), 0.0)
        return int((signs[:, 1:] * signs[:, :-1] < 0.0).sum())

    assert sign_changes("none") > 100
    # What is left are a few pixels on edges of the cubes' far sides.
    assert sign_changes("smooth") < 0.05 * sign_changes("none")


LOOKS = ({"soup.opacity": 0.3}, {"more.color": [0.1, 0.9, 0.2]}, {"thickness": 0.2}, {"beta": 0.8}, {})


@pytest.mark.parametrize("resolve", ["sorted", "kbuffer"])
def test_renderer_sees_once_while_nothing_moves(resolve, monkeypatch):
    """Looks and beta leave what each pixel sees as it is; its images are those of new renderers, to the bit."""
    setting = crowd(merge="order_independent", layers=3)
    renderer = Renderer(setting, resolve=resolve)
    module, searches = sys.modules[Renderer.__module__], []
    monkeypatch.setattr(module, "count_fragments", lambda t: searches.append(t) or count_fragments(t))
    images = [renderer.image(look) for look in LOOKS]
    assert len(searches) == 1
    for look, image in zip(LOOKS, images, strict=True):
        np.testing.assert_array_equal(image, Renderer(setting, resolve=resolve).image(look))
    moved = {"soup.translation": [0.1, 0.0, 0.0]}
    np.testing.assert_array_equal(renderer.image(moved), Renderer(setting, resolve=resolve).image(moved))
    renderer.image({**moved, "soup.opacity": 0.1})
    assert len(searches) == 1 + len(LOOKS) + 2
    assert (images[-1] != renderer.image(moved)).any()


def test_renderer_makes_the_images_of_render_and_kbuffer():
    """Sorted it is `render`; as a k-buffer the composite of `kbuffer`; with the scene's background or without."""
    setting = crowd(background=(0.1, 0.2, 0.3, 0.5), merge="none")
    np.testing.assert_array_equal(Renderer(setting).image({"beta": 0.7}), render(setting, beta=0.7))
    image = Renderer(setting, resolve="kbuffer", max_layers=2, background=False).image()
    np.testing.assert_array_equal(image, composite(kbuffer(capture(setting, sort=False), 2, merge="none")))
    renderer = Renderer(setting, resolve="kbuffer")
    assert isinstance(renderer.coverage, Coverage)
    found, expected = renderer.fragments({"soup.opacity": 0.2}), capture(setting, parameters={"soup.opacity": 0.2})
    assert found.count == renderer.coverage.count == expected.count
    np.testing.assert_array_equal(found.object_id, capture(setting, sort=False).object_id)


@pytest.mark.parametrize("resolve", ["sorted", "kbuffer"])
def test_gradients_of_a_renderer_that_has_seen_already(resolve):
    """They are those of a new one, to the bit, in looks and in what moves."""
    setting = crowd(merge="order_independent", layers=3)
    names = ["soup.vertices", "more.color", "soup.opacity", "camera.rotation"]

    def gradients(renderer):
        own = setting.parameters()
        values = {name: torch.tensor(np.asarray(own[name]), dtype=torch.float32, requires_grad=True) for name in names}
        return torch.autograd.grad(renderer.image(values).square().sum(), list(values.values()))

    renderer = Renderer(setting, resolve=resolve)
    renderer.image()
    for one, other in zip(gradients(renderer), gradients(Renderer(setting, resolve=resolve)), strict=True):
        assert one.any()
        assert torch.equal(one, other)


def test_renderer_without_room_for_a_kbuffers_fragments():
    """Fragments that do not fit go straight into the slots: the same image, and nothing is kept."""
    setting = crowd((20, 18), merge="none", layers=1)
    setting.objects.extend(quad(2.0 + 0.1 * i, name=f"quad{i}", opacity=0.1) for i in range(80))
    free = Renderer(setting, resolve="kbuffer")
    tight = Renderer(setting, resolve="kbuffer", memory_limit=0.7e6)
    np.testing.assert_array_equal(tight.image(), free.image())
    with pytest.raises(MemoryError, match=r"\d+ fragments would take .* expected at most 683\.6 KiB"):
        tight.fragments()


def test_renderers_arguments_are_checked():
    """Wrong arguments are named when a renderer is made."""
    with pytest.raises(ValueError, match='resolve: got "sort", expected "sorted" or "kbuffer"'):
        Renderer(crowd(), resolve="sort")
    with pytest.raises(ValueError, match='merge: got "smooth", expected "none" or "order_independent"'):
        Renderer(crowd(), resolve="kbuffer")


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_and_matmul_precision_move_nothing(dtype):
    """Inside of `torch.autocast`, with fast matrix products allowed, image and gradients keep their bits."""
    setting = crowd()
    names = ["soup.vertices", "soup.opacity", "more.rotation", "camera.translation", "camera.fov", "beta"]

    def run():
        own = setting.parameters()
        values = {name: torch.tensor(np.asarray(own[name]), dtype=torch.float32, requires_grad=True) for name in names}
        image = render(setting, parameters=values, samples=2)
        return [image, *torch.autograd.grad(image.square().sum(), list(values.values()))]

    expected = run()
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        with torch.autocast("cpu", dtype=dtype):
            found = run()
    finally:
        torch.set_float32_matmul_precision(before)
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)
