"""Values by pixel that are no colours (depths, normals, ids, counts) as image files.

OpenEXR and `.npy` hold the values; a PNG shows them: numbers as grey levels, from black for the least to white for the
largest, and transparent where there is nothing; normals as colours.
"""

import os
from pathlib import Path

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.files.exr import write_channels
from warpfrag.files.images import ImageError, check_target, write_image
from warpfrag.files.saving import replacing
from warpfrag.files.source import wording_of_path

# Channels of an OpenEXR file; depth has the name that is usual there.
_CHANNELS = {"depth": ("Z",), "normal": ("N.X", "N.Y", "N.Z")}


def write_values(path: str | os.PathLike, name: str, values: np.ndarray, *, bits: int = 8) -> str:
    """Write an output of `render` that is no colour; the file is there whole or not at all.

    Args:
        path: a name that ends in `.png`, `.exr` or `.npy`, in a folder that exists.
        name: "depth", "normal", "object_id" or "count".
        values: (H, W), of normals (H, W, 3).
        bits: bits per channel of a PNG file, 8 or 16.

    Returns:
        What a PNG's levels mean, in one line; empty for other files.

    Raises:
        ImageError: the name or the bits are not usable, or the file cannot be written.
        ImportError: an `.exr` file, and OpenEXR is not installed.
    """
    path = Path(path)
    check_target(path, bits=bits)
    suffix = path.suffix.lower()
    if suffix == ".png":
        levels, told = _levels(name, values)
        # A PNG has sRGB levels: those wanted here, not those of light.
        write_image(path, np.concatenate([srgb_to_linear(levels[..., :3]), levels[..., 3:]], axis=-1), bits=bits)
        return told
    try:
        with replacing(path) as partial:
            if suffix == ".npy":
                np.save(partial, values)
            else:
                parts = values.reshape((*values.shape[:2], -1)).astype(np.float32)
                names = _CHANNELS.get(name, (name,))
                write_channels(partial, {channel: parts[..., at] for at, channel in enumerate(names)})
    except OSError as error:
        raise ImageError(f"{wording_of_path(path)}: cannot be written ({error.strerror or error})") from error
    return ""


def _levels(name: str, values: np.ndarray) -> tuple[np.ndarray, str]:
    """Return sRGB levels from 0 to 1 and opacity, (H, W, 4), both 0 where there is nothing, and what they mean."""
    if name == "normal":
        seen = values.any(axis=-1, keepdims=True)
        colors = 0.5 + 0.5 * values * np.array([1.0, -1.0, -1.0])
        told = "normal: red to the right, green up, blue towards the eye, half of the levels for 0"
        return np.concatenate([np.where(seen, colors, 0.0), seen], axis=-1), told
    seen = {"depth": values > 0, "object_id": values >= 0}.get(name, np.ones(values.shape, bool))
    if not seen.any():
        return np.zeros((*values.shape, 4)), f"{name}: nothing is seen"
    low, high = float(values[seen].min()), float(values[seen].max())
    grey = np.where(seen, (values - low) / (high - low or 1.0), 0.0)
    return np.stack([grey, grey, grey, seen], axis=-1), f"{name}: from {low:.6g} (black) to {high:.6g} (white)"
