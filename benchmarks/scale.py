"""Many trials serially, by processes and by Ray: how fast, with which bytes, in what memory, and what a kill costs.

Rates are of steady work: of the later half of the parts. The start is what the whole took beyond its frames at that
rate. `serial` is what users get, its batches in as many threads as there are cores; `one thread` is the same in one,
for processes share the cores out. Kills are `SIGKILL` at random moments, of the command or of a process that works for
it: a worker, an actor, a node of Ray, of one or, as `cluster`, of two of them. The same command must then end with the
bytes of a serial run, no part twice and none missing.

With `--keep FOLDER` each piece is kept as soon as it is measured, by the hash of its data, and the next call goes on
from there, so that hours can be had in minutes: `--stages predict --kills 0`, then `--stages --kills 10`, then
`--kills 30`. With `--json` the last line is one object.
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
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command line does; before torch is imported

from sliplens import load_dataset, predict, simulate
from sliplens.extras import missing_packages
from sliplens.files import hash_file, hash_json, machine, partial_folder, versions, write_json
from sliplens.markers.tracking import track
from sliplens.models.engines import one_thread
from sliplens.progress import OnProgress
from sliplens.recordings import Dataset
from sliplens.shards import MakePart, Shard, make_parts, shard
from sliplens.study.workspace import explain_source

NETWORK = "chromatouch-difference"
EMPTY = 10_000
"""Shards whose driver is weighed."""
MAPS = 12
"""Frames that are explained."""
ONE_THREAD = "one thread"
"""Serial work of one thread; every other place is named as `--on` takes it."""
CLUSTER = "cluster"
"""A cluster of Ray of two nodes, a core each; it is killed, and not timed."""
NOBODY = "nobody"
_PATIENCE_S = 240.0  # with a command that was hit; Ray takes a minute to see that a node is gone


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Speed of a stage, and what it made."""

    start_s: float
    """What the whole took beyond its frames at that speed."""
    frames_per_s: float
    sha256: str


def parts(folder: Path) -> dict[str, Path]:
    """Parts of a folder by their names."""
    return {str(path.relative_to(folder)): path for path in folder.glob("trial=*/*") if path.name[0] != "."}


def content(folder: Path) -> str:
    """Hash of the names and bytes of all parts."""
    return hash_json({name: hash_file(path) for name, path in parts(folder).items() if path.is_file()})


def rate(made: list[tuple[float, int]], began_s: float, sha256: str) -> Rate:
    """Speed from when parts were made, and of how many frames: of the later half, when all workers are long there."""
    made = sorted(made)
    half, last_s = len(made) // 2, made[-1][0]
    steady = sum(frames for _, frames in made[half:]) / (last_s - made[half - 1][0])
    start_s = last_s - began_s - sum(frames for _, frames in made) / steady
    return Rate(start_s=start_s, frames_per_s=steady, sha256=sha256)


def rate_of_parts(folder: Path, began_s: float) -> Rate:
    """Speed of what left a file a part."""
    made = [(path.stat().st_mtime, int(path.name.split("-")[1])) for path in parts(folder).values()]
    return rate(made, began_s, content(folder))


class Empty:
    """Work that does nothing."""

    on_gpu = False

    def begin(self) -> MakePart:
        """Write a byte a part."""

        def make(_item: int, path: Path, _on_progress: OnProgress) -> None:
            path.write_bytes(b"-")

        return make


def time_predict(data: Dataset, out: Path, on: str) -> Rate:
    """Margins of all frames."""
    began_s = time.time()
    predict(NETWORK, data, engine="folded", on=on, out=out)
    return rate_of_parts(out, began_s)


def time_track(data: Dataset, out: Path, on: str) -> Rate:
    """Markers of all frames."""
    began_s = time.time()
    track(data, markers="chromatouch", on=on, out=out)
    return rate_of_parts(out, began_s)


def time_explain(data: Dataset, _: Path, on: str) -> Rate:
    """Maps of Poly-CAM on its budget."""
    made: list[tuple[float, int]] = []
    began_s, levels = time.time(), tuple(1 - number / (MAPS - 1) for number in range(MAPS))
    options = {"methods": ("poly-cam",), "levels": levels, "split": data.trials[-1].split}
    maps = explain_source(NETWORK, data, on=on, on_progress=lambda *_: made.append((time.time(), 1)), **options)
    return rate(made, began_s, hashlib.sha256(maps.relevance["poly-cam"].tobytes()).hexdigest())


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
    """Give a command and kill it, or a process that works for it, each kind as often; tells which."""
    command = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(rng.uniform(0.2, 1.0) * within_s)
    victims: dict[str, list[int]] = {"driver": [command.pid]}
    for process in set(below(os.getpid())) - {command.pid}:
        victims.setdefault(kind_of(process), []).append(process)
    kind = rng.choice(sorted(victims))
    if command.poll() is not None:
        return NOBODY
    try:
        os.kill(rng.choice(victims[kind]), signal.SIGKILL)
    except ProcessLookupError:
        kind = NOBODY
    try:
        command.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        command.kill()
        command.wait()
        kind += ", and the command hung"
    return kind


@contextmanager
def ready(on: str) -> Iterator[str]:
    """A place to work as `--on` takes it; of a cluster, while its two nodes of Ray are there."""
    if on != CLUSTER:
        yield on
        return
    from ray.cluster_utils import Cluster  # noqa: PLC0415 (an extra)  # pyright: ignore[reportMissingImports]

    cluster = Cluster()
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        yield f"ray={cluster.address}"
    finally:
        cluster.shutdown()


def survive(data: Path, on: str, *, wanted: str, within_s: float, rng: random.Random) -> dict[str, Any]:
    """What was killed of a command, with how many parts there, and whether the same command then ended with all."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        with ready(on) as place:
            killed = kill_at_random(kill_words(data, out, place), rng, within_s=within_s)
        there = len(parts(out) or parts(partial_folder(out)))
        with ready(on) as place, suppress(subprocess.TimeoutExpired):
            again = subprocess.run(
                kill_words(data, out, place), check=False, capture_output=True, text=True, timeout=_PATIENCE_S
            )
            same = again.returncode == 0 and content(out) == wanted
            told = "" if same else again.stderr[-2000:]
            return {"killed": killed, "on": on, "parts": there, "survived": same, "told": told}
        return {"killed": killed, "on": on, "parts": there, "survived": False, "told": "the second command hung"}


def kill_words(data: Path, out: Path, on: str) -> list[str]:
    """Command that is killed."""
    own = [sys.executable, "-m", "sliplens", "predict", NETWORK, str(data), "--engine", "folded"]
    return [*own, "-o", str(out), "--on", on]


def time_whole(data: Path, on: str) -> tuple[float, str]:
    """Seconds that a command takes that nobody kills, and what it makes."""
    with tempfile.TemporaryDirectory() as folder, ready(on) as place:
        began_s, words = time.perf_counter(), kill_words(data, Path(folder) / "out", place)
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

    def rates(self, data: Dataset, stages: list[str], places: list[str]) -> dict[str, dict[str, Any]]:
        """Speed of each stage at each place."""
        found: dict[str, dict[str, Any]] = {stage: {} for stage in stages}
        for stage, place in product(stages, places):

            def measure(stage: str = stage, place: str = place) -> dict[str, Any]:
                alone = place == ONE_THREAD
                with tempfile.TemporaryDirectory() as folder, one_thread() if alone else nullcontext():
                    own = STAGES[stage](data, Path(folder) / "out", "serial" if alone else place)
                return asdict(own) | {"load_average": os.getloadavg()[0]}

            found[stage][place] = self.once(f"{stage}-{place}-{data.hash[:16]}", measure)
            print(f"{stage:8s} {place:12s} {found[stage][place]}", file=sys.stderr, flush=True)
        return found

    def driver_mb(self) -> float:
        """What `weigh_driver` weighs, in memory: its files would each wait for the disk."""

        def weigh() -> float:
            with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as empty:
                return weigh_driver(Path(empty))

        return self.once("driver", weigh)

    def kills(self, data: Dataset, where: list[str], *, count: int, seed: int) -> list[dict[str, Any]]:
        """Each kill, of whom, and whether the same command then ended with the same parts."""
        found: list[dict[str, Any]] = []

        def whole(on: str) -> tuple[float, str]:
            return self.once(f"whole-{on}-{data.hash[:16]}", lambda: time_whole(data.folder, on))

        for number in range(2 * count):  # a command that was over when its moment came was not killed
            on, rng = where[number % len(where)], random.Random(f"{seed}-{number}")

            def kill(on: str = on, rng: random.Random = rng) -> dict[str, Any]:
                wanted = whole("serial")[1]
                return survive(data.folder, on, wanted=wanted, within_s=whole(on)[0], rng=rng)

            one = self.once(f"kill-{seed}-{number}-{data.hash[:16]}", kill)
            print(f"kill {number}: {one}", file=sys.stderr, flush=True)
            if NOBODY not in one["killed"]:
                found.append(one)
            if len(found) == count:
                break
        return found


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
    places = ["serial", ONE_THREAD, by_processes]
    if with_ray := not options.without_ray and missing_packages("ray", extra="ray") is None:
        places.append("ray")
    with tempfile.TemporaryDirectory() as folder:
        kept = Kept(folder=options.keep or Path(folder))
        driver_mb = kept.driver_mb()  # first: whatever else is done would hide by how much its memory peaks
        found = load_dataset(options.data or kept.data("data", trials=12, frames=40))
        rates = kept.rates(found, options.stages, places)
        where = ["serial", by_processes, *(["ray", CLUSTER] if with_ray else [])]
        kills = kept.kills(found, where, count=options.kills, seed=options.seed)
        killed = Counter(f"{one['killed']}, {one['on']}" for one in kills)
        survived = sum(one["survived"] for one in kills)

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
        "parts_there_when_killed": sorted(one["parts"] for one in kills),
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
