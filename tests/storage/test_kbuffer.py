"""The bounded k-buffer over stored fragments: its layers and their gradients, against the slow reference."""

import numpy as np
import pytest
import warp as wp
from fragment_arrays import fragments_of
from pixels import Pixels, generic_pixels, join, random_pixels
from reference import composite as reference_composite
from reference import resolve as reference_resolve
from reference_kbuffer import kbuffer as reference_kbuffer
from reference_kbuffer import kbuffer_gradient

import warpfrag as wf
from warpfrag.storage.kbuffer import kbuffer

MERGES = ("order_independent", "none")
TAILS = ("mix", "discard")
OUTPUTS = ("rgba", "depth", "thickness", "opacity_sum")


def one_pixel(*fragments: tuple[float, ...], **options) -> Pixels:
    """Return a pixel of fragments (r, g, b, A, z, t), as `Fragments.from_lists` takes them."""
    rows = np.array(fragments, np.float64).reshape(-1, 6)
    return Pixels(rows[:, :4], rows[:, 4], rows[:, 5], np.array([0, len(rows)], np.int32))


def shuffled(pixels: Pixels, seed: int) -> Pixels:
    """Return the same pixels with their fragments in another order."""
    rng = np.random.default_rng(seed)
    order = np.concatenate(
        [b + rng.permutation(e - b) for b, e in zip(pixels.offsets, pixels.offsets[1:], strict=False)]
    )
    return Pixels(*(values[order.astype(int)] for values in pixels[:3]), pixels.offsets)


def has_distinct_depths(pixels: Pixels) -> np.ndarray:
    """Tell for each pixel whether no two fragments have one depth."""
    bounds = zip(pixels.offsets, pixels.offsets[1:], strict=False)
    return np.array([len(set(pixels.depth[begin:end])) == end - begin for begin, end in bounds])


def gradients(pixels: Pixels, cotangents, dtype="float64", device="cpu", opacity_sum=None, **options) -> np.ndarray:
    """Return torch's gradients as rows (r, g, b, A, z, t), with S at the end if it is given."""
    import torch

    fragments = fragments_of(pixels, dtype, kind="torch", device=device, opacity_sum=opacity_sum, requires_grad=True)
    layers = kbuffer(fragments, **options)
    outputs = [getattr(layers, name) for name in OUTPUTS]
    seeds = [torch.as_tensor(c).to(o).reshape(o.shape) for c, o in zip(cotangents, outputs, strict=True)]
    inputs = [fragments.rgba, fragments.depth, fragments.thickness]
    inputs += [] if opacity_sum is None else [fragments.opacity_sum]
    found = torch.autograd.grad(outputs, inputs, seeds)
    return np.column_stack([grad.cpu().numpy().astype(np.float64) for grad in found])


def draw_cotangents(pixels: Pixels, slots: int, seed: int = 0) -> list[np.ndarray]:
    """Draw cotangents of all outputs."""
    rng, count = np.random.default_rng(seed), len(pixels.offsets) - 1
    return [rng.normal(size=shape) for shape in ((count, slots, 4), *[(count, slots)] * 3)]


def test_overlapping_fragments_mix_and_the_rest_goes_to_the_tail():
    """Worked by hand: two half-opaque slabs mix in the core, two more, apart, in the tail."""
    pixels = one_pixel(
        (0.5, 0.0, 0.0, 0.5, 2.0, 1.0), (0.0, 0.0, 0.5, 0.5, 9.0, 0.0), (0.0, 0.5, 0.0, 0.5, 1.5, 1.0),
        (0.0, 0.0, 0.0, 1.0, 7.0, 0.5),
    )  # fmt: skip
    layers = kbuffer(fragments_of(pixels), 2)
    assert layers.count.tolist() == [[2]]
    np.testing.assert_allclose(layers.rgba[0, 0], [[0.375, 0.375, 0.0, 0.75], [0.0, 0.0, 1 / 3, 1.0]])
    np.testing.assert_allclose(layers.depth[0, 0], [2.0, 9.0])
    np.testing.assert_allclose(layers.thickness[0, 0], [1.5, 2.5])
    np.testing.assert_allclose(layers.opacity_sum[0, 0], [1.0, 1.5])


@pytest.mark.parametrize("tail", TAILS)
@pytest.mark.parametrize("merge", MERGES)
def test_layers_are_those_of_the_reference(merge, tail, device):
    """Every degenerate case included, in both precisions."""
    for slots in (1, 3, 8):
        pixels = random_pixels(slots, 600)
        expected = reference_kbuffer(*pixels, slots=slots, merge=merge, tail=tail)
        for dtype, tolerance in (("float64", 1e-12), ("float32", 4e-6)):
            found = kbuffer(
                fragments_of(pixels, dtype, kind="warp", device=device), slots, merge=merge, tail=tail
            ).numpy()
            np.testing.assert_array_equal(found.count[0], expected.count)
            for name in OUTPUTS:
                # Sums of up to 64 numbers around 1.
                values = getattr(found, name)[0]
                np.testing.assert_allclose(values, getattr(expected, name), tolerance, tolerance, err_msg=name)


def test_given_opacity_sums_weight_the_mix():
    """Fragments that were mixed before keep their weight."""
    pixels = random_pixels(5, 200, without=("emissive", "transparent", "nearly_transparent"))
    sums = pixels.rgba[:, 3] * np.random.default_rng(0).uniform(1.0, 3.0, len(pixels.depth))
    expected = reference_kbuffer(*pixels, sums, slots=4)
    found = kbuffer(fragments_of(pixels, opacity_sum=sums), 4)
    for name in OUTPUTS:
        np.testing.assert_allclose(getattr(found, name)[0], getattr(expected, name), 1e-12, 1e-12)


@pytest.mark.parametrize("given_sums", [False, True])
@pytest.mark.parametrize("tail", TAILS)
@pytest.mark.parametrize("merge", MERGES)
def test_gradients_are_those_of_the_reference(merge, tail, given_sums, device):
    """All outputs by all inputs, opaque fragments included, in float64 to rounding."""
    for slots in (1, 2, 4):
        for opaque in (False, True):
            pixels = generic_pixels(slots, 8, 9, opaque=opaque)
            sums = np.random.default_rng(1).uniform(1.0, 3.0, len(pixels.depth)) * pixels.rgba[:, 3]
            options = {"opacity_sum": sums if given_sums else None, "slots": slots, "merge": merge, "tail": tail}
            cotangents = draw_cotangents(pixels, slots)
            expected = kbuffer_gradient(*pixels, cotangents=cotangents, **options)
            np.testing.assert_allclose(gradients(pixels, cotangents, device=device, **options), expected, 1e-9, 1e-10)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("merge", MERGES)
def test_gradients_of_degenerate_pixels(merge, dtype):
    """Empty, opaque, nearly empty and nearly opaque fragments in one slot, coincident ones: by colour and opacity."""
    pixels = random_pixels(11, 60, without=("many",))
    cotangents = draw_cotangents(pixels, 3)
    expected = kbuffer_gradient(*pixels, cotangents=cotangents, slots=3, merge=merge)[:, :4]
    found = gradients(pixels, cotangents, dtype, slots=3, merge=merge)[:, :4]
    # The reference divides by opacities of 1e-7 and their squares; float32 has the layers' weights to 1e-7.
    np.testing.assert_allclose(found, expected, 1e-6 if dtype == "float64" else 2e-5, 1e-6)


def test_gradcheck():
    """Torch's own differences agree."""
    import torch

    pixels = generic_pixels(3, 6, 5)
    fragments = fragments_of(pixels, kind="torch", requires_grad=True)

    def function(rgba, depth, thickness):
        layers = kbuffer(wf.Fragments(rgba, depth, thickness, fragments.offsets, fragments.shape), 3)
        return layers.rgba, layers.depth, layers.thickness, layers.opacity_sum

    assert torch.autograd.gradcheck(function, (fragments.rgba, fragments.depth, fragments.thickness))


def test_tape_twice_counts_double(device):
    """Warp's tape adds to gradients, with the values of torch."""
    pixels = generic_pixels(4, 10, 8)
    cotangents = draw_cotangents(pixels, 3)
    fragments = fragments_of(pixels, kind="warp", device=device, requires_grad=True)
    with wp.Tape() as tape:
        layers = kbuffer(fragments, 3)
    for times in (1, 2):
        outputs = [getattr(layers, name) for name in OUTPUTS]
        seeds = (
            wp.array(c.reshape(o.shape), dtype=o.dtype, device=device) for c, o in zip(cotangents, outputs, strict=True)
        )
        tape.backward(grads=dict(zip(outputs, seeds, strict=True)))
        found = [array.grad.numpy() for array in (fragments.rgba, fragments.depth, fragments.thickness)]
        expected = times * gradients(pixels, cotangents, slots=3)
        np.testing.assert_allclose(np.column_stack(found), expected, 1e-12, 1e-14)


@pytest.mark.parametrize("merge", MERGES)
def test_arrival_order_does_not_matter_while_the_tail_is_empty(merge):
    """With slots to spare any order gives the same layers, but for the order of coincident surfaces."""
    pixels = random_pixels(6, 400)
    distinct = has_distinct_depths(pixels)
    assert distinct.sum() > 200
    first, second = (kbuffer(fragments_of(shuffled(pixels, seed)), 65, merge=merge) for seed in (0, 1))
    np.testing.assert_array_equal(first.count, second.count)
    for name in OUTPUTS:
        found, other = (getattr(layers, name)[0][distinct] for layers in (first, second))
        np.testing.assert_allclose(found, other, 1e-11, 1e-11)


def test_mixing_fragments_in_depth_order_is_the_resolve_pass():
    """While the tail is empty the k-buffer gives what order-independent merging of the sorted fragments does."""
    pixels = random_pixels(7, 300, without=("thin", "touching"))
    found = kbuffer(fragments_of(pixels), 65)
    sorted_pass = reference_resolve(*pixels, max_layers=65, merge="order_independent")
    # The resolve pass compares with the running slab alone; where it merges all that overlaps, both are the same.
    same = found.count[0] == sorted_pass.count
    assert same.mean() > 0.8
    np.testing.assert_allclose(found.rgba[0][same], sorted_pass.rgba[same], 1e-9, 1e-9)


def test_discarding_keeps_the_nearest():
    """The classic k-buffer: the K nearest fragments, the first of coincident ones."""
    pixels = random_pixels(8, 400)
    found = kbuffer(fragments_of(pixels), 5, merge="none", tail="discard")
    for pixel, (begin, end) in enumerate(zip(pixels.offsets, pixels.offsets[1:], strict=False)):
        nearest = begin + np.argsort(pixels.depth[begin:end], kind="stable")[:5]
        assert found.count[0, pixel] == len(nearest)
        np.testing.assert_array_equal(found.depth[0, pixel, : len(nearest)], pixels.depth[nearest])
        np.testing.assert_array_equal(found.rgba[0, pixel, : len(nearest)], pixels.rgba[nearest])
        assert not found.thickness[0, pixel].any()


@pytest.mark.parametrize("merge", MERGES)
def test_enough_slots_without_thickness_are_plain_over(merge):
    """With t = 0 and as many slots as fragments the image is that of sorted over."""
    pixels = random_pixels(9, 200)
    pixels = pixels._replace(thickness=0.0 * pixels.depth)
    layers = reference_resolve(*pixels, max_layers=64, merge="none")
    image = wf.composite(kbuffer(fragments_of(pixels), 65, merge=merge))
    expected = reference_composite(layers.rgba, layers.count)
    # Coincident fragments may come in another order than by front: leave those out.
    distinct = has_distinct_depths(pixels)
    assert distinct.sum() > 50
    np.testing.assert_allclose(image[0][distinct], expected[distinct], 1e-12, 1e-12)


@pytest.mark.parametrize("merge", MERGES)
def test_opacity_is_that_of_over(merge):
    """Mixing keeps transmittance, in core and tail: 1 - prod (1 - A), whatever the slots."""
    pixels = random_pixels(10, 300)
    expected = [1 - np.prod(1 - pixels.rgba[b:e, 3]) for b, e in zip(pixels.offsets, pixels.offsets[1:], strict=False)]
    for slots in (1, 2, 5):
        image = wf.composite(kbuffer(fragments_of(pixels), slots, merge=merge))
        np.testing.assert_allclose(image[0, :, 3], expected, 1e-12, 1e-12)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_extreme_values_stay_finite(dtype):
    """Opacities down to the least and up to 1, depths and thicknesses over many decades: layers and gradients."""
    rng = np.random.default_rng(12)
    pixel_count, most = 20000, 10
    counts = rng.integers(0, most + 1, pixel_count)
    total = counts.sum()
    tiny = 10.0 ** rng.uniform(-37, 0, total)
    opacity = np.choose(rng.integers(0, 5, total), [tiny, 1 - tiny, 0.0 * tiny, 1 + 0.0 * tiny, rng.random(total)])
    color = rng.uniform(0, 1, (total, 3)) * np.where(rng.random(total) < 0.2, 1.0, opacity)[:, None]
    depth = 10.0 ** rng.uniform(-3, 6, total)
    thickness = np.where(rng.random(total) < 0.3, 0.0, 10.0 ** rng.uniform(-6, 6, total))
    pixels = Pixels(np.column_stack([color, opacity]), depth, thickness, np.cumsum([0, *counts]).astype(np.int32))
    for merge in MERGES:
        layers = kbuffer(fragments_of(pixels, dtype), 3, merge=merge)
        for name in OUTPUTS:
            assert np.isfinite(getattr(layers, name)).all()
        assert layers.rgba[..., 3].min() >= 0.0
        assert layers.rgba[..., 3].max() <= 1.0
        found = gradients(pixels, draw_cotangents(pixels, 3), dtype, slots=3, merge=merge)
        assert np.isfinite(found).all()
        # Of a mean of colours of at most 1, weighted by opacity: bounded, unlike 1 / opacity.
        colored = color.max(axis=1) <= opacity
        assert np.abs(found[colored, 4:]).max() < 100.0


def test_threads_make_no_difference(monkeypatch):
    """Layers and gradients have the same bits for any number of threads."""
    pixels = random_pixels(13, 3000)
    cotangents = draw_cotangents(pixels, 4)
    results = []
    for threads in (1, 2, 3, 8):
        monkeypatch.setenv("WARPFRAG_THREADS", str(threads))
        layers = kbuffer(fragments_of(pixels, "float32"), 4)
        found = [getattr(layers, name) for name in (*OUTPUTS, "count")]
        results.append([*found, gradients(pixels, cotangents, "float32", slots=4)])
    for other in results[1:]:
        for values, expected in zip(other, results[0], strict=True):
            np.testing.assert_array_equal(values, expected)


def test_empty_fragments_and_batches():
    """Pixels without fragments have no layers; leading batch dimensions stay."""
    pixels = join([(np.zeros((0, 4)), np.zeros(0), np.zeros(0))] * 6)
    layers = kbuffer(fragments_of(pixels, shape=(1, 2, 3)), 4)
    assert layers.rgba.shape == (1, 2, 3, 4, 4)
    assert not layers.count.any()
    assert not layers.rgba.any()


def test_arguments_are_checked():
    """Wrong arguments are named."""
    fragments = fragments_of(random_pixels(1, 4))
    with pytest.raises(TypeError, match="fragments: got list"):
        kbuffer([])
    with pytest.raises(ValueError, match="slots: got 0"):
        kbuffer(fragments, 0)
    with pytest.raises(TypeError, match=r"slots: got 2\.5"):
        kbuffer(fragments, 2.5)
    with pytest.raises(ValueError, match='merge: got "smooth", expected "none" or "order_independent"'):
        kbuffer(fragments, merge="smooth")
    with pytest.raises(ValueError, match='tail: got "drop"'):
        kbuffer(fragments, tail="drop")
    bad = one_pixel((0.5, 0.0, 0.0, 1.5, 2.0, 1.0))
    with pytest.raises(ValueError, match="in fragment 0, expected finite"):
        kbuffer(fragments_of(bad))
