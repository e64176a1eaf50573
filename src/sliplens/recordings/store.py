"""One trial on disk: a Parquet file, a row a frame."""

import json
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import UInt8

from sliplens.errors import RecordingError
from sliplens.images.files import decode_png, encode_png
from sliplens.recordings.recording import SIGNALS, ContactState, Recording
from sliplens.recordings.truth import GroundTruth

SCHEMA_VERSION = 1
ROW_GROUP = 64
"""Frames that are written, and can be read, together."""
_DESCRIPTION = ("trial", "sensor", "day", "condition")
_OPTIONAL = ("safety_margin_sigma", "valid")
_TRUTH_SIGNALS = ("static_friction", "contact_radius_m", "stick_radius_m")
_TRUTH_COLUMNS = frozenset({*_TRUTH_SIGNALS, "marker_px", "contact_map"})


def save_recording(recording: Recording, path: Path) -> None:
    """Write a trial as one Parquet file: a row a frame, its image a lossless PNG; whole or not at all."""
    columns: dict[str, Any] = {name: getattr(recording, name) for name in SIGNALS}
    columns["contact_state"] = [str(state) for state in recording.contact_state]
    description = {name: str(getattr(recording, name)) for name in _DESCRIPTION}
    columns |= {name: getattr(recording, name) for name in _OPTIONAL if getattr(recording, name) is not None}
    if recording.truth is not None:
        truth = recording.truth
        columns |= {name: getattr(truth, name) for name in _TRUTH_SIGNALS}
        columns["marker_px"] = pa.FixedSizeListArray.from_arrays(
            truth.marker_px.ravel(), list_size=truth.marker_rest_px.size
        )
        with ThreadPoolExecutor() as pool:  # zlib lets go of the interpreter's lock
            columns["contact_map"] = pa.array(list(pool.map(encode_png, truth.contact_map)), type=pa.binary())
        description["truth"] = json.dumps(
            {
                "recipe": truth.recipe,
                "displacement": truth.displacement,
                "marker_rest_px": truth.marker_rest_px.tolist(),
            }
        )
    write_trial(path, encode_frames(recording.frames), columns, description, reference=recording.reference)


def encode_frames(frames: Iterable[UInt8[np.ndarray, "height width 3"]]) -> Iterator[list[bytes]]:
    """PNG of frames, in chunks that are encoded side by side.

    Camera noise leaves nothing that repeats: where the first frame is smaller without looking for it, none is looked
    for.
    """
    huffman_only: bool | None = None
    with ThreadPoolExecutor() as pool:  # zlib lets go of the interpreter's lock
        for chunk in _chunks(frames, ROW_GROUP):
            if huffman_only is None:
                huffman_only = len(encode_png(chunk[0], huffman_only=True)) < len(encode_png(chunk[0]))
            yield list(pool.map(partial(encode_png, huffman_only=huffman_only), chunk))


def write_trial(
    path: Path,
    images: Iterable[list[bytes]],
    columns: Mapping[str, Any],
    description: Mapping[str, str],
    *,
    reference: UInt8[np.ndarray, "height width 3"],
) -> None:
    """Write the Parquet file of a trial, chunk by chunk; it appears when complete.

    Parameters
    ----------
    path
        File to write.
    images
        Encoded frames in chunks, a row group each.
    columns
        One value a frame for everything else.
    description, reference
        What the trial is, and its untouched sensor.
    """
    labels = pa.table(columns)
    metadata = {**description, b"reference": encode_png(reference), b"schema_version": str(SCHEMA_VERSION)}
    fields = [pa.field("frame", pa.int64()), *labels.schema, pa.field("image", pa.binary())]
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    written = 0
    # PNG bytes, nearly all of the file, neither compress further nor repeat
    with pq.ParquetWriter(part, pa.schema(fields, metadata), compression="none", use_dictionary=False) as writer:
        for chunk in images:
            rows = labels.slice(written, len(chunk)).combine_chunks()
            numbers = pa.array(np.arange(written, written + len(chunk)))
            arrays = [numbers, *(column.combine_chunks() for column in rows.columns), pa.array(chunk, type=pa.binary())]
            writer.write_table(pa.Table.from_arrays(arrays, schema=writer.schema))
            written += len(chunk)
    part.replace(path)


def _chunks(items: Iterable[Any], size: int) -> Iterator[list[Any]]:
    remaining = iter(items)
    while chunk := list(islice(remaining, size)):
        yield chunk


def load_recording(path: Path, *, truth: bool = True) -> Recording:
    """Read a trial written by `save_recording`.

    Parameters
    ----------
    path
        The Parquet file.
    truth
        Read a simulated trial's ground truth too; training does without it.

    Raises
    ------
    RecordingError
        If the file is missing, damaged or empty, or its labels break a law.
    ImageError
        If an image inside is damaged.
    """
    try:
        stored = pq.read_schema(path)
        wanted = None if truth else [name for name in stored.names if name not in _TRUTH_COLUMNS]
        table = pq.read_table(path, columns=wanted)
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; make the data set again") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise RecordingError(f"{path} is not a readable Parquet file ({error}); make the data set again") from None
    metadata = {key.decode(): value for key, value in (table.schema.metadata or {}).items()}
    missing = ({"reference", *_DESCRIPTION} - set(metadata)) | (
        {"image", "contact_state", *SIGNALS} - set(table.column_names)
    )
    if missing:
        raise RecordingError(f"{path} lacks {', '.join(sorted(missing))}; write it with save_recording")
    reference = decode_png(metadata["reference"], where=f"the reference frame of {path}")
    trial = metadata["trial"].decode()
    if table.num_rows == 0:
        raise RecordingError(f"trial {trial} has no frames; leave it out or record it again")
    return Recording(
        trial=trial,
        sensor=metadata["sensor"].decode(),
        day=int(metadata["day"]),
        condition=metadata["condition"].decode(),
        reference=reference,
        frames=_decode(table.column("image"), size=reference.shape, where=f"of {path}"),
        contact_state=tuple(ContactState(state) for state in table.column("contact_state").to_pylist()),
        **{name: table.column(name).to_numpy() for name in _OPTIONAL if name in table.column_names},
        truth=_read_truth(table, json.loads(metadata["truth"]), path) if truth and "truth" in metadata else None,
        **{name: table.column(name).to_numpy().astype(np.float64) for name in SIGNALS},
    )


@dataclass(frozen=True, kw_only=True)
class StoredTrial:
    """What a trial's file says without its frames being read."""

    trial: str
    sensor: str
    day: int
    condition: str
    frames: int
    height: int
    width: int
    recipe: str | None
    """Hash of the recipe of a simulated trial."""


def read_header(path: Path) -> StoredTrial:
    """Read what a trial is, without its frames.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or no trial.
    ImageError
        If its reference frame is damaged.
    """
    try:
        file = pq.read_metadata(path)
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; make the data set again") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise RecordingError(f"{path} is not a readable Parquet file ({error}); make the data set again") from None
    metadata = {key.decode(): value for key, value in (file.metadata or {}).items()}
    missing = {"reference", *_DESCRIPTION} - set(metadata)
    if missing:
        raise RecordingError(f"{path} lacks {', '.join(sorted(missing))}; write it with save_recording")
    height, width, _ = decode_png(metadata["reference"], where=f"the reference frame of {path}").shape
    return StoredTrial(
        trial=metadata["trial"].decode(),
        sensor=metadata["sensor"].decode(),
        day=int(metadata["day"]),
        condition=metadata["condition"].decode(),
        frames=file.num_rows,
        height=height,
        width=width,
        recipe=json.loads(metadata["truth"])["recipe"] if "truth" in metadata else None,
    )


def _read_truth(table: pa.Table, description: dict[str, Any], path: Path) -> GroundTruth:
    missing = _TRUTH_COLUMNS - set(table.column_names)
    if missing:
        raise RecordingError(f"{path} lacks {', '.join(sorted(missing))} of its truth; make the data set again")
    rest = np.array(description["marker_rest_px"], dtype=np.float32).reshape(-1, 2)
    # a trial is read as one chunk or many, as Arrow likes
    flat = table.column("marker_px").combine_chunks().flatten()
    maps = table.column("contact_map")
    size = decode_png(maps[0].as_py(), where=f"the contact map of frame 0 of {path}", mode="L").shape
    return GroundTruth(
        recipe=description["recipe"],
        displacement=description["displacement"],
        marker_rest_px=rest,
        marker_px=flat.to_numpy().astype(np.float32).reshape(table.num_rows, -1, 2),
        contact_map=_decode(maps, size=size, where=f"(contact map) of {path}"),
        **{name: table.column(name).to_numpy().astype(np.float64) for name in _TRUTH_SIGNALS},
    )


def _decode(images: pa.ChunkedArray, *, size: tuple[int, ...], where: str) -> UInt8[np.ndarray, "frames ..."]:
    """Decode the PNG images of a trial, all of the reference's size, in threads."""
    pixels = np.empty((len(images), *size), dtype=np.uint8)
    mode = "RGB" if len(size) == 3 else "L"

    def decode(index: int) -> UInt8[np.ndarray, "height width *channels"]:
        return decode_png(images[index].as_py(), where=f"frame {index} {where}", mode=mode)

    with ThreadPoolExecutor() as pool:
        for index, image in enumerate(pool.map(decode, range(len(images)))):
            if image.shape != size:
                raise RecordingError(
                    f"frame {index} {where} is {image.shape[:2]} pixels but the reference is {tuple(size[:2])}; "
                    "record both with the same camera settings"
                )
            pixels[index] = image
    return pixels
