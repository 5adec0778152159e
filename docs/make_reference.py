"""Write docs/scene-files.md, the reference of scene files and study files, from `reference_keys.py` and the package.

uv run python docs/make_reference.py
"""

import inspect
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from reference_keys import SECTIONS, Key, Section

from warpfrag.files.examples import example_names, title_of
from warpfrag.files.scene_objects import PRIMITIVES
from warpfrag.scene.parameters import KINDS, ParameterKind
from warpfrag.shapes import primitives

PAGE = Path(__file__).with_name("scene-files.md")
_OPENING = """# Scene files and study files

Made by `uv run python docs/make_reference.py`; the tests compare this page with what the readers take.

Both are TOML. Lengths are in scene units, angles in degrees; colours are straight linear RGB from 0 to 1, or
`"#rrggbb"` in sRGB. A number has to be one that float32 holds. An unknown key, a value of another kind or out of its
range, a file that is missing: each is refused in one line that names the file, the key, what was got and what is
expected.
"""
_STUDIES = """## Study files

A study names a scene, the images to approach, and what is fitted: `warpfrag fit study.toml`, or `wf.load_study`.
"""
_PARAMETERS = """### Parameters

Names that `[parameters]`, `reference.true`, `--set` and `wf.render(parameters=…)` take; `ball` stands for an object's
name. A camera's `object` is one value for all views. The scene's extent is the diagonal of its bounding box.
"""


def page() -> str:
    """Return the whole page."""
    parts = [_OPENING, "## Scene files", _scene_examples()]
    for file in ("scene", "study"):
        if file == "study":
            parts += [_STUDIES, _study_examples()]
        for section in (each for each in SECTIONS if each.file == file):
            parts.append(_section(section))
            if section.title.endswith("sizes of a primitive"):
                parts.append(_primitives())
    parts += [_PARAMETERS, _parameters()]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def default_of(key: Key) -> str:
    """Return the default of a key: the words it has, or what the code says."""
    if isinstance(key.default, str):
        return key.default
    value = inspect.signature(key.default).parameters[key.name].default
    if value is inspect.Parameter.empty:
        raise ValueError(f"{key.name}: got no default in {key.default.__name__}")
    return f"`{toml(value)}`"


def toml(value: Any) -> str:
    """Return a value as a TOML file would have it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml, value))}]"
    return repr(value)


def _section(section: Section) -> str:
    rows = [
        (f"`{key.name}`", key.value, default_of(key), key.unit, f"`{key.name} = {key.example}`", key.meaning)
        for key in section.keys
    ]
    table = _table(("key", "value", "default", "unit", "example", ""), rows)
    return "\n\n".join(part for part in (f"### {section.title}", section.words, table) if part)


def _primitives() -> str:
    rows = []
    for kind, sizes in PRIMITIVES.items():
        signature = inspect.signature(getattr(primitives, kind)).parameters
        rows.append((f"`{kind}`", ", ".join(f"`{name} = {toml(signature[name].default)}`" for name in sizes)))
    return "Sizes of each primitive, with their defaults:\n\n" + _table(("primitive", "sizes"), rows)


def _parameters() -> str:
    header = ("name", "per", "numbers", "range", "fitted between", "text")
    return _table(header, [_parameter(kind) for kind in KINDS])


def _parameter(kind: ParameterKind) -> tuple[str, ...]:
    owner = {"scene": "", "object": "ball.", "camera": "camera."}[kind.owner]
    bounds = "no bounds"
    if kind.bounds is not None:
        low, high = (f"{bound:g}" for bound in kind.bounds)
        bounds = f"{low} and {high}" + (" of the scene's extent" if kind.is_length else "")
    allowed = "any"
    if kind.is_bounded:
        allowed = f"from {kind.low:g}" + ("" if kind.high == math.inf else f" to {kind.high:g}")
    return (
        f"`{owner}{kind.key}`",
        ", ".join(kind.per),
        str(math.prod(kind.value_shape)),
        allowed,
        bounds,
        kind.text,
    )


def _scene_examples() -> str:
    names = [name for name in example_names() if "/" not in name]
    return "Examples, each also `example:<name>` wherever a path goes:\n\n" + _examples(names)


def _study_examples() -> str:
    return "Examples:\n\n" + _examples([name for name in example_names() if "/" in name])


def _examples(names: Iterable[str]) -> str:
    return _table(("example", ""), [(f"[{name}](../scenes/{name}.toml)", title_of(name)) for name in names])


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
