"""What a ROS 2 bag holds: its topics, and their messages in the order of recording. No ROS is needed."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliplens.errors import InputError, RecordingError, SliplensError
from sliplens.recordings.readers.ros_expansion import ExpandsTooFarError, bounded_reader

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

_STORAGE = (".mcap", ".db3")


def bag_topics(path: Path) -> dict[str, str]:
    """Topics of a bag and the types of their messages.

    Raises
    ------
    InputError
        If `rosbags` is not installed.
    RecordingError
        If the path is no bag, it is damaged, or expands too far.
    """
    with open_bag(path) as bag:
        return {connection.topic: connection.msgtype for connection in bag.connections}


def bag_messages(path: Path, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of arrival in nanoseconds and content of each message, in the order of recording.

    Definitions that the bag brings along are not used, for `rosbags` turns them into code; those of the messages read
    here are the same in all of ROS 2. Message data are views of the bytes read: a large header claims nothing. What is
    compressed is expanded a chunk, message or file at a time, within the limits of `ros_expansion`.

    Parameters
    ----------
    path
        Folder with `metadata.yaml`, or an .mcap or .db3 file.
    topics
        The topics to read.

    Raises
    ------
    InputError
        If `rosbags` is not installed.
    RecordingError
        If the path is no bag, it is damaged, or expands too far.
    """
    with open_bag(path) as bag:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 (an extra)

        types = get_typestore(Stores.LATEST)
        wanted = [connection for connection in bag.connections if connection.topic in topics]
        if not wanted:  # to rosbags none means all
            return
        for connection, time_ns, data in bag.messages(wanted):
            yield connection.topic, time_ns, types.deserialize_cdr(memoryview(data), connection.msgtype)


@contextmanager
def open_bag(path: Path) -> Iterator["Reader"]:
    """Open a bag to read it, as `bag_topics` and `bag_messages` do; they tell of its errors."""
    try:
        import rosbags.rosbag2  # noqa: F401, PLC0415 (an extra)
    except ImportError:
        raise InputError(
            'a ROS 2 bag needs rosbags, which is not installed; install it with `pip install "sliplens[ros]"`'
        ) from None
    _require_bag(path)
    for file in path.glob("*.db3") if path.is_dir() else [path]:
        _require_whole_pages(file)
    try:
        with bounded_reader()(path) as bag:
            yield bag
    except SliplensError:
        raise
    except ExpandsTooFarError as error:
        raise RecordingError(
            f"{path}: {error}, as damaged and hostile files do; expand it beforehand, or record it in smaller pieces"
        ) from None
    # a damaged byte may lead rosbags, sqlite or YAML into any error there is, from KeyError to MemoryError
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise RecordingError(
            f"{path} is not a readable ROS 2 bag ({said}); copy it again, or mend it with `mcap recover`"
        ) from None


def _require_bag(path: Path) -> None:
    if not path.exists():
        raise RecordingError(f"{path} does not exist; check the path")
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return
        inside = sorted(file.name for file in path.iterdir() if file.suffix in _STORAGE)
        cure = f"name {inside[0]} itself" if len(inside) == 1 else "name the folder of one bag"
        raise RecordingError(f"{path} has no metadata.yaml; write it with `ros2 bag reindex`, or {cure}")
    if path.suffix == ".bag":
        raise RecordingError(f"{path} is a ROS 1 bag; convert it with `rosbags-convert --src BAG --dst FOLDER`")
    if path.suffix not in _STORAGE:
        raise RecordingError(f"{path} is no ROS 2 bag; name its folder, or its {' or '.join(_STORAGE)} file")


def _require_whole_pages(file: Path) -> None:
    """Refuse a database that is cut off within a page, for sqlite would read zeros there."""
    with file.open("rb") as stream:
        head = stream.read(18)
    # https://www.sqlite.org/fileformat.html: 16 bytes of magic, then the page size, where 1 stands for 65536
    page = int.from_bytes(head[16:18], "big")
    if head.startswith(b"SQLite format 3\0") and file.stat().st_size % (65536 if page == 1 else page or 1):
        raise RecordingError(f"{file} is cut off; copy it again")
