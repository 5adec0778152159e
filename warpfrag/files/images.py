"""Images to and from files: PNG (8 and 16 bit), OpenEXR (float32), NumPy's own format and, to be read, JPEG.

In memory an image is linear light, premultiplied, float32, row 0 at the top. A PNG holds straight colours in sRGB and
linear opacity, so what emits without opacity is lost there; OpenEXR and `.npy` keep everything as it is in memory.
"""

import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.colors import encode
from warpfrag.files.exr import openexr, read_exr, write_exr
from warpfrag.files.pixels import check_pixels, decode_image, with_opacity
from warpfrag.files.saving import replacing
from warpfrag.files.source import ReadingWarning, check_regular, read_regular, wording_of_path, wording_unless_regular

SUFFIXES = (".png", ".exr", ".npy")
# Of images that are only read.
READ_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".npy")
# Encoded at once: colours are straightened and curved in float64, in several copies.
_BAND_PIXELS = 2**16


class ImageError(ValueError):
    """An image file that cannot be read or written; the message is one line that names it."""


def read_image(path: str | os.PathLike, *, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read an image.

    Args:
        path: a `.png` file of any kind (grey, palette, with or without opacity, 1 to 16 bit), a `.jpg`, `.exr` or
            `.npy` file.
        size: the width and height it must have; None takes any.

    Returns:
        Linear premultiplied colour and opacity, (H, W, 4) float32; (H, W, 3) if the file has no opacity.

    Raises:
        ImageError: the file is missing, corrupt, of another kind or size, or has values that are not finite.
        ImportError: an `.exr` file, and OpenEXR is not installed.

    Example:
        >>> read_image("after.png", size=(512, 512)).shape
        (512, 512, 4)
    """
    path, name = Path(path), wording_of_path(path)
    readers: dict[str, Callable[[Path], np.ndarray]] = {".exr": read_exr, ".npy": _read_npy}
    suffix = _suffix(path, READ_SUFFIXES)
    got = wording_unless_regular(path)
    if got is not None:
        raise ImageError(f"{name}: got {got}, expected an image")
    image = _read(path, readers.get(suffix, _read_encoded))
    if size is not None and image.shape[:2] != (size[1], size[0]):
        raise ImageError(f"{name}: got {image.shape[1]} × {image.shape[0]} pixels, expected {size[0]} × {size[1]}")
    # What is too large for float32 becomes infinite, and is told below.
    with np.errstate(over="ignore"):
        image = np.ascontiguousarray(image, dtype=np.float32)
    if not np.isfinite(image).all():
        row, column = np.argwhere(~np.isfinite(image).all(axis=-1))[0]
        raise ImageError(f"{name}: got a value that is not finite at column {column}, row {row}, expected finite ones")
    return image


def read_texture(path: Path) -> np.ndarray:
    """Read an image for a surface: any kind that Pillow reads by itself.

    Returns:
        Straight linear RGBA, (h, w, 4) float32, row 0 at the top.

    Raises:
        ImageError: the file is missing or cannot be read.
    """
    try:
        check_regular(path, "an image file")
    except ValueError as error:
        raise ImageError(str(error)) from None
    return with_opacity(_read(path, lambda file: decode_image(read_regular(file, "an image file"))))


def write_image(path: str | os.PathLike, image: Any, *, bits: int = 8) -> None:
    """Write an image; the file is there whole or not at all.

    Args:
        path: a name that ends in `.png`, `.exr` or `.npy`, in a folder that exists.
        image: linear premultiplied colour and opacity, (H, W, 4), or colour alone, (H, W, 3).
        bits: bits per channel of a PNG file, 8 or 16.

    Raises:
        ImageError: the name, the bits or the shape is not one of those, or the file cannot be written.
        ImportError: an `.exr` file, and OpenEXR is not installed.
    """
    path, name = Path(path), wording_of_path(path)
    check_target(path, bits=bits)
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.size == 0:
        raise ImageError(f"{name}: got an image of shape {pixels.shape}, expected (H, W, 3) or (H, W, 4)")
    if not all(np.isfinite(band).all() for band in _bands(pixels)):
        raise ImageError(f"{name}: got values that are not finite, expected finite ones")
    try:
        with replacing(path) as partial:
            if path.suffix.lower() == ".png":
                _write_png(partial, pixels, bits)
            elif path.suffix.lower() == ".exr":
                write_exr(partial, np.asarray(pixels, dtype=np.float32))
            else:
                np.save(partial, np.asarray(pixels, dtype=np.float32))
    except OSError as error:
        raise ImageError(f"{name}: cannot be written ({error.strerror or error})") from error


def check_target(path: str | os.PathLike, *, bits: int = 8) -> None:
    """Raise what `write_image` would about the name, before time is spent on an image.

    Raises:
        ImageError: the suffix, the bits or the folder is not usable, or no regular file is in the file's place.
    """
    path, name = Path(path), wording_of_path(path)
    suffix = _suffix(path, SUFFIXES)
    if bits not in (8, 16):
        raise ImageError(f"bits: got {bits}, expected 8 or 16")
    if not path.parent.is_dir():
        raise ImageError(f"{name}: got no folder {wording_of_path(path.parent)}, expected one that exists")
    got = wording_unless_regular(path)
    if got not in (None, "no such file"):
        raise ImageError(f"{name}: got {got}, expected a file to write or replace")
    if not os.access(path.parent, os.W_OK):
        raise ImageError(f"{name}: cannot be written")
    if suffix == ".exr":
        openexr()


def _read(path: Path, reader: Callable[[Path], np.ndarray]) -> np.ndarray:
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", ReadingWarning)
            image = reader(path)
    except ImportError:
        raise
    # Decoders raise whatever they like on broken files (SyntaxError, struct.error, zlib.error, …).
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        name = wording_of_path(path)
        if reason.startswith("got "):
            raise ImageError(f"{name}: {reason}") from error
        raise ImageError(f"{name}: got an image that cannot be read ({reason[:160]})") from error
    for warning in told:
        if issubclass(warning.category, ReadingWarning):
            warnings.warn(f"{wording_of_path(path)}: {warning.message}", ReadingWarning, stacklevel=3)
    return image


def _suffix(path: Path, known: tuple[str, ...]) -> str:
    suffix = path.suffix.lower()
    if suffix not in known:
        got = f"the suffix {suffix}" if suffix else "no suffix"
        raise ImageError(f"{wording_of_path(path)}: got {got}, expected one of {', '.join(known)}")
    return suffix


def _read_encoded(path: Path) -> np.ndarray:
    image = decode_image(read_regular(path, "an image"))
    if image.shape[2] == 4:
        image[..., :3] *= image[..., 3:]
    return image


def _bands(pixels: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the rows of an image, some at a time and as float32: what is computed from them stays small."""
    rows = max(1, _BAND_PIXELS // pixels.shape[1])
    for first in range(0, len(pixels), rows):
        # What is too large for float32 becomes infinite.
        with np.errstate(over="ignore"):
            band = np.asarray(pixels[first : first + rows], dtype=np.float32)
        yield band


def _write_png(path: Path, pixels: np.ndarray, bits: int) -> None:
    height, width, channels = pixels.shape
    stored = (encode(band, bits) for band in _bands(pixels))
    if bits == 8:
        from PIL import Image

        picture, first = Image.new("RGBA" if channels == 4 else "RGB", (width, height)), 0
        for band in stored:
            picture.paste(Image.fromarray(band), (0, first))
            first += len(band)
        picture.save(path, format="PNG")
        return
    import png

    writer = png.Writer(width, height, bitdepth=16, greyscale=False, alpha=channels == 4)
    with path.open("wb") as file:
        writer.write_packed(file, (row.astype(">u2").tobytes() for band in stored for row in band))


def _read_npy(path: Path) -> np.ndarray:
    # Mapped first, so that its size is judged before it is read.
    image = np.load(path, mmap_mode="r", allow_pickle=False)
    if image.dtype.kind != "f" or image.ndim != 3 or image.shape[2] not in (3, 4) or image.size == 0:
        got = f"{image.dtype} of shape {image.shape}"
        raise ValueError(f"got {got}, expected floating-point numbers of shape (H, W, 3) or (H, W, 4)")
    check_pixels(image.shape[1], image.shape[0])
    return np.array(image)
