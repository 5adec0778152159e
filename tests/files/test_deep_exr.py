"""Deep OpenEXR files: to the bit and back, also by way of OpenImageIO, flattened as it does; what is refused."""

import struct
import warnings
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pixels import random_pixels

import warpfrag as wf
from warpfrag.deep import tidy
from warpfrag.files.deep_exr import read_attributes
from warpfrag.files.images import ImageError
from warpfrag.files.source import ReadingWarning

openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
FLATTEN = {"merge": "exact", "mix": "optical_depth", "beta": 0.0}


def random_fragments(seed=0, shape=(6, 8), **kinds):
    """Draw float32 fragments, sorted, with ids that need all 32 bits."""
    pixels = random_pixels(seed, shape[0] * shape[1], **kinds)
    random = np.random.default_rng(seed)
    ids = random.integers(0, 2**32, (2, len(pixels.depth)), np.uint32).view(np.int32)
    floats = [array.astype(np.float32) for array in pixels[:3]]
    return tidy(wf.Fragments(*floats, pixels.offsets, shape, object_id=ids[0], primitive_id=ids[1]))


def assert_same(found, expected):
    """Compare all arrays to the bit."""
    assert found.shape == expected.shape
    for name in ("rgba", "depth", "thickness", "offsets", "object_id", "primitive_id"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def cells(values, counts):
    """Divide values into the object array that OpenEXR writes, (H, W)."""
    ends = np.concatenate([[0], np.cumsum(counts)])
    return np.fromiter((values[a:b] for a, b in pairwise(ends)), object, counts.size).reshape(counts.shape)


def write(path, counts, parts=1, header=(), views=(), **channels):
    """Write channels, or what all of R, G, B, A and Z are by default, with OpenEXR, as parts of a deep file."""
    counts = np.asarray(counts)
    total = counts.sum()
    base = {name: np.full(total, 0.5, np.float32) for name in "RGBAZ"}
    base = {name: values for name, values in {**base, **channels}.items() if values is not None}
    header = {"type": openexr.deepscanline, "compression": openexr.ZIPS_COMPRESSION, **dict(header)}
    listed = []
    for number in range(parts):
        own = {**header, "name": f"part{number}", **({"view": views[number]} if views else {})}
        listed.append(openexr.Part(own, {key: cells(v, counts) for key, v in base.items()}, own["name"]))
    with openexr.File(listed) as file:
        file.write(str(path))


@pytest.mark.parametrize("shape", [(6, 8), (1, 1), (1, 9), (40, 3)])
def test_written_and_read_to_the_bit(tmp_path, shape):
    """Every float and every bit of an id come back, in their pixels."""
    fragments = random_fragments(1, shape)
    wf.write_deep(tmp_path / "a.exr", fragments, attributes={"owner": "me"})
    assert_same(wf.read_deep(tmp_path / "a.exr"), fragments)
    told = read_attributes(tmp_path / "a.exr")
    assert told["owner"] == "me"
    assert "along the ray" in told["warpfrag:depth"]


def test_equal_numbers_of_samples_in_all_pixels(tmp_path):
    """A full image keeps its samples, as does one of surfaces, of layers, of torch tensors, and an empty one."""
    full = wf.Fragments.from_lists([[(1, 2, 3, 0.5, 4, 0), (0, 0, 1, 1, 9, 0)]] * 6, (2, 3))
    sources = [full, wf.Fragments.from_lists([[]] * 6, (2, 3))]
    for source in sources:
        wf.write_deep(tmp_path / "a.exr", source)
        assert_same(wf.read_deep(tmp_path / "a.exr"), source)
    wf.write_deep(tmp_path / "a.exr", wf.resolve(full, max_layers=4, merge="none"))
    assert_same(wf.read_deep(tmp_path / "a.exr"), full)
    pytest.importorskip("torch")
    wf.write_deep(tmp_path / "a.exr", full.torch())
    assert_same(wf.read_deep(tmp_path / "a.exr"), full)


def test_half_colours(tmp_path):
    """Colours are rounded to half precision if wanted, depths are not; what is too large for it is refused."""
    fragments = random_fragments(2)
    wf.write_deep(tmp_path / "a.exr", fragments, half=True)
    rounded = replace(fragments, rgba=fragments.rgba.astype(np.float16).astype(np.float32))
    assert_same(wf.read_deep(tmp_path / "a.exr"), rounded)
    large = replace(fragments, rgba=fragments.rgba * np.float32([1e6, 1, 1, 1]))
    with pytest.raises(ImageError, match=r"got colours up to .*, expected at most 65504"):
        wf.write_deep(tmp_path / "a.exr", large, half=True)


@pytest.mark.parametrize("compression", ["NO_COMPRESSION", "RLE_COMPRESSION", "ZIPS_COMPRESSION"])
def test_compressions(tmp_path, compression):
    """Half, float and uint channels, of runs and of noise, are unpacked to the bit, whatever packed them."""
    random = np.random.default_rng(4)
    counts = random.integers(0, 5, (30, 40))
    noise = random.random((4, counts.sum()))
    channels = {
        "R": np.float32(noise[0]),
        "G": np.float16(noise[1]),
        "Z": np.float32(noise[2].round(1)),
        "id": np.uint32(noise[3] * 2**32),
    }
    write(tmp_path / "a.exr", counts, header={"compression": getattr(openexr, compression)}, **channels)
    found = wf.read_deep(tmp_path / "a.exr")
    np.testing.assert_array_equal(np.diff(found.offsets).reshape(30, 40), counts)
    np.testing.assert_array_equal(found.rgba[:, 0], channels["R"])
    np.testing.assert_array_equal(found.rgba[:, 1], channels["G"].astype(np.float32))
    np.testing.assert_array_equal(found.rgba[:, 2:], 0.5)
    np.testing.assert_array_equal(found.depth, channels["Z"])
    np.testing.assert_array_equal(found.object_id.view(np.uint32), channels["id"])


def test_openimageio_and_back(tmp_path):
    """OpenImageIO reads what is written here, and what it writes again is read here, to the bit."""
    oiio = pytest.importorskip("OpenImageIO", reason="OpenImageIO is not installed")
    fragments = random_fragments(3, (16, 20))
    wf.write_deep(tmp_path / "a.exr", fragments)
    image = oiio.ImageBuf(str(tmp_path / "a.exr"))
    samples = image.deepdata()
    channel = {name: number for number, name in enumerate(image.spec().channelnames)}
    row, column = np.unravel_index(np.diff(fragments.offsets).argmax(), fragments.shape)
    own = fragments[row, column]
    place = int(row * 20 + column)
    assert samples.samples(place) == own.count
    for number in range(own.count):
        values = [samples.deep_value(place, channel[name], number) for name in ("R", "G", "B", "A", "ZBack")]
        np.testing.assert_array_equal(np.float32(values), [*own.rgba[number], own.depth[number]])
        assert samples.deep_value_uint(place, channel["id"], number) == own.object_id.view(np.uint32)[number]
    assert image.write(str(tmp_path / "b.exr")), image.geterror()
    assert_same(wf.read_deep(tmp_path / "b.exr"), fragments)


@pytest.mark.parametrize("seed", range(3))
def test_flattened_as_openimageio_does(tmp_path, seed):
    """Of tidied samples (sorted, slabs cut and mixed where they overlap) it is the same image."""
    oiio = pytest.importorskip("OpenImageIO", reason="OpenImageIO is not installed")
    # It has other rules for samples in one place, and cuts opaque slabs in two opaque parts.
    without = ("identical", "equal_depths", "equal_fronts", "opaque", "nearly_opaque", "emissive", "transparent")
    fragments = random_fragments(seed, (16, 16), without=without)
    wf.write_deep(tmp_path / "a.exr", fragments)
    image = oiio.ImageBuf(str(tmp_path / "a.exr"))
    image.read()
    samples = image.deepdata()
    for pixel in range(256):
        own = fragments[divmod(pixel, 16)]
        for boundary in {*own.depth.tolist(), *(own.depth - own.thickness).tolist()}:
            samples.split(pixel, boundary)
        samples.sort(pixel)
        samples.merge_overlaps(pixel)
    tidied = oiio.ImageBuf(image.spec())
    tidied.deepdata()
    for pixel in range(256):
        tidied.set_deep_samples(pixel % 16, pixel // 16, 0, samples.samples(pixel))
    for pixel in range(256):
        for number in range(samples.samples(pixel)):
            for channel in range(samples.channels):
                value = samples.deep_value(pixel, channel, number)
                tidied.set_deep_value(pixel % 16, pixel // 16, 0, channel, number, value)
    flat = oiio.ImageBufAlgo.flatten(tidied)
    expected = flat.get_pixels(oiio.FLOAT)[..., :4]
    np.testing.assert_allclose(wf.composite(fragments, **FLATTEN), expected, atol=1e-6)


def test_windows(tmp_path):
    """The grid is the display window, or the data window; samples outside of it are left out and counted."""
    header = {"dataWindow": (np.int32([2, 1]), np.int32([4, 2])), "displayWindow": (np.int32([0, 0]), np.int32([3, 3]))}
    write(tmp_path / "a.exr", [[1, 0, 2], [0, 1, 1]], header=header, Z=np.arange(5, dtype=np.float32))
    with pytest.warns(ReadingWarning, match="a.exr: leaves out 3 samples outside of the display window"):
        whole = wf.read_deep(tmp_path / "a.exr")
    assert whole.shape == (4, 4)
    assert np.diff(whole.offsets).nonzero()[0].tolist() == [6, 11]
    assert whole.depth.tolist() == [0.0, 3.0]
    own = wf.read_deep(tmp_path / "a.exr", window="data")
    assert (own.shape, own.depth.tolist()) == ((2, 3), [0, 1, 2, 3, 4])


def test_parts(tmp_path):
    """Parts are put together, unless one is chosen by its number or name; other views are left out."""
    counts = [[1, 0], [2, 1]]
    write(tmp_path / "a.exr", counts, parts=2)
    with pytest.warns(ReadingWarning, match='puts the parts "part0", "part1" together'):
        assert np.diff(wf.read_deep(tmp_path / "a.exr").offsets).tolist() == [2, 0, 4, 2]
    for part in (0, 1, "part1"):
        assert np.diff(wf.read_deep(tmp_path / "a.exr", part=part).offsets).tolist() == [1, 0, 2, 1]
    write(tmp_path / "b.exr", counts, parts=2, views=["left", "right"])
    with pytest.warns(ReadingWarning, match='b.exr: leaves out the parts "part1"'):
        assert np.diff(wf.read_deep(tmp_path / "b.exr").offsets).tolist() == [1, 0, 2, 1]
    with pytest.raises(ImageError, match=r'got no part "x", expected one of 0 "part0", 1 "part1"'):
        wf.read_deep(tmp_path / "a.exr", part="x")


def test_what_is_put_right_is_told(tmp_path):
    """Opacities beyond 1, backs before fronts, unknown channels and numbers that are no ids, in one warning."""
    write(
        tmp_path / "a.exr",
        [[2]],
        A=np.float32([0.5, 1.25]),
        Z=np.float32([2.0, 3.0]),
        ZBack=np.float32([1.0, 3.5]),
        id=np.float32([1.5, 2.0]),
        material=np.uint32([1, 2]),
    )
    words = "leaves out the channels material; .* 0.5 to 1.25 .*; takes 1 samples with ZBack before Z .*; .* channel id"
    with pytest.warns(ReadingWarning, match=words):
        found = wf.read_deep(tmp_path / "a.exr")
    assert (found.rgba[:, 3].tolist(), found.thickness.tolist()) == ([0.5, 1.0], [0.0, 0.5])
    assert (found.depth.tolist(), found.object_id) == ([2.0, 3.5], None)


def test_unknown_attributes_do_not_matter(tmp_path):
    """An attribute of a type that nobody here knows is passed over."""
    write(tmp_path / "a.exr", [[1, 2]], header={"owner": "somebody"})
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(data.replace(b"owner\0string\0", b"state\0secret\0"))
    assert wf.read_deep(tmp_path / "a.exr").count == 3


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"A": None}, "got the channels B, G, R, Z, expected R, G, B, A and Z"),
        ({"Z": None}, "got the channels A, B, G, R, expected"),
        ({"AR": np.float32([1]), "AG": np.float32([1])}, "got the coloured opacities AR, AG, expected one opacity, A"),
        ({"Z": np.float32([np.inf])}, "got Z inf at column 1, row 0, expected finite values"),
    ],
)
def test_what_cannot_be_fragments_is_refused(tmp_path, channels, message):
    """One line with the file's name says what is missing, or where."""
    write(tmp_path / "a.exr", [[0, 1]], **channels)
    with pytest.raises(ImageError, match=f"a.exr: {message}"):
        wf.read_deep(tmp_path / "a.exr")


def test_files_that_are_not_deep_are_refused(tmp_path):
    """A flat image, another file, a folder, nothing at all."""
    wf.write_image(tmp_path / "flat.exr", np.zeros((2, 2, 4), np.float32))
    (tmp_path / "text.exr").write_text("no image at all")
    (tmp_path / "folder.exr").mkdir()
    for name, words in (
        ("flat.exr", "got a flat image"),
        ("text.exr", "got a file of another kind, expected OpenEXR"),
        ("folder.exr", "got a folder"),
        ("none.exr", "got no such file"),
    ):
        with pytest.raises(ImageError, match=f"{name}: {words}"):
            wf.read_deep(tmp_path / name)
    write(tmp_path / "deep.exr", [[1]])
    with pytest.raises(ImageError, match="got a deep image"):
        wf.read_image(tmp_path / "deep.exr")


def refusal(path):
    """Read a file; return what was said if it was refused, and check the fragments if not."""
    try:
        wf.read_deep(path).validate()
    except ImageError as error:
        return str(error)
    return ""


def test_broken_files_get_one_line(tmp_path):
    """Cut off anywhere, or with any byte changed, a file is read or refused with a line that names it."""
    wf.write_deep(tmp_path / "a.exr", random_fragments(5, (4, 5)))
    whole = (tmp_path / "a.exr").read_bytes()
    random = np.random.default_rng(0)
    for cut in range(0, len(whole), 11):
        (tmp_path / "a.exr").write_bytes(whole[:cut])
        with pytest.raises(ImageError, match=r"a\.exr: got [^\n]*$"):
            wf.read_deep(tmp_path / "a.exr")
    for _ in range(300):
        broken = bytearray(whole)
        broken[random.integers(len(whole))] = random.integers(256)
        (tmp_path / "a.exr").write_bytes(broken)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ReadingWarning)
            told = refusal(tmp_path / "a.exr")
        assert "\n" not in told


def test_sizes_are_judged_before_memory_is_taken(tmp_path):
    """A header that claims a huge image is refused."""
    write(tmp_path / "a.exr", [[1]])
    small, large = (struct.pack("<5i", 16, 0, 0, last, 0) for last in (0, 2**30))
    data = (tmp_path / "a.exr").read_bytes().replace(small, large)
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(ImageError, match="pixels, expected from 1 to"):
        wf.read_deep(tmp_path / "a.exr")


def test_what_cannot_be_written_is_refused(tmp_path):
    """Names, grids and values."""
    fragments = random_fragments(6, (2, 2))
    with pytest.raises(ImageError, match=r"a.png: got the suffix .png, expected .exr"):
        wf.write_deep(tmp_path / "a.png", fragments)
    with pytest.raises(ImageError, match="got a grid of 4 pixels"):
        wf.write_deep(tmp_path / "a.exr", replace(fragments, shape=(4,)))
    with pytest.raises(ValueError, match="depth: got nan"):
        wf.write_deep(tmp_path / "a.exr", replace(fragments, depth=fragments.depth * np.float32(np.nan)))
    with pytest.raises(ImageError, match="got ids from 0 to 4294967296, expected 32 bits"):
        wf.write_deep(tmp_path / "a.exr", replace(fragments, object_id=np.full(fragments.count, 2**32)))
    with pytest.raises(TypeError, match="source: got 3"):
        wf.write_deep(tmp_path / "a.exr", 3)
    assert not list(tmp_path.iterdir())
