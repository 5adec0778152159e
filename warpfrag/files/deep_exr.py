"""Deep OpenEXR files, whose pixels have any number of samples each, to fragments and back.

A sample is R, G, B, A (premultiplied, linear) from Z to ZBack; without ZBack it is a surface at Z. As a fragment its
depth is ZBack (or Z), its thickness ZBack - Z. What Z measures a file does not say: it is taken as it stands.
"""

import os
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from warpfrag.deep import concat
from warpfrag.errors import check_choice, is_whole, shorten
from warpfrag.files.deep_parts import DeepFile, Part, Samples
from warpfrag.files.exr import openexr
from warpfrag.files.images import ImageError, check_target
from warpfrag.files.saving import replacing
from warpfrag.files.source import Source, read_regular, wording_of_path
from warpfrag.fragments import Fragments, Layers

_NEEDED = ("R", "G", "B", "A", "Z")
_COLORED_OPACITY = ("AR", "AG", "AB")
# Of ids the first is what is written; the others are what files of other programs call them.
OBJECT_IDS = ("id", "objectid", "modelid")
PRIMITIVE_IDS = ("primitiveid",)
DEPTH_ATTRIBUTE, DEPTH_MEANING = "warpfrag:depth", "distance from the eye along the ray of the pixel, in scene units"
_LARGEST_HALF = 65504.0

DeepWindow = Literal["display", "data"]


def read_deep(path: str | os.PathLike, *, part: int | str | None = None, window: DeepWindow = "display") -> Fragments:
    """Read a deep OpenEXR file: scan lines of half, float or uint channels, not compressed or by RLE or ZIPS.

    Z is taken as it stands: renderers write the distance along the ray or the planar depth, and files do not say which;
    fragments of other cameras' conventions do not fit to one another. Fragments keep the order of the file. Object ids
    are the channel `id`, or else `objectid` or `modelid`, primitive ids `primitiveid`: 32 bits, here as signed numbers.
    What is left out, or put right, is told in one warning: other channels and parts, samples outside of the window,
    opacities out of 0 ... 1, ZBack before Z.

    Args:
        path: the file.
        part: number or name of the part to read; by default all deep parts with R, G, B, A and Z are put together (of
            several views, those of the first).
        window: the pixel grid: "display" is the whole image, empty where the file has no pixels; "data" are the pixels
            that the file has.

    Returns:
        NumPy arrays, float32 and int32, (H, W) pixels.

    Raises:
        ImageError: the file is missing, broken, cut off, flat, or of tiles; channels are missing; opacity has colours
            (AR, AG, AB); a value is not finite; there is no such part.

    Example:
        >>> fragments = wf.read_deep("smoke.exr")
        >>> image = wf.composite(fragments, merge="exact", mix="optical_depth", beta=0.0)
    """
    check_choice("window", window, ("display", "data"))
    return _read(Path(path), part, window)


def read_attributes(path: str | os.PathLike) -> dict[str, Any]:
    """Return the texts and numbers that the first deep part of a file says about the image, such as its owner.

    Raises:
        ImageError: the file is missing, broken, cut off or flat.
    """
    try:
        file = DeepFile(read_regular(Path(path), "a deep image"))
    except (ValueError, OSError) as error:
        raise ImageError(f"{wording_of_path(path)}: {_reason(error)}") from error
    return next((part.attributes for part in file.parts if part.is_deep), {})


def write_deep(
    path: str | os.PathLike,
    source: Fragments | Layers,
    *,
    half: bool = False,
    attributes: Mapping[str, str | int | float] | None = None,
) -> None:
    """Write fragments or layers as a deep OpenEXR file: scan lines, ZIPS; it is there whole or not at all.

    Channels: R, G, B, A, Z in float32; ZBack if a fragment has a thickness; `id` and `primitiveid` (uint) for ids. Z is
    depth - thickness and ZBack the depth, both along the ray of the pixel as everywhere here, which the attribute
    `warpfrag:depth` says. Fragments keep their order; most programs want it by depth (`capture` gives it so). Opacity
    sums are not stored.

    Args:
        path: a name that ends in `.exr`, in a folder that exists.
        source: arrays of any kind, on a grid (H, W).
        half: whether R, G, B and A are stored in half precision.
        attributes: further texts and numbers for the header.

    Raises:
        TypeError: the source is neither.
        ImageError: the name or the grid is not one of those, or the file cannot be written.
        ValueError: a value is not finite or out of its range.
        ImportError: OpenEXR is not installed.
    """
    name = wording_of_path(path)
    if not isinstance(source, (Fragments, Layers)):
        raise TypeError(f"source: got {shorten(source)}, expected Fragments or Layers")
    check_deep_target(path)
    fragments = _of_layers(source.numpy()) if isinstance(source, Layers) else source.numpy()
    fragments.validate()
    if len(fragments.shape) != 2 or fragments.pixel_count == 0:
        sizes = "×".join(map(str, fragments.shape))
        raise ImageError(f"{name}: got a grid of {sizes} pixels, expected (H, W)")
    library = openexr()
    header = {
        **(attributes or {}),
        DEPTH_ATTRIBUTE: DEPTH_MEANING,
        "type": library.deepscanline,
        "compression": library.ZIPS_COMPRESSION,
    }
    channels = {key: _by_pixel(values, fragments) for key, values in _channels(fragments, half, name).items()}
    try:
        with replacing(path) as partial, library.File(header, channels) as file:
            file.write(str(partial))
    except OSError as error:
        raise ImageError(f"{name}: cannot be written ({error.strerror or error})") from error


def check_deep_target(path: str | os.PathLike) -> None:
    """Raise what `write_deep` would about the name, before time is spent on what is to be written.

    Raises:
        ImageError: the suffix or the folder is not usable, or no regular file is in the file's place.
        ImportError: OpenEXR is not installed.
    """
    suffix = Path(path).suffix
    if suffix.lower() != ".exr":
        raise ImageError(f"{wording_of_path(path)}: got the suffix {suffix or '(none)'}, expected .exr")
    check_target(path)


def _read(path: Path, part: int | str | None, window: DeepWindow) -> Fragments:
    source = Source(path, path.parent)
    try:
        file = DeepFile(read_regular(path, "a deep image"))
        found = [_fragments(file, index, window, source) for index in _chosen(file.parts, part, source)]
        fragments = found[0] if len(found) == 1 else concat(*found)
    except (ValueError, OSError) as error:
        raise ImageError(f"{wording_of_path(path)}: {_reason(error)}") from error
    source.warn()
    return fragments


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, ValueError) else f"cannot be read ({getattr(error, 'strerror', None) or text})"


def _chosen(parts: list[Part], wanted: int | str | None, source: Source) -> list[int]:
    """Return which parts are read; note which are not."""
    names = [part.name for part in parts]
    if wanted is not None:
        by_number = is_whole(wanted) and 0 <= int(wanted) < len(parts)
        if not by_number and wanted not in names:
            known = ", ".join(f'{number} "{name}"' for number, name in enumerate(names))
            raise ValueError(f"got no part {shorten(wanted)}, expected one of {known}")
        index = int(wanted) if by_number else names.index(str(wanted))
        _check_part(parts[index])
        return [index]
    usable = [index for index, part in enumerate(parts) if part.is_deep and set(_NEEDED) <= set(part.channels)]
    if not usable:
        # The first deep one is what was meant.
        _check_part(next((part for part in parts if part.is_deep), parts[0]))
    chosen = [index for index in usable if parts[index].view == parts[usable[0]].view]
    for index in chosen:
        _check_part(parts[index])
    if len(chosen) > 1:
        source.note(f"puts the parts {', '.join(shorten(names[index]) for index in chosen)} together")
    left_out = [shorten(names[index]) for index in range(len(parts)) if index not in chosen]
    if left_out:
        source.note(f"leaves out the parts {', '.join(left_out)}")
    return chosen


def _check_part(part: Part) -> None:
    if not part.is_deep:
        raise ValueError("got a flat image, whose pixels have one sample each, expected a deep one")
    colored = [name for name in _COLORED_OPACITY if name in part.channels]
    if colored:
        raise ValueError(f"got the coloured opacities {', '.join(colored)}, expected one opacity, A")
    if not set(_NEEDED) <= set(part.channels):
        raise ValueError(f"got the channels {', '.join(part.channels)}, expected R, G, B, A and Z (and ZBack)")


def _fragments(file: DeepFile, index: int, window: DeepWindow, source: Source) -> Fragments:
    """Return a part as fragments; note what is left out of it or put right."""
    part = file.parts[index]
    ids = {
        "object_id": next((name for name in OBJECT_IDS if name in part.channels), None),
        "primitive_id": next((name for name in PRIMITIVE_IDS if name in part.channels), None),
    }
    names = [*_NEEDED, *(["ZBack"] if "ZBack" in part.channels else []), *(name for name in ids.values() if name)]
    left_out = [name for name in part.channels if name not in names]
    if left_out:
        source.note(f"leaves out the channels {', '.join(left_out)}")
    samples = file.read(index, names)
    offsets, kept, shape = _grid(samples, part, window)
    values = samples.channels
    if kept is not None and not kept.all():
        source.note(f"leaves out {np.count_nonzero(~kept)} samples outside of the display window")
        values = {name: array[kept] for name, array in values.items()}
    floats = {name: values[name].astype(np.float32) for name in (*_NEEDED, "ZBack") if name in values}
    for name, array in floats.items():
        if not np.isfinite(array).all():
            bad = int(np.flatnonzero(~np.isfinite(array))[0])
            row, column = divmod(int(np.searchsorted(offsets, bad, side="right")) - 1, shape[1])
            raise ValueError(f"got {name} {array[bad]} at column {column}, row {row}, expected finite values")
    opacity = floats["A"]
    if ((opacity < 0.0) | (opacity > 1.0)).any():
        source.note(f"takes opacities from {opacity.min():g} to {opacity.max():g} as those from 0 to 1")
    floats["A"] = opacity.clip(0.0, 1.0)
    back = floats.get("ZBack", floats["Z"])
    thickness = back - floats["Z"]
    if (thickness < 0.0).any():
        source.note(f"takes {np.count_nonzero(thickness < 0.0)} samples with ZBack before Z as surfaces at Z")
        back = np.maximum(back, floats["Z"])
    return Fragments(
        rgba=np.stack([floats[name] for name in ("R", "G", "B", "A")], axis=1),
        depth=back,
        thickness=thickness.clip(0.0),
        offsets=offsets,
        shape=shape,
        **{key: _ids(values[name], name, source) for key, name in ids.items() if name},
    )


def _grid(samples: Samples, part: Part, window: DeepWindow) -> tuple[np.ndarray, np.ndarray | None, tuple[int, int]]:
    """Return offsets of the pixels of a window, which samples lie in it (None: all), and its size."""
    left, top, right, bottom = part.data_window if window == "data" else part.display_window
    own_left, own_top, own_right, own_bottom = part.data_window
    rows, own_rows = _shared(top, bottom, own_top, own_bottom)
    columns, own_columns = _shared(left, right, own_left, own_right)
    counts = np.zeros((bottom - top + 1, right - left + 1), np.int64)
    counts[rows, columns] = samples.counts[own_rows, own_columns]
    inside = np.zeros(samples.counts.shape, bool)
    inside[own_rows, own_columns] = True
    kept = None if inside.all() else np.repeat(inside.reshape(-1), samples.counts.reshape(-1))
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32), kept, counts.shape


def _shared(first: int, last: int, own_first: int, own_last: int) -> tuple[slice, slice]:
    """Return what two ranges of rows or columns share, counted from the begin of each."""
    begin = max(first, own_first)
    end = max(begin, min(last, own_last) + 1)
    return slice(begin - first, end - first), slice(begin - own_first, end - own_first)


def _ids(values: np.ndarray, name: str, source: Source) -> np.ndarray | None:
    """Return ids as 32 bits, None and noted where they are none."""
    if values.dtype.kind == "f":
        whole = np.isfinite(values) & (values == np.floor(values)) & (np.abs(values) < 2**31)
        if not whole.all():
            source.note(f"leaves out the channel {name}, whose numbers are not whole")
            return None
        return values.astype(np.int32)
    return values.astype(np.uint32).view(np.int32)


def _of_layers(layers: Layers) -> Fragments:
    used = np.arange(layers.max_layers) < layers.count[..., None]
    offsets = np.concatenate([[0], np.cumsum(layers.count)]).astype(np.int32)
    return Fragments(layers.rgba[used], layers.depth[used], layers.thickness[used], offsets, layers.shape)


def _channels(fragments: Fragments, half: bool, name: str) -> dict[str, np.ndarray]:
    """Return the values of each channel, (F,)."""
    if half and np.abs(fragments.rgba).max(initial=0.0) > _LARGEST_HALF:
        raise ImageError(
            f"{name}: got colours up to {np.abs(fragments.rgba).max():g}, expected at most {_LARGEST_HALF}"
        )
    channels = {
        key: fragments.rgba[:, column].astype(np.float16 if half else np.float32) for column, key in enumerate("RGBA")
    }
    channels["Z"] = (fragments.depth - fragments.thickness).astype(np.float32)
    if fragments.thickness.any():
        channels["ZBack"] = fragments.depth.astype(np.float32)
    for key, ids in ((OBJECT_IDS[0], fragments.object_id), (PRIMITIVE_IDS[0], fragments.primitive_id)):
        if ids is not None:
            low, high = ids.min(initial=0), ids.max(initial=0)
            if low < -(2**31) or high >= 2**32:
                raise ImageError(f"{name}: got ids from {low} to {high}, expected 32 bits")
            channels[key] = ids.astype(np.uint32)
    return channels


def _by_pixel(values: np.ndarray, fragments: Fragments) -> np.ndarray:
    """Return values as OpenEXR wants them: for each pixel an array of its own, (H, W)."""
    ends = fragments.offsets.tolist()
    own = (values[begin:end] for begin, end in pairwise(ends))
    return np.fromiter(own, object, fragments.pixel_count).reshape(fragments.shape)
