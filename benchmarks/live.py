"""Latency of live readings: from a frame of 640 x 480 pixels, 60 a second, to its margin, with a page open.

The gel is in the middle of the frame, as in a camera behind a dome; a sensor profile crops and resizes it for the
network, in the time that is measured.

    python benchmarks/live.py --json                # 10 minutes, and one more with maps
    python benchmarks/live.py --minutes 0.5
    python benchmarks/live.py --minutes 0.5 --page none
    python benchmarks/live.py --ratios --json       # one network over another, in two minutes

`p50_ms` and `p99_ms` are from the moment a replayed frame is due to its margin, over the frames that have one, while a
headless Chromium beside it draws the page (`--page browser`); `p99_ms_with_maps` is the same while the page
shows maps, twice a second. `drops` are frames that were never read, `memory_growth_mb` how much more memory the process
holds at the end than after the first 10 seconds (or a tenth of a shorter run), `page_ms_a_second` the processor time of
the page's threads. `of_it_ms` is the mean time of each part over the slowest hundredth of the frames: `network` is what
a frame waits for that after its checks, `waiting` what none of them took.

`--ratios` compares ways to read, without a page: readers take turns, frame by frame, so that whatever else the machine
does hits all alike. `p50_ratios` and `p99_ratios` are of `chromatouch-pair` over `chromatouch-difference`, as they come
(112 and 224 px), both at 224 px, both given a range of friction, and of frames in order over one by one.
"""

import argparse
import json
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from queue import SimpleQueue

# threads that spin while they wait take the cores from those that work; must be set before torch is imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from PIL import Image

import sliplens as sl
from sliplens.app import LivePage
from sliplens.files import DEFAULT_NETWORK
from sliplens.live import LiveFrame, LiveSource, Reading, ReplaySource
from sliplens.models import Network
from sliplens.recordings.sensor import SensorProfile
from sliplens.recordings.source import open_source
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

SIZE = (480, 640)
GEL_PX, LEFT_PX = 480, 80
PROFILE = SensorProfile(
    name="chromatouch",
    camera_size_px=(640, 480),
    crop_px=(LEFT_PX, 0, GEL_PX, GEL_PX),
    resize_px=(224, 224),
)
RATE_HZ = 60.0
WARM_S = 2.0
"""Time at the start, once the page shows its first picture, that counts for nothing: caches fill and clocks rise."""
OPENS_S = 120.0
"""Time within which a browser opens the page, however busy the machine."""
PARTS = ("waiting", "decode", "checks", "encode", "network")


def page_s() -> float:
    """Processor time that the page's threads have taken."""
    tasks = [
        f"/proc/self/task/{thread.native_id}/stat" for thread in threading.enumerate() if thread.name[:4] == "page"
    ]
    ticks = [int(part) for task in tasks for part in Path(task).read_text().rpartition(")")[2].split()[11:13]]
    return sum(ticks) / os.sysconf("SC_CLK_TCK")


def resident_mb() -> float:
    """Memory that the process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def make_frames() -> tuple[np.ndarray, np.ndarray]:
    """A simulated grip in the middle of a camera's frames, and the sensor untouched."""
    trial = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=60))

    def enlarge(image: np.ndarray) -> np.ndarray:
        gel = np.asarray(Image.fromarray(image).resize((GEL_PX, GEL_PX), Image.Resampling.BILINEAR))
        return np.pad(gel, ((0, 0), (LEFT_PX, LEFT_PX), (0, 0)))

    return np.stack([enlarge(image) for image in trial.frames]), enlarge(trial.reference)


@contextmanager
def browser(address: str) -> Iterator[None]:
    """A headless Chromium that shows an address."""
    name = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
    if name is None:
        raise SystemExit("there is no Chromium on this machine; measure without a page, with --page none")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [name, "--headless", "--no-sandbox", "--window-size=1280,900", f"--user-data-dir={profile}"]
        with subprocess.Popen([*words, "--remote-debugging-port=0", address], stderr=subprocess.DEVNULL) as process:
            try:
                yield
            finally:
                process.terminate()


def repeat_frames(frames: np.ndarray, *, seconds: float) -> ReplaySource:
    """Replay frames over and over, for so many seconds."""
    count = round(RATE_HZ * seconds)
    capture, time_s = open_source(frames)[0], np.arange(count) / RATE_HZ
    return ReplaySource(replace(capture, frame_time_s=time_s, read_frames=lambda: islice(cycle(frames), count)))


def measure(
    frames: np.ndarray, untouched: np.ndarray, *, network: Network, seconds: float, shown: bool, maps: bool
) -> dict[str, object]:
    """Read a repeated grip for a while, with a page or without, and maps on it or not."""
    source = repeat_frames(frames, seconds=seconds + OPENS_S + 60)
    # made beforehand, so that what is kept here does not look like memory that grows
    table = np.full((round(1.1 * RATE_HZ * seconds) + 600, 2 + len(PARTS)), -1.0)
    kept, last, begins_s = [0], [""], [np.inf]
    memory_mb = np.full(round(seconds) + 10, -1.0)
    dropped, settles_s = [0, 0], min(10.0, seconds / 10)

    def keep(reading: Reading, frame: LiveFrame | None) -> None:
        if frame is None or reading.time_s < begins_s[0]:
            dropped[0] = reading.dropped
            return
        spent = reading.latency
        own_ms = (spent.decode_ms, spent.checks_ms, spent.encode_ms, spent.network_ms)
        # a replayed frame was decoded before it was due
        waiting_ms = spent.total_ms - spent.checks_ms - spent.encode_ms - spent.network_ms
        if kept[0] == len(table):
            return
        table[kept[0]] = (
            reading.margin is not None,
            spent.total_ms,
            waiting_ms,
            *own_ms,
        )
        kept[0] += 1
        last[0] = str(reading.withheld)
        dropped[1] = reading.dropped
        since_s = round(reading.time_s - begins_s[0] - settles_s)
        if 0 <= since_s < len(memory_mb) and memory_mb[since_s] < 0:
            memory_mb[since_s] = resident_mb()

    reader = sl.LiveReader(source, network, reference=untouched, sensor=PROFILE)  # for hours, as far as it knows
    reader.subscribe(keep)
    pictures, explained, spent_s = set[int](), set[int](), 0.0
    with ExitStack() as stack:
        stack.enter_context(reader)
        page = stack.enter_context(LivePage(reader, port=0)) if shown else None
        if page is not None:
            stack.enter_context(browser(page.address))
        for reading in reader.readings():
            if page is not None:
                for viewer in tuple(page.feed.clients):
                    viewer.shows_map = maps
                pictures |= set() if page.feed.picture is None else {page.feed.picture.frame.number}
                explained |= set() if page.feed.map is None else {page.feed.map.number}
            if np.isinf(begins_s[0]) and (page is None or page.feed.picture is not None):
                begins_s[0] = reading.time_s + WARM_S
            if reading.time_s < begins_s[0]:
                spent_s = page_s()
            if np.isinf(begins_s[0]) and reading.time_s > OPENS_S:
                raise SystemExit(f"no browser opened the page within {OPENS_S:g} s; look after Chromium")
            if reading.time_s >= begins_s[0] + seconds:
                break
        engine, spent_s = reader.engine.name if reader.engine else "", page_s() - spent_s
    rows = table[: kept[0]]
    rows = rows[rows[:, 0] > 0, 1:]
    if not len(rows):
        raise SystemExit(f"no frame had a margin, so there is nothing to measure; the last: {last[0]}")
    memory_mb = memory_mb[memory_mb >= 0]
    return {
        **summarise(rows[:, 0], rows[:, 1:]),
        "drops": dropped[1] - dropped[0],
        "memory_growth_mb": round(float(memory_mb[-1] - memory_mb[0]), 1) if len(memory_mb) else 0.0,
        "readings": kept[0],
        "with_a_margin": len(rows),
        "page_ms_a_second": round(1e3 * spent_s / seconds, 1) if shown else None,
        "pictures": len(pictures),
        "maps": len(explained),
        "engine": engine,
    }


def summarise(total_ms: np.ndarray, parts_ms: np.ndarray) -> dict[str, object]:
    """Return quantiles of the latency, the medians of its parts, and their means over the slowest hundredth."""
    slowest = total_ms >= np.quantile(total_ms, 0.99)
    medians, of_slowest = (
        {name: round(float(value), 2) for name, value in zip(PARTS, values, strict=True)}
        for values in (np.median(parts_ms, axis=0), parts_ms[slowest].mean(axis=0))
    )
    p50_ms, p99_ms = np.quantile(total_ms, (0.5, 0.99)).round(2).tolist()
    return {"p50_ms": p50_ms, "p99_ms": p99_ms, "parts_ms": medians, "of_it_ms": of_slowest}


class TurnSource(LiveSource):
    """Frames that are captured as soon as they are handed in."""

    name, size, rate_hz = "the benchmark", SIZE, RATE_HZ
    speed = 0.0  # its clock goes on with the frames, however long the others take

    def __init__(self) -> None:
        self.handed: SimpleQueue[LiveFrame | None] = SimpleQueue()

    def frames(self) -> Iterator[LiveFrame]:
        """Frames as they are handed in."""
        while (frame := self.handed.get()) is not None:
            yield replace(frame, captured_s=time.monotonic())

    def close(self) -> None:
        """End with the frames that were handed in."""
        self.handed.put(None)


def load_at(name: str, image_size: int | None = None) -> Network:
    """A network of the package at its own image size or another, at which it errs."""
    network = sl.load(name)
    manifest = network.manifest
    if image_size is not None:
        assert manifest.novelty is not None
        novelty = replace(manifest.novelty, limit=np.inf)  # strange as such pictures are to it, none is withheld
        manifest = replace(manifest, image_size=image_size, novelty=novelty)
    return replace(network, manifest=manifest)


RATIOS = {
    "pair": ("pair", "difference"),
    "pair_at_224": ("pair_at_224", "difference"),
    "pair_friction": ("pair_friction", "difference_friction"),
}
"""Ways to read that are compared, the one over the other."""


def measure_in_turn(frames: np.ndarray, untouched: np.ndarray, *, rounds: int) -> dict[str, np.ndarray]:
    """Milliseconds from capture to reading by way to read, over the frames of which each has a margin."""
    ways: dict[str, tuple[Network, dict]] = {"pair_at_224": (load_at("chromatouch-pair", 224), {})}
    for name in ("difference", "pair"):
        network = load_at(f"chromatouch-{name}")
        for suffix, options in (("", {}), ("_friction", {"friction": (0.3, 0.9)})):
            ways[name + suffix] = network, options
    readers = {
        name: sl.LiveReader(TurnSource(), network, reference=untouched, sensor=PROFILE, stall_s=3600, **options)
        for name, (network, options) in ways.items()
    }
    names, told = list(readers), {name: SimpleQueue[Reading]() for name in readers}
    totals_ms = np.full((rounds, len(names)), np.nan)
    with ExitStack() as stack:
        for name, reader in readers.items():
            reader.subscribe(lambda reading, _, place=told[name]: place.put(reading))
            stack.enter_context(reader)
        for number in range(rounds):
            frame = LiveFrame(
                image=frames[number % len(frames)], number=number, time_s=number / RATE_HZ, captured_s=np.nan
            )
            for at in np.roll(range(len(names)), number):
                reader = readers[names[at]]
                assert isinstance(reader.source, TurnSource)
                reader.source.handed.put(frame)
                reading = told[names[at]].get(timeout=60)
                if reading.margin is not None and number > WARM_S * RATE_HZ:
                    totals_ms[number, at] = reading.latency.total_ms
    totals_ms = totals_ms[np.isfinite(totals_ms).all(axis=1)]
    return dict(zip(names, totals_ms.T, strict=True))


def compare_ways(frames: np.ndarray, untouched: np.ndarray, *, rounds: int) -> dict[str, object]:
    """Ratios of the latencies of ways to read, and the latencies themselves."""
    totals_ms = measure_in_turn(frames, untouched, rounds=rounds)
    result: dict[str, object] = {}
    for quantile in (0.5, 0.99):
        ms = {name: float(np.quantile(values, quantile)) for name, values in totals_ms.items()}
        result[f"p{100 * quantile:.0f}_ratios"] = {
            name: round(ms[one] / ms[other], 3) for name, (one, other) in RATIOS.items()
        }
        result[f"p{100 * quantile:.0f}_ms"] = {name: round(value, 2) for name, value in ms.items()}
    return {**result, "rounds": rounds, "with_a_margin": len(next(iter(totals_ms.values())))}


def measure_pace(
    frames: np.ndarray, untouched: np.ndarray, *, network: Network, seconds: float, shown: bool
) -> dict[str, object]:
    """Measure latencies at the camera's pace, with a page open or not, and with maps on it."""
    measured = partial(measure, frames, untouched, network=network, shown=shown)
    found = {**measured(seconds=seconds, maps=False), "seconds": seconds}
    if shown:
        beside = measured(seconds=max(5.0, seconds / 10), maps=True)
        found |= {f"{name}_with_maps": beside[name] for name in ("p99_ms", "of_it_ms", "drops", "page_ms_a_second")}
        found["maps"] = beside["maps"]
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the run without maps")
    parser.add_argument("--network", default=DEFAULT_NETWORK, help="name or folder of a network, but for --ratios")
    parser.add_argument("--page", choices=("browser", "none"), default="browser", help="what looks at the page")
    parser.add_argument("--ratios", action="store_true", help="compare ways to read in place of that")
    parser.add_argument("--rounds", type=int, default=1200, help="frames that each way reads, for --ratios")
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    options = parser.parse_args()
    frames, untouched = make_frames()
    if options.ratios:
        result = compare_ways(frames, untouched, rounds=options.rounds)
    else:
        network, shown = sl.load(options.network), options.page == "browser"
        result = measure_pace(frames, untouched, network=network, seconds=60 * options.minutes, shown=shown)
    result["load"] = round(os.getloadavg()[0], 1)
    print(json.dumps(result, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
