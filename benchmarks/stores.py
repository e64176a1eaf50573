"""Which lossless store frames fit best: size, writing and random reading, measured on simulated frames in one run.

PNG in Parquet, FFV1 in Matroska, sharded Zarr, and in Parquet each row less the one above under Zstandard (the store of
sliplens). Every store gives the same pixels back.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zarr
from zarr.codecs import BloscCodec

from sliplens.images import decode_png, encode_png
from sliplens.recordings.store import decode_pixels, encode_pixels
from sliplens.simulation import CHROMATOUCH, FLAT_GEL, SimulationRecipe, plan_trials, simulate_trial
from sliplens.simulation.geometry import FlatPad

_ROW_GROUP = 16
_SHARD = 16


@dataclass(frozen=True, kw_only=True)
class Store:
    """How frames are written to a path, and one of them read back."""

    write: Callable[[np.ndarray, Path], None]
    open_reader: Callable[[Path], Callable[[int], np.ndarray]]


def write_png(frames: np.ndarray, path: Path) -> None:
    """One PNG a row, in row groups, so that a frame is read without its neighbours."""
    with ThreadPoolExecutor() as pool:
        images = list(pool.map(encode_png, frames))
    table = pa.table({"image": pa.array(images, type=pa.binary())})
    pq.write_table(table, path, compression="none", use_dictionary=False, row_group_size=_ROW_GROUP)


def read_png(path: Path) -> Callable[[int], np.ndarray]:
    """Open for random reading."""
    file = pq.ParquetFile(path, memory_map=True)

    def read(index: int) -> np.ndarray:
        group = file.read_row_group(index // _ROW_GROUP, columns=["image"])
        return decode_png(group.column("image")[index % _ROW_GROUP].as_py(), where=str(path))

    return read


def write_ffv1(frames: np.ndarray, path: Path) -> None:
    """FFV1 version 3, every frame a key frame, in four slices."""
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=30, options={"level": "3", "slices": "4", "g": "1", "slicecrc": "1"})
        stream.height, stream.width = frames.shape[1:3]
        # FFV1 knows RGB only as planes with a spare byte
        stream.pix_fmt = "bgr0"
        stream.thread_count = os.cpu_count() or 1
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def read_ffv1(path: Path) -> Callable[[int], np.ndarray]:
    """Open for random reading."""
    container = av.open(str(path))
    stream = container.streams.video[0]
    time_base, rate = stream.time_base, stream.average_rate
    if time_base is None or rate is None:
        raise RuntimeError("the container tells no frame rate")

    def read(index: int) -> np.ndarray:
        wanted = round(index / rate / time_base)
        container.seek(wanted, stream=stream)
        for frame in container.decode(stream):
            if frame.pts is not None and frame.pts >= wanted - 0.5 / rate / time_base:
                return frame.to_ndarray(format="rgb24")
        raise IndexError(index)

    return read


def write_zarr(frames: np.ndarray, path: Path) -> None:
    """Frames as chunks, compressed by Zstandard after a byte shuffle, some of them in a shard."""
    array = zarr.create_array(
        path,
        shape=frames.shape,
        dtype="uint8",
        chunks=(1, *frames.shape[1:]),
        shards=(_SHARD, *frames.shape[1:]),
        compressors=BloscCodec(cname="zstd", clevel=3, shuffle="shuffle"),
    )
    array[:] = frames


def read_zarr(path: Path) -> Callable[[int], np.ndarray]:
    """Open for random reading."""
    array = cast("zarr.Array", zarr.open_array(path, mode="r"))
    return lambda index: np.asarray(array[index])


def write_rows(frames: np.ndarray, path: Path) -> None:
    """As the store of sliplens does."""
    with ThreadPoolExecutor() as pool:
        images = list(pool.map(encode_pixels, frames))
    shape = json.dumps(frames.shape[1:])
    table = pa.table({"image": pa.array(images, type=pa.binary())}).replace_schema_metadata({"shape": shape})
    pq.write_table(table, path, compression="none", use_dictionary=False, row_group_size=_ROW_GROUP)


def read_rows(path: Path) -> Callable[[int], np.ndarray]:
    """Open for random reading."""
    file = pq.ParquetFile(path, memory_map=True)
    shape = json.loads(file.schema_arrow.metadata[b"shape"])

    def read(index: int) -> np.ndarray:
        data = file.read_row_group(index // _ROW_GROUP, columns=["image"]).column("image")[index % _ROW_GROUP]
        return decode_pixels(data.as_buffer(), size=shape, where=str(path))

    return read


STORES = {
    "png": Store(write=write_png, open_reader=read_png),
    "ffv1": Store(write=write_ffv1, open_reader=read_ffv1),
    "rows+zstd": Store(write=write_rows, open_reader=read_rows),
    "zarr": Store(write=write_zarr, open_reader=read_zarr),
}


def small_frames(count: int) -> np.ndarray:
    """Frames of the simulated ChromaTouch, 224 x 224."""
    plan = plan_trials(SimulationRecipe(frames_per_trial=count, sensor=CHROMATOUCH))[0]
    return simulate_trial(plan).frames


def large_frames(count: int) -> np.ndarray:
    """Frames of a simulated flat gel, 640 x 480."""
    pad = cast("FlatPad", FLAT_GEL.geometry)
    scale = 640 / FLAT_GEL.image_size_px
    sensor = replace(
        FLAT_GEL,
        image_size_px=640,
        geometry=replace(pad, focal_px=pad.focal_px * scale, centre_px=(319.5, 319.5)),
        look=replace(FLAT_GEL.look, radius_px=(9.0, 9.0, 9.0)),
    )
    plan = plan_trials(SimulationRecipe(frames_per_trial=count, sensor=sensor))[0]
    return np.ascontiguousarray(simulate_trial(plan).frames[:, 80:560])


def measure(store: Store, frames: np.ndarray, folder: Path, *, reads: int) -> dict[str, float]:
    """Size and speeds of a store, and proof that it loses nothing."""
    path = folder / "frames"
    start = time.perf_counter()
    store.write(frames, path)
    written = time.perf_counter() - start
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    size = sum(file.stat().st_size for file in files)
    order = np.random.default_rng(0).integers(len(frames), size=reads).tolist()
    read = store.open_reader(path)
    read(order[0])
    start = time.perf_counter()
    for index in order:
        read(index)
    seconds = time.perf_counter() - start
    for index in {0, len(frames) - 1, *order[:10]}:
        np.testing.assert_array_equal(read(index), frames[index])
    return {
        "kb_per_frame": size / len(frames) / 1e3,
        "share_of_raw": size / frames.nbytes,
        "written_per_s": len(frames) / written,
        "random_reads_per_s": reads / seconds,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=96, help="frames of each size")
    parser.add_argument("--reads", type=int, default=100, help="frames read at random")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    numbers: dict[str, dict[str, float]] = {}
    for name, frames in (("224x224", small_frames(arguments.frames)), ("640x480", large_frames(arguments.frames))):
        print(f"{name:10s} kB/frame  of raw  written/s  random reads/s")
        for store_name, store in STORES.items():
            with tempfile.TemporaryDirectory() as folder:
                row = measure(store, frames, Path(folder), reads=arguments.reads)
            numbers[f"{store_name}_{name}"] = row
            print(
                f"{store_name:10s} {row['kb_per_frame']:8.1f} {row['share_of_raw']:7.2f} {row['written_per_s']:10.0f} "
                f"{row['random_reads_per_s']:15.0f}"
            )
    if arguments.json:
        print(json.dumps(numbers))


if __name__ == "__main__":
    main()
