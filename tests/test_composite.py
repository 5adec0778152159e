"""Compositing layers is over by hand and by the reference; the fused way is resolving and compositing in one."""

import numpy as np
import pytest
import reference
from fragment_arrays import array_of, fragments_of, transmittance
from hypothesis import given
from hypothesis import strategies as st
from pixels import random_pixels

import warpfrag as wf
from warpfrag import Layers

MERGES = ("none", "smooth", "order_independent")
MIXES = ("opacity", "average", "optical_depth")


def layers_of(rgba, count, dtype: str = "float64", kind: str = "numpy", device: str = "cpu") -> Layers:
    """Make layers; compositing looks at colours and counts alone."""
    rgba = np.asarray(rgba)
    others = [array_of(np.zeros(rgba.shape[:-1]), dtype, kind, device) for _ in range(3)]
    return Layers(array_of(rgba, dtype, kind, device), *others, array_of(count, "int32", kind, device))


@pytest.mark.parametrize("kind", ["numpy", "torch", "warp"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_over_by_hand(device, kind, dtype):
    """Red A = 1/2 over green A = 1/2 over blue; a pixel of green alone; an empty one."""
    if kind == "numpy" and device != "cpu":
        pytest.skip("NumPy has one device")
    rgba = np.zeros((3, 3, 4))
    rgba[0] = [[0.5, 0.0, 0.0, 0.5], [0.0, 0.5, 0.0, 0.5], [0.0, 0.0, 1.0, 1.0]]
    rgba[1, 0] = [0.0, 0.5, 0.0, 0.5]
    image = wf.composite(layers_of(rgba[None], [[3, 1, 0]], dtype, kind, device))
    image = image if kind == "numpy" else image.numpy() if kind == "warp" else image.cpu().numpy()
    assert image.dtype == dtype
    np.testing.assert_array_equal(image, [[[0.5, 0.25, 0.25, 1.0], [0.0, 0.5, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]]])


def test_nothing_past_the_count_is_looked_at():
    """Neither NaN nor a count beyond the room there is; opaque layers hide what is behind them."""
    rgba = np.full((1, 2, 3, 4), np.nan)
    rgba[0, 0, 0] = [0.25, 0.5, 0.75, 0.5]
    rgba[0, 1] = [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 1.0], [5.0, 5.0, 5.0, 1.0]]
    image = wf.composite(layers_of(rgba, [[1, 100]]))
    np.testing.assert_array_equal(image, [[[0.25, 0.5, 0.75, 0.5], [1.0, 0.0, 0.0, 1.0]]])


def test_layers_with_no_room_and_images_of_no_pixels():
    """Both give zeros of the right shape."""
    assert not wf.composite(layers_of(np.zeros((2, 3, 0, 4)), np.zeros((2, 3)))).any()
    assert wf.composite(layers_of(np.zeros((0, 3, 2, 4)), np.zeros((0, 3)))).shape == (0, 3, 4)
    assert wf.composite(layers_of(np.zeros((2, 2, 3, 2, 4)), np.zeros((2, 2, 3)))).shape == (2, 2, 3, 4)


def test_counts_may_be_of_64_bits():
    """As other libraries make them."""
    rgba = np.random.default_rng(0).uniform(0.0, 1.0, (1, 5, 3, 4))
    count = np.array([[0, 1, 2, 3, 3]])
    layers = layers_of(rgba, count)
    wide = Layers(layers.rgba, layers.depth, layers.thickness, layers.opacity_sum, count.astype(np.int64))
    np.testing.assert_array_equal(wf.composite(wide), wf.composite(layers))
    np.testing.assert_allclose(wf.composite(layers)[0], reference.composite(rgba[0], count[0]), 1e-15)


def test_options_go_with_fragments_only():
    """Layers have been merged before: every option is refused by name."""
    layers = layers_of(np.zeros((1, 1, 1, 4)), [[1]])
    for name, value in {"beta": 0.5, "max_layers": 2, "merge": "smooth", "mix": "opacity"}.items():
        with pytest.raises(TypeError, match=f"{name}: got it with Layers, expected Fragments"):
            wf.composite(layers, **{name: value})
    with pytest.raises(TypeError, match="ndarray"):
        wf.composite(layers.rgba)


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize("max_layers", [1, 2, 64])
def test_fused_image_is_that_of_the_reference(device, merge, mix, max_layers):
    """Every degenerate pixel and every beta, in double precision."""
    pixels = random_pixels(200 + max_layers, 300)
    beta = np.resize([0.0, 0.3, 1.0], 300)
    options = {"merge": merge, "mix": mix, "max_layers": max_layers}
    fragments = fragments_of(pixels, kind="warp", device=device)
    image = wf.composite(fragments, array_of(beta[None], "float64", "warp", device), **options).numpy()[0]
    layers = reference.resolve(*pixels, beta, **options)
    expected = reference.composite(layers.rgba, layers.count)
    # See `test_layers_are_those_of_the_reference`.
    known = transmittance(pixels) > 1e-5 if mix == "optical_depth" else slice(None)
    np.testing.assert_allclose(image[known], expected[known], 0.0, 1e-9 if mix == "optical_depth" else 1e-12)
    np.testing.assert_allclose(image[:, 3], expected[:, 3], 0.0, 1e-14)


@pytest.mark.parametrize(("merge", "mix"), [("none", "opacity"), ("smooth", "opacity"), ("smooth", "optical_depth")])
def test_single_precision_image_is_that_of_the_reference(device, merge, mix):
    """Inputs are exact in float32, decisions are the same, the rest is rounding."""
    pixels = random_pixels(8, 400)
    beta = np.resize([0.0, 0.25, 1.0], 400)
    fragments = fragments_of(pixels, "float32", kind="warp", device=device)
    beta_array = array_of(beta[None], "float32", "warp", device)
    image = wf.composite(fragments, beta_array, merge=merge, mix=mix).numpy()[0]
    layers = reference.resolve(*pixels, beta, merge=merge, mix=mix)
    expected = reference.composite(layers.rgba, layers.count)
    known = transmittance(pixels) > 1e-5 if mix == "optical_depth" else slice(None)
    np.testing.assert_allclose(image[known], expected[known], 0.0, 5e-6 if mix == "opacity" else 5e-5)
    np.testing.assert_allclose(image[:, 3], expected[:, 3], 0.0, 1e-6)


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(MERGES),
    st.sampled_from(MIXES),
    st.floats(0.0, 1.0),
    st.integers(1, 6),
    st.booleans(),
)
def test_fused_is_layered(seed, merge, mix, beta, max_layers, weighted):
    """The image without layers stored in between is the image with them, to rounding."""
    pixels = random_pixels(seed, 12)
    rng = np.random.default_rng(seed)
    opacity_sum = rng.uniform(1.0, 3.0, len(pixels.depth)) * pixels.rgba[:, 3] if weighted else None
    fragments = fragments_of(pixels, opacity_sum=opacity_sum, shape=(3, 4))
    options = {"max_layers": max_layers, "merge": merge, "mix": mix}
    layered = wf.composite(wf.resolve(fragments, beta, **options))
    # The layers' opacities near 1 know their transmittance to 1e-16 only, the fused way knows more.
    np.testing.assert_allclose(wf.composite(fragments, beta, **options), layered, 0.0, 1e-13)


def test_defaults_are_those_of_resolve():
    """Linear, smooth, eight layers, weights by opacity; None stands for a default."""
    fragments = fragments_of(random_pixels(9, 50))
    expected = wf.composite(fragments, 1.0, max_layers=8, merge="smooth", mix="opacity")
    np.testing.assert_array_equal(wf.composite(fragments), expected)
    np.testing.assert_allclose(wf.composite(wf.resolve(fragments)), expected, 0.0, 1e-14)
