"""Readers of recordings that take the fields of their options by keyword."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

from sliplens.errors import InputError
from sliplens.recordings.formats import arrays, images, rosbag, tables, video
from sliplens.recordings.options import ReadOptions

Found = TypeVar("Found")


def _by_keyword(read: Callable[[Path, ReadOptions], Found]) -> Callable[..., Found]:
    return lambda path, **options: read(path, ReadOptions(**options))


read_arrays = _by_keyword(arrays.read_arrays)
read_force_table = _by_keyword(lambda path, options: tables.read_force_table(tables.open_text_table(path), options))
read_image_folder = _by_keyword(images.read_image_folder)
read_rosbag = _by_keyword(rosbag.read_rosbag)
read_video = _by_keyword(video.read_video)


def refused(read: Callable[..., object], path: Path, match: str, **options: object) -> None:
    """Check that a reader refuses a recording in a sentence."""
    with pytest.raises(InputError, match=match):
        read(path, **options)
