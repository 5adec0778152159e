"""Images to files and back."""

import struct
import subprocess
import sys
import zlib

import numpy as np
import png
import pytest
from PIL import Image, ImageCms

from warpfrag.colors import encode, linear_to_srgb
from warpfrag.files import images
from warpfrag.files.images import ImageError, read_image, write_image


@pytest.fixture
def image() -> np.ndarray:
    """An image of random straight colours and opacities, premultiplied; a corner is empty."""
    generator = np.random.default_rng(1)
    rgba = generator.uniform(0.0, 1.0, (7, 5, 4)).astype(np.float32)
    rgba[..., :3] *= rgba[..., 3:]
    rgba[:2, :2] = 0.0
    return rgba


@pytest.mark.parametrize("name", ["a.exr", "a.npy"])
@pytest.mark.parametrize("channels", [3, 4])
def test_float_files_are_exact(tmp_path, image, name, channels):
    """OpenEXR and .npy give back every bit, in the right place."""
    write_image(tmp_path / name, 3.0 * image[..., :channels])
    np.testing.assert_array_equal(read_image(tmp_path / name), 3.0 * image[..., :channels])


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("channels", [3, 4])
def test_png_rounds_once(tmp_path, image, bits, channels):
    """What a PNG file gives back is stored as the same numbers again, and lies within half a step."""
    image = image[..., :channels]
    write_image(tmp_path / "a.png", image, bits=bits)
    again = read_image(tmp_path / "a.png")
    assert again.shape == image.shape
    np.testing.assert_array_equal(encode(again, bits), encode(image, bits))
    # The steepest slope of the sRGB curve is about 2.3 in this direction.
    assert np.abs(again - image).max() < 2.5 / 2**bits


@pytest.mark.parametrize("channels", [3, 4])
def test_png_in_bands_is_the_png_in_one_piece(tmp_path, image, monkeypatch, channels):
    """However many rows are encoded at once, the file has the bytes that it has of all of them."""
    image = image[..., :channels]
    monkeypatch.setattr(images, "_BAND_PIXELS", 10)
    for bits in (8, 16):
        write_image(tmp_path / "bands.png", image, bits=bits)
        stored = encode(image, bits)
        if bits == 8:
            Image.fromarray(stored).save(tmp_path / "whole.png")
        else:
            writer = png.Writer(5, 7, bitdepth=16, greyscale=False, alpha=channels == 4)
            with (tmp_path / "whole.png").open("wb") as file:
                writer.write(file, stored.reshape(7, -1))
        assert (tmp_path / "bands.png").read_bytes() == (tmp_path / "whole.png").read_bytes()


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("channels", [3, 4])
def test_png_takes_little_memory(tmp_path, bits, channels):
    """Beside the image itself writing takes half of its size at most."""
    pytest.importorskip("resource", reason="this system does not tell how much memory a process took")
    code = f"""
import resource
import numpy as np
from warpfrag.files.images import write_image

def most():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

write_image("small.png", np.ones((2, 2, {channels})), bits={bits})
before = most()
image = np.ones((4096, 2048, {channels}), np.float32)
write_image("large.png", image, bits={bits})
print((most() - before) * (1024 if sys.platform == "linux" else 1) / image.nbytes)
"""
    run = subprocess.run(
        [sys.executable, "-c", "import sys" + code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert float(run.stdout) <= 1.5


def test_png_is_straight_srgb(tmp_path):
    """A half-transparent mid grey is stored as sRGB of its straight colour, with linear opacity."""
    write_image(tmp_path / "a.png", np.full((1, 1, 4), 0.5, np.float32) * [0.2158605, 0.2158605, 0.2158605, 1.0])
    assert np.asarray(Image.open(tmp_path / "a.png")).tolist() == [[[128, 128, 128, 128]]]


def test_srgb_curve():
    """The curve passes through its known points."""
    np.testing.assert_allclose(
        linear_to_srgb(np.array([0.0, 0.0031308, 0.2140411, 1.0])), [0, 0.04045, 0.5, 1], atol=1e-5
    )


def test_16_bit_keeps_16_bits(tmp_path):
    """Neighbouring 16-bit values stay apart, in colour, grey, and grey with opacity."""
    row = [40000, 40001, 40002]
    for planes, options in ((1, {}), (2, {"alpha": True}), (3, {}), (4, {"alpha": True})):
        with (tmp_path / "a.png").open("wb") as file:
            values = np.repeat(row, planes).reshape(3, planes)
            values[:, -1:] = 65535 if planes in (2, 4) else values[:, -1:]
            png.Writer(3, 1, bitdepth=16, greyscale=planes < 3, **options).write(file, [values.reshape(-1).tolist()])
        found = read_image(tmp_path / "a.png")
        assert found.shape == (1, 3, 4 if planes in (2, 4) else 3)
        assert encode(found, 16)[0, :, 0].tolist() == row
        assert (found[..., 0] == found[..., 2]).all()


@pytest.mark.parametrize(("mode", "channels"), [("1", 3), ("L", 3), ("LA", 4), ("P", 3), ("RGB", 3), ("RGBA", 4)])
def test_kinds_of_8_bit_png(tmp_path, mode, channels):
    """White stays white in every kind of PNG file."""
    Image.new("RGBA" if channels == 4 else "RGB", (2, 3), "white").convert(mode).save(tmp_path / "a.png")
    found = read_image(tmp_path / "a.png")
    assert found.shape == (3, 2, channels)
    assert (found == 1.0).all()


def test_palette_with_transparency(tmp_path):
    """A transparent palette entry becomes opacity 0."""
    picture = Image.new("P", (2, 1))
    picture.putpalette([255, 0, 0, 0, 255, 0])
    picture.putpixel((1, 0), 1)
    picture.save(tmp_path / "a.png", transparency=1)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), [[[1, 0, 0, 1], [0, 0, 0, 0]]])


@pytest.mark.parametrize("name", ["a.png", "b.png", "a.exr", "a.npy"])
def test_corrupt_files_are_refused(tmp_path, image, name):
    """A file cut in half, or with noise in it, is refused with a line that names it."""
    path = tmp_path / name
    write_image(path, np.tile(image, (8, 8, 1)), bits=16 if name == "b.png" else 8)
    whole = path.read_bytes()
    broken = [whole[: len(whole) // 2], whole[:10], b"", b"nonsense" * 20]
    for data in broken:
        path.write_bytes(data)
        with pytest.raises(ImageError, match=name) as caught:
            read_image(path)
        assert "\n" not in str(caught.value)


def test_wrong_size_name_and_values(tmp_path, image):
    """Other sizes, missing files, unknown suffixes, bits, shapes and NaN are refused."""
    write_image(tmp_path / "a.png", image)
    with pytest.raises(ImageError, match="got 5 × 7 pixels, expected 7 × 5"):
        read_image(tmp_path / "a.png", size=(7, 5))
    with pytest.raises(ImageError, match="no such file"):
        read_image(tmp_path / "b.png")
    with pytest.raises(ImageError, match=r"\.jpg"):
        write_image(tmp_path / "b.jpg", image)
    with pytest.raises(ImageError, match="got 12"):
        write_image(tmp_path / "b.png", image, bits=12)
    with pytest.raises(ImageError, match="shape"):
        write_image(tmp_path / "b.png", image[..., :2])
    with pytest.raises(ImageError, match="no folder"):
        write_image(tmp_path / "nowhere" / "b.png", image)
    image[3, 2, 1] = np.nan
    with pytest.raises(ImageError, match="not finite"):
        write_image(tmp_path / "b.png", image)
    np.save(tmp_path / "n.npy", image)
    with pytest.raises(ImageError, match="column 2, row 3"):
        read_image(tmp_path / "n.npy")


def test_nothing_half_written_stays(tmp_path, image, monkeypatch):
    """A failure while writing leaves the old file as it was and no other."""
    write_image(tmp_path / "a.png", image)
    before = (tmp_path / "a.png").read_bytes()

    def fail(self, path, **options):
        path.write_bytes(before[:20])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(ImageError, match="No space left"):
        write_image(tmp_path / "a.png", 0.5 * image)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == before


def png_with(*chunks, value=128, bits=8):
    """Return a PNG of one grey RGB pixel with these chunks before it."""

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 1, 1, bits, 2, 0, 0, 0))
    pixel = struct.pack(">B3B" if bits == 8 else ">B3H", 0, value, value, value)
    body = b"".join(chunk(*each) for each in chunks) + chunk(b"IDAT", zlib.compress(pixel)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + header + body


def gama(value):
    """Return a gAMA chunk."""
    return b"gAMA", struct.pack(">I", value)


@pytest.mark.parametrize(
    ("chunks", "expected"),
    [
        ((), 0.2158605),
        ((gama(100000),), 128 / 255),
        ((gama(45455),), (128 / 255) ** 2.2),
        ((gama(100000), (b"sRGB", b"\0")), 0.2158605),
        ((gama(0),), 0.2158605),
        (((b"cICP", bytes([1, 8, 0, 1])), gama(45455)), 128 / 255),
        (((b"cICP", bytes([1, 13, 0, 1])), gama(100000)), 0.2158605),
        (((b"cICP", bytes([1, 4, 0, 1])),), (128 / 255) ** 2.2),
    ],
)
@pytest.mark.parametrize("bits", [8, 16])
def test_chunks_say_what_the_numbers_mean(tmp_path, chunks, expected, bits):
    """CICP comes before sRGB, sRGB before gAMA; without any of them it is sRGB."""
    (tmp_path / "a.png").write_bytes(png_with(*chunks, value=128 if bits == 8 else 128 * 257, bits=bits))
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), [[[expected] * 3]], rtol=2e-5)


def test_colour_spaces_that_are_not_read_are_refused(tmp_path):
    """High dynamic range and wide gamuts are named, not taken for sRGB."""
    for content, words in ((bytes([1, 16, 0, 1]), r"transfer function 16 \(PQ\)"), (bytes([9, 13, 0, 1]), "9/0/1")):
        (tmp_path / "a.png").write_bytes(png_with((b"cICP", content)))
        with pytest.raises(ImageError, match=rf"a.png: got the .*{words}"):
            read_image(tmp_path / "a.png")


def test_colour_profiles_are_applied(tmp_path):
    """An sRGB profile changes nothing."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for name in ("a.png", "a.jpg"):
        Image.new("RGB", (4, 4), (128, 128, 128)).save(tmp_path / name, icc_profile=profile)
        np.testing.assert_allclose(read_image(tmp_path / name)[0, 0], [0.2158605] * 3, atol=3e-3)


def test_jpeg_references(tmp_path):
    """A JPEG is read upright, as sRGB; it cannot be written."""
    picture = Image.new("RGB", (16, 8), (255, 0, 0))
    picture.paste((0, 0, 255), (0, 0, 8, 8))
    exif = Image.Exif()
    exif[0x0112] = 6
    picture.save(tmp_path / "a.jpg", quality=95, subsampling=0, exif=exif)
    found = read_image(tmp_path / "a.jpg", size=(8, 16))
    np.testing.assert_allclose(found[2, 4], [0, 0, 1], atol=0.02)
    np.testing.assert_allclose(found[13, 4], [1, 0, 0], atol=0.02)
    with pytest.raises(ImageError, match=r"expected one of .png, .exr, .npy$"):
        write_image(tmp_path / "b.jpg", found)


def test_parts_of_openexr_files(tmp_path):
    """Of several parts the one with colours is read; without any, all are named."""
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
    values = np.full((2, 3), 0.25, np.float32)

    def part(name, channels):
        return openexr.Part({"type": openexr.scanlineimage, "name": name}, channels, name)

    with openexr.File([part("depth", {"Z": values}), part("rgb", dict.fromkeys("RGB", values))]) as file:
        file.write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), np.full((2, 3, 3), 0.25))
    with openexr.File([part("depth", {"Z": values}), part("id", {"I": values})]) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(ImageError, match=r'a.exr: got the parts "depth" with Z; "id" with I, expected R, G, B'):
        read_image(tmp_path / "a.exr")


def test_deep_openexr_files_are_named(tmp_path):
    """A deep image is refused as such."""
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
    samples = np.empty((1, 2), dtype=object)
    samples[0, 0], samples[0, 1] = np.ones(2, np.float32), np.ones(1, np.float32)
    header = {"compression": openexr.ZIPS_COMPRESSION, "type": openexr.deepscanline}
    with openexr.File(header, {name: samples.copy() for name in "RGBAZ"}) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(
        ImageError, match=r"a.exr: got a deep image, whose pixels have several samples, expected a flat"
    ):
        read_image(tmp_path / "a.exr")
