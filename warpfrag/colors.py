"""Colours between files and linear light: the sRGB curve both ways, hexadecimal colours, stored whole numbers.

In memory colour is linear; straight where it is a surface's, premultiplied where it is an image's.
"""

import re
from functools import cache
from typing import Any

import numpy as np

_HEX = re.compile(r"#([0-9a-fA-F]{6})([0-9a-fA-F]{2})?")


def srgb_to_linear(value: Any) -> np.ndarray:
    """Turn sRGB values (0…1, any shape) into linear ones (IEC 61966-2-1), in float64."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Any) -> np.ndarray:
    """Turn linear values (cut to 0…1, any shape) into sRGB ones (IEC 61966-2-1), in float64."""
    value = np.clip(np.asarray(value, dtype=np.float64), 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 0.0031308) ** (1.0 / 2.4) - 0.055)


def parse_hex(text: str) -> tuple[float, float, float, float] | None:
    """Read `"#rrggbb"` or `"#rrggbbaa"` as straight linear RGBA; None if it is neither."""
    match = _HEX.fullmatch(text.strip())
    if match is None:
        return None
    red, green, blue = (float(v) for v in srgb_to_linear(np.array(list(bytes.fromhex(match[1]))) / 255.0))
    return red, green, blue, int(match[2], 16) / 255.0 if match[2] else 1.0


@cache
def _linear_of(bits: int) -> np.ndarray:
    return srgb_to_linear(np.arange(2**bits) / (2**bits - 1)).astype(np.float32)


def decode(stored: np.ndarray, bits: int = 8) -> np.ndarray:
    """Turn what an image file stores into straight linear colours.

    Args:
        stored: sRGB colours and linear opacity as whole numbers from 0 to 2^bits − 1, (h, w, 3 or 4).
        bits: bits of each number, up to 16.

    Returns:
        Straight linear RGB or RGBA, float32.
    """
    linear = np.empty(stored.shape, dtype=np.float32)
    linear[..., :3] = _linear_of(bits)[stored[..., :3]]
    linear[..., 3:] = stored[..., 3:] / np.float32(2**bits - 1)
    return linear


def encode(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Turn linear premultiplied colours into what a PNG file stores: whole numbers, straight sRGB, linear opacity.

    Args:
        image: linear premultiplied RGB or RGBA, (H, W, 3 or 4).
        bits: 8 or 16.

    Returns:
        The same shape, uint8 or uint16.
    """
    straight = np.array(image, dtype=np.float64)
    if image.shape[2] == 4:
        opacity = np.clip(straight[..., 3:], 0.0, 1.0)
        empty = np.zeros_like(straight[..., :3])
        straight[..., :3] = np.divide(straight[..., :3], opacity, out=empty, where=opacity > 0)
        straight[..., 3:] = opacity
    straight[..., :3] = linear_to_srgb(straight[..., :3])
    return np.rint(straight * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
