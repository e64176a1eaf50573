"""Many trials serially, by processes and by Ray: how fast, with which bytes, in what memory, and what a kill costs.

Rates are of steady work: of its later half. The start is what the whole took beyond its frames at that
rate. `serial` is what users get, its batches in as many threads as there are cores; `one core` is the same on one of
them: its time of the processor, which other work on the machine hardly changes, is the cost from which the plan is
drawn, of what a million and a hundred million frames take.

Kills are `SIGKILL` at random moments, of the command or of a process that works for it: a worker, an actor, a node of
Ray, of one or, as `cluster`, of two of them. The same command must then end with the bytes of a serial run, no part
twice and none missing.

With `--keep FOLDER` each piece is kept as soon as it is measured, by the hashes of code and data, and the next call of
the same code goes on from there, so that hours can be had in minutes: `--stages predict --kills 0`, then `--stages
--kills 10`, then `--kills 30`. With `--json` the last line is one object.
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
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command line does; before torch is imported

import torch

import sliplens
from sliplens import load_dataset, predict, simulate
from sliplens.extras import missing_packages
from sliplens.files import hash_file, hash_json, machine, partial_folder, versions, write_json
from sliplens.markers.tracking import track
from sliplens.recordings import Dataset, TrialInfo
from sliplens.runner import MakePart, Part, Work, part, run_parts
from sliplens.study.workspace import explain_source

NETWORK = "chromatouch-difference"
EMPTY = 10_000
"""Shards whose driver is weighed."""
MAPS = 8
"""Frames that are explained."""
PLANNED = (1_000_000, 100_000_000)
"""Frames of the plan, in trials of so many, 20 s of a usual camera, on so many cores."""
TRIAL = 600
MACHINES = {"a laptop of 8 cores": 8, "100 nodes of 16 cores": 1600}
ONE_CORE = "one core"
"""Serial work on one core; every other place is named as `--on` takes it."""
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
    bytes_per_frame: float
    """Of what was made."""
    held_per_frame: float = 0.0
    """Bytes in the driver's memory."""
    cpu_s_per_frame: float = 0.0
    """Time of the processor in the driver's process, which is all where it works alone."""


def parts(folder: Path) -> dict[str, Path]:
    """Parts of a folder by their names."""
    return {str(path.relative_to(folder)): path for path in folder.glob("trial=*/*") if path.name[0] != "."}


def content(folder: Path) -> str:
    """Hash of the names and bytes of all parts."""
    return hash_json({name: hash_file(path) for name, path in parts(folder).items() if path.is_file()})


class Ticks:
    """Whole and processor's seconds as work goes on."""

    def __init__(self) -> None:
        self._ticks = [(time.time(), time.process_time(), 0)]

    def __call__(self, done: int, _: int) -> None:
        """Note how many frames are done."""
        self._ticks.append((time.time(), time.process_time(), done))

    def rate(self, out: Path, sha256: str) -> Rate:
        """Speed and cost of the later half."""
        ticks, frames = self._ticks, self._ticks[-1][2]
        half = next(one for one in ticks if one[2] >= frames / 2)
        last_s, cpu_s, steady = (last - then for last, then in zip(ticks[-1], half, strict=True))
        frames_per_s = steady / last_s
        return Rate(
            start_s=ticks[-1][0] - ticks[0][0] - frames / frames_per_s,
            frames_per_s=frames_per_s,
            sha256=sha256,
            bytes_per_frame=size_of(out) / frames,
            cpu_s_per_frame=cpu_s / steady,
        )


def size_of(folder: Path) -> int:
    """Bytes of all files."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


@contextmanager
def one_core() -> Iterator[None]:
    """Leave this thread, and those that it begins, the last core alone."""
    every, threads = os.sched_getaffinity(0), torch.get_num_threads()
    os.sched_setaffinity(0, {max(every)})
    try:
        torch.set_num_threads(1)
        yield
    finally:
        torch.set_num_threads(threads)
        os.sched_setaffinity(0, every)


def plan(rates: dict[str, dict[str, Any]], *, driver: dict[str, float], data: Dataset) -> list[dict[str, Any]]:
    """What each stage would take of many frames, if every core did as much as one does alone."""
    stored, rows = size_of(data.folder) / data.frames, []
    for (stage, own), frames, (machines, cores) in product(rates.items(), PLANNED, MACHINES.items()):
        rate_per_s, trials = cores / own["cpu_s_per_frame"], frames / TRIAL
        shards = frames if stage == "explain" else trials
        held = driver["bytes_a_trial"] * trials + driver["grew_mb"] * 1e6 / EMPTY * shards
        rows.append({
            "stage": stage,
            "frames": frames,
            "on": machines,
            "hours": max(frames / rate_per_s, driver["s_a_shard"] * shards) / 3600,
            "read_tb": stored * frames / 1e12,
            "read_gb_per_s": stored * rate_per_s / 1e9,
            "written_gb": own["bytes_per_frame"] * frames / 1e9,
            "driver_gb": (held + own["held_per_frame"] * frames) / 1e9,
        })  # fmt: skip
    return rows


class Empty(Work):
    """Work that does nothing."""

    def begin(self) -> MakePart:
        """Write a byte a part."""

        def make(_item: int, path: Path) -> None:
            path.write_bytes(b"-")

        return make


def time_predict(data: Dataset, out: Path, on: str) -> Rate:
    """Margins of all frames."""
    ticks = Ticks()
    predict(NETWORK, data, engine="torch", on=on, out=out, on_progress=ticks)
    return ticks.rate(out, content(out))


def time_track(data: Dataset, out: Path, on: str) -> Rate:
    """Markers of all frames."""
    ticks = Ticks()
    track(data, markers="chromatouch", on=on, out=out, on_progress=ticks)
    return ticks.rate(out, content(out))


def time_explain(data: Dataset, out: Path, on: str) -> Rate:
    """Maps of Poly-CAM on its budget."""
    ticks, levels = Ticks(), tuple(1 - number / (MAPS - 1) for number in range(MAPS))
    options = {"methods": ("poly-cam",), "levels": levels, "split": data.trials[-1].split, "out": out}
    maps = explain_source(NETWORK, data, on=on, on_progress=ticks, **options)
    kept = (maps.images, maps.pictures, *maps.relevance.values(), *maps.saliency.values())
    held = sum(array.nbytes for array in kept) + 4 * maps.images.nbytes  # the references, in 32 bits
    found = ticks.rate(out, hashlib.sha256(maps.relevance["poly-cam"].tobytes()).hexdigest())
    return replace(found, held_per_frame=held / MAPS)


STAGES = {"predict": time_predict, "explain": time_explain, "track": time_track}


def weigh_driver(folder: Path) -> dict[str, float]:
    """What the driver takes: for ten thousand empty parts, more than for a hundred, and for a long list of trials."""

    def parts(count: int) -> list[Part]:
        return [part(at, trial=f"t{at}", frames=1, recipe=0, content=str(at)) for at in range(count)]

    peaks_mb, took_s = [], 0.0
    for count in (100, EMPTY):
        began_s = time.perf_counter()
        run_parts(Empty(), parts(count), folder / str(count), title="Nothing")
        took_s = time.perf_counter() - began_s
        peaks_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    tracemalloc.start()
    own = {"sensor": "a", "day": 1, "condition": "dry", "object": "", "split": "test", "height": 224, "width": 224}
    held = [TrialInfo(trial=f"trial-{row:06d}", frames=TRIAL, sha256=f"{row:064x}", **own) for row in range(EMPTY)]
    rows = [(info.trial, info.frames, info.sha256) for info in held]  # as `open_trials` has them
    bytes_a_trial = tracemalloc.get_traced_memory()[0] / EMPTY
    tracemalloc.stop()
    assert len(rows) == EMPTY
    return {"grew_mb": peaks_mb[1] - peaks_mb[0], "s_a_shard": took_s / EMPTY, "bytes_a_trial": bytes_a_trial}


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
            told = "" if same else f"exit code {again.returncode}: {again.stderr[-2000:]}"
            return {"killed": killed, "on": on, "parts": there, "survived": same, "told": told}
        return {"killed": killed, "on": on, "parts": there, "survived": False, "told": "the second command hung"}


def kill_words(data: Path, out: Path, on: str) -> list[str]:
    """Command that is killed."""
    own = [sys.executable, "-m", "sliplens", "predict", NETWORK, str(data), "--engine", "torch"]
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
    code: str
    """Hash of what is measured; what another one took or made is not compared."""

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """Measure a piece unless it is there."""
        path = self.folder / self.code / f"{name}.json"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
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
                alone = place == ONE_CORE
                with tempfile.TemporaryDirectory() as folder, one_core() if alone else nullcontext():
                    own = STAGES[stage](data, Path(folder) / "out", "serial" if alone else place)
                return asdict(own) | {"load_average": os.getloadavg()[0]}

            found[stage][place] = self.once(f"{stage}-{place}-{data.hash[:16]}", measure)
            print(f"{stage:8s} {place:12s} {found[stage][place]}", file=sys.stderr, flush=True)
        return found

    def driver(self) -> dict[str, float]:
        """What `weigh_driver` weighs, its files in memory: on a disk each would wait for it."""

        def weigh() -> dict[str, float]:
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
    places = ["serial", ONE_CORE, by_processes]
    if with_ray := not options.without_ray and missing_packages("ray", extra="ray") is None:
        places.append("ray")
    with tempfile.TemporaryDirectory() as folder:
        sources = Path(sliplens.__file__).parent
        code = hash_json({str(one.relative_to(sources)): hash_file(one) for one in sources.rglob("*.py")})
        kept = Kept(folder=options.keep or Path(folder), code=code)
        driver = kept.driver()  # first: whatever else is done would hide by how much its memory peaks
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

    planned = plan({stage: own[ONE_CORE] for stage, own in rates.items()}, driver=driver, data=found)
    result = {
        "speedup_processes": over(by_processes, "serial"),
        "speedup_processes_one_core": over(by_processes, ONE_CORE),
        "ray_over_processes": over("ray", by_processes),
        "same_bytes": {stage: len(set(own.values())) == 1 for stage, own in each("sha256").items()},
        "driver_mb_10k_parts": driver["grew_mb"],
        "kills": killed.total(),
        "kills_survived": survived,
        "killed": dict(killed),
        "parts_there_when_killed": sorted(one["parts"] for one in kills),
        **{name: each(name) for name in ("frames_per_s", "start_s", "cpu_s_per_frame", "load_average")},
        "plan": planned,
        "frames": found.frames,
        "workers": options.workers,
        "machine": vars(machine()),
        "versions": versions(),
    }
    for stage, own in rates.items():
        for on, one in own.items():
            print(f"{stage:8s} {on:12s} {one['frames_per_s']:9.2f} frames/s after a start of {one['start_s']:.1f} s")
    print(f"the same bytes: {result['same_bytes']}; driver + {driver['grew_mb']:.1f} MB from 100 to {EMPTY:,} shards")
    print(f"{survived} of {killed.total()} kills survived: {dict(killed)}")
    for row in planned:
        print("  ".join(f"{name}: {told:,.3g}" if isinstance(told, float) else f"{told}" for name, told in row.items()))
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
