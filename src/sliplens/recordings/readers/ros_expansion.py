"""A reader of ROS 2 bags that expands what is compressed no further than a limit.

`rosbags` expands a chunk, message or file to whatever size it turns out to have, and has no limit to set. Its two
modules that do so are loaded once more, for this package alone, with expansion that stops; who uses `rosbags` elsewhere
in the process sees no change.
"""

import os
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

MOST_BYTES = 256 * 2**20
"""In memory at a time: of a chunk, of all chunks that cover one moment, or of a message. Chunks are of some 1 MB."""
MOST_TIMES = 100
"""A file that is compressed as a whole expands on disk, so far that its size may be multiplied."""


class ExpandsTooFarError(Exception):
    """Says what expands too far, for a sentence that begins with the bag."""


@cache
def bounded_reader() -> "type[Reader]":
    """`rosbags.rosbag2.Reader`, but it raises `ExpandsTooFarError` before memory or disk are filled.

    Raises
    ------
    ImportError
        If `rosbags` is not installed.
    """
    mcap, reader = _own_copy("rosbags.rosbag2.storage_mcap"), _own_copy("rosbags.rosbag2.reader")
    sqlite = import_module("rosbags.rosbag2.storage_sqlite3")
    zstd, lz4 = mcap.zstd, import_module("lz4.frame")

    class Mcap(mcap.McapReader):
        def _open(self) -> None:
            super()._open()
            _require_room(self.chunks)

    class Sqlite(sqlite.Sqlite3Reader):
        def _open(self) -> None:
            # a tiny database may compute a message of any size
            self.dbconn.limit(sqlite.apsw.SQLITE_LIMIT_LENGTH, MOST_BYTES)
            super()._open()

    # each gets the bytes and the size that is claimed for them, which rosbags compares with what comes out
    mcap.DECOMPRESSORS = {
        "": lambda data, _: data,
        "lz4": lambda data, size: _expand_chunk(data, lz4.LZ4FrameDecompressor, size, frames=1),
        "zstd": lambda data, size: _expand_chunk(data, zstd.ZstdDecompressor, size),
    }
    reader.zstd = SimpleNamespace(
        decompress=lambda data: _expand(
            data, zstd.ZstdDecompressor, most=MOST_BYTES, refusal=_beyond("a message", MOST_BYTES)
        ),
        open=lambda file, mode: _BoundedFile(
            zstd.open(file, mode), most=max(MOST_BYTES, MOST_TIMES * os.fstat(file.fileno()).st_size)
        ),
    )
    reader.DirectoryReader.STORAGE_PLUGINS = {"mcap": Mcap, "sqlite3": Sqlite}
    reader.Reader.STORAGE_PLUGINS = {"dir": reader.DirectoryReader, ".mcap": Mcap, ".db3": Sqlite}
    return reader.Reader


def _own_copy(name: str) -> Any:
    spec = find_spec(name)
    if spec is None or spec.loader is None:
        raise ImportError(f"{name} is not there")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _expand_chunk(data: bytes, decompressor: Any, size: int, *, frames: int | None = None) -> bytes:
    if size > MOST_BYTES:
        raise _beyond("a chunk", MOST_BYTES)
    lie = ExpandsTooFarError(f"a chunk expands to more than the {size:,} bytes that it claims")
    return _expand(data, decompressor, most=size, refusal=lie, frames=frames)


def _require_room(chunks: Iterable[Any]) -> None:
    """Refuse chunks that cover one moment and are too large together: rosbags expands all of these at once."""
    # at the same moment what begins counts before what ends
    begins = [(chunk.message_start_time, 0, chunk.uncompressed_size) for chunk in chunks]
    ends = [(max(chunk.message_start_time, chunk.message_end_time), 1, -chunk.uncompressed_size) for chunk in chunks]
    held = 0
    for _, _, size in sorted(begins + ends):
        held += size
        if held > MOST_BYTES:
            raise _beyond("a chunk, or chunks of the same moment together,", MOST_BYTES)


def _expand(
    data: bytes, decompressor: Any, *, most: int, refusal: ExpandsTooFarError, frames: int | None = None
) -> bytes:
    """Expand frames that follow each other, all or so many, to no more bytes than that."""
    parts, room, done = [], most + 1, 0
    while data and done != frames:
        frame = decompressor()
        given = data
        while not frame.eof and (given or not frame.needs_input):
            parts.append(frame.decompress(given, max_length=room))
            room -= len(parts[-1])
            given = b""
            if room <= 0:
                raise refusal
        if not frame.eof:
            raise EOFError("compressed bytes end early")
        data, done = frame.unused_data or b"", done + 1
    return b"".join(parts)


class _BoundedFile:
    """A file that is expanded while it is read."""

    def __init__(self, file: Any, *, most: int) -> None:
        self._file, self._room, self._most = file, most, most

    def __enter__(self) -> "_BoundedFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        part = self._file.read(min(size, self._room + 1) if size >= 0 else self._room + 1)
        self._room -= len(part)
        if self._room < 0:
            raise _beyond("a file", self._most)
        return part


def _beyond(what: str, most: int) -> ExpandsTooFarError:
    return ExpandsTooFarError(f"{what} expands to more than {most / 2**20:,.0f} MiB")
