"""Readers of recordings: one row a format. An installed package adds one through `sliplens.formats`.

Files come from outside and may be damaged or hostile: a reader raises a `RecordingError` (of an image an `ImageError`)
of one sentence with the place and the cure.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sliplens.errors import InputError
from sliplens.extras import Table
from sliplens.images import IMAGE_SUFFIXES
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import DATASET_FILE, load_dataset
from sliplens.recordings.formats import arrays
from sliplens.recordings.formats.images import find_states, read_image_folder, read_stills
from sliplens.recordings.formats.rosbag import read_rosbag
from sliplens.recordings.formats.video import read_video
from sliplens.recordings.options import ReadOptions, option_flags


@dataclass(frozen=True, kw_only=True)
class Reader:
    """Reader of one format."""

    words: str  #: Description of the format in messages.
    recognises: Callable[[Path], bool]
    """Return True for a file or folder of this format, by names or the header of a table; no frame is read."""
    takes: tuple[str, ...]  #: Fields of `ReadOptions` that the reader supports.
    read: Callable[[Path, ReadOptions], Capture | list[Capture]]


_FORCE_TABLE = ("forces", "frame_rate", "start_s", "time_column", "force_columns", "time_unit", "force_unit")

_ROWS = {
    "sliplens": Reader(
        words="data set of sliplens, simulated or imported, with its labels",
        recognises=lambda path: (path / DATASET_FILE).is_file(),
        takes=(),
        read=lambda path, _: list(map((data := load_dataset(path)).open, data.trials)),
    ),
    "rosbag": Reader(
        words="ROS 2 bag (MCAP or sqlite3)",
        recognises=lambda path: path.suffix in {".mcap", ".db3", ".bag"} or (path / "metadata.yaml").is_file(),
        takes=("image_topic", "wrench_topic"),
        read=read_rosbag,
    ),
    "stills": Reader(
        words="table of labelled stills: a column of files, and forces or margins",
        recognises=lambda path: find_states(path) is not None,
        takes=("image_root", "frame_rate", "force_columns", "force_unit"),
        read=read_stills,
    ),
    "arrays": Reader(
        words="arrays of frames, with or without forces (NPZ, NPY, HDF5)",
        recognises=lambda path: path.suffix.lower() in arrays.SUFFIXES and path.is_file(),
        takes=_FORCE_TABLE,
        read=arrays.read_arrays,
    ),
    "images": Reader(
        words="folder of images, with a table of forces",
        recognises=lambda path: path.is_dir() and any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir()),
        takes=(*_FORCE_TABLE, "times"),
        read=read_image_folder,
    ),
    "video": Reader(
        words="video, with a table of forces",
        recognises=lambda path: path.is_file(),
        takes=(*_FORCE_TABLE, "skip_frames"),
        read=read_video,
    ),
}
FORMATS = Table("format", "sliplens.formats", _ROWS)  #: Readers by format.


def recognise(path: Path) -> str | None:
    """Recognise the format of a source; formats of installed packages are tried first."""
    added = [name for name in FORMATS if name not in _ROWS]
    return next((name for name in (*added, *_ROWS) if FORMATS[name].recognises(path)), None)


def open_captures(path: Path, *, format: str | None = None, options: ReadOptions) -> tuple[Capture, ...]:
    """Open a source with the reader of its format: a row of `FORMATS`, recognised by names if None."""
    if format is not None:
        FORMATS.pick(format)  # a wrong name is reported before a wrong path
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path")
    name = format or recognise(path)
    if name is None:
        formats = "; ".join(f"{name}: {FORMATS[name].words}" for name in FORMATS)
        raise InputError(f"{path} has none of the supported formats ({formats}); name one with --format")
    reader = FORMATS[name]
    if strange := [option for option in options.given() if option not in reader.takes]:
        flags = option_flags(strange)
        raise InputError(f"{path} is read as {name}, which does not take {flags}; leave it out or name another format")
    captures = reader.read(path, options)
    return (captures,) if isinstance(captures, Capture) else tuple(captures)
