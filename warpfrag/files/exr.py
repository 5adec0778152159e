"""OpenEXR images, through OpenEXR's own package: of several parts the first with colours is read; deep ones are not.

A file with pixels of several samples (a deep image) is refused with a line that says so.
"""

from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.files.pixels import check_pixels

# Flags of the version in the file's second word.
_DEEP = 0x800
_COLORS = ("R", "G", "B")
_LUMINANCE, _CHROMA = "Y", {"RY", "BY"}


def openexr() -> Any:
    """Return OpenEXR's package.

    Raises:
        ImportError: it is not installed.
    """
    return need("OpenEXR", "exr", "An .exr file")


def read_exr(path: Path) -> np.ndarray:
    """Read the colours of an OpenEXR file.

    Returns:
        Linear premultiplied RGB or RGBA, (H, W, 3 or 4) float32.

    Raises:
        ValueError: no part has R, G and B (or Y), pixels are missing or too many, or the image is deep.
        ImportError: OpenEXR is not installed.
    """
    library = openexr()
    with path.open("rb") as file:
        start = file.read(8)
    is_deep = len(start) == 8 and bool(int.from_bytes(start[4:8], "little") & _DEEP)
    try:
        with library.File(str(path), separate_channels=True, header_only=True) as file:
            index = _colored_part(library, file)
    except ValueError:
        raise
    except Exception as error:
        if is_deep:
            raise ValueError("got a deep image, whose pixels have several samples, expected a flat one") from error
        raise
    with library.File(str(path), separate_channels=True) as file:
        channels = file.channels(index)
        names = [name for name in (*_COLORS, "A") if name in channels] if "R" in channels else [_LUMINANCE] * 3
        if _LUMINANCE in names and "A" in channels:
            names.append("A")
        return np.stack([np.asarray(channels[name].pixels, dtype=np.float32) for name in names], axis=-1)


def write_exr(path: Path, pixels: np.ndarray) -> None:
    """Write linear premultiplied RGB or RGBA, (H, W, 3 or 4) float32."""
    write_channels(path, {"RGBA" if pixels.shape[2] == 4 else "RGB": pixels})


def write_channels(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Write channels by name, (H, W) float32; "RGB" and "RGBA" are three and four of them, (H, W, 3 or 4)."""
    library = openexr()
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    with library.File(header, {name: np.ascontiguousarray(pixels) for name, pixels in channels.items()}) as file:
        file.write(str(path))


def _colored_part(library: Any, file: Any) -> int:
    """Return the index of the first flat part with colours."""
    wordings = []
    for index, part in enumerate(file.parts):
        names = {channel.name for channel in part.header["channels"]}
        deep = part.header.get("type") in (library.deepscanline, library.deeptile)
        if not deep and (names.issuperset(_COLORS) or (_LUMINANCE in names and not names & {*_COLORS, *_CHROMA})):
            held, whole = (np.asarray(part.header[name]).tolist() for name in ("dataWindow", "displayWindow"))
            if held != whole:
                raise ValueError(f"got pixels of the window {held} (first, last), expected those of {whole}")
            check_pixels(*(last - first + 1 for first, last in zip(*held, strict=True)))
            return index
        title = f'"{part.name()}" ' if len(file.parts) > 1 else ""
        wordings.append(f"{title}{'(deep) ' if deep else ''}with {', '.join(sorted(names))}")
    if len(wordings) == 1 and "(deep)" in wordings[0]:
        raise ValueError("got a deep image, whose pixels have several samples, expected a flat one")
    what = f"the parts {'; '.join(wordings)}" if len(wordings) > 1 else f"the channels {wordings[0][5:]}"
    raise ValueError(f"got {what}, expected R, G, B (and A), or Y")
