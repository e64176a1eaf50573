"""Time the inference engines side by side: one frame at a time, as on a robot, on an untrained ShuffleNetV2.

In every round each engine predicts once, in an order that turns, so that whatever else the machine does hits all alike.
Decoding and encoding are left out. The answers of each engine are compared with those of `torch`.

`fps_ratios` compares whole calls of `predict` by each engine, in turn too: frames a second of `chromatouch-pair` over
those of `chromatouch-difference`, as they come (112 and 224 px) and both at 224 px, and of frames in order over frames
one by one. `python benchmarks/predict.py --rounds 100 --json` takes two minutes.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

# as the command line does; must be set before torch is imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

import sliplens as sl
from sliplens.errors import SliplensError
from sliplens.files import machine, versions
from sliplens.models import Manifest, Network, build_model
from sliplens.models.engines import ENGINES, Engine, make_engine
from sliplens.models.onnx import difference
from sliplens.recordings.source import open_source
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

WARM_UP, SIZE_PX = 5, 224


def build() -> Network:
    """Make an untrained network with batch statistics of images, whose predictions vary."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = build_model(head="histogram")
    for one in model.modules():
        if isinstance(one, nn.BatchNorm2d):
            one.momentum = None  # the true statistics; a few steps towards them would let the signal die
    last = [one for one in model.modules() if isinstance(one, nn.Linear)][-1]
    with torch.no_grad():
        for seed in range(3):
            model.train()(clouds(16, size=64, seed=seed))
        last.weight.mul_(3)
    manifest = Manifest(
        backbone="shufflenet_v2_x1_0",
        input="difference",
        image_size=SIZE_PX,
        frame_size=(SIZE_PX, SIZE_PX),
        sensor="none",
        data_hash="none",
        head="histogram",
    )
    model = model.to(memory_format=torch.channels_last).eval()  # pyright: ignore[reportCallIssue]
    return Network(model=model, manifest=manifest)


def clouds(count: int, *, size: int, seed: int) -> Tensor:
    """Coloured clouds; of noise, every image would give the same answer."""
    colours = torch.rand(count, 3, 4, 4, generator=torch.Generator().manual_seed(seed)) ** 2
    return functional.interpolate(colours, size=(size, size), mode="bilinear")


def make_ready(trained: Network, inputs: Tensor) -> tuple[dict[str, Engine], dict[str, str]]:
    """Return the engines that can be used here, and why the others cannot."""
    engines, missing = {}, {}
    for name in ENGINES:
        try:
            engines[name] = make_engine(name, trained, batch_size=1, streams=1)
            engines[name].estimate(trained, inputs)
        except SliplensError as error:
            missing[name] = str(error)
            engines.pop(name, None)
    return engines, missing


def time_rounds(work: dict[str, Callable[[], object]], *, rounds: int, warm_up: int = WARM_UP) -> dict[str, np.ndarray]:
    """Milliseconds of every call; in each round all are called once."""
    names = list(work)
    found: dict[str, list[float]] = {name: [] for name in names}
    for number in range(warm_up + rounds):
        turn = number % len(names)
        for name in names[turn:] + names[:turn]:
            start = time.perf_counter()
            work[name]()
            found[name].append(1e3 * (time.perf_counter() - start))
    return {name: np.array(times[warm_up:]) for name, times in found.items()}


def parity(trained: Network, engine: Engine, plain: Engine, inputs: Tensor) -> float:
    """Largest difference between the margins of an engine and those of `torch`."""
    return difference(engine.estimate(trained, inputs).margin, plain.estimate(trained, inputs).margin)


RATIOS = {
    "pair": ("pair", "difference"),
    "pair_at_224": ("pair_at_224", "difference"),
    "sequence_of_difference": ("difference_sequence", "difference"),
    "sequence_of_pair": ("pair_sequence", "pair"),
}
"""Ways to read that are compared, the one over the other."""


def whole_calls(engine: str, *, frames: int) -> dict[str, Callable[[], object]]:
    """Calls of `predict` with networks of the package on a simulated grip, by way to read."""
    grip = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=frames))
    trials = [replace(open_source(grip.frames, reference=grip.reference)[0], frame_time_s=grip.time_s)]
    # each of its own: an engine is kept for the last size of images that a network was asked for
    difference, pair, enlarged = (sl.load(f"chromatouch-{name}") for name in ("difference", "pair", "pair"))
    enlarged = replace(enlarged, manifest=replace(enlarged.manifest, image_size=difference.manifest.image_size))
    networks = {"difference": difference, "pair": pair, "pair_at_224": enlarged}
    one_by_one = {name: partial(sl.predict, network, trials, engine=engine) for name, network in networks.items()}
    in_order = {f"{name}_sequence": partial(one_by_one[name], sequence=True) for name in ("difference", "pair")}
    return {**one_by_one, **in_order}


def time_calls(engines: Sequence[str], *, frames: int, rounds: int) -> dict[str, dict[str, np.ndarray]]:
    """Frames a second of every call, by engine and way to read."""
    calls = {engine: time_rounds(whole_calls(engine, frames=frames), rounds=rounds, warm_up=1) for engine in engines}
    return {engine: {name: 1e3 * frames / ms for name, ms in times.items()} for engine, times in calls.items()}


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=300, help="timed calls of each engine")
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    options = parser.parse_args()
    torch.set_num_threads(2)
    trained, inputs = build(), clouds(8, size=SIZE_PX, seed=3)
    engines, missing = make_ready(trained, inputs[:1])
    work: dict[str, Callable[[], object]] = {
        name: partial(engine.estimate, trained, inputs[:1]) for name, engine in engines.items()
    }
    times = time_rounds(work, rounds=options.rounds)
    fps = time_calls(list(engines), frames=120, rounds=max(1, options.rounds // 20))
    plain = make_engine("torch", trained, batch_size=1, streams=1)
    result = {
        "p50_ms": {name: float(np.percentile(values, 50)) for name, values in times.items()},
        "p99_ms": {name: float(np.percentile(values, 99)) for name, values in times.items()},
        "parity": {name: parity(trained, engine, plain, inputs) for name, engine in engines.items()},
        "missing": missing,
        "fps": {
            engine: {name: float(np.median(values)) for name, values in own.items()} for engine, own in fps.items()
        },
        "fps_ratios": {
            engine: {name: float(np.median(own[one] / own[other])) for name, (one, other) in RATIOS.items()}
            for engine, own in fps.items()
        },
        "load_average": os.getloadavg()[0],
        "machine": machine(),
        "versions": versions(),
    }
    print(json.dumps(result, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
