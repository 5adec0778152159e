"""Masks: triangles cut where their opacity, interpolated between their corners, falls below a limit."""

from dataclasses import replace
from typing import Any

import numpy as np

from warpfrag.shapes.mesh import Mesh


def cut_at_opacity(mesh: Mesh, cutoff: float) -> Mesh:
    """Return what of a mesh is at least as opaque as `cutoff`, opaque.

    Opacity is linear within a triangle, so the cut is a straight line and exact. One opacity for all vertices makes
    all of the mesh opaque or transparent. What is hidden is left out where opacities differ.
    """
    opacity = mesh.opacity
    if opacity is None or np.ndim(opacity) == 0:
        shown = 1.0 if opacity is None else float(opacity)
        return replace(mesh, opacity=1.0 if shown >= cutoff else 0.0)
    opacity = np.asarray(opacity, dtype=np.float64)
    above = opacity[mesh.faces] >= cutoff
    count = above.sum(axis=1)
    faces = [mesh.faces[count == 3]]
    source = [np.flatnonzero(count == 3)]
    # New vertices, each between two corners: first corner, second corner, share of the second.
    between: list[np.ndarray] = []
    first_new = len(mesh.vertices)
    for kept in (1, 2):
        which = np.flatnonzero(count == kept)
        if not len(which):
            continue
        # Turned so that the corner that differs from the other two comes first.
        lone = np.argmax(above[which] == (kept == 1), axis=1)
        corners = np.stack([mesh.faces[which, (lone + step) % 3] for step in range(3)], axis=-1)
        a, b, c = corners.T
        new = []
        for other in (b, c):
            share = (cutoff - opacity[a]) / (opacity[other] - opacity[a])
            between.append(np.stack([a, other, share], axis=-1))
            new.append(first_new + np.arange(len(which)))
            first_new += len(which)
        on_b, on_c = new
        triangles = [(a, on_b, on_c)] if kept == 1 else [(on_b, b, c), (on_b, c, on_c)]
        faces += [np.stack(triangle, axis=-1) for triangle in triangles]
        source += [which] * len(triangles)
    return _interpolated(mesh, np.concatenate(faces).astype(np.int32), np.concatenate(source), between)


def _interpolated(mesh: Mesh, faces: np.ndarray, source: np.ndarray, between: list[np.ndarray]) -> Mesh:
    """Return a mesh of these faces, with vertices between two others added to those it has."""
    places = np.concatenate([np.zeros((0, 3)), *between])
    first, second, share = places[:, 0].astype(int), places[:, 1].astype(int), places[:, 2:]

    def extended(values: np.ndarray) -> np.ndarray:
        added = values[first] + share * (values[second] - values[first])
        return np.concatenate([values, added.astype(values.dtype)])

    per_vertex: dict[str, Any] = {
        name: extended(values)
        for name in ("vertices", "normals", "color", "uv")
        if (values := getattr(mesh, name)) is not None and values.ndim == 2
    }
    index = None if mesh.texture_index is None else mesh.texture_index[source]
    return replace(mesh, faces=faces, opacity=1.0, texture_index=index, **per_vertex)
