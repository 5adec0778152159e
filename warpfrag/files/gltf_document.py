"""A glTF 2.0 document: its JSON, its buffers, and its accessors as arrays.

What a file requires and this reader lacks is refused by name; what it only uses is noted as left out.
"""

import base64
import binascii
import json
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np

from warpfrag.extras import need
from warpfrag.files.source import MOST_BYTES, Source, read_regular

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
DRACO = "KHR_draco_mesh_compression"
_READ = {
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "EXT_texture_avif",
    "KHR_node_visibility",
    "KHR_materials_pbrSpecularGlossiness",
    DRACO,
}
# They concern neither the shape nor the colour of surfaces.
_HARMLESS = {"KHR_xmp", "KHR_xmp_json_ld", "KHR_animation_pointer", "KHR_materials_ior", "EXT_structural_metadata"}
_GLB_JSON, _GLB_BINARY = 0x4E4F534A, 0x004E4942


class Document:
    """A glTF file.

    Attributes:
        data: the JSON.
        source: the file, which knows what is left out of it.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        content = source.read()
        self._binary: bytes | None = None
        if content[:4] == b"glTF":
            content, self._binary = _glb_chunks(content)
        try:
            self.data: dict[str, Any] = json.loads(content.decode("utf-8-sig"))
        except RecursionError as error:
            raise ValueError("its JSON is nested too deeply") from error
        if not isinstance(self.data, dict):
            raise ValueError("its JSON is not an object")
        version = str(self._table(self.data, "asset").get("version", ""))
        if not version.startswith("2."):
            raise ValueError(f"got glTF version {version or 'none'}, expected 2.0")
        self._check_extensions()
        self._buffers: dict[int, bytes] = {}
        self._size = 0

    def entries(self, kind: str) -> list[Any]:
        """Return a list of the document, such as its "nodes"; empty where it is absent."""
        entries = self.data.get(kind, [])
        if not isinstance(entries, list):
            raise ValueError(f'got {type(entries).__name__} for "{kind}", expected a list')
        return entries

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """Return one entry of a list of the document.

        Raises:
            ValueError: there is none of this index.
        """
        entries = self.entries(kind)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(entries):
            raise ValueError(f'got the index {index} into "{kind}", of which there are {len(entries)}')
        if not isinstance(entries[index], dict):
            raise ValueError(f'got {type(entries[index]).__name__} in "{kind}", expected an object')
        return entries[index]

    def extension(self, entry: dict[str, Any], name: str) -> dict[str, Any] | None:
        """Return an extension of an entry; None without."""
        return self._table(entry, "extensions").get(name)

    def accessor(self, index: Any, *, normalized: bool | None = None) -> np.ndarray:
        """Read an accessor.

        Args:
            index: which one.
            normalized: whether whole numbers are shares of their type's largest; None as the accessor says.

        Returns:
            (count, width), or (count,) of a scalar: float64 for floats and shares, else int64.

        Raises:
            ValueError: it reaches beyond its buffer, or names what is not there.
        """
        accessor = self.entry("accessors", index)
        count, kind = accessor.get("count", 0), _COMPONENTS.get(accessor.get("componentType", 0))
        width = _WIDTHS.get(accessor.get("type", ""))
        if kind is None or width is None or not isinstance(count, int) or count < 0:
            raise ValueError(f"got accessor {index} of an unknown type or count")
        if accessor.get("bufferView") is None:
            if count * width * 8 > MOST_BYTES:
                raise ValueError(f"got {count} entries in accessor {index}, expected what fits into {MOST_BYTES} bytes")
            stored = np.zeros((count, width), dtype=kind)
        else:
            stored = self._stored(accessor["bufferView"], accessor.get("byteOffset", 0), count, width, kind)
        sparse = accessor.get("sparse")
        if sparse is not None:
            stored = self._with_sparse(stored, sparse, width, kind)
        shares = accessor.get("normalized", False) if normalized is None else normalized
        values = _as_numbers(stored, shares)
        return values[:, 0] if width == 1 else values

    def bytes_of_view(self, index: Any) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.entry("bufferViews", index)
        if self.extension(view, "EXT_meshopt_compression"):
            raise ValueError("got data compressed by EXT_meshopt_compression, which is not supported")
        data = self._buffer(view.get("buffer"))
        start, length = _whole(view, "byteOffset"), _whole(view, "byteLength")
        if start + length > len(data):
            raise ValueError(f"got buffer view {index} that ends beyond its buffer")
        return data[start : start + length]

    def bytes_of_uri(self, uri: str) -> bytes | None:
        """Return what a URI names, a file below the root folder or its own data; None, and noted, if it is missing."""
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                return base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)
            except binascii.Error as error:
                raise ValueError("got data in a URI that is not base64") from error
        path = self.source.find(uri)
        return None if path is None else read_regular(path, "a file of a glTF")

    def _check_extensions(self) -> None:
        required = [name for name in self.entries("extensionsRequired") if isinstance(name, str)]
        used = [name for name in self.entries("extensionsUsed") if isinstance(name, str)]
        missing = [name for name in required if name not in _READ | _HARMLESS | {"KHR_materials_unlit"}]
        if missing:
            raise ValueError(f"it requires {', '.join(missing)}, which is not supported")
        if DRACO in required:
            need("DracoPy", "draco", "A mesh compressed by Draco")
        dropped = [name for name in dict.fromkeys(used) if name not in _READ | _HARMLESS]
        if dropped:
            verb = "is" if len(dropped) == 1 else "are"
            self.source.note(f"{', '.join(dropped)} {verb} not supported, drawn without")

    def _buffer(self, index: Any) -> bytes:
        buffer = self.entry("buffers", index)
        if index not in self._buffers:
            uri = buffer.get("uri")
            data = self.bytes_of_uri(uri) if isinstance(uri, str) else self._binary if index == 0 else None
            if data is None:
                raise ValueError(f"the data of buffer {index} is missing")
            self._size += len(data)
            if self._size > MOST_BYTES:
                raise ValueError(f"got buffers of {self._size} bytes, expected at most {MOST_BYTES}")
            self._buffers[index] = data
        return self._buffers[index]

    def _stored(self, view_index: Any, offset: int, count: int, width: int, kind: str) -> np.ndarray:
        view = self.entry("bufferViews", view_index)
        data = self.bytes_of_view(view_index)
        item = np.dtype(kind).itemsize * width
        stride = view.get("byteStride") or item
        if not isinstance(stride, int) or stride < item or not isinstance(offset, int) or offset < 0:
            raise ValueError(f"got buffer view {view_index} with a stride or an offset that cannot be")
        if count and offset + (count - 1) * stride + item > len(data):
            raise ValueError(f"got {count} entries in buffer view {view_index}, which is too short for them")
        strides = (stride, np.dtype(kind).itemsize)
        return (
            np.ndarray((count, width), kind, data, offset if count else 0, strides) if count else np.zeros((0, width))
        )

    def _with_sparse(self, stored: np.ndarray, sparse: dict[str, Any], width: int, kind: str) -> np.ndarray:
        count, indices, values = _whole(sparse, "count"), sparse["indices"], sparse["values"]
        places = self._stored(
            indices["bufferView"], indices.get("byteOffset", 0), count, 1, _COMPONENTS[indices["componentType"]]
        )[:, 0].astype(np.int64)
        if count and places.max() >= len(stored):
            raise ValueError(f"got a sparse value for entry {places.max()} of {len(stored)}")
        result = stored.copy()
        result[places] = self._stored(values["bufferView"], values.get("byteOffset", 0), count, width, kind)
        return result

    @staticmethod
    def _table(entry: dict[str, Any], key: str) -> dict[str, Any]:
        table = entry.get(key, {})
        return table if isinstance(table, dict) else {}


def _glb_chunks(content: bytes) -> tuple[bytes, bytes | None]:
    if len(content) < 20 or int.from_bytes(content[4:8], "little") != 2:
        raise ValueError(f"got GLB version {int.from_bytes(content[4:8], 'little')}, expected 2")
    chunks: dict[int, bytes] = {}
    place = 12
    while place + 8 <= len(content):
        length, kind = (int.from_bytes(content[at : at + 4], "little") for at in (place, place + 4))
        if place + 8 + length > len(content):
            raise ValueError("got a GLB file that ends within a chunk")
        chunks.setdefault(kind, content[place + 8 : place + 8 + length])
        place += 8 + length
    if _GLB_JSON not in chunks:
        raise ValueError("got a GLB file without JSON")
    return chunks[_GLB_JSON], chunks.get(_GLB_BINARY)


def _whole(entry: dict[str, Any], key: str) -> int:
    value = entry.get(key, 0)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f'got {value!r:.40} for "{key}", expected a whole number')
    return value


def _as_numbers(stored: np.ndarray, shares: bool) -> np.ndarray:
    if stored.dtype.kind == "f":
        return stored.astype(np.float64)
    if not shares:
        return stored.astype(np.int64)
    return np.maximum(stored / float(np.iinfo(stored.dtype).max), -1.0)
