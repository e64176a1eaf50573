"""How the images of a trial are stored: each row less the one above, under Zstandard.

Camera noise is what fills a tactile image, and it does not compress: what pays is speed. On simulated frames this is
several times as fast to write and to read as PNG, FFV1 or Zarr, within 10 % of the smallest (`benchmarks/stores.py`).
Anything that reads Parquet can undo it: Zstandard, then a running sum down the rows, modulo 256.
"""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from jaxtyping import UInt8

from sliplens.errors import RecordingError

CODEC = "rows+zstd"
"""Its name in the metadata of a trial."""


def encode_pixels(pixels: UInt8[np.ndarray, "height width *channels"]) -> bytes:
    """Bytes of an image; the size is kept elsewhere."""
    rows = pixels.copy()
    rows[1:] -= pixels[:-1]
    return pa.compress(rows.tobytes(), codec="zstd", asbytes=True)


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
