"""Many trials serially, by processes and by Ray: how fast, with which bytes, in what memory, and what a kill costs.

Rates are of steady work: from the part on by which every worker has made one, to the last; what comes before is told
apart as the start. `serial` is what users get, its batches in as many threads as there are cores; `one thread` is the
same in one, for processes share the cores out. Kills are `SIGKILL` at random moments, of the command or of a process
below it: a worker, an actor, a node of Ray. The same command must then end with the bytes of a serial run, no part
twice and none missing.

With `--keep FOLDER` each piece is kept as soon as it is measured, and the next call goes on from there, so that hours
can be had in minutes: `--stages predict --kills 0`, then `--stages --kills 10`, then `--kills 30`. With `--json` the
last line is one object.
"""

import argparse
import hashlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command line does; before torch is imported

from sliplens import load_dataset, predict, simulate
from sliplens.extras import missing_packages
from sliplens.files import hash_file, hash_json, machine, versions, write_json
from sliplens.markers.tracking import track
from sliplens.models.engines import one_thread
from sliplens.progress import OnProgress
from sliplens.recordings import Dataset
from sliplens.shards import MakePart, Shard, make_parts, shard
from sliplens.study.workspace import explain_source

NETWORK = "chromatouch-difference"
EMPTY = 10_000
"""Shards whose driver is weighed."""
ONE_THREAD = "one thread"
"""Serial work of one thread; every other place is named as `--on` takes it."""
_PATIENCE_S = 240.0  # with a command that was hit; Ray takes a minute to see that a node is gone


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Speed of a stage, and what it made."""

    start_s: float
    """Until every worker has made a part."""
    frames_per_s: float
    sha256: str


def parts(folder: Path) -> dict[str, Path]:
    """Parts of a folder by their names."""
    return {str(path.relative_to(folder)): path for path in folder.glob("trial=*/*") if path.name[0] != "."}


def content(folder: Path) -> str:
    """Hash of the names and bytes of all parts."""
    return hash_json({name: hash_file(path) for name, path in parts(folder).items() if path.is_file()})


def rate(folder: Path, *, began_s: float, workers: int) -> Rate:
    """Speed from when the parts were made."""
    made = sorted((path.stat().st_mtime, int(path.name.split("-")[1])) for path in parts(folder).values())
    first_s = made[workers - 1][0]
    steady = sum(frames for _, frames in made[workers:]) / (made[-1][0] - first_s)
    return Rate(start_s=first_s - began_s, frames_per_s=steady, sha256=content(folder))


class Empty:
    """Work that does nothing."""

    on_gpu = False

    def begin(self) -> MakePart:
        """Write a byte a part."""

        def make(_item: int, path: Path, _on_progress: OnProgress) -> None:
            path.write_bytes(b"-")

        return make


def time_predict(data: Dataset, out: Path, on: str, workers: int) -> Rate:
    """Margins of all frames."""
    began_s = time.time()
    predict(NETWORK, data, engine="folded", on=on, out=out)
    return rate(out, began_s=began_s, workers=workers)


def time_track(data: Dataset, out: Path, on: str, workers: int) -> Rate:
    """Markers of all frames."""
    began_s = time.time()
    track(data, markers="chromatouch", on=on, out=out)
    return rate(out, began_s=began_s, workers=workers)


def time_explain(data: Dataset, _: Path, on: str, workers: int) -> Rate:
    """Maps of Poly-CAM on its budget, of eight frames."""
    made_s: list[float] = []
    began_s, levels = time.time(), tuple(1 - number / 7 for number in range(8))
    options = {"methods": ("poly-cam",), "levels": levels, "split": data.trials[-1].split}
    maps = explain_source(NETWORK, data, on=on, on_progress=lambda *_: made_s.append(time.time()), **options)
    steady = (len(made_s) - workers) / (made_s[-1] - made_s[workers - 1])
    relevance = hashlib.sha256(maps.relevance["poly-cam"].tobytes()).hexdigest()
    return Rate(start_s=made_s[workers - 1] - began_s, frames_per_s=steady, sha256=relevance)


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


def kind_of(process: int) -> str:
    """What a process below a command is: a worker, an actor, a node of Ray, or something that serves one."""
    try:
        words = Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return "gone"
    known = {"ray::Worker": "actor", "raylet": "node", "spawn_main": "worker"}
    return next((kind for word, kind in known.items() if word in words.split(" --")[0]), "servant")


def kill_at_random(words: list[str], rng: random.Random, *, within_s: float) -> str:
    """Give a command and kill it, or a process below it, each kind as often; tells which."""
    command = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(rng.uniform(0.2, 1.0) * within_s)
    victims: dict[str, list[int]] = {"driver": [command.pid]}
    for process in below(command.pid):
        victims.setdefault(kind_of(process), []).append(process)
    kind = rng.choice(sorted(victims))
    if command.poll() is not None:
        return "nobody"
    try:
        os.kill(rng.choice(victims[kind]), signal.SIGKILL)
    except ProcessLookupError:
        kind = "nobody"
    try:
        command.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        command.kill()
        command.wait()
        kind += ", and the command hung"
    return kind


def survive(data: Path, on: str, *, wanted: str, within_s: float, rng: random.Random) -> tuple[str, bool]:
    """What was killed of a command, and whether the same command then ended with the same parts."""
    with tempfile.TemporaryDirectory() as folder:
        words = kill_words(data, Path(folder) / "out", on)
        killed = kill_at_random(words, rng, within_s=within_s)
        ended = subprocess.run(words, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return f"{killed}, {on}", ended.returncode == 0 and content(Path(folder) / "out") == wanted


def kill_words(data: Path, out: Path, on: str) -> list[str]:
    """Command that is killed."""
    own = [sys.executable, "-m", "sliplens", "predict", NETWORK, str(data), "--engine", "folded"]
    return [*own, "-o", str(out), "--on", on]


def time_whole(data: Path, on: str) -> tuple[float, str]:
    """Seconds that a command takes that nobody kills, and what it makes."""
    with tempfile.TemporaryDirectory() as folder:
        began_s, words = time.perf_counter(), kill_words(data, Path(folder) / "out", on)
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return time.perf_counter() - began_s, content(Path(folder) / "out")


@dataclass(frozen=True, kw_only=True)
class Kept:
    """What is measured, a file a piece."""

    folder: Path

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """Measure a piece unless it is there."""
        path = self.folder / f"{name}.json"
        if not path.is_file():
            write_json(path, make())
        return json.loads(path.read_text())

    def data(self, name: str, *, trials: int, frames: int) -> Path:
        """Simulated data set."""
        if not (self.folder / name).is_dir():
            simulate(self.folder / name, dry_trials=trials, wet_trials=0, frames_per_trial=frames)
        return self.folder / name

    def rates(self, data: Dataset, stages: list[str], places: dict[str, int]) -> dict[str, dict[str, Any]]:
        """Speed of each stage at each place."""
        found: dict[str, dict[str, Any]] = {stage: {} for stage in stages}
        for stage, (place, workers) in product(stages, places.items()):

            def measure(stage: str = stage, place: str = place, workers: int = workers) -> dict[str, Any]:
                alone = place == ONE_THREAD
                with tempfile.TemporaryDirectory() as folder, one_thread() if alone else nullcontext():
                    own = STAGES[stage](data, Path(folder) / "out", "serial" if alone else place, workers)
                return asdict(own) | {"load_average": os.getloadavg()[0]}

            found[stage][place] = self.once(f"{stage}-{place}", measure)
            print(f"{stage:8s} {place:12s} {found[stage][place]}", file=sys.stderr, flush=True)
        return found

    def driver_mb(self) -> float:
        """What `weigh_driver` weighs, in memory: its files would each wait for the disk."""

        def weigh() -> float:
            with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as empty:
                return weigh_driver(Path(empty))

        return self.once("driver", weigh)

    def kills(self, where: list[str], *, count: int, seed: int) -> tuple[int, Counter[str]]:
        """Kills after which the same command ended with the same parts, and what was killed."""
        killed: Counter[str] = Counter()
        survived = 0
        if not count:
            return survived, killed
        data = self.data("few", trials=6, frames=10)
        whole = {on: self.once(f"whole-{on}", lambda on=on: time_whole(data, on)) for on in where}
        for number in range(count):
            on, rng = where[number % len(where)], random.Random(f"{seed}-{number}")
            told: dict[str, Any] = {"wanted": whole["serial"][1], "within_s": whole[on][0], "rng": rng}
            what, same = self.once(f"kill-{seed}-{number}", lambda on=on, told=told: survive(data, on, **told))
            print(f"kill {number}: {what}: {'survived' if same else 'NOT SURVIVED'}", file=sys.stderr, flush=True)
            if not what.startswith("nobody"):  # the command was over
                killed[what] += 1
                survived += same
        return survived, killed


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="a data set; 12 trials of 40 frames are simulated without it")
    parser.add_argument("--keep", type=Path, help="folder for what is measured; the next call goes on from there")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--stages", nargs="*", choices=STAGES, default=list(STAGES))
    parser.add_argument("--without-ray", action="store_true")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    by_processes = f"processes={options.workers}"
    places = {"serial": 1, ONE_THREAD: 1, by_processes: options.workers}
    if not options.without_ray and missing_packages("ray", extra="ray") is None:
        places["ray"] = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        kept = Kept(folder=options.keep or Path(folder))
        found = load_dataset(options.data or kept.data("data", trials=12, frames=40))
        driver_mb = kept.driver_mb()  # first: networks would hide by how much its memory peaks
        rates = kept.rates(found, options.stages, places)
        where = [place for place in places if place != ONE_THREAD]
        survived, killed = kept.kills(where, count=options.kills, seed=options.seed)

    def over(place: str, rival: str) -> dict[str, float]:
        both = {stage: own for stage, own in rates.items() if {place, rival} <= set(own)}
        return {stage: own[place]["frames_per_s"] / own[rival]["frames_per_s"] for stage, own in both.items()}

    def each(name: str) -> dict[str, dict[str, Any]]:
        return {stage: {on: one[name] for on, one in own.items()} for stage, own in rates.items()}

    result = {
        "speedup_processes": over(by_processes, "serial"),
        "speedup_processes_one_thread": over(by_processes, ONE_THREAD),
        "ray_over_processes": over("ray", by_processes),
        "same_bytes": {stage: len(set(own.values())) == 1 for stage, own in each("sha256").items()},
        "driver_mb_10k_shards": driver_mb,
        "kills": killed.total(),
        "kills_survived": survived,
        "killed": dict(killed),
        **{name: each(name) for name in ("frames_per_s", "start_s", "load_average")},
        "frames": found.frames,
        "workers": options.workers,
        "machine": vars(machine()),
        "versions": versions(),
    }
    for stage, own in rates.items():
        for on, one in own.items():
            print(f"{stage:8s} {on:12s} {one['frames_per_s']:9.2f} frames/s after a start of {one['start_s']:.1f} s")
    print(f"the same bytes: {result['same_bytes']}; driver + {driver_mb:.1f} MB from 100 to {EMPTY:,} shards")
    print(f"{survived} of {killed.total()} kills survived: {dict(killed)}")
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
