"""Images to files and back."""

import numpy as np
import png
import pytest
from PIL import Image

from warpfrag.colors import encode, linear_to_srgb
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
