"""The geometry of glTF primitives: attributes, triangles of all modes, morph targets, skins, Draco.

A primitive without normals gets those of its faces, as the specification says; its faces then share no vertices.
"""

import importlib.util
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.extras import need
from warpfrag.files.gltf_document import DRACO, Document
from warpfrag.files.gltf_materials import Looks
from warpfrag.shapes.mesh import Mesh, split_faces

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MODES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}
_NAMES = ("POSITION", "NORMAL", "COLOR_0")


@dataclass(frozen=True)
class Skin:
    """The matrices of a skin's joints at rest, from the mesh's space to world space, (joints, 4, 4)."""

    matrices: np.ndarray


class Primitives:
    """Reads the primitives of a document, each once for every pose that it is drawn in."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.looks = Looks(document)
        self.left_out: set[str] = set()
        self._read: dict[tuple, list[Mesh]] = {}

    def of_mesh(self, index: int, weights: Any, skin: Skin | None) -> list[Mesh]:
        """Return the primitives of a mesh that have triangles.

        Args:
            index: which mesh.
            weights: of its morph targets, from the node that draws it; None takes the mesh's own.
            skin: what bends it; None without.
        """
        entry = self.document.entry("meshes", index)
        weights = entry.get("weights", []) if weights is None else weights
        key = (index, tuple(weights))
        if skin is not None or key not in self._read:
            primitives = entry.get("primitives", [])
            meshes = [self._primitive(primitive, weights, skin) for primitive in primitives]
            read = [mesh for mesh in meshes if mesh is not None and len(mesh.faces)]
            if skin is not None:
                return read
            self._read[key] = read
        return self._read[key]

    def _primitive(self, primitive: dict[str, Any], weights: Any, skin: Skin | None) -> Mesh | None:
        mode = primitive.get("mode", _TRIANGLES)
        if mode in _MODES:
            self.left_out.add(_MODES[mode])
            return None
        attributes, indices = self._arrays(primitive)
        points = attributes.get("POSITION")
        if points is None or points.ndim != 2 or points.shape[1] != 3:
            return None
        self._morph(attributes, primitive, weights)
        points, normals = attributes["POSITION"], attributes.get("NORMAL")
        if any(len(values) != len(points) for values in attributes.values()):
            raise ValueError("got attributes of one primitive that differ in length")
        if indices is None:
            indices = np.arange(len(points))
        if len(indices) and indices.max() >= len(points):
            raise ValueError(f"a face names vertex {indices.max()}, there are {len(points)}")
        if skin is not None:
            points, normals = _skinned(points, normals, attributes, skin)
        if normals is not None and (normals.shape != points.shape or not np.isfinite(normals).all()):
            normals = None
        if not np.isfinite(points).all():
            raise ValueError("a vertex is not finite")
        mesh = Mesh(points.astype(np.float64), _triangles(indices.astype(np.int64), mode), normals)
        mesh = self.looks.apply(mesh, primitive, attributes)
        return split_faces(mesh) if normals is None else mesh

    def _arrays(self, primitive: dict[str, Any]) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Return a primitive's attributes by name, and its indices."""
        given = primitive.get("attributes", {})
        wanted = [name for name in given if name in _NAMES or name.startswith(("TEXCOORD_", "JOINTS_", "WEIGHTS_"))]
        if any(name.startswith("COLOR_") and name != "COLOR_0" for name in given):
            self.document.source.note("further colours of vertices (COLOR_1, …) are not drawn")
        draco = self.document.extension(primitive, DRACO)
        if draco is not None and self._can_decode():
            return self._decoded(primitive, draco, wanted)
        # Colours of whole numbers are always shares; the flag is often forgotten.
        attributes = {
            name: self.document.accessor(given[name], normalized=True if name == "COLOR_0" else None) for name in wanted
        }
        indices = primitive.get("indices")
        return attributes, None if indices is None else self.document.accessor(indices)

    def _can_decode(self) -> bool:
        return DRACO in self.document.entries("extensionsRequired") or importlib.util.find_spec("DracoPy") is not None

    def _decoded(
        self, primitive: dict[str, Any], draco: dict[str, Any], wanted: list[str]
    ) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        library = need("DracoPy", "draco", "A mesh compressed by Draco")
        decoded = library.decode(self.document.bytes_of_view(draco.get("bufferView")))
        attributes = {}
        for name in wanted:
            if name not in draco.get("attributes", {}):
                attributes[name] = self.document.accessor(primitive["attributes"][name])
                continue
            values = np.asarray(decoded.get_attribute_by_unique_id(draco["attributes"][name])["data"])
            accessor = self.document.entry("accessors", primitive["attributes"][name])
            if values.dtype.kind in "iu" and (accessor.get("normalized") or name == "COLOR_0"):
                values = np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)
            attributes[name] = values.astype(np.float64) if values.dtype.kind == "f" else values
        return attributes, np.asarray(decoded.faces).reshape(-1)

    def _morph(self, attributes: dict[str, np.ndarray], primitive: dict[str, Any], weights: Any) -> None:
        """Add the displacements of morph targets, as far as they weigh something."""
        for target, weight in zip(primitive.get("targets", []), weights, strict=False):
            if not weight:
                continue
            for name, accessor in target.items():
                if name in attributes:
                    attributes[name] = attributes[name] + float(weight) * self.document.accessor(accessor)


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """Return the triangles of a list, a strip or a fan, (N, 3) int32; those of strips and fans without empty ones."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3).astype(np.int32)
    count = max(len(indices) - 2, 0)
    step = np.arange(count)
    if mode == _STRIP:
        # Every other triangle of a strip runs the other way.
        places = np.stack([step, step + 1 + step % 2, step + 2 - step % 2], axis=-1)
    elif mode == _FAN:
        places = np.stack([step + 1, step + 2, np.zeros_like(step)], axis=-1)
    else:
        raise ValueError(f"got the mode {mode!r:.20} of a primitive, expected one from 0 to 6")
    faces = indices[places]
    empty = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return faces[~empty].astype(np.int32)


def _skinned(
    points: np.ndarray, normals: np.ndarray | None, attributes: dict[str, np.ndarray], skin: Skin
) -> tuple[np.ndarray, np.ndarray | None]:
    """Bend points and normals by the joints of a skin, in world space."""
    total = np.zeros((len(points), 4, 4))
    for layer in range(len([name for name in attributes if name.startswith("JOINTS_")])):
        joints, weights = attributes.get(f"JOINTS_{layer}"), attributes.get(f"WEIGHTS_{layer}")
        if joints is None or weights is None:
            continue
        if len(joints) and joints.max() >= len(skin.matrices):
            raise ValueError(f"a vertex names joint {joints.max()}, there are {len(skin.matrices)}")
        for column in range(4):
            total += weights[:, column, None, None] * skin.matrices[joints[:, column].astype(np.int64)]
    # Vertices that no joint holds stay where they are.
    total[total[:, 3, 3] == 0.0] = np.eye(4)
    bent = np.einsum("vij,vj->vi", total[:, :3, :3], points) + total[:, :3, 3]
    if normals is None:
        return bent, None
    return bent, np.einsum("vij,vj->vi", total[:, :3, :3], normals)
