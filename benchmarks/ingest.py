"""How fast a video with a table of forces is imported, and whether memory stays flat as it gets longer.

What is measured is what `sliplens import` does with a trial: read, label, store, and draw its audit page. Each figure
is taken in a fresh process: the peak of a process never falls.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

from sliplens.plots.audit import write_audits
from sliplens.recordings import import_recordings

HEIGHT, WIDTH, FRAMES_PER_S, FORCES_PER_S = 480, 640, 30, 500


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Of an import."""

    seconds: float
    peak_rss_mb: float


def write_recording(folder: Path, frames: int) -> tuple[Path, Path]:
    """Write an H.264 video of dots that are pulled until they slip, and the forces beside it."""
    rng = np.random.default_rng(0)
    seconds = frames / FRAMES_PER_S
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    noise = rng.normal(0, 2, (8, HEIGHT, WIDTH))
    video = folder / "trial.mp4"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=FRAMES_PER_S, options={"crf": "18", "preset": "ultrafast"})
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        for index in range(frames):
            shift = 12 * np.clip((index / frames - 0.2) / 0.65, 0, 1) * (index / frames < 0.85)
            dots = (np.hypot((column - 20) % 40 - 20, (row - shift - 20) % 40 - 20) < 8) * 90
            grey = np.clip(150 - dots + noise[index % len(noise)], 0, 255).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(np.repeat(grey[..., None], 3, axis=-1), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    time_s = np.arange(0, seconds, 1 / FORCES_PER_S)
    share = time_s / seconds
    normal = 1.5 * np.clip((share - 0.1) / 0.1, 0, 1)
    pull = 0.6 * normal * np.where(share < 0.85, np.clip((share - 0.2) / 0.65, 0, 1), 0.75)
    table = folder / "forces.csv"
    values = np.stack([pull, 0 * pull, normal], axis=-1) + rng.normal(0, 0.01, (len(time_s), 3))
    lines = [f"{t:.4f},{x:.4f},{y:.4f},{z:.4f}" for t, (x, y, z) in zip(time_s, values, strict=True)]
    table.write_text("\n".join(["time [s],Fx [N],Fy [N],Fz [N]", *lines]) + "\n")
    return video, table


def measure(video: Path, table: Path, *, audit: bool = True) -> Cost:
    """Import in a fresh process."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_import, (video, table, audit))


def _import(video: Path, table: Path, audit: bool) -> Cost:
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        data = import_recordings(video, forces=table, sensor="bench", out=Path(folder) / "data")
        if audit:
            write_audits(data, data.folder / "audit")
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return Cost(seconds=seconds, peak_rss_mb=peak / (2**20 if sys.platform == "darwin" else 2**10))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=240, help="frames of the shorter video; the longer has ten times")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        short, long = Path(folder) / "short", Path(folder) / "long"
        for path in (short, long):
            path.mkdir()
        one = measure(*write_recording(short, arguments.frames))
        files = write_recording(long, 10 * arguments.frames)
        ten = measure(*files)
        plain = measure(*files, audit=False)
    numbers = {
        "frames_per_s": 10 * arguments.frames / ten.seconds,
        "frames_per_s_without_audit": 10 * arguments.frames / plain.seconds,
        "peak_rss_mb_1x": one.peak_rss_mb,
        "peak_rss_mb_10x": ten.peak_rss_mb,
    }
    for name, value in numbers.items():
        print(f"{name:26s} {value:.1f}")
    if arguments.json:
        print(json.dumps(numbers))


if __name__ == "__main__":
    main()
