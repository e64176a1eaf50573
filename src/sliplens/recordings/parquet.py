"""Parquet files: what Arrow raises of a damaged one, and what is told of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa

from sliplens.errors import RecordingError

DAMAGED_PARQUET = (pa.ArrowException, OSError, ValueError, LookupError)
"""What Arrow raises of a damaged file: names, too, may be no text."""


def one_line(error: Exception) -> str:
    """What an error says, without the line breaks and stacks of Arrow."""
    return " ".join(str(error).split())[:200]


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Tell of a file of a data set that is missing or damaged, whatever is read of it inside.

    Raises
    ------
    RecordingError
        In place of what Arrow raises.
    """
    try:
        yield
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; make the data set again") from None
    except DAMAGED_PARQUET as error:
        raise RecordingError(
            f"{path} is not a readable Parquet file ({one_line(error)}); make the data set again"
        ) from None
