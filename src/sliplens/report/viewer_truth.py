"""What a simulator knows of a trial, over its camera frames in the Rerun viewer."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, Float32

from sliplens.recordings import Recording
from sliplens.recordings.parquet import reading
from sliplens.recordings.pixels import decode_pixels
from sliplens.recordings.truth import OUTSIDE, SLIPS, STICKS
from sliplens.report.style import ORANGE, SKY, YELLOW
from sliplens.report.viewer_numbers import clock, rgba
from sliplens.report.viewer_process import require_rerun

if TYPE_CHECKING:
    from rerun import RecordingStream

_TOGETHER = 8  # frames whose maps are held and sent together
_OPACITY = 0.35
_HALF_PX = 0.5  # Rerun's pixels reach from one whole number to the next, ours have their centres there


@dataclass(frozen=True, kw_only=True)
class StoredTruth:
    """What is small of the truth of a stored trial."""

    displacement: str
    """Which model moved the markers."""
    marker_rest_px: Float32[np.ndarray, "markers 2"]
    static_friction: Float[np.ndarray, " frames"]
    """mu_s, whether or not the contact slips."""


def read_truth(path: Path) -> StoredTruth | None:
    """Read the truth of a trial without its markers and maps; None where there is none."""
    with reading(path):
        metadata = pq.read_schema(path).metadata or {}
        if b"truth" not in metadata:
            return None
        told = json.loads(metadata[b"truth"])
        friction = pq.read_table(path, columns=["static_friction"]).column("static_friction")
    return StoredTruth(
        displacement=told["displacement"],
        marker_rest_px=np.array(told["marker_rest_px"], dtype=np.float32).reshape(-1, 2),
        static_friction=friction.to_numpy().astype(np.float64),
    )


def log_truth(stream: "RecordingStream", path: Path, trial: Recording, truth: StoredTruth) -> None:
    """Log contact and stick zone, and markers with how far they went, over the camera frames of a simulated trial."""
    rerun, rest_px, done = require_rerun(), truth.marker_rest_px, 0
    height, width = trial.reference.shape[:2]
    zones = [(OUTSIDE, "no contact", [0, 0, 0, 0]), (SLIPS, "slips", rgba(ORANGE)), (STICKS, "sticks", rgba(SKY))]
    stream.log("camera/zones", rerun.AnnotationContext(zones), static=True)
    form = rerun.components.ImageFormat(width=width, height=height, channel_datatype="U8")
    stream.log("camera/zones", rerun.SegmentationImage.from_fields(format=form, opacity=_OPACITY), static=True)
    dots = rerun.Points2D.from_fields(colors=[rgba(YELLOW)], radii=[rerun.Radius.ui_points(2.0)])
    stream.log("camera/markers", dots, static=True)
    arrows = rerun.Arrows2D.from_fields(colors=[rgba(YELLOW)], radii=[rerun.Radius.ui_points(1.0)])
    stream.log("camera/displacements", arrows, static=True)
    for rows in _stored_rows(path):
        places = np.arange(done, done + rows.num_rows)
        times, lengths = clock(trial.time_s[places], places), [len(rest_px)] * rows.num_rows
        markers = rows.column("marker_px").flatten().to_numpy().reshape(rows.num_rows, len(rest_px), 2)
        moved = (markers - rest_px).reshape(-1, 2)
        begin = np.tile(rest_px + _HALF_PX, (rows.num_rows, 1))
        points = rerun.Points2D.columns(positions=markers.reshape(-1, 2) + _HALF_PX).partition(lengths)
        stream.send_columns("camera/markers", times, points)
        columns = rerun.Arrows2D.columns(vectors=moved, origins=begin).partition(lengths)
        stream.send_columns("camera/displacements", times, columns)
        maps = [
            decode_pixels(one.as_buffer(), size=(height, width), where=f"frame {at} (contact map) of {path}").tobytes()
            for at, one in zip(places, rows.column("contact_map"), strict=True)
        ]
        stream.send_columns("camera/zones", times, rerun.SegmentationImage.columns(buffer=maps))
        done += rows.num_rows


def _stored_rows(path: Path) -> Iterator[pa.RecordBatch]:
    with reading(path), pq.ParquetFile(path) as file:
        yield from file.iter_batches(_TOGETHER, columns=["marker_px", "contact_map"])
