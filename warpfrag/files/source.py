"""What files are read from: regular files of a sane size, and the files that they name below a root folder.

A pipe, a device or a folder in the place of a file is refused before anything is read from it. What a reader leaves
out of a file is noted here, and told in one warning when the file has been read.
"""

import os
import stat
import warnings
from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from warpfrag.errors import suggest

# A mesh of 40 million triangles is about this large; more is not read into memory.
MOST_BYTES = 2 * 2**30
# More notes than these are counted, not listed.
_MOST_NOTES = 8
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


class ReadingWarning(UserWarning):
    """What of a file is left out, in one line that names the file."""


def wording_unless_regular(path: str | os.PathLike) -> str | None:
    """Word what stands in the place of a regular file: `"no such file"`, `"a folder"`, …; None for a regular file."""
    if "\0" in str(path):
        return "a name with a NUL character"
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "no such file"
    # A loop of links, a name that is too long, a folder that may not be entered.
    except OSError as error:
        return f"a name that cannot be followed ({error.strerror or error})"
    if stat.S_ISREG(mode):
        return None
    return next((wording for is_kind, wording in _KINDS if is_kind(mode)), "no regular file")


def check_regular(path: Path, expected: str) -> None:
    """Raise unless a path leads to a regular file.

    Raises:
        ValueError: it does not; the message names the path, and a file of a similar name if there is one.
    """
    got = wording_unless_regular(path)
    if got is None:
        return
    near = ""
    if got == "no such file" and path.parent.is_dir():
        hint = suggest(path.name, [entry.name for entry in path.parent.iterdir()])
        near = f" ({hint})" if hint.startswith("did") else ""
    raise ValueError(f"got {got} at {wording_of_path(path)}{near}, expected {expected}")


def wording_of_path(path: str | os.PathLike) -> str:
    """Word a path on one line."""
    return str(path).replace("\0", "\\0").replace("\n", "\\n")


def read_regular(path: Path, expected: str, most_bytes: int = MOST_BYTES) -> bytes:
    """Read a regular file.

    Args:
        path: the file.
        expected: what it should be, for messages.
        most_bytes: larger files are refused.

    Raises:
        ValueError: it is no regular file, or larger.
        OSError: it cannot be read.
    """
    check_regular(path, expected)
    # Without blocking, in case that a pipe has taken its place since.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(descriptor, "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise ValueError(f"got no regular file at {wording_of_path(path)}, expected {expected}")
        if status.st_size > most_bytes:
            raise ValueError(
                f"got a file of {status.st_size} bytes at {wording_of_path(path)}, expected at most {most_bytes}"
            )
        return file.read()


def resolved(path: Path) -> Path:
    """Return a path with its links followed.

    Raises:
        ValueError: they lead in a circle, or the path cannot be one.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError) as error:
        raise ValueError(f"got {wording_of_path(path)}, whose links lead in a circle, expected a file") from error


class Source:
    """A file that is being read, the folder that bounds what it may name, and what is left out of it.

    Attributes:
        path: the file.
        root: nothing outside of this folder is read for it.
    """

    def __init__(self, path: Path, root: Path) -> None:
        self.path, self.root = path, resolved(root)
        self.notes: list[str] = []
        self._missing: list[str] = []
        self._outside: list[str] = []

    def read(self) -> bytes:
        """Read the file itself."""
        return read_regular(self.path, "a mesh file")

    def find(self, name: str, *, quiet: bool = False) -> Path | None:
        """Return where a file that this one names lies.

        Args:
            name: what the file says.
            quiet: whether a name that leads to nothing is not to be told.

        Returns:
            Its path; None, and noted, where it is missing or outside of the root.
        """
        name = name.strip()
        # Exporters write percent-encoded names, backslashes, and absolute paths of their own machine.
        candidates = [name, unquote(name), name.replace("\\", "/"), PureWindowsPath(name).name]
        outside = False
        for candidate in dict.fromkeys(candidates):
            if not candidate or "\0" in candidate:
                continue
            path = self.path.parent / candidate
            if not resolved(path).is_relative_to(self.root):
                outside = True
            elif wording_unless_regular(path) is None:
                return path
        if not quiet:
            (self._outside if outside else self._missing).append(name)
        return None

    def note(self, text: str) -> None:
        """Remember what is left out, once."""
        if text not in self.notes:
            self.notes.append(text)

    def wording(self) -> str:
        """Word all that is left out, on one line; nothing if there is nothing."""
        words = []
        for names, what, where in (
            (self._missing, "cannot find", ""),
            (self._outside, "does not read", f" outside of {self.root}"),
        ):
            unique = [wording_of_path(name) for name in dict.fromkeys(names)]
            more = f" and {len(unique) - 3} more" if len(unique) > 3 else ""
            if unique:
                words.append(f"{what} {', '.join(unique[:3])}{more}{where}")
        words += self.notes[:_MOST_NOTES]
        if len(self.notes) > _MOST_NOTES:
            words.append(f"and {len(self.notes) - _MOST_NOTES} more")
        return " ".join("; ".join(words).split())

    def warn(self) -> None:
        """Tell what is left out, in one warning that names the file."""
        if words := self.wording():
            warnings.warn(f"{wording_of_path(self.path)}: {words}", ReadingWarning, stacklevel=4)
