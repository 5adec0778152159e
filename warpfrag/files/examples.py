"""The example scenes and studies that come with the package: `"example:<name>"` in place of a path."""

import os
import shutil
from pathlib import Path

from warpfrag.errors import SceneError, suggest

PREFIX = "example:"
# The folder of the meshes, points and images of scenes, beside them.
_ASSETS = "assets"
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
    """Copy examples to a folder, made if need be, each with the files that it names, a study with its scene.

    Returns:
        The copies of the examples themselves.

    Raises:
        SceneError: a file of that name is there already, with other contents.
    """
    wanted = dict.fromkeys(names)
    wanted |= {
        name.removeprefix("studies/"): None for name in names if name.removeprefix("studies/") in example_names()
    }
    files = {example_path(PREFIX + name): target / f"{name}.toml" for name in wanted}
    assets = {source: target / _ASSETS / source.name for scene in files for source in _assets(scene)}
    for source, copy in (files | assets).items():
        if copy.exists() and copy.read_bytes() != source.read_bytes():
            raise SceneError(f"{copy}: got a file with other contents, expected none in its place")
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, copy)
    return list(files.values())


def _assets(scene: Path) -> list[Path]:
    """Return the files that a scene names, beside those of other packages."""
    text = scene.read_text(encoding="utf-8")
    return [path for path in sorted((scene.parent / _ASSETS).glob("*")) if f'"{_ASSETS}/{path.name}"' in text]


def _folder() -> Path | None:
    return next((folder for folder in _FOLDERS if folder.is_dir()), None)
