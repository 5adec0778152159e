"""The MTL format: the materials of OBJ files, as colours, opacities and images."""

from dataclasses import dataclass, field

import numpy as np

from warpfrag.colors import linear_to_srgb, srgb_to_linear
from warpfrag.files.pixels import decode_image, with_opacity
from warpfrag.files.source import Source, read_regular
from warpfrag.files.texture_images import Sampling

# How many words follow an option of a map, at most; those of numbers may be fewer.
_OPTIONS = {
    "-o": 3, "-s": 3, "-t": 3, "-mm": 2, "-bm": 1, "-boost": 1, "-texres": 1, "-clamp": 1, "-blendu": 1, "-blendv": 1,
    "-cc": 1, "-imfchan": 1, "-type": 1, "-colorspace": 1,
}  # fmt: skip
_NUMERIC = ("-o", "-s", "-t", "-mm", "-bm", "-boost", "-texres")


@dataclass(frozen=True)
class ImageMap:
    """An image that a material names, and its options: `-s` scales coordinates, `-o` shifts them then."""

    name: str
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    clamped: bool = False


@dataclass
class Material:
    """A material of an MTL file.

    Attributes:
        color: straight linear RGB of Kd; None where it is not given.
        opacity: d, or 1 − Tr.
        color_map: map_Kd.
        opacity_map: map_d.
    """

    color: np.ndarray | None = None
    opacity: float = 1.0
    color_map: ImageMap | None = None
    opacity_map: ImageMap | None = None
    given: set[str] = field(default_factory=set)


def read_materials(source: Source, names: str) -> dict[str, Material]:
    """Read the materials of the libraries that an OBJ file names in one line.

    Args:
        source: the OBJ file.
        names: what follows `mtllib`: one name with blanks, or several.
    """
    materials: dict[str, Material] = {}
    # One name with blanks in it, if there is such a file.
    whole = source.find(names, quiet=True)
    paths = [whole] if whole is not None else [source.find(name) for name in names.split()]
    for path in paths:
        if path is not None:
            text = read_regular(path, "a library of materials").decode("utf-8", "replace")
            materials.update(_parse(text.replace("\\\n", " "), source))
    return materials


def material_image(material: Material, source: Source, cache: dict) -> np.ndarray | None:
    """Return the image of a material, straight linear RGBA with the opacity of map_d; None without."""
    color_map, opacity_map = material.color_map, material.opacity_map
    color = None if color_map is None else _image(color_map.name, source, cache)
    opacity = None if opacity_map is None else _image(opacity_map.name, source, cache)
    if opacity is None:
        return color
    # Of an image with opacity that is what counts, of one without its grey as it is stored.
    alpha = opacity[..., 3] if opacity[..., 3].min() < 1.0 else linear_to_srgb(opacity[..., :3].mean(axis=-1))
    alpha = alpha.astype(np.float32)
    if color is None:
        return np.concatenate([np.ones((*alpha.shape, 3), dtype=np.float32), alpha[..., None]], axis=-1)
    if color_map is not None and opacity_map is not None and _placing(color_map) != _placing(opacity_map):
        source.note("texture: map_d with other options than map_Kd, drawn with those of map_Kd")
    height, width = (max(color.shape[axis], alpha.shape[axis]) for axis in (0, 1))
    result = _resized(color, height, width).copy()
    same = opacity_map is not None and color_map is not None and opacity_map.name == color_map.name
    result[..., 3] = alpha if same else result[..., 3] * _resized(alpha, height, width)
    return result


def placing(material: Material) -> ImageMap:
    """Return the map whose options place a material's image."""
    return material.color_map or material.opacity_map or ImageMap("")


def sampling(material: Material) -> Sampling:
    """Return how a material's image is to be looked up."""
    wrap = "clamp" if placing(material).clamped else "repeat"
    return Sampling((wrap, wrap))  # type: ignore[arg-type]


def _placing(image: ImageMap) -> tuple:
    return image.offset, image.scale, image.clamped


def _parse(text: str, source: Source) -> dict[str, Material]:
    materials: dict[str, Material] = {}
    current = Material()
    for line in text.splitlines():
        key, _, rest = line.partition("#")[0].strip().partition(" ") if "\t" not in line else _by_blanks(line)
        rest = rest.strip()
        word = key.lower()
        if word == "newmtl":
            current = materials.setdefault(rest, Material())
        elif word == "kd":
            current.color = _color(rest, source)
        elif word in ("d", "tr") and "d" not in current.given:
            value = _last_number(rest)
            if value is not None:
                current.given.add(word)
                current.opacity = min(max(value if word == "d" else 1.0 - value, 0.0), 1.0)
                if word == "tr" and current.opacity == 0.0:
                    # Some programs write 1 for what they mean to be opaque.
                    source.note(f'a material of "Tr {rest}" is invisible')
        elif word == "map_kd":
            current.color_map = _image_map(rest, source)
        elif word in ("map_d", "map_opacity"):
            current.opacity_map = _image_map(rest, source)
        elif word == "map_tr":
            source.note("texture: map_Tr is not supported, drawn without")
        elif word == "ke" and any(number not in (None, 0.0) for number in map(_number, rest.split())):
            source.note("the light that materials emit is not drawn")
    return materials


def _by_blanks(line: str) -> tuple[str, str, str]:
    words = line.partition("#")[0].split(None, 1)
    return (words[0] if words else ""), " ", (words[1] if len(words) > 1 else "")


def _color(words: str, source: Source) -> np.ndarray | None:
    numbers = [_number(word) for word in words.split()]
    known = [number for number in numbers if number is not None]
    if len(known) != len(numbers) or len(known) not in (1, 3):
        if words:
            source.note(f'a colour "Kd {words[:40]}" is not supported, drawn without')
        return None
    # One number is grey.
    return srgb_to_linear(np.clip(np.array(known * 3 if len(known) == 1 else known), 0.0, 1.0))


def _image_map(words: str, source: Source) -> ImageMap | None:
    """Read options and the name, which may have blanks, of a map."""
    rest = words.split()
    values: dict[str, list[str]] = {}
    while rest and rest[0].lower() in _OPTIONS:
        option = rest.pop(0).lower()
        values[option] = []
        while rest and len(values[option]) < _OPTIONS[option]:
            if option in _NUMERIC and _number(rest[0]) is None:
                break
            values[option].append(rest.pop(0))
    if not rest:
        return None
    # The name as it stands in the line: blanks in it count.
    taken = len(words.split()) - len(rest)
    name = (words.split(None, taken)[-1] if taken else words).strip().strip('"')
    for option in ("-t", "-mm"):
        neutral = {"-t": [0.0, 0.0, 0.0], "-mm": [0.0, 1.0]}[option]
        if [_number(word) for word in values.get(option, [])] not in ([], neutral[: len(values.get(option, []))]):
            source.note(f"texture: the option {option} is not supported, drawn without")
    offset, scale = ([_number(word) or 0.0 for word in values.get(key, [])] for key in ("-o", "-s"))
    return ImageMap(
        name,
        (offset[0] if offset else 0.0, offset[1] if len(offset) > 1 else 0.0),
        (scale[0] if scale else 1.0, scale[1] if len(scale) > 1 else 1.0),
        values.get("-clamp", ["off"])[:1] == ["on"],
    )


def _image(name: str, source: Source, cache: dict) -> np.ndarray | None:
    if name not in cache:
        cache[name] = None
        path = source.find(name)
        if path is not None:
            try:
                cache[name] = with_opacity(decode_image(read_regular(path, "an image")))
            # Decoders raise whatever they like on broken images.
            except Exception as error:
                reason = " ".join(str(error).split())[:80]
                source.note(f"texture: {name} cannot be read ({reason}), drawn without")
    return cache[name]


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    rows = np.arange(height) * image.shape[0] // height
    columns = np.arange(width) * image.shape[1] // width
    return image[rows][:, columns]


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _last_number(words: str) -> float | None:
    return _number(words.split()[-1]) if words.split() else None
