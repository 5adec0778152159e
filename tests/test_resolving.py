"""The ways to resolve that `render` and `Renderer` take, and the device."""

import numpy as np
import pytest
from capture_scenes import perspective, quad, scene, soup

from warpfrag.capture import surfaces as surfaces_module
from warpfrag.capture.coverage import capture
from warpfrag.composite import composite
from warpfrag.render import render
from warpfrag.renderer import Renderer
from warpfrag.storage.kbuffer import kbuffer


def crowd(size=(20, 18), **options):
    """Return a scene of overlapping translucent triangles."""
    return scene(perspective(size), soup(1, 30), soup(2, 30, name="more"), **{"beta": 0.4, **options})


@pytest.mark.parametrize("function", [render, Renderer])
def test_unknown_options_are_refused_by_name(function):
    """A misspelt way to resolve is named, with the one that was meant."""
    with pytest.raises(TypeError, match='betta: got an argument of this name, expected a known one; did you mean "bet'):
        function(crowd(), betta=0.5)


def test_none_is_as_the_scene_says():
    """An option that is None counts as left out."""
    setting = crowd(layers=2, merge="none")
    options = {"resolve": None, "beta": None, "max_layers": None, "merge": None, "mix": None}
    np.testing.assert_array_equal(render(setting, **options), render(setting))


def test_render_streams_into_a_kbuffer():
    """`resolve="kbuffer"` is the composite of `kbuffer`, as that of a `Renderer`."""
    setting = crowd(merge="order_independent", layers=3)
    expected = composite(kbuffer(capture(setting, sort=False), 3, merge="order_independent"))
    np.testing.assert_array_equal(render(setting, resolve="kbuffer"), expected)


def test_computing_on_a_device_gives_the_same_bits(monkeypatch):
    """NumPy in, NumPy out: what is computed with arrays on a device has the bits of what the host computes."""
    random = np.random.default_rng(0)
    setting = scene(
        perspective((20, 18)), soup(1, 30),
        quad(2.2, name="map", opacity=0.5, thickness=random.uniform(0, 1, (18, 20))), background=(0.1, 0.2, 0.3, 0.5),
    )  # fmt: skip
    beta = random.uniform(0, 1, (18, 20)).astype(np.float32)
    every = ("color", "depth", "normal", "object_id", "count", "layers")
    calls = [
        lambda: vars(capture(setting, device="cpu")),
        lambda: render(setting, beta=beta, samples=2, device="cpu"),
        lambda: render(setting, beta=beta, samples=2, device="cpu", memory_limit=3e5),
        lambda: render(setting, output=every[:-1], device="cpu"),
        lambda: vars(render(setting, output="layers", device="cpu")),
        lambda: render(crowd(merge="none"), resolve="kbuffer", device="cpu"),
    ]
    for call in calls:
        monkeypatch.setattr(surfaces_module, "is_host", lambda device: True)
        expected = call()
        monkeypatch.setattr(surfaces_module, "is_host", lambda device: False)
        np.testing.assert_equal(call(), expected)


@pytest.mark.parametrize(
    ("name", "message"),
    [("gpu", 'device: got "gpu", expected "cpu", "cuda"'), ("cuda:99", "expected another, such as"), (3, 'got "3"')],
)
def test_bad_devices_are_named(name, message):
    """A device that this machine lacks is said in one line, wherever it is given."""
    for call in (lambda: render(crowd(), device=name), lambda: capture(crowd(), device=name),
                 lambda: Renderer(crowd(), device=name)):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            call()


def test_parameters_are_a_mapping():
    """Anything else is refused in one line, by all that take them."""
    renderer = Renderer(crowd())
    calls = (renderer.image, renderer.fragments, lambda p: render(crowd(), parameters=p),
             lambda p: capture(crowd(), parameters=p))  # fmt: skip
    for call in calls:
        with pytest.raises(TypeError, match="parameters: got list, expected a mapping from names to values"):
            call([0.5])
