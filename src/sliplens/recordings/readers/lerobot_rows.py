"""Rows of the episodes of a LeRobot data set, as numbers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Int64

from sliplens.errors import RecordingError
from sliplens.recordings.readers.lerobot_layout import Episode, Layout, read_columns


class EpisodeRows:
    """Rows of episodes one after another; those of one file share what was read of it.

    Parameters
    ----------
    layout
        What the data set says of itself.
    columns
        Features to read.
    """

    def __init__(self, layout: Layout, columns: list[str]) -> None:
        self.layout, self.columns = layout, columns
        self.table: tuple[Path, pa.Table] | None = None

    def of(self, episode: Episode) -> pa.Table:
        """Rows of an episode, in their order.

        Raises
        ------
        RecordingError
            If the file is missing or damaged, lacks a column or a value, or has not as many rows as it should.
        """
        path = episode.data_file
        if self.table is None or self.table[0] != path:
            self.table = path, read_columns(path, ["episode_index", *self.columns])
        table = self.table[1]
        own: Bool[np.ndarray, " rows"] = table.column("episode_index").to_numpy() == episode.index
        rows = table.filter(pa.array(own))
        if rows.num_rows != episode.length or not rows.num_rows:
            raise RecordingError(
                f"{path} has {rows.num_rows} frames of episode {episode.index}, its metadata say {episode.length}; "
                "leave the episode out, or copy the data set again"
            )
        return rows

    def vectors(self, rows: pa.Table, key: str, episode: Episode) -> Float[np.ndarray, "frames numbers"]:
        """A feature of several floating-point numbers a frame."""
        width = self.layout.width(key)
        column = rows.column(key).combine_chunks()
        numbers = column.flatten() if hasattr(column, "flatten") else column
        if len(numbers) != len(rows) * width or numbers.null_count or not pa.types.is_floating(numbers.type):
            raise RecordingError(
                f"{key} of {episode.data_file} does not hold {width} numbers a frame, as meta/info.json says; "
                "copy the data set again"
            )
        return numbers.to_numpy().astype(np.float64).reshape(-1, width)

    def numbers(self, rows: pa.Table, key: str, episode: Episode) -> Float[np.ndarray, " frames"]:
        """A feature of one number a frame, as exact as it is stored."""
        return self._one(rows, key, episode, pa.types.is_floating, "numbers").astype(np.float64)

    def truths(self, rows: pa.Table, key: str, episode: Episode) -> Bool[np.ndarray, " frames"]:
        """A feature that is true or false."""
        return self._one(rows, key, episode, pa.types.is_boolean, "true and false").astype(bool)

    def words(self, rows: pa.Table, key: str, episode: Episode) -> tuple[str, ...]:
        """A feature whose whole numbers count through words that `meta/info.json` lists."""
        codes: Int64[np.ndarray, " frames"] = self._one(rows, key, episode, pa.types.is_integer, "whole numbers")
        info = self.layout.features[key].get("info")
        words = info.get("values") if isinstance(info, dict) else None
        if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
            raise RecordingError(
                f"meta/info.json of {self.layout.folder} does not list the values of {key}; copy the data set again"
            )
        if codes.min() < 0 or codes.max() >= len(words):
            raise RecordingError(
                f"{key} of {episode.data_file} leads beyond the {len(words)} values that meta/info.json lists; "
                "copy the data set again"
            )
        return tuple(words[code] for code in codes)

    def _one(self, rows: pa.Table, key: str, episode: Episode, fits: Callable[..., bool], what: str) -> np.ndarray:
        column = rows.column(key)
        if not fits(column.type):
            raise RecordingError(f"{key} of {episode.data_file} does not hold {what}; copy the data set again")
        return column.to_numpy()
