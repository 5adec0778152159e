"""Images to and from files: PNG (8 and 16 bit), OpenEXR (float32) and NumPy's own format, told apart by suffix.

In memory an image is linear light, premultiplied, float32, row 0 at the top. A PNG holds straight colours in sRGB and
linear opacity, so what emits without opacity is lost there; OpenEXR and `.npy` keep everything as it is in memory.
"""

import io
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.extras import need
from warpfrag.files.saving import replacing

SUFFIXES = (".png", ".exr", ".npy")
# The header of a PNG file: signature, length and name of the first chunk, width, height, bit depth, colour type.
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_BIT_DEPTH, _PNG_COLOR_TYPE = 24, 25
_PNG_GREY = 0


class ImageError(ValueError):
    """An image file that cannot be read or written; the message is one line that names it."""


def read_image(path: str | os.PathLike, *, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read an image.

    Args:
        path: a `.png` file of any kind (grey, palette, with or without opacity, 1 to 16 bit), an `.exr` or `.npy` file.
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
    path = Path(path)
    readers: dict[str, Callable[[Path], np.ndarray]] = {".png": _read_png, ".exr": _read_exr, ".npy": _read_npy}
    reader = readers[_suffix(path)]
    if not path.is_file():
        raise ImageError(f"{path}: found {'a folder' if path.is_dir() else 'no such file'}, expected an image")
    try:
        image = reader(path)
    except (ImageError, ImportError):
        raise
    # Decoders raise whatever they like on broken files (SyntaxError, struct.error, zlib.error, …).
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ImageError(f"{path}: found a file that cannot be read ({reason}), expected an image") from error
    if size is not None and image.shape[:2] != (size[1], size[0]):
        found = f"{image.shape[1]} × {image.shape[0]}"
        raise ImageError(f"{path}: found {found} pixels, expected {size[0]} × {size[1]}")
    # What is too large for float32 becomes infinite, and is told below.
    with np.errstate(over="ignore"):
        image = np.ascontiguousarray(image, dtype=np.float32)
    if not np.isfinite(image).all():
        row, column = np.argwhere(~np.isfinite(image).all(axis=-1))[0]
        raise ImageError(
            f"{path}: found a value that is not finite at column {column}, row {row}, expected finite ones"
        )
    return image


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
    path = Path(path)
    check_target(path, bits=bits)
    pixels = np.asarray(image, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.size == 0:
        raise ImageError(f"{path}: found an image of shape {pixels.shape}, expected (H, W, 3) or (H, W, 4)")
    if not np.isfinite(pixels).all():
        raise ImageError(f"{path}: found values that are not finite, expected finite ones")
    try:
        with replacing(path) as partial:
            if path.suffix.lower() == ".png":
                _write_png(partial, pixels, bits)
            elif path.suffix.lower() == ".exr":
                _write_exr(partial, pixels)
            else:
                np.save(partial, pixels)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written ({error.strerror or error})") from error


def check_target(path: str | os.PathLike, *, bits: int = 8) -> None:
    """Raise what `write_image` would about the name, before time is spent on an image.

    Raises:
        ImageError: the suffix, the bits or the folder is not usable.
    """
    path = Path(path)
    suffix = _suffix(path)
    if bits not in (8, 16):
        raise ImageError(f"bits: found {bits}, expected 8 or 16")
    if not path.parent.is_dir():
        raise ImageError(f"{path}: found no folder {path.parent}, expected one that exists")
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise ImageError(f"{path}: cannot be written")
    if suffix == ".exr":
        _openexr()


def linear_to_srgb(value: np.ndarray) -> np.ndarray:
    """Turn linear values (cut to 0…1, any shape) into sRGB ones (IEC 61966-2-1), in float64."""
    value = np.clip(np.asarray(value, dtype=np.float64), 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 0.0031308) ** (1.0 / 2.4) - 0.055)


def encode(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Turn linear premultiplied colours into what a PNG file stores: whole numbers, straight sRGB, linear opacity."""
    straight = np.array(image, dtype=np.float64)
    if image.shape[2] == 4:
        opacity = np.clip(straight[..., 3:], 0.0, 1.0)
        straight[..., :3] = np.divide(
            straight[..., :3], opacity, out=np.zeros_like(straight[..., :3]), where=opacity > 0
        )
        straight[..., 3:] = opacity
    straight[..., :3] = linear_to_srgb(straight[..., :3])
    return np.rint(straight * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def _decode(stored: np.ndarray, bits: int) -> np.ndarray:
    top = 2**bits - 1
    table = srgb_to_linear(np.arange(top + 1) / top).astype(np.float32)
    image = np.empty(stored.shape, dtype=np.float32)
    image[..., :3] = table[stored[..., :3]]
    if stored.shape[2] == 4:
        image[..., 3] = stored[..., 3] / np.float32(top)
        image[..., :3] *= image[..., 3:]
    return image


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        found = f"the suffix {suffix}" if suffix else "no suffix"
        raise ImageError(f"{path}: found {found}, expected one of {', '.join(SUFFIXES)}")
    return suffix


def _read_png(path: Path) -> np.ndarray:
    data = path.read_bytes()
    if not data.startswith(_PNG_SIGNATURE) or len(data) <= _PNG_COLOR_TYPE:
        raise ImageError(f"{path}: found what is not a PNG file, expected one")
    bits = data[_PNG_BIT_DEPTH]
    # Pillow cuts 16-bit colours to 8 bits without a word, and takes no grey below 8 bits for the transparent one.
    small_grey = bits < 8 and data[_PNG_COLOR_TYPE] == _PNG_GREY
    return _read_png_as_stored(data) if bits == 16 or small_grey else _read_png8(data)


def _read_png8(data: bytes) -> np.ndarray:
    from PIL import Image

    with warnings.catch_warnings():
        # A huge image is an error all the same once memory runs out; the warning would be a second line.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        # Decoding ignores checksums, and what is behind the last pixel; verifying leaves nothing to decode.
        Image.open(io.BytesIO(data), formats=["PNG"]).verify()
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            has_opacity = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
            stored = np.asarray(image.convert("RGBA" if has_opacity else "RGB"))
    return _decode(stored, 8)


def _read_png_as_stored(data: bytes) -> np.ndarray:
    import png

    reader = png.Reader(bytes=data)
    reader.preamble()
    # It would cut values to the bits that are said to be significant; all of them are scaled to the full range.
    reader.sbit = None
    width, height, rows, info = reader.asDirect()
    stored = np.array([np.asarray(row, dtype=np.uint16) for row in rows]).reshape(height, width, info["planes"])
    if info["greyscale"]:
        grey = np.repeat(stored[..., :1], 3, axis=-1)
        stored = np.concatenate([grey, stored[..., 1:]], axis=-1)
    return _decode(stored, info["bitdepth"])


def _write_png(path: Path, pixels: np.ndarray, bits: int) -> None:
    stored = encode(pixels, bits)
    if bits == 8:
        from PIL import Image

        Image.fromarray(stored).save(path, format="PNG")
        return
    import png

    height, width, channels = stored.shape
    writer = png.Writer(width, height, bitdepth=16, greyscale=False, alpha=channels == 4)
    with path.open("wb") as file:
        writer.write_packed(file, (row.astype(">u2").tobytes() for row in stored))


def _openexr() -> Any:
    return need("OpenEXR", "exr", "An .exr file")


def _read_exr(path: Path) -> np.ndarray:
    openexr = _openexr()
    with openexr.File(str(path), separate_channels=True) as file:
        channels = {name: np.asarray(channel.pixels, dtype=np.float32) for name, channel in file.channels().items()}
        held, whole = (np.asarray(file.header()[name]).tolist() for name in ("dataWindow", "displayWindow"))
    if held != whole:
        raise ImageError(f"{path}: found pixels of the window {held} (first, last), expected those of {whole}")
    color = [channels[name] for name in ("R", "G", "B") if name in channels]
    if len(color) != 3:
        grey = "Y" in channels and not color and not {"RY", "BY"} & channels.keys()
        color = [channels["Y"]] * 3 if grey else []
    if not color:
        raise ImageError(f"{path}: found the channels {', '.join(sorted(channels))}, expected R, G, B (and A), or Y")
    return np.stack([*color, channels["A"]] if "A" in channels else color, axis=-1)


def _write_exr(path: Path, pixels: np.ndarray) -> None:
    openexr = _openexr()
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    name = "RGBA" if pixels.shape[2] == 4 else "RGB"
    with openexr.File(header, {name: np.ascontiguousarray(pixels)}) as file:
        file.write(str(path))


def _read_npy(path: Path) -> np.ndarray:
    image = np.load(path, allow_pickle=False)
    if image.dtype.kind != "f" or image.ndim != 3 or image.shape[2] not in (3, 4) or image.size == 0:
        found = f"{image.dtype} of shape {image.shape}"
        raise ImageError(f"{path}: found {found}, expected floating-point numbers of shape (H, W, 3) or (H, W, 4)")
    return image
