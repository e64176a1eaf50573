"""LeRobot v3.0 data sets of a tactile camera and a wrench, laid out as LeRobot does."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from own_recording import write_frames

FPS = 30
HEIGHT, WIDTH = 48, 64
LENGTHS = (7, 5, 6)
FILES = (0, 0, 1)
"""File of each episode: the first two share one, for data and for videos."""
CAMERA, SCENE, FORCE = "observation.images.tactile", "observation.images.front", "observation.wrench"
LOSSLESS = {"codec": "libx264rgb", "pixels": "rgb24", "options": {"qp": "0", "g": "2", "bf": "0"}}
TEMPLATE = "chunk-{chunk_index:03d}/file-{file_index:03d}"

Edit = Callable[[dict[str, Any]], object]


def write_info(folder: Path, edit: Edit | None = None) -> None:
    camera = {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channels"]}
    number = {"dtype": "float32", "shape": [1], "names": None}
    axes = ["fx", "fy", "fz", "tx", "ty", "tz"]
    info = {
        "codebase_version": "v3.0",
        "fps": FPS,
        "total_episodes": len(LENGTHS),
        "total_frames": sum(LENGTHS),
        "chunks_size": 1000,
        "features": {
            CAMERA: camera,
            SCENE: dict(camera),
            FORCE: {"dtype": "float32", "shape": [6], "names": axes},
            "observation.state": {"dtype": "float32", "shape": [2], "names": ["x", "y"]},
            "action.wrench": {"dtype": "float32", "shape": [6], "names": axes},
            "timestamp": number,
        },
    }
    if edit is not None:
        edit(info)
    (folder / "meta").mkdir(parents=True, exist_ok=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))


def write_table(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


def write_dataset(folder: Path, frames: np.ndarray, wrenches: np.ndarray, *, coding: dict[str, Any] = LOSSLESS) -> Path:
    """Write every episode's frames, rows and metadata as LeRobot lays them out."""
    write_info(folder)
    starts = np.cumsum([0, *LENGTHS])
    episode_of = np.repeat(range(len(LENGTHS)), LENGTHS)
    in_episode = np.arange(sum(LENGTHS)) - starts[episode_of]
    for file in set(FILES):
        own = np.isin(episode_of, [episode for episode, of in enumerate(FILES) if of == file])
        place = TEMPLATE.format(chunk_index=0, file_index=file)
        columns = {
            "timestamp": pa.array((in_episode[own] / FPS).astype(np.float32)),
            "frame_index": in_episode[own],
            "episode_index": episode_of[own],
            "index": np.flatnonzero(own),
            "task_index": np.zeros(own.sum(), np.int64),
            FORCE: pa.FixedSizeListArray.from_arrays(pa.array(wrenches[own].reshape(-1)), 6),
            "observation.state": pa.array(wrenches[own][:, :2].tolist()),
        }
        for key, shown in ((CAMERA, frames), (SCENE, 255 - frames)):
            write_frames(folder / "videos" / key / f"{place}.mp4", shown[own], rate=FPS, **coding)
        write_table(folder / "data" / f"{place}.parquet", columns)
    write_episodes(folder, starts)
    return folder


def write_episodes(folder: Path, starts: np.ndarray, **changes: Any) -> None:
    first_of_file = [starts[FILES.index(file)] for file in FILES]
    count = len(LENGTHS)
    columns = {
        "episode_index": list(range(count)),
        "tasks": [["press"]] * count,
        "length": list(LENGTHS),
        "data/chunk_index": [0] * count,
        "data/file_index": list(FILES),
        "dataset_from_index": starts[:-1].tolist(),
        "dataset_to_index": starts[1:].tolist(),
    }
    for key in (CAMERA, SCENE):
        columns |= {
            f"videos/{key}/chunk_index": [0] * count,
            f"videos/{key}/file_index": list(FILES),
            f"videos/{key}/from_timestamp": ((starts[:-1] - first_of_file) / FPS).tolist(),
            f"videos/{key}/to_timestamp": ((starts[1:] - first_of_file) / FPS).tolist(),
        }
    write_table(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet", columns | changes)
