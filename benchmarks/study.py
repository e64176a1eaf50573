"""The whole study on simulated touch with the networks of the package: how long it takes, interrupted once.

It is interrupted while parts of the frames are removed, given again, and given a third time when all is there. Every
stage that was finished before must be left as it was, and the third run must leave everything so. Most of the time goes
into forward passes, so how many of them this machine does in a second is measured first.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # the study inherits it

import torch

from sliplens.files import DEFAULT_NETWORK
from sliplens.models.checkpoint import load
from sliplens.models.engines import prepare

_INTERRUPTED = 130
_LOOK_EVERY_S = 0.5


def main() -> None:
    """Print the minutes and whether the study went on where it stopped, as text or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="a simulated data set; the thesis's preset is made anew without it")
    parser.add_argument("--trials", type=int, default=14, help="trials to look at; the thesis: 14")
    parser.add_argument("--keep", type=Path, help="keep the study in this folder, which must not exist")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.keep is not None and options.keep.exists():
        parser.error(f"{options.keep} exists; name a new folder, so that the whole study is timed")
    # a shell that started this in the background had it ignore interruptions, and so would the study
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as scratch:
        output = options.keep or Path(scratch) / "study"
        data = ["--preset", "thesis"] if options.data is None else [str(options.data)]
        networks = ["thesis-difference", "thesis-raw"] if options.data is None else [DEFAULT_NETWORK]
        words = [sys.executable, "-m", "sliplens", "study", *data, "-o", str(output), "--trials", str(options.trials)]
        words += ["--network", *networks]
        passes_per_s = measure_passes(networks[0])  # both are of one backbone and size
        started = time.perf_counter()
        stopped = run_until(words, output, ".faithfulness-*.partial/parts/*")
        before = written(output)
        subprocess.run(words, check=True, stdout=sys.stderr)
        minutes = (time.perf_counter() - started) / 60
        after = written(output)
        started = time.perf_counter()
        subprocess.run(words, check=True, stdout=sys.stderr)
        told = {
            "minutes": minutes,
            "resumed_ok": stopped
            and bool(before)
            and all(after[path] == when for path, when in before.items())
            and written(output) == after
            and (output / "report.html").is_file(),
            "stages_before_interruption": len(before),
            "stages": len(after),
            "seconds_when_all_is_there": time.perf_counter() - started,
            "passes_per_s": passes_per_s,
            "load": os.getloadavg()[2],
        }
    if options.json:
        print(json.dumps(told))
        return
    print(f"{passes_per_s:.0f} passes a second by the engine of the study")
    print(f"{minutes:.1f} minutes, {'went on where it stopped' if told['resumed_ok'] else 'did NOT resume'}")


def measure_passes(network: str, count: int = 1000) -> float:
    """Forward passes a second of a network that the study explains, by the engine that it uses."""
    trained = load(network)
    shape = (16, trained.encoding.colours, *2 * (trained.manifest.image_size,))
    images = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        passes = prepare(trained.model, images, trained.model(images).reshape(-1), passes=10_000)
    batch = images[: passes.batch_size]
    for batches in (10, count // len(batch)):  # the first to warm up
        started = time.perf_counter()
        for _ in passes.run(batch for _ in range(batches)):
            pass
    return batches * len(batch) / (time.perf_counter() - started)


def run_until(words: list[str], output: Path, sign: str) -> bool:
    """Run a command, interrupt it once its folder holds some file, and say whether it stopped as it should."""
    process = subprocess.Popen(words, stdout=sys.stderr)
    try:
        while process.poll() is None:
            if any(output.glob(sign)):
                process.send_signal(signal.SIGINT)
                break
            time.sleep(_LOOK_EVERY_S)
        return process.wait() == _INTERRUPTED
    finally:
        process.kill()


def written(output: Path) -> dict[Path, int]:
    """When each finished stage was written."""
    return {path: path.stat().st_mtime_ns for path in sorted(output.glob("*/run.json"))}


if __name__ == "__main__":
    main()
