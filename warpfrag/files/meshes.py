"""Mesh files into meshes: ply, obj, stl, off, glb, gltf and usd, each by the reader of its format.

A file is one mesh with the transforms of its scene graph, or one for each of its nodes or groups. What the parts look
like is kept: colour factors and vertex colours as colour per vertex (or one, where all agree), every image as an image
of its own with an index per face. Colours are made linear: colours of ply, obj, off and stl, materials of mtl files and
all images are sRGB; glTF factors and vertex colours and USD colours are linear already. Opacity follows glTF's
alphaMode; other formats use their alpha as it is. Files that a mesh file names are read only below the root folder.
Whatever is left out is named in one warning a file.
"""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpfrag.errors import suggest
from warpfrag.files.gltf import read_gltf
from warpfrag.files.obj import read_obj
from warpfrag.files.off import read_off
from warpfrag.files.ply_meshes import read_ply_mesh
from warpfrag.files.source import Source, check_regular, wording_of_path
from warpfrag.files.stl import read_stl
from warpfrag.files.table import LARGEST
from warpfrag.files.usd import read_usd
from warpfrag.shapes.mesh import Mesh, join

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
_READERS: dict[str, Callable[[Source], tuple[list[Mesh], str]]] = {
    ".ply": read_ply_mesh,
    ".stl": read_stl,
    ".off": read_off,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    **dict.fromkeys(USD_SUFFIXES, read_usd),
}
MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf", *USD_SUFFIXES)


def load_mesh(path: str | os.PathLike, root: str | os.PathLike | None = None) -> Mesh:
    """Read a mesh file as one mesh.

    Args:
        path: a file with one of `MESH_SUFFIXES`, or `"warp:<name>"` for an asset of the Warp wheel.
        root: folder outside of which nothing is read for this mesh (materials, buffers, images, references); default
            the file's own folder.

    Raises:
        ValueError: the file is missing, of an unknown kind, unreadable, or holds no triangles (one line each).
        ImportError: its reader is not installed (named, with the command that installs it).
    """
    return join(_read(path, root, split=False))


def load_parts(path: str | os.PathLike, root: str | os.PathLike | None = None) -> list[Mesh]:
    """Read a mesh file as one mesh for each node (glTF, USD) or group (obj), with names of their own.

    Args:
        path: as for `load_mesh`.
        root: as for `load_mesh`.

    Raises:
        ValueError: as for `load_mesh`.
        ImportError: as for `load_mesh`.
    """
    return _read(path, root, split=True)


def _read(path: str | os.PathLike, root: str | os.PathLike | None, *, split: bool) -> list[Mesh]:
    if str(path).startswith("warp:"):
        path = warp_asset(str(path))
        root = path.parent
    path = Path(path)
    name, suffix = wording_of_path(path), path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        expected = ", ".join(MESH_SUFFIXES)
        raise ValueError(f"got the mesh file {name} of an unknown kind, expected one of {expected}")
    check_regular(path, "a mesh file")
    source = Source(path, Path(root) if root is not None else path.parent)
    try:
        # Broken files make NumPy warn, before they fail or are refused below.
        with np.errstate(all="ignore"):
            parts, holds = read_obj(source, split=split) if suffix == ".obj" else _READERS[suffix](source)
            _check(parts)
    except (ImportError, MemoryError):
        raise
    # A broken file can fail at any place of a reader.
    except Exception as error:
        words = " ".join(str(error).split())[:300] or type(error).__name__
        reason = words if isinstance(error, (ValueError, OSError)) else f"{type(error).__name__}: {words}"
        left_out = f": {source.wording()}" if source.wording() else ""
        kind = "USD" if suffix in USD_SUFFIXES else suffix[1:]
        article = "an" if kind in ("obj", "stl", "off") else "a"
        raise ValueError(f"got {article} {kind} file that cannot be read: {name} ({reason}){left_out}") from error
    if not parts:
        raise ValueError(f"got no faces in {name}{holds}, expected a mesh with triangles")
    source.warn()
    return parts


def warp_asset(name: str) -> Path:
    """Return where `"warp:<file>"` lies among the example assets of the Warp wheel.

    Raises:
        ValueError: there is no such asset.
    """
    spec = importlib.util.find_spec("warp")
    folder = Path(spec.origin if spec and spec.origin else ".").parent / "examples" / "assets"
    names = [entry.name for entry in folder.iterdir() if entry.is_file()] if folder.is_dir() else []
    stem = name.removeprefix("warp:")
    if stem not in names:
        meshes = [entry for entry in names if entry.endswith(MESH_SUFFIXES)]
        raise ValueError(f'got no "{stem}" among the assets of Warp; {suggest(stem, meshes)}')
    return folder / stem


def _check(parts: list[Mesh]) -> None:
    for part in parts:
        if not len(part.vertices):
            continue
        # NaN and infinity are found in the least and the largest of all as well.
        farthest = max(-float(part.vertices.min()), float(part.vertices.max()))
        if not np.isfinite(farthest):
            raise ValueError("a vertex is not finite")
        if farthest > LARGEST:
            raise ValueError(f"a vertex is at {farthest:.3g}, expected at most {LARGEST:.3g}")
