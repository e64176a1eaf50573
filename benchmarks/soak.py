"""Long nights in one process: what memory, file handles, threads and latency do over hours of work.

    python benchmarks/soak.py --json                    # 2 h of reading, 24 h by a fast clock, 1,000 imports
    python benchmarks/soak.py --minutes 5 --hours 1 --imports 50 --log soak.jsonl

Three parts, one after another. A simulated fingertip is read while its page is served to a visitor who comes and goes;
every minute something else is done: a recording begins, a frozen picture is explained by the next method, the recording
ends, a new reference is taken. Then the same with a source whose stamps run 96 times as fast as the world, for
`--hours` of its clock. Then one recording is imported again and again. Every minute, and every fiftieth of the imports,
is a line of `--log`: memory, handles, threads, latency.

Growth is the median of a part's last five samples less that of the five after its first tenth, in which caches fill.
Each explainer has run twice before the first sample, so that engines that pay are made. `memory_growth_mb` and
`handles_growth` are of the reading.
"""

import argparse
import asyncio
import json
import os
import re
import shutil
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import TextIO

# threads that spin while they wait take the cores from those that work; must be set before torch is imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

import sliplens as sl
from ingest import write_trial
from live import resident_mb
from sliplens.app import LivePage
from sliplens.files import scratch_folder
from sliplens.live import LiveFrame, LiveSource, Reading, SimulatedSource
from sliplens.recordings import import_recordings
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

FAST = 96.0
"""How many times as fast as the world the stamps of the second part run."""
METHODS = (
    "grad-cam",
    "layer-cam",
    "integrated-gradients",
    "smooth-grad",
    "occlusion",
    "occlusion-marker",
    "lrp",
    "shapley",
)
"""Explainers of a few seconds; the others do the same for longer."""
STAYS_S = 180.0
"""Time after which the visitor leaves, and comes back."""
PATIENCE_S = 30.0


@dataclass(frozen=True, kw_only=True)
class Sample:
    """What the process held, and how it read since the sample before."""

    part: str
    at_s: float
    """Since the part began."""
    memory_mb: float
    handles: int
    threads: int
    readings: int = 0
    with_a_margin: int = 0
    dropped: int = 0
    """Since the part began."""
    p50_ms: float | None = None
    p99_ms: float | None = None
    did: str = ""


class Log:
    """Samples of all parts, each a line of a file as soon as it is taken."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self.samples: list[Sample] = []

    def take(self, part: str, begun_s: float, **read: object) -> None:
        """Look at the process, and keep it with what was read."""
        sample = Sample(
            part=part,
            at_s=round(time.monotonic() - begun_s, 1),
            memory_mb=round(resident_mb(), 1),
            handles=len(os.listdir("/proc/self/fd")),  # noqa: PTH208 (a thread may close one meanwhile)
            threads=threading.active_count(),
            **read,  # pyright: ignore[reportArgumentType]
        )
        self.samples.append(sample)
        self._file.write(json.dumps(asdict(sample)) + "\n")
        self._file.flush()

    def growth(self, part: str, name: str) -> float | None:
        """How much more the last five samples of a part hold than the five after its first tenth; None of too few."""
        values = [getattr(sample, name) for sample in self.samples if sample.part == part]
        first = -(-len(values) // 10)
        if len(values) < first + 2:
            return None
        return round(median(values[-5:]) - median(values[first : first + 5]), 1)


class Visitor(threading.Thread):
    """One who opens the page, answers what is sent, goes and comes back."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self._address, self._ended = address, threading.Event()
        self.visits = self.messages = 0

    def run(self) -> None:
        """Visit again and again."""
        while not self._ended.is_set():
            with suppress(OSError, WebSocketException):
                self._visit()
            self._ended.wait(1.0)

    def _visit(self) -> None:
        with urllib.request.urlopen(self._address, timeout=PATIENCE_S) as answer:
            [name] = set(re.findall(r"/frames/([\w-]+)", answer.read().decode()))
        with connect(self._address.replace("http", "ws", 1) + f"frames/{name}", max_size=None) as socket:
            self.visits += 1
            leaves_s = time.monotonic() + STAYS_S
            while not self._ended.is_set() and time.monotonic() < leaves_s:
                message = socket.recv(timeout=PATIENCE_S)
                assert isinstance(message, bytes)
                update = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
                socket.send(json.dumps({"serial": update["serial"], "drawn": True}))
                self.messages += 1

    def close(self) -> None:
        """Leave."""
        self._ended.set()
        self.join(PATIENCE_S)


class FastClock(LiveSource):
    """Simulated fingertip whose stamps run fast."""

    simulated = True

    def __init__(self, source: SimulatedSource) -> None:
        self.inner, self.name, self.speed = source, source.name, FAST
        self.size, self.rate_hz, self.reference = source.size, source.rate_hz, source.reference

    def frames(self) -> Iterator[LiveFrame]:
        """Its frames, stamped by when they were captured."""
        begun_s = time.monotonic()
        for frame in self.inner.frames():
            time_s = FAST * (frame.captured_s - begun_s)
            forces = None if frame.forces is None else replace(frame.forces, time_s=np.array([time_s]))
            yield replace(frame, time_s=time_s, forces=forces)

    def close(self) -> None:
        """Stop at the next frame."""
        self.inner.close()


class Night:
    """A running reader with its page, and what is done with it."""

    def __init__(self, reader: sl.LiveReader, page: LivePage, fingertip: SimulatedSource, into: Path) -> None:
        self._reader, self._page, self._fingertip, self._into = reader, page, fingertip, into
        self._methods = cycle(METHODS)
        self.recorded = self.explained = self.references = 0

    def tasks(self) -> Iterator[Callable[[], str]]:
        """What is done, minute after minute."""
        return cycle((self.record, self.explain, self.stop_recording, self.take_reference))

    def record(self) -> str:
        """Record, with no map over the picture."""
        self._show_maps(wanted=False)
        self._reader.record(self._into)
        return "record"

    def explain(self) -> str:
        """Explain a frozen picture by the next method, and show maps of the running one from then on."""
        self._show_maps(wanted=True)
        viewers = tuple(self._page.feed.clients)
        picture = viewers[0].freeze() if viewers else self._page.feed.picture
        method = next(self._methods)
        if picture is None:
            return "nobody looks"
        try:
            asyncio.run(self._page.feed.explain(picture, method))
        except sl.SliplensError as error:
            return f"{method}: {error}"
        finally:
            for viewer in viewers:
                viewer.thaw()
        self.explained += 1
        return f"explain by {method}"

    def stop_recording(self) -> str:
        """End the recording, and make room for the next."""
        data = self._reader.stop_recording()
        frames = 0 if data is None else sum(trial.frames for trial in data.trials)
        shutil.rmtree(self._into, ignore_errors=True)
        self.recorded += frames
        return f"stop, {frames} frames"

    def take_reference(self) -> str:
        """Let go, take a new reference, and grip again."""
        before, gives_up_s = self._reader.reference, time.monotonic() + PATIENCE_S
        self._fingertip.load(normal_force_n=0.0, tangential_force_n=0.0)
        time.sleep(1.0)
        self._page.feed.take_reference()
        while self._reader.reference is before and time.monotonic() < gives_up_s:
            time.sleep(0.1)
        self._fingertip.let_go()
        self.references += self._reader.reference is not before
        return "reference"

    def _show_maps(self, *, wanted: bool) -> None:
        for viewer in tuple(self._page.feed.clients):
            viewer.shows_map = wanted


def read_on(log: Log, part: str, *, seconds: float, rate_hz: float, fast: bool) -> dict[str, object]:
    """Read, show, record and explore for a while; gives what was done."""
    fingertip = SimulatedSource(rate_hz=rate_hz)
    source = FastClock(fingertip) if fast else fingertip
    latencies_ms, readings, dropped = list[float](), [0], [0]

    def keep(reading: Reading, _: LiveFrame | None) -> None:
        readings[0] += 1
        dropped[0] = reading.dropped
        if reading.margin is not None:
            latencies_ms.append(reading.latency.total_ms)

    with (
        scratch_folder() as scratch,
        sl.LiveReader(source, "chromatouch-difference", engine="torch") as reader,
        LivePage(reader, port=0) as page,
    ):
        reader.subscribe(keep)
        night, visitor = Night(reader, page, fingertip, scratch / "recorded"), Visitor(page.address)
        visitor.start()
        while page.feed.picture is None:
            time.sleep(0.1)
        begun_s = time.monotonic()
        for _ in range(2 * len(METHODS)):
            log.take(f"before {part}", begun_s, did=night.explain())
        step_s, begun_s = min(60.0, seconds / 12), time.monotonic()
        tasks, readings[0] = night.tasks(), 0
        latencies_ms.clear()
        while (now_s := time.monotonic() - begun_s) < seconds:
            did = next(tasks)()
            # as long as this step still lasts, in the beat of the whole
            time.sleep(max(0.0, begun_s + step_s * (now_s // step_s + 1) - time.monotonic()))
            if page.feed.ended is not None:
                raise SystemExit(f"the reading ended after {now_s:.0f} s of {seconds:.0f}: {page.feed.ended}")
            times_ms = latencies_ms.copy()
            del latencies_ms[: len(times_ms)]
            middle, late = (round(float(value), 1) for value in np.quantile(times_ms or [np.nan], (0.5, 0.99)))
            log.take(
                part,
                begun_s,
                readings=readings[0],
                with_a_margin=len(times_ms),
                dropped=dropped[0],
                p50_ms=middle if times_ms else None,
                p99_ms=late if times_ms else None,
                did=did,
            )
            readings[0] = 0
        night.stop_recording()
        visitor.close()
    return {
        "recorded": night.recorded,
        "explained": night.explained,
        "references": night.references,
        "visits": visitor.visits,
        "messages": visitor.messages,
    }


def import_again(log: Log, *, count: int, frames: int = 24) -> None:
    """Import one video with its forces, again and again."""
    with scratch_folder() as scratch:
        (source := scratch / "trial").mkdir()
        write_trial(simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=frames)), source, name="trial")
        begun_s = time.monotonic()
        for number in range(count):
            imported = scratch / "imported"
            import_recordings(source / "trial.mp4", out=imported, forces=source / "trial.csv", sensor="tip")
            shutil.rmtree(imported)
            if number % max(1, count // 50) == 0 or number == count - 1:
                log.take("imports", begun_s, did=f"{number + 1} imported")


def main() -> None:
    """Run the parts and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=120.0, help="of reading; 0 for none")
    parser.add_argument("--hours", type=float, default=24.0, help="by the fast clock; 0 for none")
    parser.add_argument("--imports", type=int, default=1000, help="of one recording; 0 for none")
    parser.add_argument("--rate", type=float, default=15.0, help="frames a second")
    parser.add_argument("--log", type=Path, help="file of a line of JSON a minute")
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    options = parser.parse_args()
    torch.set_num_threads(1)
    result: dict[str, object] = {"minutes": options.minutes, "hours": options.hours, "imports": options.imports}
    with Path(options.log or os.devnull).open("w", encoding="utf-8") as file:
        log = Log(file)
        if options.minutes > 0:
            done = read_on(log, "reading", seconds=60 * options.minutes, rate_hz=options.rate, fast=False)
            result |= growths(log, "reading", prefix="") | done
        if options.hours > 0:
            read_on(log, "fast", seconds=3600 * options.hours / FAST, rate_hz=options.rate, fast=True)
            result |= growths(log, "fast", prefix="fast_")
        if options.imports > 0:
            import_again(log, count=options.imports)
            result |= growths(log, "imports", prefix="imports_")
    if options.json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        print(f"{name:28} {value}")


def growths(log: Log, part: str, *, prefix: str) -> dict[str, object]:
    """What of a part grew, and how late its readings were first and last."""
    samples = [sample for sample in log.samples if sample.part == part]
    told: dict[str, object] = {
        f"{prefix}{name}_growth{unit}": log.growth(part, f"{name}{unit}")
        for name, unit in (("memory", "_mb"), ("handles", ""), ("threads", ""))
    }
    told[f"{prefix}memory_mb"] = samples[-1].memory_mb
    late_ms = [sample.p99_ms for sample in samples if sample.p99_ms is not None]
    if late_ms:
        told |= {
            f"{prefix}readings": sum(sample.readings for sample in samples),
            f"{prefix}with_a_margin": sum(sample.with_a_margin for sample in samples),
            f"{prefix}dropped": samples[-1].dropped,
            f"{prefix}first_p99_ms": median(late_ms[:10]),
            f"{prefix}last_p99_ms": median(late_ms[-10:]),
        }
    return told


if __name__ == "__main__":
    main()
