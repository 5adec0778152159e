"""The example scenes and studies that come with the package: `"example:<name>"` in place of a path."""

import os
import shutil
from pathlib import Path

from warpfrag.errors import SceneError, suggest

PREFIX = "example:"
# In the wheel they lie inside of the package, in a clone beside it.
_FOLDERS = (Path(__file__).parents[1] / "scenes", Path(__file__).parents[2] / "scenes")


def example_names() -> list[str]:
    """Return the names of all examples: those of scenes, and `"studies/<name>"`."""
    folder = _folder()
    if folder is None:
        return []
    paths = [*sorted(folder.glob("*.toml")), *sorted(folder.glob("studies/*.toml"))]
    return [path.relative_to(folder).with_suffix("").as_posix() for path in paths]


def example_path(name: str | os.PathLike) -> Path:
    """Return the path that `"example:<name>"` stands for, and any other path as it is.

    Raises:
        SceneError: there is no such example.

    Example:
        >>> example_path("example:three_spheres").name
        'three_spheres.toml'
    """
    text = str(name)
    if not text.startswith(PREFIX):
        return Path(name)
    stem = text.removeprefix(PREFIX).removesuffix(".toml")
    known = example_names()
    folder = _folder()
    if stem not in known or folder is None:
        raise SceneError(f'{PREFIX}: got "{stem}", expected the name of an example; {suggest(stem, known)}')
    return folder / f"{stem}.toml"


def title_of(name: str) -> str:
    """Return the first line of an example, a comment that says what it shows."""
    first = example_path(PREFIX + name).read_text(encoding="utf-8").partition("\n")[0]
    return first.lstrip("# ")


def copy_examples(names: list[str], target: Path) -> list[Path]:
    """Copy examples to a folder, made if need be, and with a study the scene that it names.

    Raises:
        SceneError: a file of that name is there already, with other contents.
    """
    wanted = dict.fromkeys(names)
    wanted |= {
        name.removeprefix("studies/"): None for name in names if name.removeprefix("studies/") in example_names()
    }
    copies = []
    for name in wanted:
        source, copy = example_path(PREFIX + name), target / f"{name}.toml"
        if copy.exists() and copy.read_bytes() != source.read_bytes():
            raise SceneError(f"{copy}: got a file with other contents, expected none in its place")
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, copy)
        copies.append(copy)
    return copies


def _folder() -> Path | None:
    return next((folder for folder in _FOLDERS if folder.is_dir()), None)
