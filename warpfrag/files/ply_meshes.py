"""Meshes of PLY files: polygons and triangle strips, colours of vertices or faces, images that comments name."""

from dataclasses import replace

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.files.pixels import decode_image, with_opacity
from warpfrag.files.ply import Element, Lists, PlyFile, read_ply
from warpfrag.files.ply_columns import color_columns, opacity_column, scalar_columns
from warpfrag.files.polygons import cut_polygons
from warpfrag.files.source import Source, read_regular
from warpfrag.shapes.mesh import Mesh, unshared

_INDICES = ("vertex_indices", "vertex_index")
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_IMAGE = "TextureFile "


def read_ply_mesh(source: Source) -> tuple[list[Mesh], str]:
    """Read the mesh of a PLY file.

    Returns:
        The mesh, in a list that is empty without faces, and words about what else the file holds.

    Raises:
        ValueError: the file cannot be read.
    """
    file = read_ply(source.read())
    vertex = file.elements.get("vertex")
    if vertex is None:
        return [], ""
    points = scalar_columns(vertex, ("x", "y", "z"))
    if points is None:
        raise ValueError("the vertices have no x, y and z")
    polygon, corners, faces = _faces(file, points)
    if not len(faces):
        return [], f" (it holds {len(points)} points)" if len(points) else ""
    for name in file.elements:
        if name == "edge":
            source.note("edges are not drawn")
    mesh = Mesh(points, faces.astype(np.int32, copy=False), scalar_columns(vertex, ("nx", "ny", "nz")))
    if mesh.normals is not None and not np.isfinite(mesh.normals).all():
        mesh = replace(mesh, normals=None)
    for names in _COORDINATES:
        uv = scalar_columns(vertex, names)
        if uv is not None and mesh.uv is None and np.isfinite(uv).all():
            mesh = replace(mesh, uv=uv.astype(np.float32))
    mesh = _colored(mesh, vertex, file.elements.get("face"), polygon, source)
    return [_with_images(mesh, file, polygon, corners, source)], ""


def _faces(file: PlyFile, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the polygon of each triangle, the places of its corners among those of all polygons, and its vertices."""
    face = file.elements.get("face")
    lists = next((face.lists[name] for name in _INDICES if name in face.lists), None) if face else None
    if lists is not None and len(lists.values):
        polygon, places = cut_polygons(points, lists.counts, lists.values)
        # Triangles are what they are; taking each of their corners anew would be most of the time.
        faces = lists.values.reshape(-1, 3) if (lists.counts == 3).all() else lists.values[places]
        return polygon, places, faces
    strips = file.elements.get("tristrips")
    found = next((strips.lists[name] for name in _INDICES if name in strips.lists), None) if strips else None
    if found is None:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3), dtype=np.int64)
    faces = _strip_faces(found)
    if len(faces) and faces.max() >= len(points):
        raise ValueError(f"a face names vertex {faces.max()}, there are {len(points)}")
    return np.zeros(len(faces), dtype=np.int64), np.zeros((0, 3), dtype=np.int64), faces


def _strip_faces(strips: Lists) -> np.ndarray:
    """Return the triangles of strips, which −1 separates; without empty ones."""
    values = strips.values.astype(np.int64)
    ends = np.zeros(len(values), dtype=bool)
    ends[strips.first()[strips.counts > 0]] = True
    # A strip begins where a list does, and after each −1.
    breaks = values < 0
    begins = ends | np.concatenate([[True], breaks[:-1]])
    start = np.maximum.accumulate(np.where(begins, np.arange(len(values)), 0))
    at = np.arange(len(values))
    inside = (at - start >= 2) & ~breaks
    last = at[inside]
    odd = ((last - start[inside]) % 2).astype(bool)
    a, b, c = values[last - 2], values[last - 1], values[last]
    faces = np.stack([np.where(odd, b, a), np.where(odd, a, b), c], axis=-1)
    return faces[(a != b) & (b != c) & (a != c)]


def _colored(mesh: Mesh, vertex: Element, face: Element | None, polygon: np.ndarray, source: Source) -> Mesh:
    """Give a mesh the colours of its vertices, or else those of its faces."""
    color, opacity = color_columns(vertex), opacity_column(vertex, source)
    if color is None and face is not None and len(polygon):
        color, opacity_of_face = color_columns(face), opacity_column(face, source)
        if color is not None or (opacity is None and opacity_of_face is not None):
            mesh = unshared(mesh)
            color = None if color is None else np.repeat(color[polygon], 3, axis=0)
            opacity = None if opacity_of_face is None else np.repeat(opacity_of_face[polygon], 3)
    for name, values in (("colour", color), ("opacity", opacity)):
        if values is not None and not (np.isfinite(values).all() and values.min() >= 0.0 and values.max() <= 1.0):
            raise ValueError(f"a {name} is out of its range")
    if color is not None:
        mesh = replace(mesh, color=srgb_to_linear(color))
    return mesh if opacity is None else replace(mesh, opacity=opacity)


def _with_images(mesh: Mesh, file: PlyFile, polygon: np.ndarray, corners: np.ndarray, source: Source) -> Mesh:
    """Give a mesh the images that comments name, with coordinates of its vertices or of its faces' corners."""
    names = [comment.removeprefix(_IMAGE).strip() for comment in file.comments if comment.startswith(_IMAGE)]
    face = file.elements.get("face")
    own = face.lists.get("texcoord") if face else None
    indices = next((face.lists[name] for name in _INDICES if name in face.lists), None) if face else None
    if own is not None and indices is not None and len(corners) and (own.counts == 2 * indices.counts).all():
        mesh = unshared(mesh)
        mesh = replace(mesh, uv=own.values.reshape(-1, 2)[corners.reshape(-1)].astype(np.float32))
    if not names or mesh.uv is None:
        return mesh
    images = [_image(name, source) for name in names]
    number = face.scalars.get("texnumber") if face else None
    index = np.zeros(len(mesh.faces), dtype=np.int32)
    if number is not None and len(polygon):
        index = number[polygon].astype(np.int32)
    kept = [place for place, image in enumerate(images) if image is not None]
    index = np.array([kept.index(i) if i in kept else -1 for i in range(len(images))] + [-1], dtype=np.int32)[
        np.where((index >= 0) & (index < len(images)), index, len(images))
    ]
    if not kept:
        return mesh
    if mesh.color is not None:
        source.note("colours of vertices beside an image, drawn with the image alone")
    return replace(
        mesh, color=np.ones(3), textures=[image for image in images if image is not None], texture_index=index
    )


def _image(name: str, source: Source) -> np.ndarray | None:
    path = source.find(name)
    if path is None:
        return None
    try:
        return with_opacity(decode_image(read_regular(path, "an image")))
    # Decoders raise whatever they like on broken images.
    except Exception as error:
        source.note(f"texture: {name} cannot be read ({' '.join(str(error).split())[:80]}), drawn without")
        return None
