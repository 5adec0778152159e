"""STL files, in text and binary, with the colours that VisCAM, SolidView and Magics put into binary ones.

Colours are 5 bits of sRGB for each triangle. Vertices, which an STL repeats for every triangle, are merged.
"""

import re
from dataclasses import replace

import numpy as np

from warpfrag.colors import linear_to_srgb, srgb_to_linear
from warpfrag.files.source import Source
from warpfrag.shapes.mesh import GREY, Mesh, unshared, weld

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_MAGICS = b"COLOR="
_FLAG = 0x8000


def read_stl(source: Source) -> tuple[list[Mesh], str]:
    """Read the mesh of an STL file, in a list that is empty without triangles, and no words.

    Raises:
        ValueError: the file cannot be read.
    """
    data = source.read()
    count = int.from_bytes(data[80:84], "little")
    # Binary files may begin with "solid" too: their size tells.
    if len(data) >= _HEADER and len(data) >= _HEADER + count * _TRIANGLE.itemsize and not _is_text(data, count):
        table = np.frombuffer(data, _TRIANGLE, count, _HEADER)
        mesh = _welded(table["corners"].reshape(-1, 3).astype(np.float64))
        return ([_colored(mesh, data[:80], table["attribute"])] if count else []), ""
    if not data.lstrip()[:5].lower() == b"solid":
        raise ValueError(f"got {len(data)} bytes for {count} triangles, expected {_HEADER + 50 * count}")
    try:
        corners = np.array(_VERTEX.findall(data), dtype=np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise ValueError("got vertices that are not numbers, or not three a triangle") from error
    return ([_welded(corners.reshape(-1, 3))] if len(corners) else []), ""


def _is_text(data: bytes, count: int) -> bool:
    exact = len(data) == _HEADER + count * _TRIANGLE.itemsize
    return not exact and data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:1000].lower()


def _welded(corners: np.ndarray) -> Mesh:
    if not np.isfinite(corners).all():
        raise ValueError("a vertex is not finite")
    return Mesh(*weld(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3)))


def _colored(mesh: Mesh, header: bytes, attribute: np.ndarray) -> Mesh:
    """Give a mesh the colours of its triangles, if there are any."""
    five_bits = np.stack([attribute >> shift & 31 for shift in (0, 5, 10)], axis=-1) / 31.0
    flagged = (attribute & _FLAG) != 0
    place = header.find(_MAGICS)
    if 0 <= place <= 80 - len(_MAGICS) - 4:
        # Magics: the flag says that the colour of the header counts; red is lowest.
        whole = np.frombuffer(header, np.uint8, 4, place + len(_MAGICS)) / 255.0
        by_header = flagged | ((attribute == 0).all())
        color = np.where(by_header[:, None], whole[:3], five_bits)
        opacity = np.where(by_header, whole[3], 1.0)
    elif flagged.any():
        # VisCAM and SolidView: the flag says that the triangle has a colour; blue is lowest.
        color = np.where(flagged[:, None], five_bits[:, ::-1], linear_to_srgb(GREY))
        opacity = np.ones(len(color))
    else:
        return mesh
    linear = srgb_to_linear(color)
    if (linear == linear[0]).all() and (opacity == opacity[0]).all():
        return replace(mesh, color=linear[0], opacity=float(opacity[0]))
    mesh = unshared(mesh)
    return replace(mesh, color=np.repeat(linear, 3, axis=0), opacity=np.repeat(opacity, 3))
