"""OFF files (OFF, COFF, NOFF): polygons in text, with colours of vertices or faces."""

import re
from dataclasses import replace

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.files.polygons import cut_polygons
from warpfrag.files.source import Source
from warpfrag.shapes.mesh import Mesh, unshared

# Texture coordinates (ST) and a fourth dimension are not read.
_HEADER = re.compile(r"\s*(C?N?OFF)", re.IGNORECASE)


def read_off(source: Source) -> tuple[list[Mesh], str]:
    """Read the mesh of an OFF file, in a list that is empty without faces, and no words.

    Raises:
        ValueError: the file cannot be read.
    """
    text = source.read().decode("utf-8", "replace")
    match = _HEADER.match(text)
    if match is None:
        raise ValueError("got no OFF header")
    header = match[1].upper()
    rest = [line for line in (raw.partition("#")[0].split() for raw in text[match.end() :].splitlines()) if line]
    if not rest or len(rest[0]) < 2:
        raise ValueError("got no numbers of vertices and faces")
    vertex_count, face_count = int(rest[0][0]), int(rest[0][1])
    if len(rest) - 1 < vertex_count + face_count:
        raise ValueError(f"got {len(rest) - 1} lines for {vertex_count} vertices and {face_count} faces")
    rows = rest[1 : 1 + vertex_count]
    points = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise ValueError("a vertex is not finite")
    faces = rest[1 + vertex_count : 1 + vertex_count + face_count]
    counts = np.array([int(row[0]) for row in faces], dtype=np.int64)
    if any(len(row) <= count for row, count in zip(faces, counts, strict=True)):
        raise ValueError("got a face with fewer vertices than it says")
    corners = np.array([int(at) for row, n in zip(faces, counts, strict=True) for at in row[1 : 1 + n]], dtype=np.int64)
    polygon, places = cut_polygons(points, counts, corners)
    if not len(places):
        return [], ""
    mesh = Mesh(points, corners[places].astype(np.int32))
    if "N" in header[:-3]:
        mesh = replace(mesh, normals=np.array([row[3:6] for row in rows], dtype=np.float64))
    if "C" in header[:-3]:
        start = 6 if "N" in header[:-3] else 3
        rgba = _rgba([row[start:] for row in rows])
        return [mesh if rgba is None else _with(mesh, rgba)], ""
    rgba = _rgba([row[1 + n :] for row, n in zip(faces, counts, strict=True)])
    return [mesh if rgba is None else _with(unshared(mesh), np.repeat(rgba[polygon], 3, axis=0))], ""


def _rgba(words: list[list[str]]) -> np.ndarray | None:
    """Return colours of three or four numbers, whole ones of 255, as shares (N, 4); None unless all have one."""
    if not words or any(len(each) not in (3, 4) for each in words):
        return None
    whole = not any("." in word for each in words for word in each)
    rgba = np.array([[*map(float, each), *([255.0 if whole else 1.0] * (4 - len(each)))] for each in words])
    rgba = rgba / 255.0 if whole and rgba.max() > 1.0 else rgba
    if not (np.isfinite(rgba).all() and rgba.min() >= 0.0 and rgba.max() <= 1.0):
        raise ValueError("a colour is out of its range")
    return rgba


def _with(mesh: Mesh, rgba: np.ndarray) -> Mesh:
    return replace(mesh, color=srgb_to_linear(rgba[:, :3]), opacity=rgba[:, 3])
