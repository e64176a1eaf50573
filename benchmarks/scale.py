"""Many trials serially, by processes and by Ray: how fast, with which bytes, in what memory, and what a kill costs.

Rates are of steady work: from the part on by which every worker has made one, to the last; what comes before is told
apart as the start. Kills are `SIGKILL` at random moments, of the command or of any process below it; the same command
must then end with the bytes of a serial run, no part twice and none missing. With `--json` the last line is one object.
"""

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command line does; before torch is imported

from sliplens import load_dataset, predict, simulate
from sliplens.extras import missing_packages
from sliplens.files import hash_file, machine, versions
from sliplens.markers.tracking import track
from sliplens.progress import OnProgress
from sliplens.recordings import Dataset
from sliplens.shards import MakePart, Shard, make_parts, shard
from sliplens.study.workspace import explain_source

NETWORK = "chromatouch-difference"
EMPTY = 10_000
"""Shards whose driver is weighed."""


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Speed of a stage."""

    start_s: float
    """Until every worker has made a part."""
    frames_per_s: float


def parts(folder: Path) -> dict[str, Path]:
    """Parts of a folder by their names."""
    return {str(path.relative_to(folder)): path for path in folder.glob("trial=*/*") if path.name[0] != "."}


def rate(folder: Path, *, began_s: float, workers: int) -> Rate:
    """Speed from when the parts were made."""
    made = sorted((path.stat().st_mtime, int(path.name.split("-")[1])) for path in parts(folder).values())
    first_s = made[workers - 1][0]
    return Rate(
        start_s=first_s - began_s,
        frames_per_s=sum(frames for _, frames in made[workers:]) / (made[-1][0] - first_s),
    )


def content(folder: Path) -> dict[str, str]:
    """Hash of each part."""
    return {name: hash_file(path) for name, path in parts(folder).items() if path.is_file()}


class Empty:
    """Work that does nothing."""

    on_gpu = False

    def begin(self) -> MakePart:
        """Write a byte a part."""

        def make(_item: int, path: Path, _on_progress: OnProgress) -> None:
            path.write_bytes(b"-")

        return make


def time_predict(data: Dataset, out: Path, on: str, workers: int) -> tuple[Rate, object]:
    """Margins of all frames."""
    began_s = time.time()
    predict(NETWORK, data, engine="folded", on=on, out=out)
    return rate(out, began_s=began_s, workers=workers), content(out)


def time_track(data: Dataset, out: Path, on: str, workers: int) -> tuple[Rate, object]:
    """Markers of all frames."""
    began_s = time.time()
    track(data, markers="chromatouch", on=on, out=out)
    return rate(out, began_s=began_s, workers=workers), content(out)


def time_explain(data: Dataset, _: Path, on: str, workers: int) -> tuple[Rate, object]:
    """Maps of Poly-CAM on its budget, of ten frames."""
    made_s: list[float] = []
    began_s, levels = time.time(), tuple(1 - number / 9 for number in range(10))
    options = {"methods": ("poly-cam",), "levels": levels, "split": data.trials[-1].split}
    maps = explain_source(NETWORK, data, on=on, on_progress=lambda *_: made_s.append(time.time()), **options)
    steady = (len(made_s) - workers) / (made_s[-1] - made_s[workers - 1])
    return Rate(start_s=made_s[workers - 1] - began_s, frames_per_s=steady), maps.relevance["poly-cam"].tobytes()


STAGES = {"predict": time_predict, "explain": time_explain, "track": time_track}


def weigh_driver(folder: Path) -> float:
    """Megabytes by which the driver grows from a hundred empty shards to ten thousand."""

    def shards(count: int) -> Iterator[Shard]:
        for number in range(count):
            yield shard(number, trial=f"t{number}", frames=1, recipe=0, shown=str(number))

    peaks_mb = []
    for count in (100, EMPTY):
        make_parts(Empty(), lambda count=count: shards(count), folder / str(count), title="Nothing")
        peaks_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return peaks_mb[1] - peaks_mb[0]


def below(process: int) -> list[int]:
    """Processes that a process has begun, and those that these have."""
    try:
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return []
    return [one for child in children for one in (int(child), *below(int(child)))]


def kill_at_random(words: list[str], rng: random.Random, *, within_s: float) -> str:
    """Give a command and kill it, or a process below it; tells which."""
    command = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(rng.uniform(0.2, 1.0) * within_s)
    victims = [command.pid, *below(command.pid)]
    victim = victims[0] if rng.random() < 0.3 else rng.choice(victims)
    try:
        os.kill(victim, signal.SIGKILL)
    except ProcessLookupError:
        return "nobody"
    killed = "driver" if victim == command.pid else "process below"
    command.wait()
    return killed


def count_kills(data: Path, scratch: Path, places: list[str], *, kills: int, seed: int) -> tuple[int, dict[str, int]]:
    """Kills after which the same command ended with the same parts, and what was killed."""
    rng, survived, killed = random.Random(seed), 0, {}
    own = [sys.executable, "-m", "sliplens", "predict", NETWORK, str(data), "--engine", "folded"]
    began_s = time.perf_counter()
    subprocess.run(
        [*own, "-o", str(scratch / "whole")], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    whole_s, wanted = time.perf_counter() - began_s, content(scratch / "whole")
    for number in range(kills):
        out, on = scratch / f"killed-{number}", places[number % len(places)]
        words = [*own, "-o", str(out), "--on", on]
        what = f"{kill_at_random(words, rng, within_s=1.2 * whole_s)}, {on}"
        killed[what] = killed.get(what, 0) + 1
        ended = subprocess.run(words, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        survived += ended.returncode == 0 and content(out) == wanted
    return survived, killed


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="a data set; 12 trials of 60 frames are simulated without it")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=list(STAGES))
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    places = {"serial": 1, f"processes={options.workers}": options.workers}
    if missing_packages("ray", extra="ray") is None:
        places["ray"] = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        data = options.data or scratch / "data"
        if options.data is None:
            simulate(data, dry_trials=12, wet_trials=0, frames_per_trial=60)
        found = load_dataset(data)
        rates: dict[str, dict[str, Rate]] = {stage: {} for stage in options.stages}
        bytes_of: dict[str, dict[str, object]] = {stage: {} for stage in options.stages}
        for stage, (on, workers) in product(options.stages, places.items()):
            out = scratch / f"{stage}-{on}"
            rates[stage][on], bytes_of[stage][on] = STAGES[stage](found, out, on, workers)
            print(f"{stage:8s} {on:12s} {rates[stage][on]}", file=sys.stderr)
        with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as empty:
            driver_mb = weigh_driver(Path(empty))  # in memory: its files would each wait for the disk
        survived, killed = count_kills(data, scratch, list(places)[1:], kills=options.kills, seed=options.seed)
    by_processes = f"processes={options.workers}"
    speedups = {
        stage: own[by_processes].frames_per_s / own["serial"].frames_per_s for stage, own in rates.items() if own
    }
    result = {
        "speedup_processes": speedups,
        "ray_over_processes": {
            stage: own["ray"].frames_per_s / own[by_processes].frames_per_s
            for stage, own in rates.items()
            if "ray" in own
        },
        "same_bytes": all(one == own["serial"] for own in bytes_of.values() for one in own.values()),
        "driver_mb_10k_shards": driver_mb,
        "kills": options.kills,
        "kills_survived": survived,
        "killed": killed,
        "frames_per_s": {stage: {on: one.frames_per_s for on, one in own.items()} for stage, own in rates.items()},
        "start_s": {stage: {on: one.start_s for on, one in own.items()} for stage, own in rates.items()},
        "frames": found.frames,
        "workers": options.workers,
        "load_average": os.getloadavg()[0],
        "machine": vars(machine()),
        "versions": versions(),
    }
    for stage, own in rates.items():
        for on, one in own.items():
            print(f"{stage:8s} {on:12s} {one.frames_per_s:9.2f} frames/s after a start of {one.start_s:.1f} s")
    print(f"the same bytes: {result['same_bytes']}; driver + {driver_mb:.1f} MB from 100 to {EMPTY:,} shards")
    print(f"{survived} of {options.kills} kills survived: {killed}")
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
