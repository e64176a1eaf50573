"""How fast a folder of videos and tables of forces becomes a checked data set with its summary page.

One simulated trial is filmed, enlarged to the camera's size and written as video with a table of what a force sensor
saw; the folder holds it many times. Measured is all of `sliplens import DIR`: pairing, labels, frames without loss, the
summary page, and `sliplens check`. `cpu_ms_per_frame` is the time of all cores.
"""

import argparse
import csv
import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
from PIL import Image

from sliplens.files import scratch_folder
from sliplens.recordings import Recording, check_dataset, import_recordings
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

_SIZE = 640, 480
_RATE_HZ = 30
_FORCE_HZ = 500


def write_trial(trial: Recording, folder: Path, *, name: str) -> None:
    """Video of the frames in a dark surround, and the table of forces beside it."""
    width, height = _SIZE
    with av.open(str(folder / f"{name}.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=_RATE_HZ, options={"crf": "12", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in trial.frames:
            canvas = np.full((height, width, 3), 12, dtype=np.uint8)
            left = (width - height) // 2
            canvas[:, left : left + height] = np.asarray(Image.fromarray(frame).resize((height, height)))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(canvas, format="rgb24")))
        container.mux(stream.encode())
    times = np.arange(0, len(trial) / _RATE_HZ, 1 / _FORCE_HZ)
    film = np.arange(len(trial)) / _RATE_HZ
    pull, press = (np.interp(times, film, values) for values in (trial.tangential_force_n, trial.normal_force_n))
    seen = np.stack([pull, np.zeros_like(pull), press], axis=-1)
    seen += np.random.default_rng(1).normal(0, 0.02, seen.shape)
    with (folder / f"{name}.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time [s]", "Fx [N]", "Fy [N]", "Fz [N]"])
        writer.writerows(np.column_stack([times, seen]).round(5).tolist())


def main() -> None:
    """Measure and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--frames", type=int, default=240, help="of each trial")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with scratch_folder() as scratch:
        source = scratch / "trials"
        source.mkdir()
        trial = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=options.frames))
        write_trial(trial, source, name="trial-000")
        for number in range(1, options.trials):
            for suffix in ("mp4", "csv"):
                shutil.copyfile(source / f"trial-000.{suffix}", source / f"trial-{number:03d}.{suffix}")
        begun, spent = time.perf_counter(), time.process_time()
        data = import_recordings(source, out=scratch / "data", sensor="tip")
        imported = time.perf_counter()
        findings = check_dataset(data)
        ended, spent = time.perf_counter(), time.process_time() - spent
    result = {
        "frames_per_s": data.frames / (ended - begun),
        "import_frames_per_s": data.frames / (imported - begun),
        "cpu_ms_per_frame": 1e3 * spent / data.frames,
        "trials": len(data.trials),
        "left_out": len(data.left_out),
        "findings": len(findings),
        "frames": data.frames,
        "cores": os.cpu_count(),
    }
    print(json.dumps(result, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
