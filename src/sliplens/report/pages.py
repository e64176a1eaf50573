"""Pages of pictures and charts: laid out in inches from the left upper corner, saved whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.errors import InputError
from sliplens.report.style import drawing_style

# no dates: the same trials, the same file
_METADATA: dict[str, dict[str, Any]] = {".png": {}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}


def require_picture_path(path: Path, *, example: str) -> None:
    """Check that a file is named as a picture that can be saved.

    Raises
    ------
    InputError
        If its suffix is another one.
    """
    if path.suffix.lower() not in _METADATA:
        raise InputError(f"{path} does not end in {', '.join(_METADATA)}; name a picture, such as {example}")


def save_page(figure: Figure, path: Path) -> None:
    """Save a page as .png, .pdf or .svg; it appears when complete.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    suffix = path.suffix.lower()
    with written_whole(path) as part, drawing_style():
        # 150 dots an inch show frames of 224 pixels about pixel for pixel
        figure.savefig(part, format=suffix[1:], dpi=150, metadata=_METADATA[suffix])


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a file beside the target to write to; it takes the target's name when all went well, else it is gone.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        part.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror}); choose another file") from None
    finally:
        with suppress(OSError):  # it has its name by now, or could not be made
            part.unlink()


def place_axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Add axes whose left upper corner and size are given in inches from the left upper corner of the page."""
    across, down = figure.get_size_inches()
    return figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))


def place_text(figure: Figure, left: float, top: float, text: str, **settings: Any) -> None:
    """Write words there, their upper edge on that line unless told otherwise."""
    across, down = figure.get_size_inches()
    figure.text(left / across, 1 - top / down, text, **{"va": "top", **settings})
