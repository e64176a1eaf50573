"""Trial on disk: a Parquet file with a row a frame, and a header and the reference frame in its metadata."""

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from itertools import accumulate, islice, pairwise
from math import prod
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, UInt8

from sliplens.codec import from_builtins, open_parquet, read_parquet, write_tables
from sliplens.errors import RecordingError
from sliplens.files import hash_json, parse_json, to_builtins, whole_file
from sliplens.images import MOST_PIXELS, encode_image, read_image
from sliplens.recordings.capture import Forces, Frame
from sliplens.recordings.labelling import Labelling
from sliplens.recordings.trial import OPTIONAL_LABELS, SIGNALS, ContactState, GroundTruth, Labels, Recording, TrialFacts

Pixels: TypeAlias = UInt8[np.ndarray, "height width *channels"]
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

SCHEMA_VERSION = 2
ROW_GROUP = 64  #: Frames that are written and read together.
_AGAIN = "make the data set again"


def encode_pixels(pixels: Pixels) -> bytes:
    """Encode an image; its size is stored elsewhere."""
    rows = pixels.copy()
    rows[1:] -= pixels[:-1]
    # a copy of the right size: bytes that shrink in place leave holes, and memory would grow with every frame
    return pa.compress(rows, codec="zstd").to_pybytes()


def in_turn(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """Apply a function in threads while the next items are made; yields the results in the order of the items."""
    cores = os.environ.get("OMP_NUM_THREADS", "")  # of this process, where several work
    workers = int(cores) if cores.isdigit() and int(cores) else os.cpu_count() or 1
    items = iter(items)
    waiting: Iterator[_Result] = iter(())
    with ThreadPoolExecutor(workers) as pool:
        while batch := list(islice(items, workers)):
            ahead = pool.map(function, batch)
            yield from waiting
            waiting = ahead
        yield from waiting


def decode_pixels(data: bytes | pa.Buffer | None, *, size: Sequence[int], where: str) -> Pixels:
    """Decode the pixels of an image of known size (height, width, and channels if any)."""
    count = prod(size)
    try:
        raw = pa.decompress(data, decompressed_size=count, codec="zstd")
    except (pa.ArrowInvalid, OSError, ValueError, TypeError) as error:
        raise RecordingError(f"{where} cannot be read ({error}); {_AGAIN}") from None
    rows = np.frombuffer(raw, dtype=np.uint8)
    if rows.size != count:
        raise RecordingError(f"{where} holds {rows.size} bytes, {count} are expected; {_AGAIN}")
    return np.cumsum(rows.reshape(size), axis=0, dtype=np.uint8)


@dataclass(frozen=True, kw_only=True)
class TruthHeader:
    """Part of the ground truth that has no value a frame; see `GroundTruth`."""

    recipe: str
    displacement: str
    marker_rest_px: tuple[tuple[float, float], ...]


@dataclass(frozen=True, kw_only=True)
class StoredFacts(TrialFacts):
    """Facts of a stored trial; a name or size that none has is a `ValueError`."""

    frames: int
    height: int  #: Rows of its frames, in pixels.
    width: int

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w(?:[\w.-]*\w)?", self.trial):
            raise ValueError(f"a trial is named with letters, digits, dots, dashes and underscores, not {self.trial!r}")
        if self.frames < 0 or min(self.height, self.width) <= 0 or self.height * self.width > MOST_PIXELS:
            raise ValueError(f"no trial has {self.frames} frames of {self.height} x {self.width} pixels")


@dataclass(frozen=True, kw_only=True)
class TrialHeader(StoredFacts):
    """Facts of a stored trial that can be read without its frames."""

    labelling: Labelling | None = None
    truth: TruthHeader | None = None


_FACTS = tuple(field.name for field in fields(TrialFacts))
_HEADER, _FIRST_REFERENCE = b"sliplens", b"first_reference"


def read_header(path: Path) -> TrialHeader:
    """Read the facts of a trial and the provenance of its labels, without its frames."""
    with _open(path) as (_, header, _):
        return header


def read_first_reference(path: Path) -> Frame | None:
    """Read the image of the untouched sensor from before a correction named another; None where none did."""
    with _open(path) as (_, _, metadata):
        image = metadata.get(_FIRST_REFERENCE)
        return None if image is None else read_image(image, where=f"the first reference frame of {path}", cure=_AGAIN)


_KINDS = {
    **dict.fromkeys((*SIGNALS, "safety_margin_sigma", "force_time_s"), "numbers"),
    **{"image": "bytes", "contact_state": "texts", "valid": "true and false", "reason": "texts"},
}
"""Kind of each column of a trial; `OPTIONAL_LABELS` may be missing."""


@contextmanager
def _open(path: Path) -> Iterator[tuple[pq.ParquetFile, TrialHeader, Mapping[bytes, bytes]]]:
    """Open a trial, its header and its metadata; whatever is damaged, also of what is read inside, is one sentence."""
    needed = {name: kind for name, kind in _KINDS.items() if name not in OPTIONAL_LABELS}
    with open_parquet(path, needed, cure=_AGAIN, error=RecordingError) as file:
        metadata: Mapping[bytes, bytes] = file.schema_arrow.metadata or {}
        where = f"the header of {path}"
        values = parse_json(metadata[_HEADER], where=where, cure=_AGAIN)
        header = from_builtins(values, TrialHeader, where=where, command="sliplens import")
        yield file, replace(header, frames=file.metadata.num_rows), metadata


_TRUTH_SIGNALS = ("static_friction", "contact_radius_m", "stick_radius_m")
_TRUTH_KINDS = {**dict.fromkeys(_TRUTH_SIGNALS, "numbers"), **{"marker_px": "lists of numbers", "contact_map": "bytes"}}


def save_recording(recording: Recording, path: Path) -> None:
    """Write a trial as one Parquet file with lossless images; complete or not at all."""
    write_trial(
        path,
        in_turn(encode_pixels, recording.frames),
        facts=recording,
        time_s=recording.time_s,
        labels=recording,
        reference=recording.reference,
        truth=recording.truth,
    )


def write_trial(
    path: Path,
    images: Iterable[bytes],
    *,
    facts: TrialFacts,
    time_s: Float[np.ndarray, " frames"],
    labels: Labels,
    reference: Frame,
    first_reference: Frame | None = None,
    truth: GroundTruth | None = None,
) -> None:
    """Write the Parquet file of a trial, its encoded images a row group at a time; it appears when complete."""
    columns: dict[str, Any] = {"time_s": time_s, "contact_state": labels.contact_state}
    for name in (*SIGNALS[1:], *OPTIONAL_LABELS):
        columns |= {} if getattr(labels, name) is None else {name: getattr(labels, name)}
    truth_header = None
    if truth is not None:
        rest = tuple(map(tuple, truth.marker_rest_px.tolist()))
        truth_header = TruthHeader(recipe=truth.recipe, displacement=truth.displacement, marker_rest_px=rest)
        columns |= {name: getattr(truth, name) for name in _TRUTH_SIGNALS}
        columns["marker_px"] = pa.FixedSizeListArray.from_arrays(truth.marker_px.ravel(), list_size=2 * len(rest))
        columns["contact_map"] = pa.array(list(in_turn(encode_pixels, truth.contact_map)), type=pa.binary())
    height, width, _ = reference.shape
    stored = {name: getattr(facts, name) for name in _FACTS} | {"frames": len(time_s), "height": height, "width": width}
    header = TrialHeader(**stored, labelling=labels.labelling, truth=truth_header)
    metadata = {_HEADER: msgspec.json.encode(to_builtins(header))}
    pictures = {b"reference": reference, _FIRST_REFERENCE: first_reference}
    metadata |= {key: encode_image(image) for key, image in pictures.items() if image is not None}
    table = pa.table({"frame": np.arange(len(time_s)), **columns})
    schema = pa.schema([*table.schema, pa.field("image", pa.binary())], metadata)
    images = iter(images)
    with (
        whole_file(path) as part,
        # the images, nearly all of the file, neither compress further nor repeat
        pq.ParquetWriter(part, schema, compression="none", use_dictionary=False) as writer,
    ):
        for first in range(0, len(table), ROW_GROUP):
            chunk = pa.array(islice(images, ROW_GROUP), pa.binary())
            writer.write_table(table.slice(first, ROW_GROUP).append_column("image", chunk).combine_chunks())


def load_recording(path: Path, *, truth: bool = True, pixels: bool = True) -> Recording:
    """Read a trial written by `save_recording`; without `pixels` every frame is the reference, without truth."""
    with _open(path) as (file, header, metadata):
        exact = header.truth if truth and pixels else None
        kinds = {name: kind for name, kind in _KINDS.items() if name in file.schema_arrow.names}
        if not pixels:
            del kinds["image"]
        size, frames = (header.height, header.width, 3), header.frames
        reference = read_image(metadata[b"reference"], where=f"the reference frame of {path}", cure=_AGAIN)
        if pixels and frames * prod(size) > 2**35:
            raise RecordingError(f"{path} claims {frames:,} frames, more than memory holds; {_AGAIN}")
        table = read_parquet(path, kinds | (_TRUTH_KINDS if exact else {}), cure=_AGAIN, error=RecordingError)
        labels: dict[str, Any] = {}
        for name, kind in kinds.items():
            if kind == "texts":
                labels[name] = tuple(table.column(name).to_pylist())
            elif name != "image":
                labels[name] = table.column(name).to_numpy().astype(np.float64 if kind == "numbers" else np.bool_)
        labels["contact_state"] = tuple(map(ContactState, labels["contact_state"]))
        if pixels:
            images = _decode(table.column("image"), size, f"of {path}")
        else:
            images = np.broadcast_to(reference, (frames, *size))
        if exact is not None:
            rest = np.array(exact.marker_rest_px, dtype=np.float32).reshape(-1, 2)
            # a trial is read as one chunk or many, as Arrow likes
            places = table.column("marker_px").combine_chunks().flatten().to_numpy().astype(np.float32)
            exact = GroundTruth(
                recipe=exact.recipe,
                displacement=exact.displacement,
                marker_rest_px=rest,
                marker_px=places.reshape(frames, *rest.shape),
                contact_map=_decode(table.column("contact_map"), size[:2], f"(contact map) of {path}"),
                **{name: table.column(name).to_numpy().astype(np.float64) for name in _TRUTH_SIGNALS},
            )
        return Recording(
            **{name: getattr(header, name) for name in _FACTS},
            **labels,
            labelling=header.labelling,
            reference=reference,
            frames=images,
            truth=exact,
        )


def stream_frames(path: Path, places: Collection[int] | None = None) -> Iterator[Frame]:
    """Yield the frames of a stored trial, all or those of some places, with one row group in memory."""
    with _open(path) as (file, header, _):
        sizes = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
        for group, (first, stop) in enumerate(pairwise(accumulate(sizes, initial=0))):
            if not (inside := [place for place in range(first, stop) if places is None or place in places]):
                continue
            images = file.read_row_group(group, columns=["image"]).column("image")
            for place in inside:
                where, size = f"frame {place} of {path}", (header.height, header.width, 3)
                yield decode_pixels(images[place - first].as_buffer(), size=size, where=where)


def read_frames(path: Path, places: Sequence[int]) -> UInt8[np.ndarray, "frames height width 3"]:
    """Read some frames of a stored trial, in the order of `places`, with one row group in memory at a time."""
    header, wanted = read_header(path), set(places)
    if outside := [place for place in places if not 0 <= place < header.frames]:
        raise RecordingError(f"{path} has no frame {outside[0]}; name one from 0 to {header.frames - 1}")
    frames = np.empty((len(places), header.height, header.width, 3), dtype=np.uint8)
    for place, frame in zip(sorted(wanted), stream_frames(path, wanted), strict=True):
        frames[np.equal(places, place)] = frame
    return frames


def hash_frames(path: Path) -> str:
    """Hash the images of a stored trial: its reference, its first and last frame, and the number of frames."""
    with _open(path) as (file, header, metadata):
        last = file.num_row_groups - 1
        ends = [file.read_row_group(group, columns=["image"]).column("image")[at] for group, at in ((0, 0), (last, -1))]
        images = [metadata[b"reference"], *(end.as_py() for end in ends)]
        return hash_json([header.frames, *(sha256(image).hexdigest() for image in images)])


def _decode(images: pa.ChunkedArray, size: tuple[int, ...], where: str) -> UInt8[np.ndarray, "frames ..."]:
    """Decode the images of a trial in threads."""
    pixels = np.empty((len(images), *size), dtype=np.uint8)

    def decode(index: int) -> Pixels:
        return decode_pixels(images[index].as_buffer(), size=size, where=f"frame {index} {where}")

    for index, image in enumerate(in_turn(decode, range(len(images)))):
        pixels[index] = image
    return pixels


_AXES = ("x_n", "y_n", "z_n")


def forces_path(folder: Path, trial: str) -> Path:
    """Return the file of the force samples of a trial."""
    return folder / "forces" / f"{trial}.parquet"


def save_forces(forces: Forces, path: Path) -> None:
    """Write samples as one Parquet file with a row a sample; complete or not at all."""
    columns = {"time_s": forces.time_s, **dict(zip(_AXES, forces.force_n.T, strict=True))}
    table = pa.table(columns).replace_schema_metadata({"source": forces.source})
    write_tables([table], path, table.schema)


def load_forces(path: Path) -> Forces:
    """Read samples written by `save_forces`."""
    columns: dict[str, str] = dict.fromkeys(("time_s", *_AXES), "numbers")
    table = read_parquet(path, columns, cure=_AGAIN, error=RecordingError)
    source = (table.schema.metadata or {}).get(b"source", b"the force sensor").decode(errors="replace")
    time_s, *force_n = (table.column(name).to_numpy().astype(np.float64) for name in columns)
    return Forces(time_s=time_s, force_n=np.stack(force_n, axis=-1), source=source)
