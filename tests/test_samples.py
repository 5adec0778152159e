"""Several samples a pixel: their mean, maps by pixel, memory, gradients."""

import numpy as np
import pytest
import torch
from capture_scenes import orthographic, perspective, quad, scene, soup, surface

from warpfrag.render import render
from warpfrag.renderer import Renderer
from warpfrag.samples import by_sample, sampling_camera


def crowd(size=(20, 18), **options):
    """Return a scene of overlapping translucent triangles over a background."""
    options = {"beta": 0.4, "background": (0.1, 0.2, 0.3, 0.5), **options}
    return scene(perspective(size), soup(1, 30), soup(2, 30, name="more"), **options)


def mean_of(fine, samples):
    """Return the mean of each pixel's samples, in float64."""
    height, width, _ = fine.shape
    shape = (height // samples, samples, width // samples, samples, 4)
    return fine.reshape(shape).astype(np.float64).mean((1, 3))


def test_edge_by_hand():
    """A pixel of which a square covers a quarter gets a quarter of its colour."""
    corners = [[0.0, 0.0, 2.0], [0.5, 0.0, 2.0], [0.5, 0.5, 2.0], [0.0, 0.5, 2.0]]
    square = surface(corners, [[0, 1, 2], [0, 2, 3]], color=(1.0, 0.5, 0.0))
    image = render(scene(orthographic((2, 2), 2.0), square), samples=4)
    expected = np.zeros((2, 2, 4))
    expected[1, 1] = [0.25, 0.125, 0.0, 0.25]
    np.testing.assert_allclose(image, expected, atol=1e-7)


@pytest.mark.parametrize("options", [{}, {"resolve": "kbuffer", "merge": "none", "max_layers": 2}])
def test_image_is_the_mean_of_a_finer_one(options):
    """Samples × samples times as many pixels, of which each pixel takes the mean."""
    setting = crowd()
    fine = render(setting, sampling_camera(setting.camera, 3), **options)
    np.testing.assert_allclose(render(setting, samples=3, **options), mean_of(fine, 3), atol=1e-6)


def test_values_by_pixel_are_those_of_the_image():
    """Thickness maps, also in multiples of P(z), and maps of beta have a value for each pixel of the image."""
    random = np.random.default_rng(0)
    maps = {"scene": random.uniform(0, 1, (18, 20)), "P": random.uniform(0, 1e5, (18, 20))}
    beta = random.uniform(0, 1, (18, 20)).astype(np.float32)

    def made(size, grow):
        quads = [quad(2.1 + 0.1 * i, 1.0, name=unit, opacity=0.5, thickness=grow(value), thickness_unit=unit)
                 for i, (unit, value) in enumerate(maps.items())]  # fmt: skip
        return scene(perspective(size), soup(1, 30), *quads)

    fine = render(made((40, 36), lambda value: by_sample(value, 2)), beta=by_sample(beta, 2))
    image = render(made((20, 18), lambda value: value), beta=beta, samples=2)
    np.testing.assert_allclose(image, mean_of(fine, 2), atol=1e-6)
    with pytest.raises(ValueError, match=r"beta: got shape \(36, 40\), expected \(\) or \(18, 20\)"):
        render(made((20, 18), lambda value: value), beta=by_sample(beta, 2), samples=2)


def test_memory_is_that_of_bands():
    """Where the samples' fragments do not fit, bands of rows give the same image, with less than the samples take."""
    setting = crowd((48, 40))
    whole = render(setting, samples=4)
    fragments = Renderer(setting, samples=4).coverage.count
    limit = 0.3 * 36 * fragments
    np.testing.assert_array_equal(render(setting, samples=4, memory_limit=limit), whole)
    with pytest.raises(MemoryError, match=f"{fragments} fragments"):
        Renderer(setting, samples=4, memory_limit=limit).fragments()


@pytest.mark.parametrize("limit", [None, 1.1e5])
def test_gradient_is_that_of_the_mean(limit):
    """The gradient equals that of a fine image's mean, whole and in bands, in maps by pixel as well."""
    setting = crowd((16, 12))
    values = {
        "soup.opacity": torch.full((), 0.4),
        "more.vertices": torch.tensor(setting.parameters()["more.vertices"]),
        "soup.thickness": torch.full((12, 16), 0.3),
        "beta": torch.full((12, 16), 0.6),
    }
    values = {name: value.requires_grad_() for name, value in values.items()}
    weight = torch.rand((12, 16, 4), generator=torch.Generator().manual_seed(0))
    fine = {**values, "beta": by_sample(values["beta"], 2), "soup.thickness": by_sample(values["soup.thickness"], 2)}
    finer = render(setting, sampling_camera(setting.camera, 2), parameters=fine)
    expected = torch.autograd.grad((finer.reshape(12, 2, 16, 2, 4).mean((1, 3)) * weight).sum(), list(values.values()))
    if limit is not None:
        with pytest.raises(MemoryError):
            Renderer(setting, samples=2, memory_limit=limit).fragments(values)
    image = render(setting, parameters=values, samples=2, memory_limit=limit)
    found = torch.autograd.grad((image * weight).sum(), list(values.values()))
    for one, other in zip(found, expected, strict=True):
        assert other.any()
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4 * float(other.abs().max()))


@pytest.mark.parametrize(("samples", "error"), [(0, ValueError), (65, ValueError), (1.5, TypeError)])
def test_samples_are_checked(samples, error):
    """They are a whole number, and not of a slip of the keyboard."""
    with pytest.raises(error, match=r"samples: got .* expected a whole number from 1 to 64"):
        render(crowd(), samples=samples)
