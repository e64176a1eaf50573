"""Readers: one row a format. An installed package adds one through the entry point group `sliplens.readers`."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib.metadata import entry_points
from pathlib import Path

from sliplens.errors import InputError
from sliplens.images.files import IMAGE_SUFFIXES
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import DATASET_FILE
from sliplens.recordings.formats.gelsight import is_gelsight, read_gelsight
from sliplens.recordings.formats.images import read_image_folder
from sliplens.recordings.formats.lerobot import read_lerobot
from sliplens.recordings.formats.rosbag import read_rosbag
from sliplens.recordings.formats.stored import read_stored
from sliplens.recordings.formats.thesis import is_thesis_list, read_thesis
from sliplens.recordings.formats.video import read_video

_BAG_SUFFIXES = frozenset({".mcap", ".db3"})


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What a user may say of a source; None where nothing is said. Which reader takes what, `Reader.takes` tells."""

    forces: Path | None = None
    """Table of forces beside the frames."""
    frame_rate: float | None = None
    """Frames a second, where the stamps are missing or wrong."""
    times: Path | None = None
    """Table of when each image of a folder was taken."""
    name_unit: str | None = None
    """Unit of the last number in the names of images, which is then their time."""
    skip_frames: int | None = None
    """Frames at the start of a video to leave out."""
    skip_stale: bool | None = None
    """Leave out what a video begins with that belongs to another scene."""
    start_s: float | None = None
    """When the first frame was taken, on the clock of the forces."""
    time_column: str | None = None
    force_columns: tuple[str, ...] | None = None
    time_unit: str | None = None
    force_unit: str | None = None
    image_topic: str | None = None
    wrench_topic: str | None = None
    camera_key: str | None = None
    force_key: str | None = None
    image_root: Path | None = None
    """Folder under which listed images lie now."""
    margin_unit: str | None = None

    def given(self) -> dict[str, object]:
        """What was said."""
        return {field.name: value for field in fields(self) if (value := getattr(self, field.name)) is not None}


@dataclass(frozen=True, kw_only=True)
class Reader:
    """How a format is recognised and read."""

    words: str
    """What it reads, for people."""
    recognises: Callable[[Path], bool]
    """Told by names alone, without reading."""
    takes: tuple[str, ...]
    """Options it understands."""
    read: Callable[..., Capture | list[Capture]]
    """Called with the path and the options that were given."""


_TABLE = ("forces", "frame_rate", "start_s", "time_column", "force_columns", "time_unit", "force_unit")

READERS = {
    "sliplens": Reader(
        words="data set of sliplens, simulated or imported, with its labels",
        recognises=lambda path: (path / DATASET_FILE).is_file(),
        takes=(),
        read=read_stored,
    ),
    "rosbag": Reader(
        words="ROS 2 bag (MCAP or sqlite3)",
        recognises=lambda path: path.suffix in _BAG_SUFFIXES or (path / "metadata.yaml").is_file(),
        takes=("image_topic", "wrench_topic"),
        read=read_rosbag,
    ),
    "lerobot": Reader(
        words="LeRobot v3 data set",
        recognises=lambda path: (path / "meta" / "info.json").is_file(),
        takes=("camera_key", "force_key"),
        read=read_lerobot,
    ),
    "thesis": Reader(
        words="lists of the thesis (*_images_L.txt), with their margins",
        recognises=is_thesis_list,
        takes=("image_root", "margin_unit", "frame_rate"),
        read=read_thesis,
    ),
    "gelsight": Reader(
        words="GelSight Mini clips of the data set behind 'Incipient Slip Detection', without a label of any frame",
        recognises=is_gelsight,
        takes=("frame_rate",),
        read=read_gelsight,
    ),
    "images": Reader(
        words="folder of images, with a table of forces",
        recognises=lambda path: path.is_dir() and any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir()),
        takes=(*_TABLE, "times", "name_unit"),
        read=read_image_folder,
    ),
    "video": Reader(
        words="video, with a table of forces",
        recognises=lambda path: path.is_file(),
        takes=(*_TABLE, "skip_frames", "skip_stale"),
        read=read_video,
    ),
}
"""Readers by format, tried in this order where none is named."""


def all_readers() -> dict[str, Reader]:
    """Readers of sliplens and of installed packages, the latter tried first; none replaces one of ours."""
    found = {point.name: point.load() for point in entry_points(group="sliplens.readers") if point.name not in READERS}
    return {**found, **READERS}


def open_captures(path: Path, *, format: str | None = None, options: ReadOptions) -> tuple[Capture, ...]:
    """Open a source with the reader of its format.

    Parameters
    ----------
    path
        File or folder.
    format
        Row of `all_readers`; recognised by names if None.
    options
        What is known of the source.

    Raises
    ------
    InputError
        If the source is missing, its format is not known, or its reader does not take an option that was given.
    RecordingError
        If it cannot be read.
    """
    readers = all_readers()
    if format is not None and format not in readers:
        raise InputError(f"format {format!r} is not known; choose {', '.join(readers)}")
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path")
    name = format or next((name for name, reader in readers.items() if reader.recognises(path)), None)
    if name is None:
        known = "; ".join(f"{name}: {reader.words}" for name, reader in readers.items())
        raise InputError(f"{path} is none of the formats that are known ({known}); name one with --format")
    given = options.given()
    strange = [option for option in given if option not in readers[name].takes]
    if strange:
        raise InputError(
            f"{path} is read as {name}, which does not take {', '.join(strange)}; leave it out or name another format"
        )
    captures = readers[name].read(path, **given)
    return (captures,) if isinstance(captures, Capture) else tuple(captures)
