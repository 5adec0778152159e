"""Resolving gives the layers of the slow reference, obeys the invariants of its formulas and refuses what is wrong."""

import numpy as np
import pytest
import reference
from fragment_arrays import array_of, fragments_of, transmittance
from hypothesis import given
from hypothesis import strategies as st
from pixels import KINDS, Pixels, join, random_pixels

import warpfrag as wf
from warpfrag import Fragments

MERGES = ("none", "smooth", "order_independent")
MIXES = ("opacity", "average", "optical_depth")
BETAS = np.array([0.0, 0.3, 1.0])
NAMES = ("rgba", "depth", "thickness", "opacity_sum")

betas = st.floats(0.0, 1.0)
merges = st.sampled_from(MERGES)
mixes = st.sampled_from(MIXES)
seeds = st.integers(0, 2**32 - 1)


def resolve_both(pixels: Pixels, beta: np.ndarray, dtype: str, device: str, opacity_sum=None, **options):
    """Return the layers of the operator and of the reference, each with one axis of pixels, float64."""
    fragments = fragments_of(pixels, dtype, kind="warp", device=device, opacity_sum=opacity_sum)
    layers = wf.resolve(fragments, array_of(beta[None], dtype, "warp", device), **options).numpy()
    expected = reference.resolve(*pixels, np.asarray(beta, dtype), opacity_sum, **options)
    return layers, expected


def assert_layers(layers, expected, pixels: Pixels, mix: str, tolerance: float) -> None:
    """Compare layers of one row of pixels with those of the reference, relative to numbers above 1."""
    np.testing.assert_array_equal(layers.count[0], expected.count)
    # The reference knows a transmittance to 1e-16 alone, the operator any; weights by optical depth tell them apart.
    known = transmittance(pixels) > 1e-5 if mix == "optical_depth" else slice(None)
    for name in NAMES:
        # Beyond 1e12 the operator lets an opacity sum be: no mix can tell.
        actual, wanted = (np.minimum(getattr(source, name), 1e11) for source in (layers, expected))
        np.testing.assert_allclose(actual[0][known], wanted[known], tolerance, tolerance, err_msg=name)


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize("max_layers", [1, 2, 8, 64])
def test_layers_are_those_of_the_reference(device, merge, mix, max_layers):
    """Every degenerate pixel, every beta, more layers than needed and fewer, in double precision."""
    pixels = random_pixels(100 + max_layers, 400)
    beta = np.resize(BETAS, 400)
    layers, expected = resolve_both(pixels, beta, "float64", device, merge=merge, mix=mix, max_layers=max_layers)
    # 64 merges round a few times each; opacity sums, and nothing else, grow with the rounding of dense parts: 1e-16 of
    # 1e-6 is passed on. Under optical depth it is 1e-16 of the 1e-5 above.
    assert_layers(layers, expected, pixels, mix, 1e-9)
    np.testing.assert_allclose(layers.rgba[0][..., 3], expected.rgba[..., 3], 0.0, 1e-14)


@pytest.mark.parametrize(("merge", "mix"), [("none", "opacity"), ("smooth", "opacity"), ("smooth", "optical_depth")])
def test_single_precision_layers_are_those_of_the_reference(device, merge, mix):
    """The inputs are exact in float32, so order and overlap are the same, and the rest is rounding."""
    pixels = random_pixels(7, 400)
    layers, expected = resolve_both(pixels, np.resize([0.0, 0.25, 1.0], 400), "float32", device, merge=merge, mix=mix)
    assert layers.rgba.dtype == np.float32
    # About 64 roundings of 6e-8; the weights of a mix lose as much again when the parts are thin.
    tolerance = 1e-5 if mix == "opacity" else 1e-4
    assert_layers(layers, expected, pixels, mix, tolerance)


def test_faint_layers_are_those_of_the_reference(device):
    """Opacities of 0.001 to 0.024, where series replace quotients, or just do not yet: to a few roundings."""
    pixels = random_pixels(9, 200, without=("many",))
    pixels = pixels._replace(rgba=pixels.rgba / 40.0)
    for mix in MIXES:
        layers, expected = resolve_both(pixels, np.resize(BETAS, 200), "float64", device, mix=mix)
        assert_layers(layers, expected, pixels, mix, 1e-13)


def test_a_given_opacity_sum_weighs_the_colours(device):
    """Fragments that were merged before bring S > A along."""
    pixels = random_pixels(11, 300, without=("many",))
    opacity_sum = np.random.default_rng(0).uniform(1.0, 3.0, len(pixels.depth)) * pixels.rgba[:, 3]
    for merge in MERGES:
        layers, expected = resolve_both(
            pixels, np.resize(BETAS, 300), "float64", device, opacity_sum=opacity_sum, merge=merge, max_layers=3
        )
        assert_layers(layers, expected, pixels, "opacity", 1e-9)


def test_smooth_merge_by_hand(device):
    """Red slab 0 ... 2 and green slab 1 ... 3, both A = 1/2, linear: see `test_reference`."""
    pixel = Pixels(
        np.array([[0.5, 0.0, 0.0, 0.5], [0.0, 0.5, 0.0, 0.5]]), np.array([2.0, 3.0]), np.full(2, 2.0), np.array([0, 2])
    )
    layers = wf.resolve(fragments_of(pixel, kind="warp", device=device), max_layers=2).numpy()
    np.testing.assert_allclose(layers.rgba[0, 0, 0], [13 / 28, 2 / 7, 0.0, 0.75], 1e-14)
    np.testing.assert_allclose([layers.depth[0, 0, 0], layers.thickness[0, 0, 0]], 3.0, 1e-14)
    np.testing.assert_allclose(layers.opacity_sum[0, 0, 0], 7 / 6, 1e-14)
    assert layers.count.tolist() == [[1]]


def test_part_behind_a_wall_adds_nothing_to_the_opacity_sum(device):
    """An opaque slab under optical depth is a wall at its front: its part in the mix and its rest are 0/0.

    Red wall 0 ... 2 and green slab 1 ... 3, A = 1/2, at beta = 0: S = 1 + 1/2, green's halves 1 - 1/sqrt(2) each.
    """
    pixel = Pixels(
        np.array([[1.0, 0.0, 0.0, 1.0], [0.0, 0.5, 0.0, 0.5]]), np.array([2.0, 3.0]), np.full(2, 2.0), np.array([0, 2])
    )
    fragments = fragments_of(pixel, kind="warp", device=device)
    layers = wf.resolve(fragments, 0.0, mix="optical_depth").numpy()
    np.testing.assert_allclose(layers.rgba[0, 0, 0], [1.0, 0.0, 0.0, 1.0], 0.0, 1e-15)
    np.testing.assert_allclose(layers.opacity_sum[0, 0, 0], 1.0 + 2.0 * (1.0 - np.sqrt(0.5)), 1e-14)


@pytest.mark.parametrize("kind", ["numpy", "torch", "warp"])
@pytest.mark.parametrize("shape", [(0, 3), (2, 0), (2, 3), (0,), (6,)])
def test_images_of_no_pixels_or_no_fragments(kind, shape):
    """Layers have the shape of the grid and are zero everywhere, in the kind and precision that went in."""
    pixel_count = int(np.prod(shape))
    empty = Pixels(np.zeros((0, 4)), np.zeros(0), np.zeros(0), np.zeros(pixel_count + 1))
    fragments = fragments_of(empty, "float32", kind=kind, shape=shape)
    layers = wf.resolve(fragments, max_layers=5)
    assert type(layers.rgba) is type(fragments.rgba)
    layers = layers.numpy()
    assert layers.rgba.dtype == np.float32
    assert layers.rgba.shape == (*shape, 5, 4)
    assert layers.depth.shape == layers.thickness.shape == layers.opacity_sum.shape == (*shape, 5)
    assert layers.count.shape == shape
    assert not any(values.any() for values in vars(layers).values())
    image = wf.composite(fragments)
    image = image if kind == "numpy" else image.numpy()
    np.testing.assert_array_equal(image, np.zeros((*shape, 4)))


def test_any_grid_has_the_layers_of_its_pixels_in_a_row():
    """Batch dimensions are nothing but a shape."""
    pixels = random_pixels(3, 24)
    row = wf.resolve(fragments_of(pixels), 0.4, max_layers=3)
    for shape in ((24,), (4, 6), (2, 3, 4), (2, 1, 3, 4)):
        layers = wf.resolve(fragments_of(pixels, shape=shape), 0.4, max_layers=3)
        assert layers.shape == shape
        for name in (*NAMES, "count"):
            values = getattr(layers, name)
            np.testing.assert_array_equal(values.reshape(getattr(row, name).shape), getattr(row, name))


def test_a_number_for_beta_is_that_number_in_every_pixel():
    """A Python number, a NumPy number, a 0-d array and an array of pixels give the same bits."""
    pixels = random_pixels(4, 30)
    fragments = fragments_of(pixels, shape=(5, 6))
    expected = wf.resolve(fragments, 0.25)
    for beta in (np.float64(0.25), np.array(0.25), np.array([0.25]), np.full((5, 6), 0.25)):
        np.testing.assert_array_equal(wf.resolve(fragments, beta).rgba, expected.rgba)
    assert not np.array_equal(wf.resolve(fragments, 0).rgba, expected.rgba)
    mixed = np.tile([0.0, 0.25, 1.0], 10).reshape(5, 6)
    layers = wf.resolve(fragments, mixed).rgba
    for beta in (0.0, 0.25, 1.0):
        np.testing.assert_array_equal(layers[mixed == beta], wf.resolve(fragments, beta).rgba[mixed == beta])


def test_memory_layout_and_index_type_do_not_matter():
    """Read-only, strided and reversed arrays, and offsets of 64 bits."""
    pixels = random_pixels(5, 40)
    expected = wf.resolve(fragments_of(pixels))
    strided = [np.repeat(values, 2, axis=0)[::2] for values in pixels[:3]]
    reversed_twice = [values[::-1].copy()[::-1] for values in pixels[:3]]
    fortran = [np.asfortranarray(pixels.rgba), *pixels[1:3]]
    for arrays in (strided, reversed_twice, fortran):
        for values in arrays:
            values.flags.writeable = False
        layers = wf.resolve(Fragments(*arrays, pixels.offsets.astype(np.int64), (1, 40)))
        np.testing.assert_array_equal(layers.rgba, expected.rgba)


# Invariants.


@given(seeds, merges, mixes, betas, st.integers(1, 9))
def test_image_opacity_depends_on_opacities_alone(seed, merge, mix, beta, max_layers):
    """It is 1 - prod(1 - A); layers are sorted, at most M, and zero past the count."""
    pixels = random_pixels(seed, 12)
    layers = wf.resolve(fragments_of(pixels), beta, max_layers=max_layers, merge=merge, mix=mix)
    passed = 1.0 - pixels.rgba[:, 3]
    expected = [1.0 - passed[b:e].prod() for b, e in zip(pixels.offsets, pixels.offsets[1:], strict=False)]
    np.testing.assert_allclose(wf.composite(layers)[0, :, 3], expected, 0.0, 1e-14)
    # Shares of colours are differences of lengths, 1 - y - v: negative by no more than their rounding.
    assert layers.rgba.min() > -1e-14
    for pixel in range(12):
        count = layers.count[0, pixel]
        assert count <= max_layers
        assert (np.diff(layers.depth[0, pixel, :count]) >= 0.0).all()
        assert not any(getattr(layers, name)[0, pixel, count:].any() for name in NAMES)


@given(seeds, mixes, merges, st.integers(0, 3))
def test_surfaces_stay_as_they_are(seed, mix, merge, spare):
    """With t = 0 and M >= N, layers are the sorted fragments, bit for bit; their image does not depend on M."""
    pixels = random_pixels(seed, 8)
    pixels = pixels._replace(thickness=np.zeros_like(pixels.depth))
    most = max(1, np.diff(pixels.offsets).max()) + spare
    layers = wf.resolve(fragments_of(pixels), 0.5, max_layers=int(most), merge=merge, mix=mix)
    for pixel, (begin, end) in enumerate(zip(pixels.offsets, pixels.offsets[1:], strict=False)):
        order = begin + np.argsort(pixels.depth[begin:end], kind="stable")
        np.testing.assert_array_equal(layers.rgba[0, pixel, : end - begin], pixels.rgba[order])
        np.testing.assert_array_equal(layers.depth[0, pixel, : end - begin], pixels.depth[order])
    few = wf.composite(fragments_of(pixels), 0.5, max_layers=2, merge=merge, mix=mix)
    np.testing.assert_allclose(few, wf.composite(layers), 0.0, 1e-14)


@given(seeds, merges, mixes, betas)
def test_order_of_submission_matters_only_between_equals(seed, merge, mix, beta):
    """Where all slabs of a pixel differ in extent, any order gives the same bits."""
    pixels = random_pixels(seed, 8, without=("identical", "many"))
    rng = np.random.default_rng(seed)
    shuffled, kept = [], []
    for pixel, (begin, end) in enumerate(zip(pixels.offsets, pixels.offsets[1:], strict=False)):
        order = begin + rng.permutation(end - begin)
        shuffled.append([values[order] for values in pixels[:3]])
        extents = set(zip(pixels.depth[order], pixels.thickness[order], strict=True))
        kept += [pixel] if len(extents) == end - begin else []
    options = {"max_layers": 3, "merge": merge, "mix": mix}
    expected = wf.resolve(fragments_of(pixels), beta, **options)
    layers = wf.resolve(fragments_of(join(shuffled)), beta, **options)
    for name in NAMES:
        np.testing.assert_array_equal(getattr(layers, name)[0, kept], getattr(expected, name)[0, kept])


@given(seeds, betas, st.floats(0.0, 1.0), st.integers(1, 3), mixes)
def test_slab_cut_in_two_composites_to_itself(seed, beta, r, max_layers, mix):
    """Front and back part touch, so they stay apart or go to the tail, and their over is the whole."""
    whole = random_pixels(seed, 16, 1, without=("many", "empty"))
    parts = []
    for row in reference.fragment_rows(*whole[:3], None):
        (fragment,) = reference.pixel_fragments(row[None])
        cut = whole.depth.dtype.type(fragment.front + r * fragment.thickness)
        pieces = [reference.part(fragment, *ends, beta, mix) for ends in ((0.0, r), (r, 1.0))]
        rgba = [[*piece.color, min(piece.opacity, 1.0)] for piece in pieces]
        parts.append((np.array(rgba), np.array([cut, fragment.depth]), np.array([0.0, 0.0])))
    image = wf.composite(fragments_of(join(parts)), beta, max_layers=max_layers, mix=mix)
    np.testing.assert_allclose(image[0], whole.rgba, 0.0, 1e-13)


@given(seeds, merges, mixes, betas)
def test_permuted_pixels_have_permuted_layers(seed, merge, mix, beta):
    """No pixel knows its neighbours."""
    pixels = random_pixels(seed, 10)
    order = np.random.default_rng(seed).permutation(10)
    bounds = [(pixels.offsets[pixel], pixels.offsets[pixel + 1]) for pixel in order]
    permuted = join([tuple(values[begin:end] for values in pixels[:3]) for begin, end in bounds])
    options = {"max_layers": 4, "merge": merge, "mix": mix}
    expected = wf.resolve(fragments_of(pixels), beta, **options)
    layers = wf.resolve(fragments_of(permuted), beta, **options)
    for name in (*NAMES, "count"):
        np.testing.assert_array_equal(getattr(layers, name)[0], getattr(expected, name)[0, order])


@given(seeds, merges, mixes)
def test_more_room_than_layers_changes_nothing(seed, merge, mix):
    """Where M - 1 layers are enough, M, 2 M and as many as there are fragments give the same bits."""
    pixels = random_pixels(seed, 10, without=("many",))
    roomy = wf.resolve(fragments_of(pixels), 0.5, max_layers=16, merge=merge, mix=mix)
    for max_layers in (2, 5, 9):
        layers = wf.resolve(fragments_of(pixels), 0.5, max_layers=max_layers, merge=merge, mix=mix)
        enough = roomy.count <= max_layers
        np.testing.assert_array_equal(layers.rgba[enough], roomy.rgba[enough][:, :max_layers])
        assert (layers.count[~enough] == max_layers).all()


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("opacity", [0.5, 0.999, 1.0])
def test_hundreds_of_dense_slabs_on_top_of_one_another(opacity, mix):
    """Opacity sums triple with every cut and transmittance underflows; single precision still gives the image."""
    rng = np.random.default_rng(1)
    rgba = np.column_stack([rng.uniform(0.0, opacity, (256, 3)), np.full(256, opacity)]).astype(np.float32)
    depth = np.sort(rng.integers(1024, 2048, 256)) / 1024.0
    pixel = Pixels(rgba.astype(np.float64), depth, np.full(256, 0.5), np.array([0, 256]))
    for merge in ("smooth", "order_independent"):
        for beta in BETAS:
            single, double = (
                wf.composite(fragments_of(pixel, dtype), beta, merge=merge, mix=mix) for dtype in ("float32", "float64")
            )
            # 256 merges of rounded numbers near 1.
            np.testing.assert_allclose(single, double, 0.0, 2e-5)


# Errors.


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"merge": "soft"}, ValueError, 'merge: got "soft", expected one of "none", "smooth", "order_independent"'),
        ({"merge": 1}, ValueError, "merge: got 1"),
        ({"mix": "opacities"}, ValueError, 'mix: got "opacities", expected one of "opacity", "average"'),
        ({"max_layers": 0}, ValueError, "max_layers: got 0, expected a whole number from 1 to"),
        ({"max_layers": 2.0}, TypeError, "max_layers: got 2.0, expected a whole number"),
        ({"max_layers": True}, TypeError, "max_layers: got true"),
        ({"beta": -0.1}, ValueError, "beta: got -0.1, expected a number from 0 to 1"),
        ({"beta": float("nan")}, ValueError, "beta: got nan"),
        ({"beta": "optical"}, TypeError, 'beta: got "optical", expected a number from 0 to 1'),
        ({"beta": True}, TypeError, "beta: got true"),
        ({"beta": np.full((1, 3), 0.5, np.float32)}, TypeError, "beta: got dtype float32, expected float64"),
        ({"beta": np.full((3,), 0.5)}, ValueError, r"beta: got shape \(3,\), expected \(\) or \(1, 3\)"),
        ({"beta": np.array([[0.5, 1.5, 0.5]])}, ValueError, "beta: got 1.5 in pixel 1, expected numbers from 0 to 1"),
        ({"beta": np.array([[0.5, 0.5, np.nan]])}, ValueError, "beta: got nan in pixel 2"),
        ({"beta": np.array(-1.0)}, ValueError, "beta: got -1.0 in pixel 0"),
    ],
)
def test_options_are_checked(options, error, message):
    """By both functions, in one line that says what was found and what is expected."""
    fragments = Fragments.from_lists([[(0.1, 0.1, 0.1, 0.5, 1.0, 0.2)], [], []], (1, 3), np.float64)
    for function in (wf.resolve, wf.composite):
        with pytest.raises(error, match=message):
            function(fragments, **options)


@pytest.mark.parametrize("merge", ["none", "smooth"])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("rgba", np.array([0.0, 0.0, 0.0, bad])) for bad in (-1e-3, 1.001, np.nan, np.inf)),
        *(("rgba", np.array([0.0, bad, 0.0, 0.5])) for bad in (np.nan, np.inf, -np.inf)),
        *(("depth", bad) for bad in (np.nan, np.inf, -np.inf)),
        *(("thickness", bad) for bad in (-1e-6, np.nan, np.inf)),
        *(("opacity_sum", bad) for bad in (-1e-6, np.nan, np.inf)),
    ],
)
def test_values_are_checked(device, merge, name, value):
    """The first fragment that is not finite or out of range is named, with what it holds."""
    pixels = random_pixels(2, 9, without=KINDS)
    wrong = {field: getattr(pixels, field).copy() for field in ("rgba", "depth", "thickness")}
    wrong["opacity_sum"] = wrong["rgba"][:, 3].copy()
    wrong[name][5] = value
    wrong[name][7] = value
    opacity_sum = wrong.pop("opacity_sum")
    fragments = fragments_of(pixels._replace(**wrong), kind="warp", device=device, opacity_sum=opacity_sum)
    for function in (wf.resolve, wf.composite):
        with pytest.raises(ValueError, match=rf"got .*{name} .* in fragment 5, expected finite values"):
            function(fragments, merge=merge)


@pytest.mark.parametrize(
    ("offsets", "message"),
    [
        ([0, 2, 1, 3], "offsets: got the fragments 2 : 1 for pixel 1, expected 0 <= begin <= end <= 3"),
        ([0, 1, 4, 3], "offsets: got the fragments 1 : 4 for pixel 1"),
        ([-1, 1, 2, 3], "offsets: got the fragments -1 : 1 for pixel 0"),
        ([0, 1, 2, 2], "offsets: got a run from 0 to 2, expected from 0 to the 3 fragments"),
        ([1, 1, 2, 3], "offsets: got a run from 1 to 3"),
    ],
)
@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_offsets_are_checked(offsets, message, dtype):
    """Nothing is read outside the arrays, and no fragment is left out."""
    fragments = Fragments(np.zeros((3, 4)), np.ones(3), np.zeros(3), np.array(offsets, dtype), (1, 3))
    for function in (wf.resolve, wf.composite):
        with pytest.raises(ValueError, match=message):
            function(fragments)


def test_warp_arrays_have_four_dimensions():
    """Layers of several views would need five."""
    fragments = fragments_of(random_pixels(0, 8), kind="warp", shape=(2, 2, 2))
    assert wf.composite(fragments).shape == (2, 2, 2, 4)
    with pytest.raises(ValueError, match=r"fragments: got shape \(2, 2, 2\), expected at most 2 dimensions"):
        wf.resolve(fragments)


def test_only_fragments_are_resolved():
    """Layers, arrays and None are refused by name."""
    for wrong in (None, np.zeros((3, 4)), wf.resolve(fragments_of(random_pixels(0, 2)))):
        with pytest.raises(TypeError, match=r"fragments: got .*, expected Fragments"):
            wf.resolve(wrong)
