"""Colours from files into linear light: the sRGB curve, hexadecimal colours, 8-bit images."""

import re
from typing import Any

import numpy as np

_HEX = re.compile(r"#([0-9a-fA-F]{6})([0-9a-fA-F]{2})?")


def srgb_to_linear(value: Any) -> np.ndarray:
    """Turn sRGB values (0…1, any shape) into linear ones (IEC 61966-2-1), in float64."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4)


_LINEAR_OF_BYTE = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)


def parse_hex(text: str) -> tuple[float, float, float, float] | None:
    """Read ``"#rrggbb"`` or ``"#rrggbbaa"`` as straight linear RGBA; None if it is neither."""
    match = _HEX.fullmatch(text.strip())
    if match is None:
        return None
    red, green, blue = (float(v) for v in srgb_to_linear(np.array(list(bytes.fromhex(match[1]))) / 255.0))
    return red, green, blue, int(match[2], 16) / 255.0 if match[2] else 1.0


def linear_image(image: Any) -> np.ndarray:
    """Turn a Pillow image in sRGB into straight linear RGBA, (h, w, 4) float32 with row 0 at the top."""
    if image.mode.startswith("I") or image.mode == "F":
        # Pillow's own conversion to RGBA clips 16-bit grey images instead of scaling them.
        grey = np.asarray(image, dtype=np.float64)
        grey = srgb_to_linear(np.clip(grey / (1.0 if image.mode == "F" else 65535.0), 0.0, 1.0))
        return np.stack([grey, grey, grey, np.ones_like(grey)], axis=-1).astype(np.float32)
    pixels = np.asarray(image.convert("RGBA"))
    linear = np.empty(pixels.shape, dtype=np.float32)
    linear[..., :3] = _LINEAR_OF_BYTE[pixels[..., :3]]
    linear[..., 3] = pixels[..., 3] / np.float32(255.0)
    return linear
