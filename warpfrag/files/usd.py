"""USD files (usd, usda, usdc, usdz) through usd-core.

Every visible mesh of the stage, instances included, with its world transform at the earliest time. Units and the up
axis stay as the file has them: a file with z up stays so (turn it with `rotate`). Polygons become fans of triangles;
subdivision surfaces are their control mesh. Colour and opacity are displayColor and displayOpacity (linear), else the
constants of a bound UsdPreviewSurface; its textures are not read.
"""

from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.shapes.mesh import Mesh, transformed_normals


def load_usd(path: Path, root: Path) -> tuple[list[Mesh], str]:
    """Read the meshes of a stage; see `load_mesh`.

    Returns:
        The meshes, and words about what else the stage holds when there are none.

    Raises:
        ValueError: the file cannot be read, or it refers to a file outside of `root`.
        ImportError: usd-core is not installed.
    """
    need("pxr", "usd", "Reading USD files")
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        reason = str(error).strip().splitlines()[-1].strip()[:120]
        raise ValueError(f"got a USD file that cannot be read: {path} ({reason})") from error
    for layer in stage.GetUsedLayers():
        used = layer.realPath.split("[")[0]
        if used and Path(used).resolve() != path.resolve() and not Path(used).resolve().is_relative_to(root.resolve()):
            raise ValueError(f"got a reference to {used} in {path}, expected references inside {root}")
    time = Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(time)
    parts, kinds = [], set()
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer):
            kinds.add(str(prim.GetTypeName()))
        if not prim.IsA(UsdGeom.Mesh):
            continue
        shown = UsdGeom.Imageable(prim)
        if shown.ComputeVisibility(time) == "invisible" or shown.ComputePurpose() in ("guide", "proxy"):
            continue
        mesh = _mesh(prim, np.array(transforms.GetLocalToWorldTransform(prim)).T, time)
        if mesh is not None:
            parts.append(mesh)
    return parts, f" (it holds {', '.join(sorted(kinds))})" if kinds else ""


def _mesh(prim: Any, matrix: np.ndarray, time: Any) -> Mesh | None:
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(prim)
    points = np.asarray(mesh.GetPointsAttr().Get(time), dtype=np.float64)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(time), dtype=np.int64)
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(time), dtype=np.int64)
    if points.ndim != 2 or counts.ndim != 1 or indices.ndim != 1 or not len(counts):
        return None
    where = f"got a USD mesh that cannot be read: {prim.GetPath()}"
    if counts.min() < 0 or counts.sum() != len(indices):
        raise ValueError(f"{where} (its faces need {counts.sum()} indices, it has {len(indices)})")
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        raise ValueError(f"{where} (a face names vertex {indices.max()}, there are {len(points)})")
    if not np.isfinite(points).all():
        raise ValueError(f"{where} (a vertex is not finite)")
    face_of, corners = _fan(counts)
    if not len(corners):
        return None
    points = points @ matrix[:3, :3].T + matrix[:3, 3]
    color, color_where = _primvar(mesh.GetDisplayColorPrimvar(), time)
    opacity, opacity_where = _primvar(mesh.GetDisplayOpacityPrimvar(), time)
    if color is None and opacity is None:
        color, opacity = _preview_surface(prim)
        color_where = opacity_where = "constant"
    normals, normal_where = _normals(mesh, time)
    attributes = {
        "color": (color, color_where),
        "opacity": (opacity, opacity_where),
        "normals": (normals, normal_where),
    }
    source, vertex_of, values = _vertices(attributes, face_of, corners.reshape(-1), indices, len(points))
    vertices, faces = points[source], vertex_of.reshape(-1, 3)
    if values["normals"] is not None:
        values["normals"] = transformed_normals(values["normals"], matrix)
    if values["color"] is not None:
        values["color"] = np.maximum(values["color"], 0.0)
    if values["opacity"] is not None:
        values["opacity"] = np.clip(values["opacity"], 0.0, 1.0)
    return Mesh(vertices, faces.astype(np.int32), values["normals"], values["color"], values["opacity"])


def _fan(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide polygons into fans; return each triangle's polygon and its three places in the list of corners."""
    first = np.cumsum(counts) - counts
    triangles = np.maximum(counts - 2, 0)
    face_of = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(len(face_of)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = first[face_of]
    return face_of, np.stack([start, start + step + 1, start + step + 2], axis=-1)


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


def _primvar(primvar: Any, time: Any) -> tuple[np.ndarray | None, str]:
    values = primvar.ComputeFlattened(time) if primvar and primvar.HasAuthoredValue() else None
    if values is None or not len(values):
        return None, "constant"
    array = np.asarray(values, dtype=np.float64)
    return (array, str(primvar.GetInterpolation())) if np.isfinite(array).all() else (None, "constant")


def _normals(mesh: Any, time: Any) -> tuple[np.ndarray | None, str]:
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(mesh.GetPrim()).GetPrimvar("normals")
    values, where = _primvar(primvar, time)
    if values is None:
        given = mesh.GetNormalsAttr().Get(time)
        values = np.asarray(given, dtype=np.float64) if given is not None and len(given) else None
        where = str(mesh.GetNormalsInterpolation())
    if values is None or values.ndim != 2 or where in ("uniform", "constant"):
        # Face normals would only repeat what `normals = "flat"` computes.
        return None, "constant"
    return values, where


def _preview_surface(prim: Any) -> tuple[np.ndarray | None, np.ndarray | None]:
    from pxr import UsdShade

    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0] if material else None
    found: list[np.ndarray | None] = []
    for name in ("diffuseColor", "opacity"):
        value = shader.GetInput(name) if shader else None
        plain = value.Get() if value and not value.HasConnectedSource() else None
        found.append(None if plain is None else np.asarray([plain], dtype=np.float64))
    return found[0], found[1]
