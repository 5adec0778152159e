"""Encoded images, such as PNG and JPEG, to straight linear colours; their sizes are judged before they are unpacked.

What the numbers of a PNG file mean is told by its chunks, the first of them that is there: cICP, iCCP, sRGB, gAMA
(PNG specification, third edition, 4.3); without one they are sRGB. JPEG and other files follow their ICC profile.
"""

import io
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.colors import decode, srgb_to_linear
from warpfrag.files.source import ReadingWarning

# Of one image: 1 GiB as float32 RGBA.
MOST_PIXELS = 2**26
# What Pillow reads without the help of other programs.
FORMATS = ("PNG", "JPEG", "JPEG2000", "WEBP", "BMP", "DIB", "GIF", "TIFF", "TGA", "PPM", "DDS", "PCX", "SGI", "AVIF")
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY = 0
# Transfer functions of cICP (ITU-T H.273): gammas, linear light, and those that are taken as sRGB.
_GAMMAS = {4: 2.2, 5: 2.8, 8: 1.0}
_SRGB_CURVES = (13,)
_NAMES = {1: "BT.709", 6: "BT.601", 14: "BT.2020", 15: "BT.2020", 16: "PQ", 18: "HLG"}
_SRGB_PRIMARIES = 1


@dataclass(frozen=True)
class _Header:
    """What the chunks before the pixels of a PNG file say."""

    width: int
    height: int
    bits: int
    color_type: int
    gamma: float | None
    has_profile: bool


def decode_image(data: bytes, *, managed: bool = True) -> np.ndarray:
    """Decode an image file.

    Args:
        data: the file's bytes.
        managed: whether what the file says about its colours counts; else they are sRGB, as the images of glTF are.

    Returns:
        Straight linear RGB, (h, w, 3), or RGBA, (h, w, 4), if the file has opacity; float32, row 0 at the top.

    Raises:
        ValueError: it is larger than `MOST_PIXELS` or cannot be decoded. Decoders raise other kinds too.
    """
    if data.startswith(_SIGNATURE):
        return _decode_png(data, managed)
    with _opened(data) as image:
        return of_pillow(image, managed)


def with_opacity(pixels: np.ndarray) -> np.ndarray:
    """Return RGBA of RGB or RGBA, (h, w, 4)."""
    if pixels.shape[2] == 4:
        return pixels
    return np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)


def check_pixels(width: int, height: int, most: int = MOST_PIXELS) -> None:
    """Raise unless an image has at least one pixel and at most so many.

    Raises:
        ValueError: it has none, or more.
    """
    if width < 1 or height < 1 or width * height > most:
        raise ValueError(f"got {width} × {height} pixels, expected from 1 to {most} of them")


def _opened(data: bytes) -> Any:
    from PIL import Image

    with warnings.catch_warnings():
        # Sizes are judged here, by a limit that is an error.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            image = Image.open(io.BytesIO(data), formats=FORMATS)
        except Image.UnidentifiedImageError as error:
            raise ValueError("of no known kind, or broken") from error
        except Image.DecompressionBombError as error:
            raise ValueError(f"got more pixels than the {MOST_PIXELS} of the largest image") from error
    check_pixels(*image.size)
    return image


def of_pillow(image: Any, managed: bool) -> np.ndarray:
    """Turn a Pillow image into straight linear RGB or RGBA, (h, w, 3 or 4) float32."""
    from PIL import ImageOps

    if managed and image.format == "JPEG":
        image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I") or image.mode == "F":
        # Pillow's own conversion to RGBA clips 16-bit grey images instead of scaling them.
        grey = np.asarray(image, dtype=np.float64)
        grey = srgb_to_linear(np.clip(grey / (1.0 if image.mode == "F" else 65535.0), 0.0, 1.0))
        return np.stack([grey, grey, grey], axis=-1).astype(np.float32)
    if managed and "icc_profile" in image.info:
        image = _without_profile(image)
    has_opacity = image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
    return decode(np.asarray(image.convert("RGBA" if has_opacity else "RGB")))


def _without_profile(image: Any) -> Any:
    """Bring the colours of an image from its ICC profile to sRGB."""
    from PIL import ImageCms

    if image.mode == "P":
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(image.info["icc_profile"]))
        opacity = image.getchannel("A") if image.mode in ("RGBA", "LA") else None
        color = image.convert({"RGBA": "RGB", "LA": "L"}.get(image.mode, image.mode))
        converted = ImageCms.profileToProfile(color, profile, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (ImageCms.PyCMSError, OSError) as error:
        reason = " ".join(str(error).split())
        warnings.warn(f"a colour profile that cannot be used ({reason}), taken as sRGB", ReadingWarning, stacklevel=6)
        return image
    assert converted is not None
    if opacity is not None:
        converted.putalpha(opacity)
    return converted


def _decode_png(data: bytes, managed: bool) -> np.ndarray:
    header = _png_header(data)
    check_pixels(header.width, header.height)
    if header.has_profile and managed and header.bits <= 8:
        with _opened(data) as image:
            image.load()
            return of_pillow(image, managed)
    # Pillow cuts 16-bit colours to 8 bits without a word, and takes no grey below 8 bits for the transparent one.
    small_grey = header.bits < 8 and header.color_type == _GREY
    stored, bits = _png_as_stored(data) if header.bits == 16 or small_grey else (_png8(data), 8)
    if header.has_profile and managed:
        warnings.warn("a colour profile of 16-bit colours is not applied, taken as sRGB", ReadingWarning, stacklevel=5)
    if header.gamma is None or not managed:
        return decode(stored, bits)
    top = 2**bits - 1
    table = ((np.arange(top + 1) / top) ** header.gamma).astype(np.float32)
    linear = decode(stored, bits)
    linear[..., :3] = table[stored[..., :3]]
    return linear


def _png_header(data: bytes) -> _Header:
    found = dict(_chunks(data))
    if len(found.get(b"IHDR", b"")) < 13:
        raise ValueError("got no header, expected a PNG file")
    width, height, bits, color_type = struct.unpack(">IIBB", found[b"IHDR"][:10])
    gamma, has_profile = None, False
    if len(found.get(b"cICP", b"")) == 4:
        primaries, curve, matrix, full = found[b"cICP"]
        if curve not in _GAMMAS and curve not in _SRGB_CURVES:
            name = f" ({_NAMES[curve]})" if curve in _NAMES else ""
            raise ValueError(f"got the transfer function {curve}{name}, expected sRGB, linear light or a gamma")
        if primaries != _SRGB_PRIMARIES or matrix != 0 or full != 1:
            raise ValueError(f"got the colour space {primaries}/{matrix}/{full} in cICP, expected that of sRGB, 1/0/1")
        gamma = _GAMMAS.get(curve)
    elif b"iCCP" in found:
        has_profile = True
    elif b"sRGB" not in found and len(found.get(b"gAMA", b"")) == 4:
        (stored,) = struct.unpack(">I", found[b"gAMA"])
        gamma = 100000.0 / stored if stored else None
    return _Header(width, height, bits, color_type, gamma, has_profile)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield names and contents of the chunks before the pixels."""
    place = len(_SIGNATURE)
    while place + 8 <= len(data):
        length, name = struct.unpack(">I4s", data[place : place + 8])
        if name == b"IDAT":
            return
        yield name, data[place + 8 : place + 8 + length]
        place += length + 12


def _png8(data: bytes) -> np.ndarray:
    # Decoding ignores checksums, and what is behind the last pixel; verifying leaves nothing to decode.
    with _opened(data) as image:
        image.verify()
    with _opened(data) as image:
        has_opacity = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
        return np.asarray(image.convert("RGBA" if has_opacity else "RGB"))


def _png_as_stored(data: bytes) -> tuple[np.ndarray, int]:
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
    return stored, info["bitdepth"]
