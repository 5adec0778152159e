"""USD files (usd, usda, usdc, usdz) through usd-core, in a process of its own with limits of time and memory.

Every visible mesh of the stage, instances and those of point instancers included, with its world transform at one time.
Units and the up axis stay as the file has them: a file with z up stays so (turn it with `rotate`). Subdivision surfaces
are their control mesh. Colour and opacity are those of a bound UsdPreviewSurface, of the mesh or of subsets of its
faces, else displayColor and displayOpacity (linear), inherited ones too; its images are not read.
"""

import json
import re
import signal
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.files import usd_stage
from warpfrag.files.polygons import cut_polygons
from warpfrag.files.source import Source, resolved
from warpfrag.shapes.mesh import GREY, Mesh, placed

# Limits of the process that reads: address space, and time, which grows with the size of the file.
MOST_BYTES = 4 * 2**30
MOST_SECONDS, BYTES_PER_SECOND = 60.0, 10 * 2**20
_MISSING = re.compile(r"Could not open asset @([^@]*)@")
SCRIPT = Path(usd_stage.__file__)


def read_usd(source: Source) -> tuple[list[Mesh], str]:
    """Read the meshes of a stage, one for each of its meshes, with the name of its prim.

    Returns:
        The meshes in world space, and words about what else the stage holds.

    Raises:
        ValueError: the file cannot be read, within its limits, or it refers to a file outside of its root folder.
        ImportError: usd-core is not installed.
    """
    need("pxr", "usd", "Reading USD files")
    told, arrays = _run_here(source) if _comes_with_warp(source) else _run(source)
    if "refused" in told:
        raise ValueError(told["refused"])
    if "error" in told:
        raise ValueError(_memory() if told["error"] == "memory" else told["error"])
    parts = []
    for number, entry in enumerate(told["meshes"]):
        prefix = f"{number}."
        own = {key.removeprefix(prefix): values for key, values in arrays.items() if key.startswith(prefix)}
        mesh = _mesh(entry, own)
        if mesh is not None:
            parts.append(mesh)
    for name in dict.fromkeys(told["missing"]):
        source.find(name)
    for note in told["notes"]:
        source.note(note)
    kinds = told["kinds"]
    if kinds and parts:
        source.note(f"{', '.join(kinds)} {'is' if len(kinds) == 1 else 'are'} not drawn")
    return parts, f" (it holds {', '.join(kinds)})" if kinds else ""


def _comes_with_warp(source: Source) -> bool:
    """Tell whether a stage is one of the Warp wheel's own: those need no guard, and a process takes half a second."""
    found = find_spec("warp")
    if found is None or found.origin is None:
        return False
    return resolved(source.path).is_relative_to(Path(found.origin).parent)


def _run_here(source: Source) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a stage in this process."""
    reading = usd_stage.read_stage(resolved(source.path), source.root)
    return {**usd_stage.told_of(reading), "missing": []}, reading.arrays


def _run(source: Source) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Let a process of its own read the stage; return what it tells and its arrays."""
    path = resolved(source.path)
    seconds = MOST_SECONDS + path.stat().st_size / BYTES_PER_SECOND
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "stage.npz"
        command = [sys.executable, "-P", str(SCRIPT), str(path), str(source.root), str(output), str(MOST_BYTES)]
        try:
            done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, check=False)
        except subprocess.TimeoutExpired as error:
            raise ValueError(f"its reader took more than {seconds:.0f} s") from error
        if done.returncode or not output.is_file():
            words = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
            if done.returncode < 0:
                name = signal.Signals(-done.returncode).name
                # What runs out of memory in native code is mostly aborted.
                why = _memory() if name == "SIGABRT" and "alloc" in str(words) else f"its reader was ended by {name}"
                raise ValueError(why)
            raise ValueError(_memory() if "MemoryError" in str(words) else " ".join(words)[:160] or "its reader failed")
        with np.load(output, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
    told = json.loads(str(arrays.pop("told")))
    # References that lead nowhere are told by USD on standard error alone.
    told["missing"] = _MISSING.findall(done.stderr.decode("utf-8", "replace"))
    return told, arrays


def _memory() -> str:
    return f"its reader needed more than {MOST_BYTES / 2**30:g} GiB of memory"


def _mesh(told: dict[str, Any], arrays: dict[str, np.ndarray]) -> Mesh | None:
    points, counts, indices = arrays["points"], arrays["counts"], arrays["indices"]
    where = f"got a USD mesh that cannot be read: {told['path']}"
    if counts.min() < 0 or counts.sum() != len(indices):
        raise ValueError(f"{where} (its faces need {counts.sum()} indices, it has {len(indices)})")
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        raise ValueError(f"{where} (a face names vertex {indices.max()}, there are {len(points)})")
    if not np.isfinite(points).all():
        raise ValueError(f"{where} (a vertex is not finite)")
    face_of, corners = cut_polygons(points, counts, indices)
    if len(arrays["holes"]):
        kept = ~np.isin(face_of, arrays["holes"])
        face_of, corners = face_of[kept], corners[kept]
    if not len(corners):
        return None
    if told["mirrored"]:
        corners = corners[:, ::-1]
    attributes = {key: (arrays.get(key), told.get(key, "constant")) for key in ("color", "opacity", "normals")}
    normals, normal_where = attributes["normals"]
    if normals is not None and (normals.ndim != 2 or normal_where == "constant" or not np.isfinite(normals).all()):
        attributes["normals"] = (None, "constant")
    for key, default in (("color", np.full(3, GREY)), ("opacity", np.ones(()))):
        attributes[key] = _with_looks(key, attributes[key], told["looks"], arrays, default)
    source, vertex_of, values = _vertices(attributes, face_of, corners.reshape(-1), indices, len(points))
    if values["color"] is not None:
        values["color"] = np.maximum(values["color"], 0.0)
    if values["opacity"] is not None:
        values["opacity"] = np.clip(values["opacity"], 0.0, 1.0)
    faces = vertex_of.reshape(-1, 3).astype(np.int32)
    mesh = Mesh(points[source], faces, values["normals"], values["color"], values["opacity"], name=told["name"])
    return placed(mesh, arrays["matrix"])


def _with_looks(
    key: str,
    own: tuple[np.ndarray | None, str],
    looks: list[dict[str, Any]],
    arrays: dict[str, np.ndarray],
    default: np.ndarray,
) -> tuple[np.ndarray | None, str]:
    """Return an attribute with what materials say in place of the mesh's own, and its interpolation."""
    values, where = own
    subsets = []
    for look in looks:
        if look[key] is None:
            continue
        if look["faces"] is None:
            values, where = np.array([look[key]], dtype=np.float64), "constant"
        else:
            subsets.append((arrays[f"faces{look['faces']}"], look[key]))
    if not subsets:
        return values, where
    counts, indices = arrays["counts"], arrays["indices"]
    polygon = np.repeat(np.arange(len(counts)), counts)
    if values is None:
        spread = np.broadcast_to(default, (len(indices), *default.shape)).copy()
    else:
        place = {
            "constant": np.zeros(len(indices), dtype=np.int64),
            "uniform": polygon,
            "faceVarying": np.arange(len(indices)),
        }.get(where, indices)
        spread = values[np.minimum(place, len(values) - 1)].copy()
    for faces, value in subsets:
        spread[np.isin(polygon, faces)] = value
    return spread, "faceVarying"


def _vertices(
    attributes: dict[str, tuple[np.ndarray | None, str]],
    face_of: np.ndarray,
    corner: np.ndarray,
    indices: np.ndarray,
    point_count: int,
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray | None]]:
    """Bring values of any interpolation to vertices; a point becomes several vertices only where its values differ.

    Args:
        attributes: values (or None) and USD interpolation, by name.
        face_of: polygon of each triangle.
        corner: places of the triangles' corners in the list of polygon corners, (3T,).
        indices: point of each polygon corner.
        point_count: number of points.

    Returns:
        The point of each vertex, the vertex of each triangle corner (3T,), and each attribute per vertex (or one
        value).
    """
    point = indices[corner]
    per_corner: dict[str, np.ndarray] = {}
    result: dict[str, np.ndarray | None] = {}
    keys = [point]
    for name, (values, where) in attributes.items():
        result[name] = values[0] if values is not None and where == "constant" else None
        if values is None or where == "constant":
            continue
        wanted = {"uniform": np.repeat(face_of, 3), "faceVarying": corner}.get(where, point)
        # A list that is too short is ignored, as USD's own imaging does.
        if wanted.max() >= len(values):
            continue
        per_corner[name] = values[wanted]
        if where in ("uniform", "faceVarying"):
            keys.extend(values[wanted].reshape(len(wanted), -1).T)
    if len(keys) == 1:
        # The points stay as they are, used or not.
        for name in per_corner:
            values = attributes[name][0]
            assert values is not None
            padding = np.zeros((max(point_count - len(values), 0), *values.shape[1:]))
            result[name] = np.concatenate([values, padding])[:point_count]
        return np.arange(point_count), point, result
    _, first, vertex_of = np.unique(np.stack(keys, axis=-1), axis=0, return_index=True, return_inverse=True)
    result.update({name: values[first] for name, values in per_corner.items()})
    return point[first], vertex_of.reshape(-1), result
