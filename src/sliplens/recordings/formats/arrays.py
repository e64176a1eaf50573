"""Frames and forces as arrays of one file: NPY or NPZ of NumPy, or HDF5. Frames are read one at a time."""

import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from math import prod
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from sliplens.codec import ARRAY_DAMAGE, one_line
from sliplens.errors import RecordingError
from sliplens.extras import require_packages
from sliplens.images import MOST_PIXELS, as_frames
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.formats import tables
from sliplens.recordings.options import ReadOptions

_Array: TypeAlias = Any  # of NumPy, of h5py, or a `_Member`: what they share are shape, dtype, and iteration by rows
_HDF5 = frozenset({".h5", ".hdf5"})
SUFFIXES = _HDF5 | {".npy", ".npz"}
_MOST_ROWS = 2**24  # four hours at 1 kHz


def read_arrays(path: Path, options: ReadOptions) -> Capture:
    """Open arrays that are found by their names, with units as those of the columns in a table of forces.

    Frames are `frames` or `images`, their times `time_s`, the untouched sensor `reference`. Forces are `fx`, `fy` and
    `fz`, `force` (samples, 3), or `fn` and `ft`, one for each frame, or at times of their own (`force_time_s`).
    """
    with _errors(path):
        arrays = _find_hdf5(path) if path.suffix.lower() in _HDF5 else _find_numpy(path)
        names = {name.rpartition("/")[2].lower(): name for name in arrays}
        images = names.get("frames") or names.get("images") or (next(iter(arrays)) if len(arrays) == 1 else None)
        columns = dict(column for name in arrays if name != images for column in _columns(name, arrays[name]))
    if images is None:
        raise RecordingError(f"{path} holds {', '.join(arrays) or 'no array'}; name the array of its frames 'frames'")
    count, height, width, _ = _image_shape(arrays[images], f"frames of {path}")
    untouched = arrays.get(names.get("reference", ""))
    if untouched is not None and _image_shape(untouched, f"reference of {path}") != (1, height, width, 3):
        raise RecordingError(f"the reference of {path} is no image of the size of its frames; store both alike")
    times = {name: values for name, values in columns.items() if tables.is_time(name)}
    of_forces = {name: times.pop(name) for name in list(times) if "force" in name.lower()}
    if options.time_column is not None:
        times = {name: columns[name] for name in columns if name == options.time_column}
    measured = {
        name: columns[name] for name in columns if tables.force_axis(name) or name in (options.force_columns or ())
    }
    time_s, notes = np.full(count, np.nan), ()
    if options.frame_rate is not None:
        time_s = tables.evenly_spaced(count, frame_rate=options.frame_rate)
        notes = (f"{path.name}: frames were declared to be taken {options.frame_rate:g} times a second.",)
        times = times or {"time_s": time_s}
    elif times:
        table = _as_table(path, {images: time_s, **times})
        column, unit = options.time_column or tables.guess_time_column(tuple(times), path=path), options.time_unit
        time_s, unit = tables.scale_times(times[column], range(count), table=table, column=column, unit=unit)
        notes = (f"{path.name}: times of frames are those of {column!r}, in {unit}.",)
    forces = None
    if measured:
        if options.forces is not None:
            raise RecordingError(f"{path} holds forces of its own; leave out --forces")
        forces, more = tables.read_force_table(_as_table(path, (of_forces or times) | measured), options)
        notes += more
    time_s, beside, more = tables.place_on_clock(time_s, options, source=path.name)
    return Capture(
        trial=tables.trial_name(path.stem),
        source=str(path),
        frame_time_s=time_s,
        frame_size=(height, width),
        read_frames=partial(_read_frames, path, arrays[images]),
        forces=forces or beside,
        notes=(*notes, *more),
        reference=None if untouched is None else next(_read_frames(path, untouched)),
    )


def _image_shape(array: _Array, what: str) -> tuple[int, ...]:
    """Return (frames, height, width, 3), before any is read; what holds no 8-bit RGB images is refused."""
    shape = as_frames(np.broadcast_to(np.zeros((), dtype=array.dtype), array.shape), what=what).shape
    if shape[0] > _MOST_ROWS or shape[1] * shape[2] > MOST_PIXELS:
        raise RecordingError(f"the {what} claim to be {' x '.join(map(str, shape))}; the file is damaged, copy it")
    return shape


def _read_frames(path: Path, array: _Array) -> Iterator[Frame]:
    with _errors(path):
        yield from array if len(array.shape) == 4 else [np.asarray(array)]


def _columns(name: str, array: _Array) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the numbers of a column, or those of forces along three axes, by names as those in a table."""
    if array.dtype.kind not in "iuf" or not array.shape or not 0 < array.shape[0] <= _MOST_ROWS:
        return
    if len(array.shape) == 1:
        yield name, np.asarray(array)
    elif array.shape[1:] == (3,) and (force := re.fullmatch(r".*forces?(\W.*|_.*|)", name, re.IGNORECASE)):
        for axis, values in zip("xyz", np.asarray(array).T, strict=True):
            yield f"force_{axis}{force[1]}", values


def _as_table(path: Path, columns: Mapping[str, np.ndarray]) -> tables.TextTable:
    """Return columns as a table, in whose text numbers are as exact as in the arrays."""
    (first, values), *others = columns.items()
    if odd := [f"{len(each)} of {name!r}" for name, each in others if len(each) != len(values)]:
        raise RecordingError(f"{path} has {len(values)} of {first!r} but {odd[0]}; give as many, or force_time_s")
    rows = zip(*(map(repr, each.tolist()) for each in columns.values()), strict=True)
    return tables.TextTable(path=path, header=tuple(columns), rows=enumerate(map(list, rows)), row="row")


@contextmanager
def _errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (*ARRAY_DAMAGE, RuntimeError) as error:  # of h5py, and of archives with a password
        kind = "HDF5" if path.suffix.lower() in _HDF5 else "a NumPy array"
        raise RecordingError(f"{path} cannot be read as {kind} ({one_line(error)}); save it again") from None


class _Member:
    """Array in an archive, iterated row by row; no pickle is opened."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self._open = partial(archive.open, name)
        with self._open() as stream:
            self.shape, self._columns_first, self.dtype = self._read_header(stream)

    @staticmethod
    def _read_header(stream: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
        first = np.lib.format.read_magic(stream) == (1, 0)
        return (np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0)(stream)

    def __array__(self, *_: Any, **_options: Any) -> np.ndarray:
        with self._open() as stream:
            return np.lib.format.read_array(stream, allow_pickle=False)

    def __iter__(self) -> Iterator[np.ndarray]:
        if self._columns_first:
            yield from self.__array__()
            return
        with self._open() as stream:
            self._read_header(stream)
            for _ in range(self.shape[0]):
                row = stream.read(prod(self.shape[1:]) * self.dtype.itemsize)
                yield np.frombuffer(row, dtype=self.dtype).reshape(self.shape[1:])


def _find_numpy(path: Path) -> Mapping[str, _Array]:
    if path.suffix.lower() == ".npy":
        return {"frames": np.lib.format.open_memmap(path, mode="r")}
    archive = zipfile.ZipFile(path)
    return {name.removesuffix(".npy"): _Member(archive, name) for name in archive.namelist()}


def _find_hdf5(path: Path) -> Mapping[str, _Array]:
    require_packages("h5py", extra="hdf5", purpose=path.name)
    import h5py  # noqa: PLC0415 (an extra)  # pyright: ignore[reportMissingImports]

    arrays = {}

    def visit(name: str, item: Any) -> None:
        # never what lies in other files
        if isinstance(item, h5py.Dataset) and not (item.is_virtual or item.external):
            arrays[name] = item

    h5py.File(path, "r").visititems(visit)
    return arrays
