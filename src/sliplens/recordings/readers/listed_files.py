"""Files named by a list that was written on another computer."""

import os
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath

from sliplens.errors import RecordingError


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of a list."""

    line: int
    """Counted from 1, in the file."""
    text: str


def read_lines(path: Path) -> list[Line]:
    """Read the lines of a list that are neither empty nor comments.

    Raises
    ------
    RecordingError
        If the file is missing, empty or no text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; the lists of a set must lie in one folder") from None
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); name a text file") from None
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise RecordingError(f"{path} is not a text file; name a list with one entry a line")
    lines = [Line(line=number, text=line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [line for line in lines if line.text and not line.text.startswith("#")]
    if not lines:
        raise RecordingError(f"{path} is empty; list one entry a line")
    return lines


@dataclass(frozen=True, kw_only=True)
class ListedFiles:
    """Finds the files of lists by the paths they had elsewhere."""

    folder: Path
    """Of the lists: relative paths start here."""
    root: Path
    """Relative paths may not lead out of it; files that moved are looked for under it."""
    _found: dict[Path, str] = field(default_factory=dict)

    def find(self, listed: str, *, where: str) -> Path:
        """Find a file: where its path says, else under the root by the last parts of its path, the most first.

        Raises
        ------
        RecordingError
            If it is not there, a relative path leads out of the root, or another listed path led to the same file; the
            message begins with `where`.
        """
        path = self._search(listed, where=where)
        before = self._found.setdefault(path, listed)
        if before != listed:
            raise RecordingError(
                f"{where}: {listed!r} and {before!r} both lead to {path}; give as root a folder in which they differ"
            )
        return path

    def _search(self, listed: str, *, where: str) -> Path:
        foreign = PureWindowsPath(listed.strip("\"'"))  # reads slashes and backslashes
        own = Path(listed.strip("\"'"))
        if own.is_absolute() and _is_file(own):
            return own
        parts = foreign.parts
        if foreign.anchor:
            parts = parts[1:]
        else:
            inside = Path(os.path.normpath(self.folder.absolute().joinpath(*parts)))
            if inside.is_relative_to(os.path.normpath(self.root.absolute())):
                if _is_file(inside):
                    return inside
            elif ".." in parts:
                raise RecordingError(f"{where}: {listed!r} leads out of {self.root}; give the folder of all as root")
        parts = tuple(part for part in parts if part != "..")
        for dropped in range(len(parts)):
            moved = self.root.joinpath(*parts[dropped:])
            if _is_file(moved):
                return moved
        raise RecordingError(
            f"{where}: {listed[:200]!r} is not there, nor under {self.root}; give the folder of the images as root"
        )


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a line that is too long for a name
        return False
