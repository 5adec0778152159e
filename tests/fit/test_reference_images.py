"""Reference images of every kind: what a fit compares with, or the one line that refuses the file.

Every image is 3 × 2 pixels. A file is named in a study file, which is loaded and made ready to be fitted.
"""

import struct
import zlib

import numpy as np
import png
import pytest
from PIL import Image

from warpfrag.colors import srgb_to_linear
from warpfrag.files.images import ImageError, write_image
from warpfrag.fit import Reference, Study, StudyError, load_study
from warpfrag.fit.problem import Problem

STUDY = """
scene = "scene.toml"
size = [3, 2]
[reference]
image = "{image}"
[parameters]
beta = 0.9
"""

SCENE = """
background = {background}
[camera]
eye = [0, 0, 3]
target = [0, 0, 0]
fov = 40
[[object]]
name = "ball"
primitive = "sphere"
segments = 6
thickness = 0.2
"""

OPAQUE, CLEAR = "[0.8, 0.6, 0.4]", "[0, 0, 0, 0]"
# Straight sRGB colours and opacity of 8 bit, three pixels in each of two rows; all are different.
RGB = np.array([[[255, 0, 0], [0, 128, 0], [12, 34, 56]], [[0, 0, 0], [255, 255, 255], [200, 100, 50]]], np.uint8)
OPACITY = np.array([[255, 128, 64], [0, 1, 254]], np.uint8)
RGBA = np.dstack([RGB, OPACITY])
GREY = np.array([[0, 51, 102], [153, 204, 255]], np.uint8)
# To half a unit of float32 in numbers up to 1, after a product and a sum.
TOLERANCE = 2e-7


@pytest.fixture
def folder(tmp_path):
    """A folder for the files of a study."""
    return tmp_path


def prepare(folder, image: str, background: str = OPAQUE) -> Problem:
    """Load a study that names a reference image, and make it ready to be fitted."""
    (folder / "scene.toml").write_text(SCENE.format(background=background))
    (folder / "study.toml").write_text(STUDY.format(image=image))
    return Problem(load_study(folder / "study.toml"))


def compared(folder, image: str, background: str = OPAQUE) -> np.ndarray:
    """Return what a fit compares with."""
    reference = prepare(folder, image, background).views[0].reference
    assert reference.dtype == np.float32
    return reference


def refused(folder, image: str, background: str = OPAQUE) -> str:
    """Return the line that refuses a reference image, without the file's path."""
    with pytest.raises((ImageError, StudyError)) as caught:
        prepare(folder, image, background)
    # What only shows beside the camera is told of the study, which is named first.
    message, path = str(caught.value).removeprefix(f"{folder / 'study.toml'}: "), str(folder / image)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def save(folder, stored: np.ndarray, mode: str | None = None, **options) -> str:
    """Write a PNG of 8 bit or less with Pillow; return its name."""
    image = Image.fromarray(stored)
    (image if mode is None else image.convert(mode)).save(folder / "a.png", **options)
    return "a.png"


def save16(folder, stored: np.ndarray) -> str:
    """Write a PNG of 16 bit: grey, grey and opacity, RGB or RGBA by the last axis."""
    height, width, planes = stored.shape
    writer = png.Writer(width, height, bitdepth=16, greyscale=planes < 3, alpha=planes in (2, 4))
    with (folder / "a.png").open("wb") as file:
        writer.write(file, stored.reshape(height, -1).tolist())
    return "a.png"


def save_chunks(folder, depth: int, color_type: int, rows: list[bytes], **chunks: bytes) -> str:
    """Write a PNG chunk by chunk, with some that no library writes; return its name."""
    header = struct.pack(">IIBBBBB", 3, 2, depth, color_type, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\0" + row for row in rows))
    parts = [(b"IHDR", header), *((name.encode(), data) for name, data in chunks.items())]
    data = b"\x89PNG\r\n\x1a\n"
    for name, content in [*parts, (b"IDAT", pixels), (b"IEND", b"")]:
        data += struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
    (folder / "a.png").write_bytes(data)
    return "a.png"


def linear(stored: np.ndarray, bits: int = 8) -> np.ndarray:
    """Return linear values of stored ones, grey ones three times."""
    values = srgb_to_linear(stored / (2**bits - 1))
    return values if values.ndim == 3 else np.dstack([values] * 3)


def over(color: np.ndarray, opacity: np.ndarray, background: str) -> np.ndarray:
    """Return straight linear colours over a scene's background, premultiplied with opacity; it is straight, too."""
    behind = np.array([float(part) for part in background.strip("[]").split(",")])
    behind = np.append(behind[:3] * behind[3:], behind[3:]) if behind.size == 4 else np.append(behind, 1.0)
    opacity = opacity[..., None]
    return np.dstack([color * opacity, opacity]) + (1.0 - opacity) * behind


@pytest.mark.parametrize("background", [OPAQUE, CLEAR])
def test_without_opacity_colors_are_compared(folder, background):
    """An image without opacity is compared as it is, whatever the background; opacity is not compared."""
    found = compared(folder, save(folder, RGB), background)
    np.testing.assert_allclose(found, linear(RGB), rtol=0, atol=TOLERANCE)
    problem = prepare(folder, "a.png", background).views[0]
    assert problem.residual(np.ones((2, 3, 4), np.float32)).shape == (2, 3, 3)


@pytest.mark.parametrize("background", [OPAQUE, CLEAR, "[0.2, 0.1, 0.1, 0.5]"])
def test_straight_opacity_is_laid_over_the_background(folder, background):
    """A PNG holds straight colours: premultiplied, and over the background that the scene has, if any."""
    found = compared(folder, save(folder, RGBA), background)
    expected = over(linear(RGB), OPACITY / 255.0, background)
    np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE)
    if background == OPAQUE:
        np.testing.assert_allclose(found[..., 3], 1.0, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", ["a.exr", "a.npy"])
def test_premultiplied_opacity_is_laid_over_the_background(folder, name):
    """OpenEXR and NumPy files hold premultiplied colours, also brighter than 1."""
    premultiplied = 3.0 * over(linear(RGB), OPACITY / 255.0, CLEAR).astype(np.float32)
    premultiplied[..., 3] /= 3.0
    write_image(folder / name, premultiplied)
    expected = premultiplied + (1.0 - premultiplied[..., 3:]) * [0.8, 0.6, 0.4, 1.0]
    # Up to 3, hence three times as much.
    np.testing.assert_allclose(compared(folder, name), expected, rtol=0, atol=3 * TOLERANCE)


@pytest.mark.parametrize(
    ("mode", "stored", "expected"),
    [
        ("L", GREY, linear(GREY)),
        ("P", RGB, linear(RGB)),
        ("1", np.where(GREY > 100, 255, 0).astype(np.uint8), linear(np.where(GREY > 100, 255, 0))),
    ],
)
def test_kinds_of_8_bit_and_less(folder, mode, stored, expected):
    """Grey, palette and black-and-white images are colours without opacity."""
    image = Image.fromarray(stored)
    # Its own colours, not those of a fixed palette.
    image = image.quantize(256, dither=Image.Dither.NONE) if mode == "P" else image.convert(mode)
    image.save(folder / "a.png")
    with Image.open(folder / "a.png") as file:
        assert file.mode == mode
    np.testing.assert_allclose(compared(folder, "a.png"), expected, rtol=0, atol=TOLERANCE)


def test_grey_with_opacity(folder):
    """Grey with opacity is laid over the background as colours are."""
    found = compared(folder, save(folder, np.dstack([GREY, OPACITY])))
    np.testing.assert_allclose(found, over(linear(GREY), OPACITY / 255.0, OPAQUE), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("planes", [1, 2, 3, 4])
def test_16_bit(folder, planes):
    """All 16 bits count: of grey, grey with opacity, RGB and RGBA."""
    color = 250 * RGB[..., : 3 if planes > 2 else 1].astype(np.uint16) + 77
    opacity = 250 * OPACITY[..., None].astype(np.uint16)
    found = compared(folder, save16(folder, color if planes % 2 else np.dstack([color, opacity])))
    expected = linear(color if planes > 2 else color[..., 0], 16)
    if planes % 2 == 0:
        expected = over(expected, opacity[..., 0] / 65535.0, OPAQUE)
    np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE)


def test_16_bit_of_which_12_are_significant(folder):
    """Values fill the 16 bits though the file says that 12 of them came from the camera."""
    row = struct.pack(">9H", *range(0, 63000, 7000))
    found = compared(folder, save_chunks(folder, 16, 2, [row, row], sBIT=bytes([12, 12, 12])))
    expected = linear(np.arange(0, 63000, 7000).reshape(3, 3)[None], 16)
    np.testing.assert_allclose(found, np.repeat(expected, 2, axis=0), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(
    ("depth", "rows"),
    [(1, [b"\x40", b"\x40"]), (2, [b"\x34", b"\x34"]), (4, [b"\x0f\x50", b"\x0f\x50"]), (8, [b"\x00\xff\x05"] * 2)],
)
def test_transparent_grey(folder, depth, rows):
    """One grey value of a PNG may stand for transparent, in any depth: black here."""
    found = compared(folder, save_chunks(folder, depth, 0, rows, tRNS=b"\0\0"), CLEAR)
    np.testing.assert_array_equal(found[:, :2], [[[0, 0, 0, 0], [1, 1, 1, 1]]] * 2)


def test_transparent_grey_that_is_not_black(folder):
    """The transparent value is one of those stored, from 0 to 15 in a file of 4 bit."""
    found = compared(folder, save_chunks(folder, 4, 0, [b"\x0f\x50"] * 2, tRNS=b"\0\5"), CLEAR)
    np.testing.assert_array_equal(found, [[[0, 0, 0, 1], [1, 1, 1, 1], [0, 0, 0, 0]]] * 2)


def test_animation_counts_as_its_still_image(folder):
    """Of an animated PNG the image counts that viewers without animation show."""
    frames = [Image.fromarray(RGB), Image.fromarray(255 - RGB)]
    frames[0].save(folder / "a.png", save_all=True, append_images=frames[1:])
    assert b"acTL" in (folder / "a.png").read_bytes()
    np.testing.assert_allclose(compared(folder, "a.png"), linear(RGB), rtol=0, atol=TOLERANCE)


def test_large_suffix_and_subfolder(folder):
    """The name is relative to the study file, and its suffix may be in capitals."""
    (folder / "photos").mkdir()
    (folder / save(folder, RGB)).rename(folder / "photos" / "A.PNG")
    np.testing.assert_allclose(compared(folder, "photos/A.PNG"), linear(RGB), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", ["a.png", "a.exr", "a.npy"])
def test_wrong_size_is_refused(folder, name):
    """Width and height of the camera are told, also when only swapped."""
    for shape, found in (((3, 2, 4), "2 × 3"), ((4, 6, 3), "6 × 4")):
        write_image(folder / name, np.zeros(shape))
        assert refused(folder, name) == f"got {found} pixels, expected 3 × 2 like the study's camera"


def test_files_that_are_no_images(folder):
    """Missing, empty, a folder, another kind of file, or one that only bears the name."""
    assert refused(folder, "none.png") == "got no such file, expected an image"
    (folder / "folder.png").mkdir()
    assert refused(folder, "folder.png") == "got a folder, expected an image"
    (folder / "empty.png").write_bytes(b"")
    assert refused(folder, "empty.png").startswith("got an image that cannot be read")
    assert refused(folder, "photo").startswith("got no suffix, expected one of ")
    for name in ("empty.exr", "empty.npy"):
        (folder / name).write_bytes(b"")
        assert refused(folder, name).startswith("got an image that cannot be read")


def test_a_photo_is_read_by_what_it_is(folder):
    """A JPEG has colours without opacity, under the name of a PNG as well."""
    for name in ("photo.jpg", "photo.png"):
        Image.fromarray(np.full((2, 3, 3), 128, np.uint8)).save(folder / name, "JPEG")
        np.testing.assert_allclose(compared(folder, name), linear(np.full((2, 3, 3), 128)), atol=0.02)


@pytest.mark.parametrize("kind", ["8 bit", "16 bit"])
def test_truncated_png_is_refused(folder, kind):
    """Wherever the file ends too early, up to the last chunk's checksum."""
    save(folder, RGBA) if kind == "8 bit" else save16(folder, 257 * RGBA.astype(np.uint16))
    whole = (folder / "a.png").read_bytes()
    for length in range(0, len(whole) - 4, 3):
        (folder / "a.png").write_bytes(whole[:length])
        assert "got" in refused(folder, "a.png")


@pytest.mark.parametrize("kind", ["8 bit", "16 bit"])
def test_damaged_png_is_refused(folder, kind):
    """A byte that changed before the end mark is noticed, also where pixels could still be decoded."""
    save(folder, RGBA) if kind == "8 bit" else save16(folder, 257 * RGBA.astype(np.uint16))
    whole = (folder / "a.png").read_bytes()
    for place in range(0, len(whole) - 12):
        damaged = bytearray(whole)
        damaged[place] ^= 0x55
        (folder / "a.png").write_bytes(damaged)
        assert "got" in refused(folder, "a.png")


@pytest.mark.parametrize("name", ["a.exr", "a.npy"])
def test_truncated_float_files_are_refused(folder, name):
    """Cut in half, and short of the last few bytes."""
    write_image(folder / name, np.random.default_rng(0).uniform(size=(2, 3, 4)))
    whole = (folder / name).read_bytes()
    for length in (len(whole) // 2, len(whole) - 8):
        (folder / name).write_bytes(whole[:length])
        assert refused(folder, name).startswith("got an image that cannot be read")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(folder, value):
    """The first pixel is told, in NumPy and OpenEXR files."""
    import OpenEXR

    image = np.full((2, 3, 3), 0.5, np.float32)
    image[1, 2, 0] = value
    np.save(folder / "a.npy", image)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": image}) as file:
        file.write(str(folder / "a.exr"))
    for name in ("a.npy", "a.exr"):
        assert refused(folder, name) == "got a value that is not finite at column 2, row 1, expected finite ones"


def test_values_too_large_for_float32_are_refused(folder):
    """Without a warning, which would be a second line."""
    np.save(folder / "a.npy", np.full((2, 3, 3), 1e300))
    assert refused(folder, "a.npy").startswith("got a value that is not finite at column 0, row 0")


@pytest.mark.parametrize(
    ("array", "found"),
    [
        (RGB, "uint8 of shape (2, 3, 3)"),
        (RGB.astype(np.int64), "int64 of shape (2, 3, 3)"),
        (np.zeros((2, 3)), "float64 of shape (2, 3)"),
        (np.zeros((2, 3, 1)), "float64 of shape (2, 3, 1)"),
        (np.zeros((2, 3, 3), bool), "bool of shape (2, 3, 3)"),
        (np.zeros((0, 3, 3)), "float64 of shape (0, 3, 3)"),
    ],
)
def test_numpy_files_of_other_kinds_are_refused(folder, array, found):
    """Whole numbers may mean 0 to 255 or 0 to 1, so they are not guessed at; nor are grey images."""
    np.save(folder / "a.npy", array)
    expected = "floating-point numbers of shape (H, W, 3) or (H, W, 4)"
    assert refused(folder, "a.npy") == f"got {found}, expected {expected}"


def test_half_and_double_precision(folder):
    """Floating-point numbers of 16 and 64 bit are taken."""
    for dtype in (np.float16, np.float64):
        np.save(folder / "a.npy", np.full((2, 3, 3), 0.25, dtype))
        assert (compared(folder, "a.npy") == 0.25).all()


def test_openexr_channels(folder):
    """Grey with and without opacity, and colours beside depth, are taken; chroma, layers and crops are refused."""
    import OpenEXR

    plane = np.full((2, 3), 0.5, np.float32)

    def write(header=None, **channels) -> str:
        with OpenEXR.File({"type": OpenEXR.scanlineimage, **(header or {})}, channels) as file:
            file.write(str(folder / "a.exr"))
        return "a.exr"

    assert compared(folder, write(Y=plane)).shape == (2, 3, 3)
    assert compared(folder, write(Y=plane, A=plane)).shape == (2, 3, 4)
    assert compared(folder, write(R=plane, G=plane, B=plane, Z=7.0 * plane)).shape == (2, 3, 3)
    assert refused(folder, write(Y=plane, RY=plane, BY=plane)).startswith("got the channels BY, RY, Y, expected")
    layer = {f"beauty.{name}": plane for name in "RGB"}
    assert "got the channels beauty.B, beauty.G, beauty.R" in refused(folder, write(**layer))
    window = {"displayWindow": (np.int32([0, 0]), np.int32([2, 1])), "dataWindow": (np.int32([1, 0]), np.int32([3, 1]))}
    message = refused(folder, write(window, R=plane, G=plane, B=plane))
    assert message.startswith("got pixels of the window [[1, 0], [3, 1]]")


@pytest.mark.parametrize("image", ["3", "[1, 2]", "true"])
def test_name_must_be_text(folder, image):
    """The study file and the key are told."""
    (folder / "scene.toml").write_text(SCENE.format(background=OPAQUE))
    (folder / "study.toml").write_text(STUDY.format(image="").replace('image = ""', f"image = {image}"))
    with pytest.raises(StudyError, match=r"study\.toml: reference\.image: got"):
        load_study(folder / "study.toml")


@pytest.mark.parametrize("shape", [(2, 3), (2, 3, 1), (2, 3, 5), (3, 2, 3)])
def test_arrays_of_other_shapes_are_refused(folder, shape):
    """A reference that is given as an array has to fit the camera, too."""
    study = prepare(folder, save(folder, RGB)).study
    with pytest.raises(StudyError, match=r"^reference.image: got [^\n]+$"):
        Study(study.scene, Reference(image=np.zeros(shape)), {"beta": 0.5})


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((2, 3, 3), np.uint8), "got uint8 of shape"),
        (np.full((2, 3, 3), np.nan), "got a value that is not finite at column 0, row 0"),
        ("a.png", "expected linear floating-point numbers"),
        ([[1.0], [2.0, 3.0]], "expected linear floating-point numbers"),
    ],
)
def test_arrays_of_other_kinds_are_refused(folder, image, words):
    """Whole numbers are no linear light; values have to be finite; a name is not an image."""
    scene = prepare(folder, save(folder, RGB)).study.scene
    with pytest.raises(StudyError, match=words):
        Study(scene, Reference(image=image), {"beta": 0.5})
