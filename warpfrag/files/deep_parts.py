"""OpenEXR deep scan lines, from the bytes of a file to arrays of samples: header, chunks, and their compressions.

OpenEXR's own package makes a Python object of every pixel and channel, refuses files with attributes that it does not
know (`deepImageState`), and leaves a part that is cut off out with no more than a word on standard error.

A file is a header of attributes for each part, a table of where chunks begin for each part, and the chunks. Each is a
scan line: the running count of samples by pixel, then channel by channel the samples of all its pixels.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpfrag.files.pixels import check_pixels

# Of one part: 5 GiB of colours, depth and thickness.
MOST_SAMPLES = 2**28
_MAGIC = b"\x76\x2f\x31\x01"
_DEEP, _SEVERAL_PARTS = 0x800, 0x1000
_NUMBERS: dict[int, np.dtype] = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
_NONE, _RLE, _ZIPS = range(3)
_SCALARS = {"int": "<i", "float": "<f", "double": "<d"}
_CUT = "got a file that ends early, expected a whole one"


@dataclass(frozen=True, eq=False)
class Part:
    """The header of one part.

    Attributes:
        name: its name, "" if it has none.
        view: which eye it is for, "" if it does not say.
        kind: "deepscanline", "deeptile", "scanlineimage" or "tiledimage".
        channels: the NumPy types of its channels by name, in the order of the file.
        data_window: first column, first row, last column and last row that it has pixels of.
        display_window: those of the whole image.
        compression: its number in the file.
        attributes: what else it says in texts and numbers, by name.
        chunk_count: number of its chunks.
    """

    name: str
    view: str
    kind: str
    channels: dict[str, np.dtype]
    data_window: tuple[int, int, int, int]
    display_window: tuple[int, int, int, int]
    compression: int
    attributes: dict[str, Any]
    chunk_count: int

    @property
    def is_deep(self) -> bool:
        """Whether its pixels have any number of samples."""
        return self.kind.startswith("deep")


@dataclass(frozen=True, eq=False)
class Samples:
    """The samples of a part.

    Attributes:
        counts: how many each pixel of the data window has, (h, w).
        channels: their values, row by row from the top left, by the name of the channel, (S,) each.
    """

    counts: np.ndarray
    channels: dict[str, np.ndarray]


class DeepFile:
    """A file with deep parts.

    Attributes:
        parts: the headers of its parts.

    Raises:
        ValueError: it is no OpenEXR file, has no deep part, or its header is broken.
    """

    def __init__(self, data: bytes) -> None:
        self._bytes = _Bytes(data)
        if self._bytes.take(4) != _MAGIC:
            raise ValueError("got a file of another kind, expected OpenEXR")
        (flags,) = self._bytes.unpack("<I")
        self._several = bool(flags & _SEVERAL_PARTS)
        if not flags & _DEEP:
            raise ValueError("got a flat image, whose pixels have one sample each, expected a deep one")
        self.parts: list[Part] = []
        while True:
            attributes = dict(self._attributes())
            if self._several and not attributes:
                break
            self.parts.append(_part(attributes))
            if not self._several:
                break
        self._tables = [self._bytes.array("<u8", part.chunk_count) for part in self.parts]

    def read(self, index: int, names: list[str]) -> Samples:
        """Read some channels of a part of deep scan lines.

        Raises:
            ValueError: the file is cut off or broken, has too many samples, or another compression.
        """
        part = self.parts[index]
        if part.kind != "deepscanline":
            raise ValueError(f"got a part of the kind {part.kind}, expected deepscanline")
        if part.compression not in (_NONE, _RLE, _ZIPS):
            raise ValueError(f"got the compression number {part.compression}, expected none, RLE or ZIPS")
        left, top, right, bottom = part.data_window
        width, height = right - left + 1, bottom - top + 1
        counts = np.zeros((height, width), np.int64)
        rows: list[dict[str, np.ndarray] | None] = [None] * height
        total = 0
        for offset in self._tables[index].tolist():
            y, counts_of_row, data, size = self._chunk(offset, index, part, width)
            if not top <= y <= bottom or rows[y - top] is not None:
                raise ValueError(f"got the scan line {y} twice or outside of the image, expected each once")
            sample_count = int(counts_of_row.sum())
            total += sample_count
            if total > MOST_SAMPLES:
                raise ValueError(f"got more than {MOST_SAMPLES} samples, expected at most so many")
            if size != sample_count * sum(dtype.itemsize for dtype in part.channels.values()):
                raise ValueError(f"got scan line {y} of {size} bytes, expected {sample_count} samples of its channels")
            counts[y - top] = counts_of_row
            rows[y - top] = _divided(_unpacked(data, size, part.compression), part.channels, names, sample_count)
        if any(row is None for row in rows):
            raise ValueError(_CUT)
        return Samples(counts, {name: np.concatenate([row[name] for row in rows if row is not None]) for name in names})

    def _attributes(self) -> Iterator[tuple[str, tuple[str, bytes]]]:
        """Yield name, type and value of the attributes of the next header."""
        while name := self._bytes.text():
            kind = self._bytes.text()
            (size,) = self._bytes.unpack("<i")
            yield name, (kind, self._bytes.take(size))

    def _chunk(self, offset: int, index: int, part: Part, width: int) -> tuple[int, np.ndarray, bytes, int]:
        """Return the line of a chunk, how many samples its pixels have, its packed data and their size unpacked."""
        source = self._bytes
        # Where nothing has been written yet, the table says 0.
        if offset == 0:
            raise ValueError(_CUT)
        source.place = offset
        if self._several and source.unpack("<i") != (index,):
            raise ValueError("got a chunk of another part, expected one of each part's own")
        y, table_size, data_size, size = source.unpack("<iQQQ")
        table = _unpacked(source.take(table_size), 4 * width, part.compression)
        running = np.frombuffer(table, "<i4")
        counts = running.copy()
        counts[1:] -= running[:-1]
        if (counts < 0).any():
            raise ValueError(f"got counts of samples that fall in scan line {y}, expected running ones")
        return y, counts, source.take(data_size), size


class _Bytes:
    """The bytes of a file, read one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.place = data, 0

    def take(self, size: int) -> bytes:
        """Return the next bytes."""
        if size < 0 or self.place + size > len(self.data):
            raise ValueError(_CUT)
        self.place += size
        return self.data[self.place - size : self.place]

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """Return the next numbers."""
        return struct.unpack(layout, self.take(struct.calcsize(layout)))

    def array(self, dtype: str, count: int) -> np.ndarray:
        """Return the next numbers as an array."""
        return np.frombuffer(self.take(count * np.dtype(dtype).itemsize), dtype)

    def text(self) -> str:
        """Return the next text, which ends with a zero."""
        end = self.data.find(b"\0", self.place)
        if end < 0:
            raise ValueError(_CUT)
        return self.take(end + 1 - self.place)[:-1].decode(errors="replace")


def _part(attributes: dict[str, tuple[str, bytes]]) -> Part:
    values = {name: _value(kind, value) for name, (kind, value) in attributes.items()}
    missing = {"channels", "dataWindow", "displayWindow", "compression"} - {
        n for n, v in values.items() if v is not None
    }
    if missing:
        raise ValueError(f"got a header without {', '.join(sorted(missing))}, expected a whole one")
    data, display = values["dataWindow"], values["displayWindow"]
    for left, top, right, bottom in (data, display):
        check_pixels(right - left + 1, bottom - top + 1)
    kind, chunk_count = values.get("type") or "scanlineimage", values.get("chunkCount")
    if not isinstance(chunk_count, int) or chunk_count < 0:
        raise ValueError("got a header without chunkCount, expected a whole one")
    if kind == "deepscanline" and chunk_count != data[3] - data[1] + 1:
        raise ValueError(f"got {chunk_count} chunks, expected one for each of {data[3] - data[1] + 1} scan lines")
    told = {
        name: value
        for name, value in values.items()
        if isinstance(value, (str, float, int)) and name not in _OF_THE_PART
    }
    return Part(
        name=str(values.get("name") or ""),
        view=str(values.get("view") or ""),
        kind=str(kind),
        channels=values["channels"],
        data_window=data,
        display_window=display,
        compression=values["compression"],
        attributes=told,
        chunk_count=chunk_count,
    )


# Not about the image but about how it lies in the file.
_OF_THE_PART = ("name", "type", "version", "chunkCount", "view", "compression", "maxSamplesPerPixel")


def _value(kind: str, value: bytes) -> Any:
    """Return an attribute's value, or None for one of a type that nothing is done with."""
    if kind == "string":
        return value.decode(errors="replace")
    if kind in _SCALARS and len(value) == struct.calcsize(_SCALARS[kind]):
        return struct.unpack(_SCALARS[kind], value)[0]
    if kind == "box2i" and len(value) == 16:
        return struct.unpack("<4i", value)
    if kind == "compression" and len(value) == 1:
        return value[0]
    return _channels(value) if kind == "chlist" else None


def _channels(value: bytes) -> dict[str, np.dtype]:
    source, channels = _Bytes(value), dict[str, np.dtype]()
    while name := source.text():
        number, _, across, down = source.unpack("<4i")
        if number not in _NUMBERS or (across, down) != (1, 1):
            raise ValueError(f'got the channel "{name}" of type {number}, sampled {across} × {down}, expected 1 × 1')
        channels[name] = _NUMBERS[number]
    return channels


def _divided(data: bytes, channels: dict[str, np.dtype], names: list[str], sample_count: int) -> dict[str, np.ndarray]:
    """Return the wanted channels of a scan line."""
    place, found = 0, dict[str, np.ndarray]()
    for name, dtype in channels.items():
        if name in names:
            found[name] = np.frombuffer(data, dtype, sample_count, place)
        place += sample_count * dtype.itemsize
    return found


def _unpacked(data: bytes, size: int, compression: int) -> bytes:
    """Return packed bytes unpacked; those that packing would not have made fewer are stored as they are."""
    if len(data) == size:
        return data
    if compression == _NONE or len(data) > size:
        raise ValueError(f"got {len(data)} bytes of a scan line, expected {size}")
    raw = _run_lengths(data, size) if compression == _RLE else _inflated(data, size)
    if len(raw) != size:
        raise ValueError(f"got {len(raw)} bytes of a scan line, expected {size}")
    # Differences of neighbours, from which 128 was added; then every other byte, and the others.
    steps = np.frombuffer(raw, np.uint8).copy()
    steps[1:] -= 128
    values = np.cumsum(steps, dtype=np.uint8)
    bytes_in_order = np.empty(size, np.uint8)
    half = (size + 1) // 2
    bytes_in_order[0::2], bytes_in_order[1::2] = values[:half], values[half:]
    return bytes_in_order.tobytes()


def _inflated(data: bytes, size: int) -> bytes:
    """Inflate bytes, but not to more than was announced."""
    try:
        return zlib.decompressobj().decompress(data, size)
    except zlib.error as error:
        raise ValueError(f"got a scan line that cannot be unpacked ({error})") from error


def _run_lengths(data: bytes, size: int) -> bytes:
    """Unpack runs: a number of bytes that follow, negative, or how often more the next byte comes."""
    pieces, place, length = [], 0, 0
    while place + 1 < len(data) and length < size:
        run = data[place] - 256 if data[place] > 127 else data[place]
        piece = data[place + 1 : place + 1 - run] if run < 0 else data[place + 1 : place + 2] * (run + 1)
        pieces.append(piece)
        place += 1 - run if run < 0 else 2
        length += len(piece)
    return b"".join(pieces)
