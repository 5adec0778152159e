"""Mesh files into one `Mesh` each: ply, obj, stl, off, glb and gltf here, usd in its own file.

All parts of a file become one mesh, with the transforms of its scene graph. What the parts look like is kept: colour
factors and vertex colours as colour per vertex (or one, where all agree), every image as an image of its own with an
index per face. Colours are made linear: 8-bit colours of ply and obj, materials of mtl files and all images are sRGB;
glTF factors and vertex colours are linear already. Opacity follows glTF's alphaMode: OPAQUE is 1, MASK 0 or 1 by its
cutoff, BLEND the alpha; other formats use their alpha as it is (mtl: d, Tr). Nothing is merged or reordered, but the
vertices of stl files, which repeat for every triangle. Files that a mesh file names are read only below the root
folder; what is missing there is left out with a warning.
"""

import importlib.util
import io
import json
import os
import warnings
from pathlib import Path, PureWindowsPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from warpfrag.colors import srgb_to_linear
from warpfrag.errors import suggest
from warpfrag.files.pixels import of_pillow, with_opacity
from warpfrag.shapes.mesh import Mesh, join, split_faces, transformed_normals, weld

TRIMESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def load_mesh(path: str | os.PathLike, root: str | os.PathLike | None = None) -> Mesh:
    """Read a mesh file.

    Args:
        path: A file with one of the suffixes above, or `"warp:<name>"` for an asset of the Warp wheel.
        root: Folder outside of which nothing is read for this mesh (materials, buffers, images, references); default
            the file's own folder.

    Raises:
        ValueError: The file is missing, of an unknown kind, unreadable, or holds no triangles (one line each).
        ImportError: Its reader is not installed (named, with the command that installs it).
    """
    if str(path).startswith("warp:"):
        path = warp_asset(str(path))
        root = path.parent
    path = Path(path)
    root = Path(root) if root is not None else path.parent
    suffix = path.suffix.lower()
    if suffix not in TRIMESH_SUFFIXES + USD_SUFFIXES:
        expected = ", ".join(TRIMESH_SUFFIXES + USD_SUFFIXES)
        raise ValueError(f"got the mesh file {path} of an unknown kind, expected one of {expected}")
    if not path.is_file():
        got = "a folder" if path.is_dir() else "no such file"
        raise ValueError(f"got {got} at {path}{_near(path)}, expected a mesh file")
    if suffix in USD_SUFFIXES:
        from warpfrag.files.usd import load_usd

        parts, holds = load_usd(path, root)
    else:
        parts, holds = _load_trimesh(path, root)
    if not parts:
        raise ValueError(f"got no faces in {path}{holds}, expected a mesh with triangles")
    return join(parts)


def warp_asset(name: str) -> Path:
    """Return where `"warp:<file>"` lies among the example assets of the Warp wheel.

    Raises:
        ValueError: There is no such asset.
    """
    spec = importlib.util.find_spec("warp")
    folder = Path(spec.origin if spec and spec.origin else ".").parent / "examples" / "assets"
    names = [entry.name for entry in folder.iterdir() if entry.is_file()] if folder.is_dir() else []
    stem = name.removeprefix("warp:")
    if stem not in names:
        meshes = [entry for entry in names if entry.endswith(TRIMESH_SUFFIXES + USD_SUFFIXES)]
        raise ValueError(f'got no "{stem}" among the assets of Warp; {suggest(stem, meshes)}')
    return folder / stem


def _near(path: Path) -> str:
    if not path.parent.is_dir():
        return ""
    names = [entry.name for entry in path.parent.iterdir()]
    hint = suggest(path.name, names)
    return f" ({hint})" if hint.startswith("did") else ""


def _load_trimesh(path: Path, root: Path) -> tuple[list[Mesh], str]:
    import trimesh

    resolver = _Resolver(path, root)
    suffix = path.suffix.lower()
    content = path.read_bytes()
    try:
        with warnings.catch_warnings():
            # Broken files make NumPy warn inside the reader, before they fail or are refused below.
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(io.BytesIO(content), file_type=suffix[1:], resolver=resolver, process=False)
            factors = _gltf_factors(content) if suffix in (".glb", ".gltf") else []
            images: dict = {}
            parts = []
            for node in _in_file_order(scene, suffix):
                matrix, geometry = scene.graph[node]
                part = scene.geometry[geometry]
                if isinstance(part, trimesh.Trimesh) and len(part.faces):
                    parts.append(_part(part, np.asarray(matrix), suffix, factors, images))
    except Exception as error:
        because = str(error).strip().splitlines()
        reason = f" ({because[0][:120]})" if because else f" ({type(error).__name__})"
        raise ValueError(
            f"got a {suffix[1:]} file that cannot be read: {path}{reason}{resolver.complaint()}"
        ) from error
    if resolver.complaint():
        warnings.warn(f"{path}{resolver.complaint()}", stacklevel=4)
    kinds = sorted({type(item).__name__ for item in scene.geometry.values() if not isinstance(item, trimesh.Trimesh)})
    return parts, f" (it holds {', '.join(kinds)})" if kinds else ""


def _in_file_order(scene: Any, suffix: str) -> list[str]:
    """Order the nodes that hold geometry by their mesh's place in the file, then as the scene graph has them."""
    # trimesh walks graphs, and reads the parts of an obj, from the last to the first.
    names = list(scene.geometry)
    place = {name: index for index, name in enumerate(names[::-1] if suffix == ".obj" else names)}
    nodes = list(scene.graph.nodes_geometry)[::-1]
    return sorted(nodes, key=lambda node: place[scene.graph[node][1]])


def _part(part: Any, matrix: np.ndarray, suffix: str, factors: list, images: dict) -> Mesh:
    vertices = np.asarray(part.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(part.faces).astype(np.int32)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"a face names vertex {faces.max()}, there are {len(vertices)}")
    if not np.isfinite(vertices).all():
        raise ValueError("a vertex is not finite")
    # Only the cache tells the file's own normals from those that trimesh would compute.
    normals = part._cache.cache.get("vertex_normals")
    if suffix in (".stl", ".off") or normals is None or not np.isfinite(normals).all():
        normals = None
    else:
        normals = transformed_normals(np.asarray(normals, dtype=np.float64), matrix)
    mesh = Mesh(vertices, faces, normals)
    if suffix == ".stl":
        mesh = Mesh(*weld(vertices, faces))
    return _with_visual(mesh, part.visual, suffix in (".glb", ".gltf"), factors, images)


def _with_visual(mesh: Mesh, visual: Any, linear: bool, factors: list, images: dict) -> Mesh:
    to_linear = np.asarray if linear else srgb_to_linear
    rgba = None
    if visual.kind == "face" and len(visual.face_colors) == len(mesh.faces):
        mesh = split_faces(mesh)
        rgba = np.repeat(visual.face_colors, 3, axis=0) / 255.0
    elif visual.kind == "vertex" and len(visual.vertex_colors) == len(mesh.vertices):
        rgba = np.asarray(visual.vertex_colors) / 255.0
    elif visual.kind == "texture":
        return _with_material(mesh, visual, linear, factors, images)
    if rgba is None:
        return mesh
    return _replaced(mesh, color=to_linear(rgba[:, :3]), opacity=rgba[:, 3])


def _with_material(mesh: Mesh, visual: Any, linear: bool, factors: list, images: dict) -> Mesh:
    material = visual.material
    color: np.ndarray | None
    mode, cutoff = "BLEND", 0.0
    if hasattr(material, "alphaMode"):
        factor = _pbr_factor(material, factors)
        color, alpha, image = factor[:3], float(factor[3]), material.baseColorTexture
        mode = material.alphaMode or "OPAQUE"
        cutoff = 0.5 if material.alphaCutoff is None else float(material.alphaCutoff)
    else:
        color, alpha = _simple_factor(material)
        image = getattr(material, "image", None)
    vertex = visual.vertex_attributes.get("color") if hasattr(visual, "vertex_attributes") else None
    opacity: float | np.ndarray = alpha
    if vertex is not None and len(vertex) == len(mesh.vertices):
        vertex = np.asarray(vertex)
        scale = np.iinfo(vertex.dtype).max if np.issubdtype(vertex.dtype, np.integer) else 1.0
        vertex = vertex / scale
        color = (np.ones(3) if color is None else color) * (vertex[:, :3] if linear else srgb_to_linear(vertex[:, :3]))
        if vertex.shape[1] == 4:
            opacity = alpha * np.clip(vertex[:, 3], 0.0, 1.0)
    uv = visual.uv
    textured = image is not None and uv is not None and len(uv) == len(mesh.vertices) and np.isfinite(uv).all()
    if mode == "OPAQUE":
        opacity = 1.0
    elif mode == "MASK" and not textured:
        opacity = (np.asarray(opacity) >= cutoff) * 1.0
    if not textured:
        return _replaced(mesh, color=color, opacity=opacity)
    key = id(image), mode, cutoff, alpha if mode == "MASK" else 1.0
    if key not in images:
        pixels = with_opacity(of_pillow(image, managed=False))
        if mode == "OPAQUE":
            pixels[..., 3] = 1.0
        elif mode == "MASK":
            pixels[..., 3] = pixels[..., 3] * alpha >= cutoff
        # The image is kept beside its pixels, so that its id is not used again.
        images[key] = pixels, image
    if mode == "MASK":
        opacity = 1.0
    color = np.ones(3) if color is None else color
    return _replaced(mesh, color=color, opacity=opacity, uv=np.asarray(uv, dtype=np.float32), textures=[images[key][0]])


def _replaced(mesh: Mesh, *, color, opacity, uv=None, textures=None) -> Mesh:
    color = None if color is None else np.maximum(np.asarray(color, dtype=np.float64), 0.0)
    if isinstance(opacity, np.ndarray) and opacity.ndim and opacity.min() == opacity.max():
        opacity = opacity[0]
    opacity = float(opacity) if np.ndim(opacity) == 0 else opacity
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, color, opacity, uv, textures or [])


def _simple_factor(material: Any) -> tuple[np.ndarray | None, float]:
    """Return an mtl material's linear Kd and its opacity; no colour for a material that was never given one."""
    given = getattr(material, "kwargs", None) or {}
    alpha = 1.0
    for key, flip in (("d", False), ("tr", True)):
        try:
            value = float(np.ravel(given[key])[-1])
            alpha = 1.0 - value if flip else value
            break
        except (KeyError, IndexError, ValueError):
            continue
    alpha = min(max(alpha, 0.0), 1.0)
    diffuse = given.get("kd")
    if diffuse is not None and np.size(diffuse) == 3:
        return srgb_to_linear(np.clip(np.asarray(diffuse, dtype=np.float64), 0.0, 1.0)), alpha
    return None, alpha


def _pbr_factor(material: Any, factors: list) -> np.ndarray:
    """Return a glTF base colour factor, exact where the file's JSON tells what trimesh has rounded to 8 bits."""
    rounded = material.baseColorFactor
    if rounded is None:
        return np.ones(4)
    rounded = np.asarray(rounded)
    scale = 255.0 if np.issubdtype(rounded.dtype, np.integer) else 1.0
    value = np.ones(4)
    value[: rounded.size] = rounded.reshape(-1) / scale
    for name, factor in factors:
        if name == material.name and np.abs(factor - value).max() <= 0.5001 / 255.0:
            return factor
    return value


def _gltf_factors(content: bytes) -> list[tuple[str | None, np.ndarray]]:
    """Read (name, base colour factor) of the materials from the JSON of a glb or gltf file."""
    if content[:4] == b"glTF":
        length = int.from_bytes(content[12:16], "little")
        content = content[20 : 20 + length]
    materials = json.loads(content).get("materials", [])
    result = []
    for material in materials:
        factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor")
        if factor is not None and np.shape(factor) == (4,):
            result.append((material.get("name"), np.asarray(factor, dtype=np.float64)))
    return result


class _Resolver:
    """Gives trimesh the files that a mesh file names, as long as they lie below the root folder."""

    def __init__(self, path: Path, root: Path) -> None:
        self.file_name = path.name
        self.folder = path.parent
        self.root = root.resolve()
        self.missing: list[str] = []
        self.outside: list[str] = []

    def get(self, name: str) -> bytes:
        name = name.strip()
        # Exporters write percent-encoded names, backslashes, and absolute paths of their own machine.
        candidates = [name, unquote(name), name.replace("\\", "/"), PureWindowsPath(name).name]
        outside = False
        for candidate in candidates:
            path = (self.folder / candidate).resolve()
            if not path.is_relative_to(self.root):
                outside = True
            elif path.is_file():
                return path.read_bytes()
        (self.outside if outside else self.missing).append(name)
        raise FileNotFoundError(name)

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)

    def complaint(self) -> str:
        """Word what could not be read, or nothing."""
        words = []
        for names, what, where in (
            (self.missing, "cannot find", ""),
            (self.outside, "does not read", f" outside of {self.root}"),
        ):
            unique = list(dict.fromkeys(names))
            more = f" and {len(unique) - 3} more" if len(unique) > 3 else ""
            if unique:
                words.append(f"{what} {', '.join(unique[:3])}{more}{where}")
        return ": " + "; ".join(words) if words else ""
