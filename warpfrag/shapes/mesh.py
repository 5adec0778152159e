"""A triangle mesh on its way into a scene: what primitives and files give, and its normals."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warpfrag.errors import check_number, shorten
from warpfrag.scene.light import area_vectors, transformed_normals, unit_rows
from warpfrag.scene.names import ThicknessUnit
from warpfrag.scene.rotation import rotation_matrix
from warpfrag.scene.surface import SceneObject

# Of what says nothing about its colour, in linear light.
GREY = 0.8


@dataclass(frozen=True, repr=False)
class Mesh:
    """Triangles and how they look, before a scene file has its say.

    Attributes:
        vertices: (V, 3) float64.
        faces: (N, 3) int32, indices into `vertices`.
        normals: (V, 3) float64 unit normals of the primitive's or file's own; None where there are none.
        color: straight linear RGB, (3,) or (V, 3); None where the file names no colour.
        opacity: one number (or 0-d array) or (V,); None where the file names none.
        uv: (V, 2) float32 texture coordinates, v up; None without.
        textures: straight linear RGBA images, (h, w, 4) float32, row 0 at the top.
        texture_index: (N,) int32, the image of each face, −1 for none; None where all faces have image 0 (or there is
            none).
        name: what a file calls it; blank where it has no name.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    color: np.ndarray | None = None
    opacity: float | np.ndarray | None = None
    uv: np.ndarray | None = None
    textures: list[np.ndarray] = field(default_factory=list)
    texture_index: np.ndarray | None = None
    name: str = ""

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces)"

    def object(
        self,
        name: str,
        *,
        color: Any = None,
        opacity: Any = None,
        thickness: Any = "2P",
        texture: np.ndarray | None = None,
        translate: Any = (0.0, 0.0, 0.0),
        rotate: Any = (0.0, 0.0, 0.0),
        scale: Any = 1.0,
    ) -> SceneObject:
        """Return this mesh as an object of a scene, scaled first, then turned, moved last.

        Normals that it lacks are computed, smooth ones (see `split_faces` for flat ones).

        Args:
            name: unique in its scene.
            color: straight linear RGB from 0, (3,) or per vertex (V, 3), in place of the mesh's colours and those of
                its images; default those, or else grey.
            opacity: 0 to 1, one number or per vertex (V,), in place of the mesh's, but what its images cut out (alpha
                0) stays cut out; default that, or else 1.
            thickness: z-thickness [scene units], or a text such as "2P", multiples of P(z).
            texture: straight linear image, (h, w, 3) or (h, w, 4), row 0 at the top, which `color` tints; the mesh must
                have texture coordinates (`uv=True` of round primitives).
            translate: [scene units], 3 numbers.
            rotate: rotation vector: along the axis, as long as the angle [degrees], 3 numbers.
            scale: a number other than 0, or one for each axis.

        Raises:
            TypeError: a value of the wrong kind.
            ValueError: a value of the wrong shape or out of its range.

        Example:
            >>> wf.shapes.cube().object("box", opacity=0.5, rotate=(0, 45, 0))
            SceneObject('box', 24 vertices, 12 faces)
        """
        mesh = self if self.normals is not None else replace(self, normals=smooth_normals(self.vertices, self.faces))
        if texture is not None:
            mesh = replace(mesh, textures=[_with_opacity(name, texture)])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_matrix(np.array(_vector(name, "rotate", rotate)))
        factors = [scale] * 3 if np.ndim(scale) == 0 else scale
        matrix[:3, :3] = matrix[:3, :3] @ np.diag(_vector(name, "scale", factors))
        matrix[:3, 3] = _vector(name, "translate", translate)
        return scene_object(looking(mesh, color, opacity, own_images=texture is None), name, matrix, thickness)


def looking(mesh: Mesh, color: Any, opacity: Any, *, own_images: bool = True) -> Mesh:
    """Return a mesh with a colour and an opacity, where they are not None, in place of its own.

    Args:
        mesh: the mesh.
        color: straight linear RGB, (3,) or (V, 3).
        opacity: one number or (V,).
        own_images: whether its images are its own, whose colours and opacity the new ones replace too; else they are
            another, which the new ones tint. What an image cuts out (alpha 0) stays cut out.
    """
    images = mesh.textures
    if not own_images:
        mesh = replace(mesh, texture_index=None, color=color if color is None else np.asarray(color))
        return mesh if opacity is None else replace(mesh, opacity=opacity)
    if color is not None:
        images = [np.concatenate([np.ones_like(image[..., :3]), image[..., 3:]], axis=-1) for image in images]
        mesh = replace(mesh, color=np.asarray(color))
    if opacity is not None:
        images = [np.concatenate([image[..., :3], image[..., 3:] > 0.0], axis=-1) for image in images]
        mesh = replace(mesh, opacity=opacity)
    if color is not None and all(image.min() == 1.0 for image in images):
        images = []
    return replace(mesh, textures=images)


def scene_object(
    mesh: Mesh, name: str, matrix: np.ndarray, thickness: Any, unit: ThicknessUnit = "scene"
) -> SceneObject:
    """Return a mesh as an object: grey, or white under an image, where it has no colour of its own; opaque."""
    color = np.full(3, 1.0 if mesh.textures else GREY) if mesh.color is None else mesh.color
    return SceneObject(
        name,
        mesh.vertices,
        mesh.faces,
        matrix,
        color,
        1.0 if mesh.opacity is None else mesh.opacity,
        thickness,
        unit,
        mesh.uv if mesh.textures else None,
        (mesh.textures if mesh.texture_index is not None else mesh.textures[0]) if mesh.textures else None,
        mesh.texture_index if mesh.textures else None,
        normals=mesh.normals,
    )


def _vector(name: str, key: str, value: Any) -> list[float]:
    if not isinstance(value, (list, tuple, np.ndarray)) or len(value) != 3:
        raise ValueError(f"{name}.{key}: got {shorten(value)}, expected 3 numbers")
    return [check_number(f"{name}.{key}", part) for part in value]


def _with_opacity(name: str, image: Any) -> np.ndarray:
    image = np.asarray(image, dtype=np.float32)
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise ValueError(f"{name}.texture: got shape {image.shape}, expected shape (h, w, 3) or (h, w, 4)")
    opaque = np.ones((*image.shape[:2], 1), np.float32)
    return image if image.shape[2] == 4 else np.concatenate([image, opaque], axis=-1)


def placed(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """Move a mesh by a matrix (4, 4); its outside stays outside, also where the matrix mirrors it."""
    matrix = np.asarray(matrix, dtype=np.float64)
    if np.array_equal(matrix, np.eye(4)):
        return mesh
    mirrors = np.linalg.det(matrix[:3, :3]) < 0.0
    normals = None if mesh.normals is None else transformed_normals(mesh.normals, matrix)
    if normals is not None and mirrors:
        normals = -normals
    return replace(
        mesh,
        vertices=mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3],
        faces=np.ascontiguousarray(mesh.faces[:, ::-1]) if mirrors else mesh.faces,
        normals=normals,
    )


def join(parts: list[Mesh]) -> Mesh:
    """Put parts after one another in one mesh; parts without a colour are grey, or white under an image."""
    if len(parts) == 1:
        return parts[0]
    counts = [len(part.vertices) for part in parts]
    first = np.cumsum([0, *counts])
    textures: list[np.ndarray] = []
    place: dict[int, int] = {}
    indices = []
    for part in parts:
        for image in part.textures:
            if id(image) not in place:
                place[id(image)] = len(textures)
                textures.append(image)
        index = part.texture_index
        if index is None:
            index = np.full(len(part.faces), 0 if part.textures else -1)
        places = np.array([place[id(image)] for image in part.textures] or [-1])
        indices.append(np.where(index < 0, -1, places[np.maximum(index, 0)]).astype(np.int32))
    color: Any = None
    opacity: Any = None
    normals = uv = None
    if any(part.color is not None for part in parts):
        colors = [_known_color(part) for part in parts]
        color = colors[0]
        if any(other.ndim > 1 or not np.array_equal(other, color) for other in colors):
            color = np.concatenate([np.broadcast_to(c, (n, 3)) for c, n in zip(colors, counts, strict=True)])
    if any(part.opacity is not None for part in parts):
        opacities = [np.asarray(1.0 if part.opacity is None else part.opacity) for part in parts]
        opacity = float(opacities[0]) if opacities[0].ndim == 0 else opacities[0]
        if any(other.ndim > 0 or other != opacity for other in opacities):
            opacity = np.concatenate([np.broadcast_to(o, (n,)) for o, n in zip(opacities, counts, strict=True)])
    if any(part.normals is not None for part in parts):
        own = [smooth_normals(part.vertices, part.faces) if part.normals is None else part.normals for part in parts]
        normals = np.concatenate(own)
    if textures or all(part.uv is not None for part in parts):
        blank = [np.zeros((n, 2), dtype=np.float32) for n in counts]
        uv = np.concatenate([zero if part.uv is None else part.uv for part, zero in zip(parts, blank, strict=True)])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + np.int32(start) for part, start in zip(parts, first, strict=False)]),
        normals,
        color,
        opacity,
        uv,
        textures,
        np.concatenate(indices) if textures else None,
    )


def _known_color(part: Mesh) -> np.ndarray:
    return np.full(3, 1.0 if part.textures else GREY) if part.color is None else np.asarray(part.color)


def unshared(mesh: Mesh) -> Mesh:
    """Give every face three vertices of its own, face-major; all else stays."""
    corner = mesh.faces.reshape(-1)

    def pick(values: Any) -> Any:
        return values[corner] if np.ndim(values) and len(values) == len(mesh.vertices) else values

    return replace(
        mesh,
        vertices=mesh.vertices[corner],
        faces=np.arange(len(corner), dtype=np.int32).reshape(-1, 3),
        normals=pick(mesh.normals),
        color=mesh.color if mesh.color is None or mesh.color.ndim == 1 else mesh.color[corner],
        opacity=pick(mesh.opacity),
        uv=pick(mesh.uv),
    )


def split_faces(mesh: Mesh) -> Mesh:
    """Give every face three vertices of its own (face-major), with flat normals."""
    normals = np.repeat(unit_rows(area_vectors(mesh.vertices, mesh.faces)), 3, axis=0)
    return replace(unshared(mesh), normals=normals)


def weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices at bitwise equal positions; the first of each keeps its place in the order."""
    unique, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return unique[order], rank[inverse.reshape(-1)][faces].astype(np.int32)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute vertex normals: the faces' normals weighted by area and corner angle.

    Vertices at the same position count as one, so that a texture seam does not show. Degenerate faces count for
    nothing.

    Args:
        vertices: (V, 3).
        faces: (N, 3).

    Returns:
        (V, 3) float64 unit normals; zero for a vertex that no face of positive area uses.
    """
    points, corners = weld(np.asarray(vertices, dtype=np.float64), faces)
    area = area_vectors(points, corners)
    total = np.zeros_like(points)
    for corner in range(3):
        here, ahead, behind = (points[corners[:, (corner + step) % 3]] for step in range(3))
        # atan2 needs no normalised edges: an edge of length 0 has the angle 0, not NaN.
        cosine = np.einsum("ij,ij->i", ahead - here, behind - here)
        angle = np.arctan2(np.linalg.norm(area, axis=1), cosine)
        for axis in range(3):
            total[:, axis] += np.bincount(corners[:, corner], area[:, axis] * angle, minlength=len(points))
    # Coincident faces of opposite winding cancel: such a vertex takes the normal of one of them.
    size = np.linalg.norm(area, axis=1)
    largest = np.zeros(len(points))
    np.maximum.at(largest, corners.reshape(-1), np.repeat(size, 3))
    lost = np.linalg.norm(total, axis=1) <= 1e-9 * largest
    uses_lost = lost[corners] & (size > 0.0)[:, None]
    face, corner_of = np.nonzero(uses_lost)
    total[corners[face, corner_of]] = area[face]
    normals = np.zeros((len(vertices), 3))
    normals[faces.reshape(-1)] = unit_rows(total)[corners.reshape(-1)]
    return normals
