"""The PLY format: elements of scalar and list properties, in text or in binary of either byte order."""

import warnings
from dataclasses import dataclass, field

import numpy as np

_KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Lists:
    """A list property: a list of numbers for each entry of its element.

    Attributes:
        counts: length of each list, (N,) int64.
        values: all lists one after the other.
    """

    counts: np.ndarray
    values: np.ndarray

    def first(self) -> np.ndarray:
        """Return where each list begins in `values`, (N,) int64."""
        return np.cumsum(self.counts) - self.counts


@dataclass
class Element:
    """One kind of entries of a file.

    Attributes:
        name: its name, such as "vertex".
        count: number of entries.
        kinds: type of each property as NumPy writes it, and of its counts if it is a list, by the property's name.
        scalars: values of scalar properties in the file's own type, (count,) each.
        lists: values of list properties.
    """

    name: str
    count: int
    kinds: dict[str, tuple[str, str | None]] = field(default_factory=dict)
    scalars: dict[str, np.ndarray] = field(default_factory=dict)
    lists: dict[str, Lists] = field(default_factory=dict)


@dataclass(frozen=True)
class PlyFile:
    """A file's elements by name, and its comments."""

    elements: dict[str, Element]
    comments: list[str]


def read_ply(data: bytes) -> PlyFile:
    """Read a PLY file.

    Raises:
        ValueError: it is no PLY file, its header cannot be understood, or it holds less than its header says.
    """
    order, elements, comments, start = _header(data)
    # Entries that the file is too short for are refused before anything is allocated for them.
    if order:
        for element in elements:
            start = _read_binary(element, data, start, order)
    else:
        lines, place = [line for line in data[start:].splitlines() if line.strip()], 0
        for element in elements:
            place = _read_text(element, lines, place)
    return PlyFile({element.name: element for element in elements}, comments)


def _header(data: bytes) -> tuple[str, list[Element], list[str], int]:
    """Return byte order ("" for text), empty elements, comments, and where the entries begin."""
    end = data.find(b"end_header")
    if not data[:4].strip() == b"ply" or end < 0:
        raise ValueError("got no PLY header")
    start = end + len(b"end_header")
    for ending in (b"\r\n", b"\n", b"\r"):
        if data.startswith(ending, start):
            start += len(ending)
            break
    order: str | None = None
    elements: list[Element] = []
    comments = []
    for line in data[:end].decode("utf-8", "replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"] and len(words) == 3 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif words[:1] in (["comment"], ["obj_info"]):
            comments.append(line.strip().partition(" ")[2])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19:
            elements.append(Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements and _is_property(words):
            kind = _KINDS[words[-2]]
            elements[-1].kinds[words[-1]] = (kind, _KINDS[words[2]] if words[1] == "list" else None)
        elif words:
            raise ValueError(f"got the header line {line.strip()[:60]!r}, which is not PLY's")
    if order is None:
        raise ValueError("got no format in the PLY header")
    return order, elements, comments, start


def _is_property(words: list[str]) -> bool:
    if words[1:2] == ["list"]:
        return len(words) == 5 and words[2] in _KINDS and words[3] in _KINDS and "f" not in _KINDS[words[2]]
    return len(words) == 3 and words[1] in _KINDS


def _read_binary(element: Element, data: bytes, start: int, order: str) -> int:
    """Read an element's entries; return where the next one's begin."""
    sizes = [np.dtype(count or kind).itemsize for kind, count in element.kinds.values()]
    if element.count * sum(sizes) > len(data) - start:
        raise ValueError(f'got a file that ends within its {element.count} entries of "{element.name}"')
    if element.count == 0 or not sizes:
        _leave_empty(element)
        return start
    lengths = _lengths_of_first(element, data, start, order)
    columns: list[tuple] = []
    for (name, (kind, count)), length in zip(element.kinds.items(), lengths, strict=True):
        if count is None:
            columns.append((name, order + kind))
        else:
            columns += [(f"{name} count", order + count), (f"{name} values", order + kind, (length,))]
    table = np.dtype(columns)
    # Lists are as long as those of the first entry almost always: then all entries are one array.
    if element.count * table.itemsize <= len(data) - start:
        rows = np.frombuffer(data, table, element.count, start)
        if all((rows[f"{name} count"] == n).all() for name, n in _list_lengths(element, lengths)):
            for name, (kind, count) in element.kinds.items():
                if count is None:
                    element.scalars[name] = rows[name].astype(kind)
                else:
                    values = rows[f"{name} values"].astype(kind).reshape(-1)
                    element.lists[name] = Lists(rows[f"{name} count"].astype(np.int64), values)
            return start + element.count * table.itemsize
    return _read_entry_by_entry(element, data, start, order)


def _lengths_of_first(element: Element, data: bytes, start: int, order: str) -> list[int]:
    lengths = []
    for kind, count in element.kinds.values():
        if count is None:
            lengths.append(0)
            start += np.dtype(kind).itemsize
            continue
        size = np.dtype(count).itemsize
        if start + size > len(data):
            raise ValueError(f'got a file that ends within the first entry of "{element.name}"')
        lengths.append(int(np.frombuffer(data, order + count, 1, start)[0]))
        start += size + max(lengths[-1], 0) * np.dtype(kind).itemsize
        if lengths[-1] < 0 or start > len(data):
            raise ValueError(f'got a list of {lengths[-1]} numbers in the first entry of "{element.name}"')
    return lengths


def _list_lengths(element: Element, lengths: list[int]) -> list[tuple[str, int]]:
    return [(name, n) for (name, (_, count)), n in zip(element.kinds.items(), lengths, strict=True) if count]


def _read_entry_by_entry(element: Element, data: bytes, start: int, order: str) -> int:
    """Read entries whose lists differ in length: where they begin is known only from the ones before."""
    steps = []
    for kind, count in element.kinds.values():
        size = np.dtype(count).itemsize if count else 0
        steps.append((size, np.dtype(kind).itemsize, count is not None and count.startswith("i")))
    byte_order = "little" if order == "<" else "big"
    places = [np.empty(element.count, dtype=np.int64) for _ in steps]
    counts = [np.ones(element.count, dtype=np.int64) for _ in steps]
    place, end = start, len(data)
    for entry in range(element.count):
        for which, (count_size, size, signed) in enumerate(steps):
            length = 1
            if count_size:
                length = int.from_bytes(data[place : place + count_size], byte_order, signed=signed)  # type: ignore[arg-type]
                counts[which][entry] = length
                place += count_size
            places[which][entry] = place
            place += length * size
            if length < 0 or place > end:
                raise ValueError(f'got a file that ends within entry {entry} of "{element.name}"')
    for which, (name, (kind, count)) in enumerate(element.kinds.items()):
        values = _gather(data, places[which], counts[which], order + kind).astype(kind)
        if count is None:
            element.scalars[name] = values
        else:
            element.lists[name] = Lists(counts[which], values)
    return place


def _gather(data: bytes, places: np.ndarray, counts: np.ndarray, kind: str) -> np.ndarray:
    """Return the numbers at places of a file, `counts` of them at each."""
    size = np.dtype(kind).itemsize
    stored = np.frombuffer(data, np.uint8)
    values = np.empty(int(counts.sum()), dtype=kind)
    first = np.cumsum(counts) - counts
    for length in np.unique(counts):
        rows = np.flatnonzero(counts == length)
        found = stored[places[rows][:, None] + np.arange(length * size)].view(kind)
        values[first[rows][:, None] + np.arange(length)] = found.reshape(len(rows), length)
    return values


def _numbers(lines: list[bytes]) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(b"\n".join(lines).decode("ascii"), dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise ValueError("got words among the numbers of a PLY file in text") from error


def _read_text(element: Element, lines: list[bytes], start: int) -> int:
    """Take an element's entries, each on a line, from a text file; return the line where the next one's begin."""
    if element.count > len(lines) - start:
        raise ValueError(f'got a file that ends within its {element.count} entries of "{element.name}"')
    if element.count == 0 or not element.kinds:
        _leave_empty(element)
        return start + element.count
    own = lines[start : start + element.count]
    numbers = _numbers(own)
    is_list = [count is not None for _, count in element.kinds.values()]
    if not any(is_list) and len(numbers) == element.count * len(is_list):
        rows = numbers.reshape(element.count, -1)
        for column, (name, (kind, _)) in enumerate(element.kinds.items()):
            element.scalars[name] = rows[:, column].astype(kind)
        return start + element.count
    widths = np.array([len(line.split()) for line in own])
    places = [np.empty(element.count, dtype=np.int64) for _ in is_list]
    counts = [np.ones(element.count, dtype=np.int64) for _ in is_list]
    # As a list of Python's numbers: taking them from an array one by one is several times slower.
    plain = numbers.tolist()
    end = 0
    for entry, width in enumerate(widths.tolist()):
        at, end = end, end + width
        for which, listed in enumerate(is_list):
            length = 1
            if listed:
                length = int(plain[at]) if at < end else -1
                counts[which][entry] = length
                at += 1
            places[which][entry] = at
            at += length
            # What a line has beyond its entry is not looked at.
            if length < 0 or at > end:
                raise ValueError(f'got a line that ends within entry {entry} of "{element.name}"')
    for which, (name, (kind, count)) in enumerate(element.kinds.items()):
        first = np.repeat(places[which] - (np.cumsum(counts[which]) - counts[which]), counts[which])
        values = numbers[first + np.arange(len(first))].astype(kind)
        if count is None:
            element.scalars[name] = values
        else:
            element.lists[name] = Lists(counts[which], values)
    return start + element.count


def _leave_empty(element: Element) -> None:
    for name, (kind, count) in element.kinds.items():
        if count is None:
            element.scalars[name] = np.zeros(0, dtype=kind)
        else:
            element.lists[name] = Lists(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=kind))
