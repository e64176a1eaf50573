"""One trial on disk: a Parquet file, a row a frame."""

import json
import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import UInt8

from sliplens.errors import RecordingError
from sliplens.images.files import decode_png, encode_png
from sliplens.recordings.trial import SIGNALS, ContactState, GroundTruth, Recording

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


DESCRIPTION = ("trial", "sensor", "day", "condition")
"""What every trial tells in its metadata."""
OBJECT = "object"
"""And what it may tell."""


@dataclass(frozen=True, kw_only=True)
class StoredTrial:
    """What a trial's file says without its frames being read."""

    trial: str
    sensor: str
    day: int
    condition: str
    object: str
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
    metadata = _read_metadata(path)
    missing = {"reference", *DESCRIPTION} - set(metadata)
    if missing:
        raise RecordingError(f"{path} lacks {', '.join(sorted(missing))}; write it with save_recording")
    height, width, _ = decode_png(metadata["reference"], where=f"the reference frame of {path}").shape
    return StoredTrial(
        trial=metadata["trial"].decode(),
        sensor=metadata["sensor"].decode(),
        day=int(metadata["day"]),
        condition=metadata["condition"].decode(),
        object=metadata.get(OBJECT, b"").decode(),
        frames=int(metadata["frames"]),
        height=height,
        width=width,
        recipe=json.loads(metadata["truth"])["recipe"] if "truth" in metadata else None,
    )


def read_reference(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read the reference frame of a trial.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or no trial.
    ImageError
        If the image is damaged.
    """
    metadata = _read_metadata(path)
    if "reference" not in metadata:
        raise RecordingError(f"{path} lacks a reference frame; write it with save_recording")
    return decode_png(metadata["reference"], where=f"the reference frame of {path}")


def read_labelling(path: Path) -> dict[str, Any] | None:
    """What the labels of an imported trial rest on, as `import_trial` found it; None where nothing is kept.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or what it tells of its labels is.
    """
    metadata = _read_metadata(path)
    if "labelling" not in metadata:
        return None
    try:
        labelling = json.loads(metadata["labelling"])
    except ValueError:
        labelling = None
    require_labelling(labelling, where=str(path))
    return labelling


def require_labelling(labelling: object, *, where: str) -> None:
    """Check that what is told of labels has the parts that pages and tables show.

    Raises
    ------
    RecordingError
        If a part is missing or of another kind.
    """

    def fits(value: object, parts: dict[str, Any]) -> bool:
        return isinstance(value, dict) and all(name in value and kind(value[name]) for name, kind in parts.items())

    def number(value: object) -> bool:
        return value is None or (isinstance(value, int | float) and not isinstance(value, bool))

    def words(value: object) -> bool:
        return isinstance(value, list) and all(isinstance(one, str) for one in value)

    def counts(value: object) -> bool:
        return isinstance(value, dict) and all(isinstance(one, int) and one >= 0 for one in value.values())

    def maybe(**parts: Any) -> Any:
        return lambda value: value is None or fits(value, parts)

    def text(value: object) -> bool:
        return value is None or isinstance(value, str)

    def three(value: object) -> bool:
        return isinstance(value, list) and len(value) == 3 and all(map(number, value))

    seen = {f"{name}_found": text for name in ("normal", "sign", "tare")}
    axes = maybe(
        notes=words,
        normal=text,
        sign=number,
        still_until_s=number,
        tare_n=three,
        tare_sigma_n=three,
        noise_n=three,
        **seen,
    )
    parts = {
        "source": text,
        "forces": text,
        "frames_by_reason": counts,
        "notes": words,
        "axes": axes,
        "friction": maybe(mu=number, low=number, high=number, found=text, method=text, image_sigmas=number),
        "lag": maybe(lag_s=number, sigma_s=number, doubt=text, correlation=number),
        "lag_applied": lambda value: isinstance(value, bool),
        "reference": lambda value: fits(
            value, {"index": number, "method": text, "contact_energy": number, "drift": number}
        ),
        **dict.fromkeys(("slip_s", "contact_threshold_n", "window_s", "gap_s", "force_range_n"), number),
    }
    if not fits(labelling, parts):
        wrong = [
            name for name, kind in parts.items() if not (isinstance(labelling, dict) and fits(labelling, {name: kind}))
        ]
        raise RecordingError(
            f"{where} tells nothing usable of how its labels were made ({', '.join(wrong[:3])}); import the trial again"
        )


def _read_metadata(path: Path) -> dict[str, bytes]:
    with reading(path):
        file = pq.read_metadata(path)
    metadata = {key.decode(): value for key, value in (file.metadata or {}).items()}
    return {**metadata, "frames": str(file.num_rows).encode()}


SCHEMA_VERSION = 1
_OPTIONAL = ("safety_margin_sigma", "valid")
_TRUTH_SIGNALS = ("static_friction", "contact_radius_m", "stick_radius_m")
_TRUTH_COLUMNS = frozenset({*_TRUTH_SIGNALS, "marker_px", "contact_map"})


def save_recording(recording: Recording, path: Path) -> None:
    """Write a trial as one Parquet file: a row a frame, its image lossless (`pixels`); whole or not at all."""
    columns: dict[str, Any] = {name: getattr(recording, name) for name in SIGNALS}
    columns["contact_state"] = [str(state) for state in recording.contact_state]
    description = {name: str(getattr(recording, name)) for name in DESCRIPTION}
    if recording.object:
        description[OBJECT] = recording.object
    columns |= {name: getattr(recording, name) for name in _OPTIONAL if getattr(recording, name) is not None}
    if recording.truth is not None:
        truth = recording.truth
        columns |= {name: getattr(truth, name) for name in _TRUTH_SIGNALS}
        columns["marker_px"] = pa.FixedSizeListArray.from_arrays(
            truth.marker_px.ravel(), list_size=truth.marker_rest_px.size
        )
        maps = [encoded for chunk in encode_frames(truth.contact_map) for encoded in chunk]
        columns["contact_map"] = pa.array(maps, type=pa.binary())
        description["truth"] = json.dumps(
            {
                "recipe": truth.recipe,
                "displacement": truth.displacement,
                "marker_rest_px": truth.marker_rest_px.tolist(),
            }
        )
    write_trial(path, encode_frames(recording.frames), columns, description, reference=recording.reference)


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
    metadata = {
        **description,
        "codec": CODEC,
        "schema_version": str(SCHEMA_VERSION),
        b"reference": encode_png(reference),
    }
    fields = [pa.field("frame", pa.int64()), *labels.schema, pa.field("image", pa.binary())]
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    written = 0
    # the images, nearly all of the file, neither compress further nor repeat
    with pq.ParquetWriter(part, pa.schema(fields, metadata), compression="none", use_dictionary=False) as writer:
        for chunk in images:
            rows = labels.slice(written, len(chunk)).combine_chunks()
            numbers = pa.array(np.arange(written, written + len(chunk)))
            arrays = [numbers, *(column.combine_chunks() for column in rows.columns), _in_place(chunk)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=writer.schema))
            written += len(chunk)
    part.replace(path)


def _in_place(images: list[bytes]) -> pa.ChunkedArray:
    """As Arrow sees them, none copied."""
    ends = (pa.py_buffer(np.array([0, len(image)], dtype=np.int32)) for image in images)
    parts = [
        pa.Array.from_buffers(pa.binary(), 1, [None, end, pa.py_buffer(image)])
        for end, image in zip(ends, images, strict=True)
    ]
    return pa.chunked_array(parts, type=pa.binary())


def load_recording(path: Path, *, truth: bool = True, pixels: bool = True) -> Recording:
    """Read a trial written by `save_recording`.

    Parameters
    ----------
    path
        The Parquet file.
    truth
        Read a simulated trial's ground truth too; training does without it.
    pixels
        Read the images too. Without them, and the truth, a trial of any length takes little memory: the reference
        stands for every frame, and `read_frames` reads those that are needed.

    Raises
    ------
    RecordingError
        If the file is missing, damaged or empty, or its labels break a law.
    ImageError
        If an image inside is damaged.
    """
    with reading(path):
        stored = pq.read_schema(path)
        left_out = (set() if truth and pixels else _TRUTH_COLUMNS) | (set() if pixels else {"image"})
        table = pq.read_table(path, columns=[name for name in stored.names if name not in left_out])
    metadata = {key.decode(): value for key, value in (table.schema.metadata or {}).items()}
    missing = ({"reference", *DESCRIPTION} - set(metadata)) | ({"image", "contact_state", *SIGNALS} - set(stored.names))
    if missing:
        raise RecordingError(f"{path} lacks {', '.join(sorted(missing))}; write it with save_recording")
    _require_codec(table.schema, path)
    reference = decode_png(metadata["reference"], where=f"the reference frame of {path}")
    trial = metadata["trial"].decode()
    if table.num_rows == 0:
        raise RecordingError(f"trial {trial} has no frames; leave it out or record it again")
    return Recording(
        trial=trial,
        sensor=metadata["sensor"].decode(),
        day=int(metadata["day"]),
        condition=metadata["condition"].decode(),
        object=metadata.get(OBJECT, b"").decode(),
        reference=reference,
        frames=_decode(table.column("image"), size=reference.shape, where=f"of {path}")
        if pixels
        else np.broadcast_to(reference, (table.num_rows, *reference.shape)),
        contact_state=tuple(ContactState(state) for state in table.column("contact_state").to_pylist()),
        **{name: table.column(name).to_numpy() for name in _OPTIONAL if name in table.column_names},
        truth=_read_truth(table, json.loads(metadata["truth"]), reference.shape[:2], path)
        if truth and pixels and "truth" in metadata
        else None,
        **{name: table.column(name).to_numpy().astype(np.float64) for name in SIGNALS},
    )


def stream_frames(path: Path) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Frames of a stored trial one at a time, a row group of them in memory.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or keeps its images in another way.
    ImageError
        If an image inside is damaged.
    """
    header, file, first = read_header(path), _open_images(path), 0
    with file:
        for group in range(file.num_row_groups):
            images = _read_images(file, group, path)
            for at, image in enumerate(images):
                where = f"frame {first + at} of {path}"
                yield decode_pixels(image.as_buffer(), size=(header.height, header.width, 3), where=where)
            first += len(images)


def read_frames(path: Path, places: Sequence[int]) -> UInt8[np.ndarray, "frames height width 3"]:
    """Some frames of a stored trial, in the order asked for, a row group in memory at a time.

    Parameters
    ----------
    path
        The Parquet file.
    places
        Numbers of the frames.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or a frame is not there.
    ImageError
        If an image inside is damaged.
    """
    header, first = read_header(path), 0
    strange = [place for place in places if not 0 <= place < header.frames]
    if strange:
        raise RecordingError(f"{path} has no frame {strange[0]}; name one from 0 to {header.frames - 1}")
    found = np.empty((len(places), header.height, header.width, 3), dtype=np.uint8)
    with _open_images(path) as file:
        for group in range(file.num_row_groups):
            end = first + file.metadata.row_group(group).num_rows
            inside = [(at, place) for at, place in enumerate(places) if first <= place < end]
            images = _read_images(file, group, path) if inside else None
            for at, place in inside:
                assert images is not None
                where = f"frame {place} of {path}"
                found[at] = decode_pixels(images[place - first].as_buffer(), size=found.shape[1:], where=where)
            first = end
    return found


def _open_images(path: Path) -> pq.ParquetFile:
    with reading(path):
        file = pq.ParquetFile(path, memory_map=True)
    _require_codec(file.schema_arrow, path)
    return file


def _read_images(file: pq.ParquetFile, group: int, path: Path) -> pa.ChunkedArray:
    with reading(path):
        return file.read_row_group(group, columns=["image"]).column("image")


def _require_codec(schema: pa.Schema, path: Path) -> None:
    codec = (schema.metadata or {}).get(b"codec", b"png").decode()
    if codec != CODEC:
        raise RecordingError(f"{path} keeps its images as {codec}, {CODEC} is needed; make the data set again")


def _read_truth(table: pa.Table, description: dict[str, Any], size: tuple[int, ...], path: Path) -> GroundTruth:
    missing = _TRUTH_COLUMNS - set(table.column_names)
    if missing:
        raise RecordingError(f"{path} lacks {', '.join(sorted(missing))} of its truth; make the data set again")
    rest = np.array(description["marker_rest_px"], dtype=np.float32).reshape(-1, 2)
    # a trial is read as one chunk or many, as Arrow likes
    flat = table.column("marker_px").combine_chunks().flatten()
    return GroundTruth(
        recipe=description["recipe"],
        displacement=description["displacement"],
        marker_rest_px=rest,
        marker_px=flat.to_numpy().astype(np.float32).reshape(table.num_rows, -1, 2),
        contact_map=_decode(table.column("contact_map"), size=size, where=f"(contact map) of {path}"),
        **{name: table.column(name).to_numpy().astype(np.float64) for name in _TRUTH_SIGNALS},
    )


def _decode(images: pa.ChunkedArray, *, size: tuple[int, ...], where: str) -> UInt8[np.ndarray, "frames ..."]:
    """Decode the images of a trial in threads."""
    pixels = np.empty((len(images), *size), dtype=np.uint8)

    def decode(index: int) -> None:
        pixels[index] = decode_pixels(images[index].as_buffer(), size=size, where=f"frame {index} {where}")

    with ThreadPoolExecutor() as pool:
        list(pool.map(decode, range(len(images))))
    return pixels
