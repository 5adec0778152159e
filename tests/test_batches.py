"""Several cameras in one call."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from capture_scenes import AHEAD, perspective, scene, soup

from warpfrag.capture.coverage import capture
from warpfrag.composite import composite
from warpfrag.render import render
from warpfrag.scene.camera import Camera


def crowd(**options):
    """Return a scene of overlapping translucent triangles."""
    return scene(perspective((20, 18)), soup(1, 20), soup(2, 20, name="more"), **{"beta": 0.4, **options})


CAMERAS = [Camera(**{**AHEAD, "eye": (0.1 * i, 0.0, -0.2 * i)}, fov=60.0 - 5 * i, size=(20, 18)) for i in range(3)]


def test_images_have_a_leading_dimension():
    """Each is that of its camera, to the bit; so are other outputs, and samples."""
    setting = crowd()
    images = render(setting, CAMERAS, samples=2)
    assert images.shape == (3, 18, 20, 4)
    for image, camera in zip(images, CAMERAS, strict=True):
        np.testing.assert_array_equal(image, render(setting, camera, samples=2))
    found = render(setting, tuple(CAMERAS), output=("layers", "object_id"))
    assert found["layers"].shape == found["object_id"].shape == (3, 18, 20)
    np.testing.assert_array_equal(found["layers"].depth[1], render(setting, CAMERAS[1], output="layers").depth)
    assert render(setting, CAMERAS[:1]).shape == (1, 18, 20, 4)


@pytest.mark.parametrize("rows", [None, (3, 7)])
def test_fragments_have_a_leading_dimension(rows):
    """One `Fragments` of all views, with ids, composites to the images of each."""
    setting = crowd()
    fragments = capture(setting, CAMERAS, rows=rows)
    singles = [capture(setting, camera, rows=rows) for camera in CAMERAS]
    fragments.validate()
    assert fragments.shape == (3, *singles[0].shape)
    assert fragments.offsets.dtype == np.int32
    for name in ("rgba", "depth", "thickness", "object_id", "primitive_id"):
        expected = np.concatenate([getattr(single, name) for single in singles])
        np.testing.assert_array_equal(getattr(fragments, name), expected)
    images = composite(fragments, 0.4)
    for image, single in zip(images, singles, strict=True):
        np.testing.assert_array_equal(image, composite(single, 0.4))


def test_batches_are_differentiable():
    """The gradient is the sum of those of the views; beta may be a map for each."""
    setting = crowd()
    beta = torch.rand((3, 18, 20), generator=torch.Generator().manual_seed(0)).requires_grad_()
    vertices = torch.tensor(setting.parameters()["soup.vertices"], requires_grad=True)
    images = render(setting, CAMERAS, parameters={"soup.vertices": vertices}, beta=beta)
    found = torch.autograd.grad(images.square().sum(), (vertices, beta))
    singles = [
        render(setting, camera, parameters={"soup.vertices": vertices, "beta": beta[i]})
        for i, camera in enumerate(CAMERAS)
    ]
    assert torch.equal(images, torch.stack(singles))
    expected = torch.autograd.grad(sum(image.square().sum() for image in singles), (vertices, beta))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)
    fragments = capture(setting, CAMERAS, parameters={"soup.vertices": vertices})
    (grad,) = torch.autograd.grad(fragments.depth.sum(), vertices)
    depths = sum(capture(setting, c, parameters={"soup.vertices": vertices}).depth.sum() for c in CAMERAS)
    torch.testing.assert_close(grad, torch.autograd.grad(depths, vertices)[0])


@pytest.mark.parametrize(
    ("cameras", "error", "message"),
    [
        ([], ValueError, "camera: got an empty sequence"),
        ([CAMERAS[0], None], TypeError, r"camera\[1\]: got None, expected a Camera"),
        ([CAMERAS[0], replace(CAMERAS[1], size=(4, 3))], ValueError, r"camera\[1\]: got the size 4 × 3, expected 20"),
        ("front", TypeError, "camera: got str, expected a Camera"),
    ],
)
def test_cameras_are_checked(cameras, error, message):
    """What is no camera, or has another size, is named by its place."""
    for function in (render, capture):
        with pytest.raises(error, match=message):
            function(crowd(), cameras)
