"""Latency of live readings: from a frame of 640 x 480 pixels, 60 a second, to its margin.

    python benchmarks/live.py --json                # 10 minutes, and one more with maps
    python benchmarks/live.py --seconds 30

`p50_ms` and `p99_ms` are from the moment a replayed frame is due to its reading; `p99_ms_with_maps` is the same while
another thread explains the newest frame twice a second. `drops` are frames that were never read, `memory_growth_mb` how
much more memory the process holds at the end than after the first 10 seconds (or a tenth of a shorter run).
"""

import argparse
import json
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Thread

# threads that spin while they wait take the cores from those that work; must be set before torch is imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from PIL import Image

import sliplens as sl
from sliplens.live import LiveFrame, Reading, ReplaySource
from sliplens.recordings.source import open_source
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

SIZE = (480, 640)
RATE_HZ = 60.0
MAPS_HZ = 2.0
WARM_S = 2.0
"""Time at the start that counts for nothing: caches fill and clocks rise."""


@dataclass(frozen=True, kw_only=True)
class Latencies:
    """What a run of the loop measured."""

    engine: str
    total_ms: np.ndarray
    drops: int
    memory_growth_mb: float
    parts_ms: dict[str, float]
    maps: int


def resident_mb() -> float:
    """Memory that the process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def make_frames() -> tuple[np.ndarray, np.ndarray]:
    """A simulated grip at the size of a camera, and the sensor untouched."""
    trial = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=60))

    def enlarge(image: np.ndarray) -> np.ndarray:
        return np.asarray(Image.fromarray(image).resize((SIZE[1], SIZE[0]), Image.Resampling.BILINEAR))

    return np.stack([enlarge(image) for image in trial.frames]), enlarge(trial.reference)


def measure(frames: np.ndarray, untouched: np.ndarray, *, seconds: float, maps: bool) -> Latencies:
    """Read a repeated grip for a while, with maps beside it or without."""
    network = sl.load("chromatouch-difference")
    network = replace(network, manifest=replace(network.manifest, frame_size=SIZE))
    source = ReplaySource(open_source(frames)[0], rate_hz=RATE_HZ, repeat=True)
    readings: list[tuple[float, float, float, float]] = []
    memory_mb: list[float] = []
    newest: list[np.ndarray] = []
    dropped = [0, 0]
    settles_s = min(10.0, seconds / 10)

    def keep(reading: Reading, frame: LiveFrame | None) -> None:
        if frame is None or reading.time_s < WARM_S:
            dropped[0] = reading.dropped
            return
        latency = reading.latency
        readings.append((reading.time_s, latency.total_ms, latency.encode_ms, latency.network_ms))
        dropped[1] = reading.dropped
        newest[:] = [frame.image]
        if reading.time_s > WARM_S + settles_s and reading.number % int(RATE_HZ) == 0:
            memory_mb.append(resident_mb())

    stopped, explained = Event(), [0]

    def explain() -> None:
        while not stopped.wait(1 / MAPS_HZ):
            if newest:
                sl.explain(network, newest[0][None], reference=untouched, method="grad-cam")
                explained[0] += 1

    reader = sl.LiveReader(source, network, reference=untouched)  # for hours, as far as it knows
    reader.subscribe(keep)
    with reader:
        beside = Thread(target=explain, daemon=True)
        if maps:
            beside.start()
        for reading in reader.readings():
            if reading.time_s >= seconds + WARM_S:
                break
        stopped.set()
        engine = reader.engine.name if reader.engine else ""
    if maps:
        beside.join()
    table = np.array(readings)
    return Latencies(
        engine=engine,
        total_ms=table[:, 1],
        drops=dropped[1] - dropped[0],
        memory_growth_mb=memory_mb[-1] - memory_mb[0] if memory_mb else 0.0,
        parts_ms={"encode": float(np.median(table[:, 2])), "network": float(np.median(table[:, 3]))},
        maps=explained[0],
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="length of the run without maps")
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    options = parser.parse_args()
    frames, untouched = make_frames()
    begun = time.monotonic()
    alone = measure(frames, untouched, seconds=options.seconds, maps=False)
    beside = measure(frames, untouched, seconds=max(5.0, options.seconds / 10), maps=True)
    result = {
        "p50_ms": round(float(np.median(alone.total_ms)), 2),
        "p99_ms": round(float(np.quantile(alone.total_ms, 0.99)), 2),
        "p99_ms_with_maps": round(float(np.quantile(beside.total_ms, 0.99)), 2),
        "drops": alone.drops,
        "memory_growth_mb": round(alone.memory_growth_mb, 1),
        "seconds": options.seconds,
        "readings": len(alone.total_ms),
        "encode_ms": round(alone.parts_ms["encode"], 2),
        "network_ms": round(alone.parts_ms["network"], 2),
        "maps": beside.maps,
        "engine": alone.engine,
        "load": round(os.getloadavg()[0], 1),
        "took_s": round(time.monotonic() - begun, 1),
    }
    if options.json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        print(f"{name:18} {value}")


if __name__ == "__main__":
    main()
