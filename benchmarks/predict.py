"""Time the inference engines side by side: one frame at a time, as on a robot, by `chromatouch-difference` at 224 px.

In every round each engine predicts once, in an order that turns, so that other work on the machine hits all alike.
Decoding and encoding are left out. Predictions of each engine are compared with those of `torch`.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from functools import partial

# as the command line does; must be set before torch is imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

import sliplens as sl
from sliplens.errors import SliplensError
from sliplens.files import machine, versions
from sliplens.models import Network
from sliplens.models.engines import ENGINES, Engine, make_engine
from sliplens.models.onnx import difference

WARM_UP = 5


def make_ready(trained: Network, inputs: Tensor) -> tuple[dict[str, Engine], dict[str, str]]:
    """Return the engines that can be used here, and why the others cannot."""
    engines, missing = {}, {}
    for name in ENGINES:
        try:
            engines[name] = make_engine(name, trained, batch_size=1, streams=1)
            trained.estimate(inputs, engine=engines[name])
        except SliplensError as error:
            missing[name] = str(error)
            engines.pop(name, None)
    return engines, missing


def time_rounds(work: dict[str, Callable[[], object]], *, rounds: int) -> dict[str, np.ndarray]:
    """Milliseconds of every call; in each round all are called once."""
    names = list(work)
    found: dict[str, list[float]] = {name: [] for name in names}
    for number in range(WARM_UP + rounds):
        turn = number % len(names)
        for name in names[turn:] + names[:turn]:
            start = time.perf_counter()
            work[name]()
            found[name].append(1e3 * (time.perf_counter() - start))
    return {name: np.array(times[WARM_UP:]) for name, times in found.items()}


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=300, help="timed calls of each engine")
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    options = parser.parse_args()
    torch.set_num_threads(2)
    trained, rng = sl.load("chromatouch-difference"), np.random.default_rng(3)
    # coloured clouds: of noise, every image would have the same prediction
    colours = torch.from_numpy(rng.random((8, 3, 4, 4), dtype=np.float32) ** 2)
    inputs = functional.interpolate(colours, size=(trained.manifest.image_size,) * 2, mode="bilinear")
    engines, missing = make_ready(trained, inputs[:1])
    work: dict[str, Callable[[], object]] = {
        name: partial(trained.estimate, inputs[:1], engine=engine) for name, engine in engines.items()
    }
    times = time_rounds(work, rounds=options.rounds)
    margins = {name: trained.estimate(inputs, engine=engine).margin for name, engine in engines.items()}
    result = {
        "p50_ms": {name: float(np.percentile(values, 50)) for name, values in times.items()},
        "p99_ms": {name: float(np.percentile(values, 99)) for name, values in times.items()},
        "parity": {name: difference(values, margins["torch"]) for name, values in margins.items()},
        "missing": missing,
        "load_average": os.getloadavg()[0],
        "machine": machine(),
        "versions": versions(),
    }
    print(json.dumps(result, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
