"""Files of points: ply (the vertices of a mesh too), pts, pwn and xyz.

Text files hold a point a row; their columns are told apart by number and content (`#` and `//` start comments; rows
with nothing but a number of points, one for each scan, are skipped): 3 positions; with 4 or 7 columns an intensity
follows, which is not used; of the triples that follow, the one of unit length is the normal, the other the colour. The
6 columns of a pwn file always end in normals. Colours from 0 to 255, or to 1 where none is larger, are sRGB, as those
of ply files are.
"""

import io
import os
import re
from pathlib import Path

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.files.ply import read_ply
from warpfrag.files.ply_columns import color_columns, opacity_column, scalar_columns
from warpfrag.files.source import Source, check_regular, wording_of_path
from warpfrag.shapes.surfels import PointSet

POINT_SUFFIXES = (".ply", ".pts", ".pwn", ".xyz")
# Rounding in text files: a normal of 3 digits is this far from unit length.
_UNIT = 0.02
_COUNT_LINE = re.compile(r"^[ \t]*\d+[ \t]*\r?$\n?", re.MULTILINE)


def load_points(path: str | os.PathLike) -> PointSet:
    """Read a file of points, or the vertices of a ply mesh.

    Args:
        path: a file with one of `POINT_SUFFIXES`.

    Raises:
        ValueError: the file is missing, of an unknown kind, unreadable, or holds no points (one line each).
    """
    path = Path(path)
    name = wording_of_path(path)
    if path.suffix.lower() not in POINT_SUFFIXES:
        raise ValueError(f"got the point file {name} of an unknown kind, expected one of {', '.join(POINT_SUFFIXES)}")
    check_regular(path, "a file of points")
    source = Source(path, path.parent)
    read = _read_ply if path.suffix.lower() == ".ply" else _read_text
    try:
        points = read(source)
    except Exception as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise ValueError(f"got a file of points that cannot be read: {name} ({reason})") from error
    if len(points.points) == 0:
        raise ValueError(f"got no points in {name}, expected at least 2")
    source.warn()
    return points


def _read_ply(source: Source) -> PointSet:
    elements = read_ply(source.read()).elements
    vertex = elements.get("vertex")
    if vertex is None or not vertex.count:
        return PointSet(np.zeros((0, 3)))
    points = scalar_columns(vertex, ("x", "y", "z"))
    if points is None:
        raise ValueError("the vertices have no x, y and z")
    normals = scalar_columns(vertex, ("nx", "ny", "nz"))
    return _checked(points, normals, color_columns(vertex), opacity_column(vertex, source))


def _read_text(source: Source) -> PointSet:
    text = source.read().decode("utf-8-sig").replace(",", " ")
    text = _COUNT_LINE.sub("", text)
    if not text.strip():
        return PointSet(np.zeros((0, 3)))
    rows = np.loadtxt(io.StringIO(text), comments=("#", "//"), ndmin=2)
    width = rows.shape[1]
    if width not in (3, 4, 6, 7, 9):
        raise ValueError(f"{width} columns, expected 3, 4, 6, 7 or 9")
    skip = 4 if width in (4, 7) else 3
    normals = color = None
    for begin in range(skip, width, 3):
        triple = rows[:, begin : begin + 3]
        length = np.linalg.norm(triple, axis=1)
        if normals is None and (source.path.suffix.lower() == ".pwn" or np.mean(np.abs(length - 1.0) < _UNIT) > 0.9):
            normals = triple
        else:
            color = triple / (255.0 if triple.max() > 1.0 else 1.0)
    return _checked(rows[:, :3], normals, color, None)


def _checked(
    points: np.ndarray, normals: np.ndarray | None, color: np.ndarray | None, opacity: np.ndarray | None
) -> PointSet:
    if not np.isfinite(points).all():
        raise ValueError("a position is not finite")
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        # A file with normals for some of its points only gets all of them estimated.
        normals = normals / length if np.isfinite(length).all() and length.min() > 0.0 else None
    if color is not None:
        if not _is_share(color):
            raise ValueError("a colour is out of its range")
        color = srgb_to_linear(color)
    if opacity is not None and not _is_share(opacity):
        raise ValueError("an alpha is out of its range")
    return PointSet(points, normals, color, opacity)


def _is_share(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and values.min() >= 0.0 and values.max() <= 1.0)
