"""What training through `fit` costs above the passes it cannot do without.

After every step of `fit` (default recipe, augmentation on: what `sliplens train` runs) the same network takes two bare
steps of its own, forward, backward and optimizer: one on a batch that is ready, one that augments it first. So all
three meet the same moments of a busy machine, and each ratio is the median over these rounds. Where others use the CPU
too, wall-clock time tells more of them than of us: the ratios of processor time stand beside it. With `--json` the last
line is one JSON object.
"""

import argparse
import json
import statistics
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sliplens.files import machine, versions
from sliplens.models import build_model
from sliplens.models.backbones import margin_loss
from sliplens.models.encodings import ENCODINGS
from sliplens.training import TrainConfig, fit, get_recipe
from sliplens.training.data import FrameSet, get_augmentation


def make_frames(count: int, *, size: int, trial: str, generator: torch.Generator) -> FrameSet:
    """Frames of noise: how long a step takes does not depend on what they show."""
    return FrameSet(
        encoding=ENCODINGS.pick("difference"),
        images=torch.randint(0, 256, (count, 3, size, size), dtype=torch.uint8, generator=generator),
        safety_margin=torch.rand(count, generator=generator),
        traction_ratio=torch.rand(count, generator=generator),
        friction=np.full(count, 0.6),
        trial=(trial,) * count,
        frame=tuple(range(count)),
        condition=("dry",) * count,
        day=(1,) * count,
        time_s=np.arange(count) / 30,
    )


class BareSteps:
    """Forward, backward and optimizer on batches that lie on the device, and nothing else."""

    def __init__(self, config: TrainConfig, frames: FrameSet, *, batches: int) -> None:
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        model = build_model(config.backbone, head=config.head).to(memory_format=torch.channels_last)
        self.model = model.to(self.device).train()
        self.optimizer = torch.optim.AdamW(self.model.parameters(), lr=config.learning_rate)
        self.augmentation = get_augmentation(config.augmentation)
        self.generator = torch.Generator(device=self.device).manual_seed(0)
        rows = [range(at * config.batch_size, (at + 1) * config.batch_size) for at in range(batches)]
        self.batches = [tuple(part.to(self.device) for part in frames.__getitems__(one)) for one in rows]
        self.done = 0

    def step(self, *, augment: bool) -> None:
        """Take one step."""
        images, labels, ratios = self.batches[self.done % len(self.batches)]
        self.done += 1
        if augment and self.augmentation is not None:
            images = self.augmentation(images, generator=self.generator)
        loss, _ = margin_loss(self.model, images, labels, ratios)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()

    def synchronise(self) -> None:
        """Wait for the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Wall-clock seconds, and seconds of processor time in all threads of this process."""

    wall_s: float
    processor_s: float

    def __sub__(self, other: "Cost") -> "Cost":
        return Cost(wall_s=self.wall_s - other.wall_s, processor_s=self.processor_s - other.processor_s)


def measure(config: TrainConfig, *, steps: int) -> dict[str, float]:
    """Seconds of the steps of `fit` and of the two bare ones, and their ratios."""
    generator = torch.Generator().manual_seed(0)
    size, batch = config.image_size, config.batch_size
    frames = make_frames(steps * batch, size=size, trial="train", generator=generator)
    validation = make_frames(batch, size=size, trial="validation", generator=generator)
    bare = BareSteps(config, frames, batches=min(4, steps))
    rounds: list[tuple[Cost, Cost, Cost]] = []
    ended: list[Cost] = []

    def now() -> Cost:
        bare.synchronise()
        return Cost(wall_s=time.perf_counter(), processor_s=time.process_time())

    def after_step(*_: int) -> None:
        if 0 < len(ended) < steps:
            start = now()
            bare.step(augment=False)
            between = now()
            bare.step(augment=True)
            rounds.append((start - ended[-1], between - start, now() - between))
        ended.append(now())

    with tempfile.TemporaryDirectory() as folder:
        fit(
            replace(config, epochs=1),
            frames,
            validation,
            Path(folder),
            frame_size=(size, size),
            sensor="benchmark",
            data_hash="none",
            on_progress=after_step,
        )
    kept = rounds[2:]  # the first warm caches and allocators

    def ratio(above: int, below: int, name: str) -> float:
        return statistics.median(getattr(one[above], name) / getattr(one[below], name) for one in kept)

    speeds = [batch / statistics.median(one.wall_s for one in part) for part in zip(*kept, strict=True)]
    numbers: dict[str, float] = {}
    for name, speed in zip(("fit", "bare", "bare_augmenting"), speeds, strict=True):
        numbers[f"images_per_s_{name}"] = speed
    for name, ending in (("wall_s", ""), ("processor_s", "_processor_time")):
        numbers[f"efficiency{ending}"] = ratio(1, 0, name)
        numbers[f"efficiency_above_augmentation{ending}"] = ratio(2, 0, name)
        numbers[f"augmentation_over_bare_step{ending}"] = ratio(2, 1, name) - 1
    return numbers


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=12, help="steps of fit, of which three warm up")
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--image-size", type=int, default=224)
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    config = replace(get_recipe("default"), batch_size=arguments.batch_size, image_size=arguments.image_size)
    numbers = measure(config, steps=arguments.steps)
    for name, value in numbers.items():
        print(f"{name:46s} {value:.3f}")
    if arguments.json:
        print(json.dumps({**numbers, **vars(arguments), "machine": vars(machine()), "versions": versions()}))


if __name__ == "__main__":
    main()
