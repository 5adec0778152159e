"""glTF 2.0 files (glb, gltf): the default scene's nodes, each a mesh in its place, as the specification says.

Read: accessors of all kinds (sparse and quantised too), all modes of triangles, morph targets and skins at rest,
instances, materials' base colour (factors, vertex colours, images with their samplers and transforms), alpha modes,
Draco. Not read, as nothing here would draw it: normal, metal, roughness and occlusion maps, cameras, animations.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from warpfrag.files.gltf_document import Document
from warpfrag.files.gltf_primitives import Primitives, Skin
from warpfrag.files.source import Source
from warpfrag.shapes.mesh import Mesh, join, placed

# Of all instances together; more do not fit into memory.
MOST_FACES = 2**26


def read_gltf(source: Source) -> tuple[list[Mesh], str]:
    """Read the meshes of a glTF file, one for each node that has triangles, with the node's name.

    Returns:
        The meshes in world space, and words about what else the file holds.

    Raises:
        ValueError: the file cannot be read, or requires what is not supported.
        ImportError: it is compressed by Draco, and DracoPy is not installed.
    """
    document = Document(source)
    primitives = Primitives(document)
    matrices = dict(_nodes(document))
    parts: list[Mesh] = []
    count = 0
    for index, world in matrices.items():
        node = document.entry("nodes", index)
        if "mesh" not in node:
            continue
        skin = _skin(document, node["skin"], matrices) if "skin" in node else None
        meshes = primitives.of_mesh(node["mesh"], node.get("weights"), skin)
        instances = _instances(document, node)
        count += sum(len(mesh.faces) for mesh in meshes) * len(instances)
        if count > MOST_FACES:
            raise ValueError(f"got more than {MOST_FACES} triangles")
        if skin is not None:
            # The matrices of joints lead to world space by themselves.
            world = np.eye(4)
        pieces = [placed(mesh, world @ instance) for instance in instances for mesh in meshes]
        if pieces:
            mesh_name = document.entry("meshes", node["mesh"]).get("name")
            name = str(node.get("name") or mesh_name or f"node {index}")
            parts.append(replace(join(pieces), name=name))
    if primitives.left_out and parts:
        source.note(f"{' and '.join(sorted(primitives.left_out))} are not drawn")
    return parts, f" (it holds {', '.join(sorted(primitives.left_out))})" if primitives.left_out else ""


def _nodes(document: Document) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the nodes of the default scene with their matrices to world space, parents before children."""
    scenes, nodes = document.entries("scenes"), document.entries("nodes")
    if scenes:
        chosen = document.data.get("scene", 0)
        roots = document.entry("scenes", chosen).get("nodes", [])
        if len(scenes) > 1:
            document.source.note(f"scenes other than scene {chosen} are not drawn")
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    seen: set[int] = set()
    waiting = [(index, np.eye(4)) for index in reversed(roots)]
    while waiting:
        index, above = waiting.pop()
        node = document.entry("nodes", index)
        if index in seen:
            raise ValueError(f"got node {index} in two places of the scene")
        seen.add(index)
        if (document.extension(node, "KHR_node_visibility") or {}).get("visible", True) is False:
            continue
        world = above @ _matrix(node)
        yield index, world
        waiting += [(child, world) for child in reversed(node.get("children", []))]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        matrix = np.asarray(node["matrix"], dtype=np.float64).reshape(4, 4).T
    else:
        matrix = _transforms(
            np.asarray([node.get("translation", (0.0, 0.0, 0.0))], dtype=np.float64),
            np.asarray([node.get("rotation", (0.0, 0.0, 0.0, 1.0))], dtype=np.float64),
            np.asarray([node.get("scale", (1.0, 1.0, 1.0))], dtype=np.float64),
        )[0]
    if not np.isfinite(matrix).all():
        raise ValueError("got a transform that is not finite")
    return matrix


def _transforms(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the matrices of translations (N, 3), unit quaternions (N, 4; real part last) and scales (N, 3)."""
    x, y, z, w = (rotation / np.maximum(np.linalg.norm(rotation, axis=1, keepdims=True), 1e-300)).T
    matrices = np.zeros((len(translation), 4, 4))
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    for row, entries in enumerate(rows):
        matrices[:, row, :3] = np.stack(entries, axis=-1) * scale
    matrices[:, :3, 3] = translation
    matrices[:, 3, 3] = 1.0
    return matrices


def _instances(document: Document, node: dict[str, Any]) -> np.ndarray:
    """Return the matrices of a node's instances, (N, 4, 4); one that changes nothing without."""
    instancing = document.extension(node, "EXT_mesh_gpu_instancing")
    if instancing is None:
        return np.eye(4)[None]
    given = {name: document.accessor(index) for name, index in instancing.get("attributes", {}).items()}
    count = max((len(values) for values in given.values()), default=0)
    return _transforms(
        given.get("TRANSLATION", np.zeros((count, 3))),
        given.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))),
        given.get("SCALE", np.ones((count, 3))),
    )


def _skin(document: Document, index: int, matrices: dict[int, np.ndarray]) -> Skin | None:
    skin = document.entry("skins", index)
    joints = skin.get("joints", [])
    unknown = [joint for joint in joints if joint not in matrices]
    if unknown or not joints:
        document.source.note("a skin whose joints are not in the scene, drawn without")
        return None
    world = np.stack([matrices[joint] for joint in joints])
    if "inverseBindMatrices" in skin:
        inverse = document.accessor(skin["inverseBindMatrices"])[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        world = world @ inverse
    return Skin(world)
