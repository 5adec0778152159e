"""Losses of images: values by hand and by loops, gradients, pyramids."""

import math

import numpy as np
import pytest
import torch

from warpfrag.fit.losses import ImageLoss, RobustLoss, halve, psnr, pyramid, ssim

MIXED = {"l1": 0.8, "ssim": 0.2}


LOSSES = ["l2", "l1", "huber", "ssim", MIXED]


def pair(height: int, width: int, channels: int = 3, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return an image and a reference that resembles it."""
    generator = np.random.default_rng(seed)
    reference = generator.uniform(0.0, 1.0, (height, width, channels))
    image = np.clip(reference + generator.normal(0.0, 0.2, reference.shape), 0.0, 1.0)
    return torch.tensor(image), torch.tensor(reference)


def ssim_by_loops(image: np.ndarray, reference: np.ndarray, rows: int, columns: int) -> float:
    """Return the mean SSIM as Wang et al. write it: window by window, from centred moments."""
    around = [np.exp(-0.5 * ((np.arange(size) - size // 2) / 1.5) ** 2) for size in (rows, columns)]
    weights = np.outer(*around) / np.outer(*around).sum()
    values = []
    for channel in range(image.shape[2]):
        for top in range(image.shape[0] - rows + 1):
            for left in range(image.shape[1] - columns + 1):
                x = image[top : top + rows, left : left + columns, channel]
                y = reference[top : top + rows, left : left + columns, channel]
                mean_x, mean_y = (weights * x).sum(), (weights * y).sum()
                variance_x, variance_y = (weights * (x - mean_x) ** 2).sum(), (weights * (y - mean_y) ** 2).sum()
                covariance = (weights * (x - mean_x) * (y - mean_y)).sum()
                luminance = (2 * mean_x * mean_y + 0.0001) / (mean_x**2 + mean_y**2 + 0.0001)
                structure = (2 * covariance + 0.0009) / (variance_x + variance_y + 0.0009)
                values.append(luminance * structure)
    return float(np.mean(values))


@pytest.mark.parametrize(
    ("height", "width", "rows", "columns"),
    [(15, 13, 11, 11), (11, 11, 11, 11), (10, 20, 9, 11), (4, 3, 3, 3), (1, 12, 1, 11), (2, 1, 1, 1)],
)
def test_ssim_is_that_of_loops(height, width, rows, columns):
    """Moments under a Gaussian of 11 pixels, or of the largest odd size that fits, averaged over windows within."""
    image, reference = pair(height, width)
    expected = ssim_by_loops(image.numpy(), reference.numpy(), rows, columns)
    # Variances as differences of moments lose a few digits of 16 against the constant 9e-4.
    assert float(ssim(image, reference)) == pytest.approx(expected, abs=1e-12)
    assert float(ImageLoss.of("ssim", 0.1)(image, reference)) == pytest.approx(1.0 - expected, abs=1e-12)


def test_ssim_by_hand():
    """Constant images differ in luminance alone; an image and its negative about the same mean have SSIM below 0."""
    dark, light = torch.full((16, 12, 1), 0.2).double(), torch.full((16, 12, 1), 0.6).double()
    # (2·0.2·0.6 + 1e-4) / (0.04 + 0.36 + 1e-4)
    assert float(ssim(dark, light)) == pytest.approx(0.2401 / 0.4001, rel=1e-7)
    board = 0.5 * torch.tensor([[1.0, -1.0], [-1.0, 1.0]]).double().repeat(8, 6)[..., None]
    # The mean under a window is 0.5, the variance 0.25, the covariance −0.25: (−0.5 + 9e-4) / (0.5 + 9e-4).
    assert float(ssim(0.5 + board, 0.5 - board)) == pytest.approx(-0.4991 / 0.5009, abs=1e-4)


@pytest.mark.parametrize("loss", LOSSES)
def test_equal_images_have_no_loss_and_no_gradient(loss):
    """At equal images, constant ones too, the loss and its gradient are 0, not NaN."""
    for reference in (pair(13, 12)[1], torch.full((13, 12, 3), 0.3).double(), torch.zeros(13, 12, 3).double()):
        image = reference.clone().requires_grad_()
        value = ImageLoss.of(loss, 0.1, scales=3)(image, reference)
        value.backward()
        # Rounding of SSIM, which is 1 there.
        assert value.item() == pytest.approx(0.0, abs=1e-14)
        assert float(image.grad.abs().max()) < 1e-14


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_are_symmetric(loss):
    """Image and reference may change places."""
    image, reference = pair(14, 9)
    value = ImageLoss.of(loss, 0.1, scales=2)
    assert float(value(image, reference)) == pytest.approx(float(value(reference, image)), rel=1e-12)
    assert float(value(image, reference)) > 0.0


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(("height", "width"), [(13, 12), (5, 2)])
def test_gradients(loss, height, width):
    """The gradient is that of differences, over three scales of even and odd sizes."""
    image, reference = pair(height, width, channels=2)
    value = ImageLoss.of(loss, 0.1, scales=3)
    assert torch.autograd.gradcheck(lambda x: value(x, reference), image.requires_grad_(), fast_mode=True)


def test_float32_images_get_float32_gradients():
    """The loss of float32 images is computed in float64."""
    image, reference = (tensor.float() for tensor in pair(12, 12))
    value = ImageLoss.of(MIXED, 0.1, scales=2)(image.requires_grad_(), reference)
    value.backward()
    assert (value.dtype, value.shape, image.grad.dtype) == (torch.float64, (), torch.float32)
    again = ImageLoss.of(MIXED, 0.1, scales=2)(image.detach().double(), reference.double())
    assert float(value.detach()) == float(again)


@pytest.mark.parametrize("name", ["l2", "l1", "huber"])
def test_one_robust_loss_is_that_of_least_squares(name):
    """At one scale the value is factor times the mean of rho, and `robust` is that loss."""
    image, reference = pair(6, 7, channels=4)
    loss = ImageLoss.of(name, 0.05)
    robust = RobustLoss.named(name, 0.05)
    expected = robust.rho((image - reference).numpy()).mean() * robust.factor
    assert float(loss(image, reference)) == pytest.approx(expected, rel=1e-14)
    assert loss.robust == ImageLoss.of({name: 1}, 0.05, scales=4).robust == robust


@pytest.mark.parametrize("loss", ["ssim", MIXED, {"l2": 0.5}, {"l1": 1.0, "l2": 1.0}])
def test_other_losses_are_not_for_least_squares(loss):
    """SSIM, sums and weights have no robust loss."""
    assert ImageLoss.of(loss, 0.1).robust is None


def test_terms_are_weighted():
    """A sum is the sum of its terms, each with its weight."""
    image, reference = pair(12, 11)
    l1, similarity = (float(ImageLoss.of(name, 0.1, 3)(image, reference)) for name in ("l1", "ssim"))
    mixed = float(ImageLoss.of(MIXED, 0.1, 3)(image, reference))
    assert mixed == pytest.approx(0.8 * l1 + 0.2 * similarity, rel=1e-14)


def test_scales_average_levels():
    """A checkerboard error is seen at the first level and gone from the second; at most the levels there are count."""
    reference = torch.zeros(4, 4, 1)
    board = torch.tensor([[1.0, -1.0], [-1.0, 1.0]]).repeat(2, 2)[..., None]
    assert float(ImageLoss.of("l2", 0.1, 1)(board, reference)) == 1.0
    assert float(ImageLoss.of("l2", 0.1, 2)(board, reference)) == 0.5
    assert float(ImageLoss.of("l2", 0.1, 9)(board, reference)) == pytest.approx(1.0 / 3.0)


def test_halve_by_hand():
    """Boxes of 2 × 2; the last row and column of odd sizes are boxes of their own."""
    image = np.array([[1.0, 3.0, 5.0], [5.0, 7.0, 9.0], [2.0, 4.0, 8.0]])[..., None]
    np.testing.assert_array_equal(halve(image)[..., 0], [[4.0, 7.0], [3.0, 8.0]])
    np.testing.assert_array_equal(halve(image[:2, :2])[..., 0], [[4.0]])
    np.testing.assert_array_equal(halve(image[:1])[..., 0], [[2.0, 5.0]])
    np.testing.assert_array_equal(halve(image[:1, :1]), image[:1, :1])


@pytest.mark.parametrize("shape", [(8, 6, 3), (7, 5, 4), (1, 9, 3), (9, 1, 3), (1, 1, 3)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_halve_is_alike_for_arrays_and_tensors(shape, dtype):
    """The same bits, in the same precision."""
    image = np.random.default_rng(2).normal(size=shape).astype(dtype)
    halved = halve(image)
    assert halved.dtype == dtype
    np.testing.assert_array_equal(halve(torch.tensor(image)).numpy(), halved)


def test_halve_takes_derivatives():
    """Each derivative of an image is halved as an image is."""
    jacobian = np.random.default_rng(3).normal(size=(7, 6, 4, 5))
    halved = halve(jacobian)
    for column in range(5):
        np.testing.assert_array_equal(halved[..., column], halve(jacobian[..., column]))


@pytest.mark.parametrize(
    ("shape", "scales", "sizes"),
    [
        ((4, 4), 2, [(4, 4), (2, 2)]),
        ((5, 3), 9, [(5, 3), (3, 2), (2, 1), (1, 1)]),
        ((1, 1), 3, [(1, 1)]),
        ((1, 4), 9, [(1, 4), (1, 2), (1, 1)]),
    ],
)
def test_pyramid_ends_at_a_pixel(shape, scales, sizes):
    """Each level has half the size, rounded up, down to a single pixel."""
    assert [level.shape[:2] for level in pyramid(np.zeros((*shape, 3)), scales)] == sizes


@pytest.mark.parametrize(
    ("loss", "scales", "words"),
    [
        ("l3", 1, 'loss: got "l3", expected one of "l2", "l1", "huber", "ssim"'),
        ({}, 1, "loss: got no names"),
        ({"l1": 1.0, "sim": 1.0}, 1, 'loss: got "sim"'),
        ({"l1": 0}, 1, "loss.l1: got 0, expected a number above 0"),
        ({"l1": math.nan}, 1, "loss.l1: got nan"),
        ({"l1": math.inf}, 1, "loss.l1: got inf"),
        ({"l1": True}, 1, "loss.l1: got true"),
        ({"l1": "1"}, 1, 'loss.l1: got "1"'),
        ("l2", 0, "scales: got 0, expected a whole number of at least 1"),
        ("l2", 1.5, "scales: got 1.5"),
        ("l2", True, "scales: got true"),
    ],
)
def test_mistakes_get_one_line(loss, scales, words):
    """Unknown names, weights and scales are refused."""
    with pytest.raises((TypeError, ValueError), match=r"^[^\n]+$") as caught:
        ImageLoss.of(loss, 0.1, scales)
    assert words in str(caught.value)


def test_sizes_must_match():
    """An image is not stretched over a reference of another shape, or over one channel."""
    with pytest.raises(ValueError, match=r"got shape \(4, 4, 3\), expected \(4, 4, 1\)"):
        ImageLoss.of("l2", 0.1)(torch.zeros(4, 4, 3), torch.zeros(4, 4, 1))


def test_psnr():
    """An error of a tenth in all colours is 20 dB; opacity plays no part; equal colours are infinitely close."""
    reference = np.full((3, 4, 3), 0.5, np.float32)
    image = np.concatenate([reference + np.float32(0.1), np.zeros((3, 4, 1), np.float32)], axis=-1)
    # 0.6 − 0.5 in float32 is off by 1e-7 of it, 1e-6 dB.
    assert psnr(image, reference) == pytest.approx(20.0, abs=1e-5)
    assert psnr(reference, image) == pytest.approx(20.0, abs=1e-5)
    image[..., :3] = reference
    assert psnr(image, reference) == math.inf
    with pytest.raises(ValueError, match="got 4 × 2 pixels, expected 4 × 3"):
        psnr(image[:2], reference)


@pytest.mark.parametrize("name", ["l2", "l1", "huber"])
def test_loss_is_the_named_one(name):
    """Square, absolute value and Huber's function, alike for arrays and tensors; weights are slopes."""
    residual = np.array([-0.5, -0.02, 0.0, 0.004, 0.3])
    loss = RobustLoss.named(name, 0.05)
    size = np.abs(residual)
    huber = np.where(size < 0.05, 0.5 * size**2, 0.05 * (size - 0.025))
    # The absolute value is rounded off below 1e-3, by half of that.
    expected = {"l2": size**2, "huber": huber, "l1": np.where(size > 0, size - 5e-4, 0.0)}[name]
    np.testing.assert_allclose(loss.rho(residual) * loss.factor, expected, rtol=1e-12)
    np.testing.assert_allclose(loss.rho(torch.tensor(residual)).numpy(), loss.rho(residual), rtol=1e-12)
    squares = residual**2
    slope = (loss.rho(np.sqrt(squares + 1e-9)) - loss.rho(np.sqrt(squares))) / 1e-9
    np.testing.assert_allclose(loss.weight(residual)[1:], slope[1:], rtol=1e-4)
