"""How the images of a trial are stored: each row less the one above, under Zstandard.

Camera noise is what fills a tactile image, and it does not compress: what pays is speed. On simulated frames this is
several times as fast to write and to read as PNG, FFV1 or Zarr, within 10 % of the smallest (`benchmarks/stores.py`).
Anything that reads Parquet can undo it: Zstandard, then a running sum down the rows, modulo 256.
"""

import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import pyarrow as pa
from jaxtyping import UInt8

from sliplens.errors import RecordingError

CODEC = "rows+zstd"
"""Its name in the metadata of a trial."""
ROW_GROUP = 64
"""Frames that are written, and can be read, together."""


def encode_pixels(pixels: UInt8[np.ndarray, "height width *channels"]) -> bytes:
    """Bytes of an image; the size is kept elsewhere."""
    rows = pixels.copy()
    rows[1:] -= pixels[:-1]
    # a copy of the right size: bytes that are cut down in place leave holes, and memory would grow with every frame
    return pa.compress(rows, codec="zstd").to_pybytes()


def encode_frames(frames: Iterable[UInt8[np.ndarray, "height width *channels"]]) -> Iterator[list[bytes]]:
    """Encode frames side by side while the next are made, and give them in chunks of a row group.

    Two frames a processor are held as pixels, however many there are.
    """
    workers = os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:  # Zstandard lets go of the interpreter's lock
        chunk: list[bytes] = []
        for image in _in_turn(pool, frames, ahead=2 * workers):
            chunk.append(image)
            if len(chunk) == ROW_GROUP:
                yield chunk
                chunk = []
        if chunk:
            yield chunk


def _in_turn(
    pool: ThreadPoolExecutor, frames: Iterable[UInt8[np.ndarray, "height width *channels"]], *, ahead: int
) -> Iterator[bytes]:
    waiting: deque[Future[bytes]] = deque()
    for frame in frames:
        waiting.append(pool.submit(encode_pixels, frame))
        if len(waiting) == ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def decode_pixels(
    data: bytes | pa.Buffer, *, size: Sequence[int], where: str
) -> UInt8[np.ndarray, "height width *channels"]:
    """Pixels of an image of known size (height, width, and channels if any).

    Raises
    ------
    RecordingError
        If the bytes are damaged or of another size; the message begins with `where`.
    """
    count = int(np.prod(size))
    try:
        raw = pa.decompress(data, decompressed_size=count, codec="zstd")
    except (pa.ArrowInvalid, OSError, ValueError) as error:
        raise RecordingError(f"{where} cannot be read ({error}); make the data set again") from None
    rows = np.frombuffer(raw, dtype=np.uint8)
    if rows.size != count:
        raise RecordingError(f"{where} holds {rows.size} bytes, {count} are expected; make the data set again")
    return np.cumsum(rows.reshape(size), axis=0, dtype=np.uint8)
