"""`sliplens demo`: the whole path, from a recording to a report."""

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.console import say, wrote
from sliplens.cli.evaluate import Evaluate
from sliplens.cli.explain import Explain
from sliplens.cli.report import Report
from sliplens.cli.score import Score
from sliplens.cli.simulate import Simulate
from sliplens.cli.train import Train
from sliplens.errors import InputError
from sliplens.files import hash_json, read_json, require_folder, to_builtins, write_json

INPUTS = ("difference", "raw")
_PLAN = "plan.json"
_LEVELS = 6
_POLY_CAM_PASSES = 4464
"""Of an engine, for a map: two for each of ShuffleNetV2's 1860 channels, and a fifth more to make the masks."""
_GRADIENT_PASSES = 400
"""Of the network itself, for Integrated Gradients of a frame: up to 130 images, each there and back."""
_IMAGE_SIZES = (112, 96, 80, 64)
_SHORTEST_TRAINING = 1.4
"""Minutes below which a network has not learned enough to be worth explaining."""
_OTHER_SECONDS = 60
"""Reading trials twice for each network, drawing, importing."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Run the whole path once: simulate, train, evaluate, explain, score, report.

    Needs no network and no GPU. It measures how fast this machine is and trains for as long as the time allows. Run it
    again after an interruption and it goes on where it stopped.
    """

    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder to make; the page is report.html in it."""
    max_minutes: float = 8.0
    """Time to aim for, everything included."""
    image_size: int | None = None
    """Height and width of the networks' input; the frames are 224 x 224 pixels. If not given, the largest of 112, 96,
    80 and 64 that leaves time to train."""
    dry_trials: int = 96
    """Simulated dry trials, dealt to all days."""
    wet_trials: int = 8
    """Simulated wet trials."""
    frames_per_trial: int = 48
    """Frames of each trial."""
    days: int = 12
    """Simulated days, each with its own friction, stiffness, light and camera; the last one tests."""
    real_frames: Path | None = None
    """Folder of real difference images named ..._GG.png with the safety margin in percent; found by itself where
    SLIPLENS_REFERENCE (or ../shared/reference) holds the public ChromaTouch images."""
    seed: int = 0
    """Seed of the simulation and the networks."""

    def run(self) -> None:
        """Run every stage and print where the page is."""
        started = time.perf_counter()
        real = self._find_real_frames()
        self._open_workspace(real)
        data = self.output / "data"
        Simulate(
            output=data,
            dry_trials=self.dry_trials,
            wet_trials=self.wet_trials,
            frames_per_trial=self.frames_per_trial,
            days=self.days,
            seed=self.seed,
        ).run()
        image_size, minutes = self._plan_training(started, real)
        for name in INPUTS:
            Train(
                data=data,
                output=self.output / f"train-{name}",
                input=name,
                image_size=image_size,
                epochs=60,
                max_minutes=minutes,
                seed=self.seed,
            ).run()
        for name in INPUTS:
            run = self.output / f"train-{name}"
            Evaluate(model=run, data=data, output=self.output / f"evaluate-{name}").run()
            Explain(model=run, data=data, output=self.output / f"explain-{name}").run()
            Score(
                model=run,
                explanations=self.output / f"explain-{name}",
                output=self.output / f"score-{name}",
                seed=self.seed,
            ).run()
        if real is not None:
            run = self.output / "train-difference"
            explanations = self.output / "explain-real"
            Explain(model=run, frames=real, labels_in_names=True, output=explanations).run()
            Score(model=run, explanations=explanations, output=self.output / "score-real", seed=self.seed).run()
        Report(workspace=self.output).run()
        page = (self.output / "report.html").resolve()
        say(f"the demo took {(time.perf_counter() - started) / 60:.1f} minutes")
        say(f"open {page}")

    def _find_real_frames(self) -> Path | None:
        if self.real_frames is not None:
            return require_folder(self.real_frames, what="the folder of real frames")
        reference = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference"))
        folder = reference / "chromatouch" / "difference"
        return folder if folder.is_dir() else None

    def _open_workspace(self, real: Path | None) -> None:
        """Make the workspace, or go on in one that was begun with the same settings."""
        settings = to_builtins({**asdict(self), "real_frames": None if real is None else real.resolve()})
        del settings["output"]  # the same folder, named from elsewhere
        plan = self.output / _PLAN
        if plan.is_file():
            if hash_json(read_json(plan)["settings"]) != hash_json(settings):
                raise InputError(f"{self.output} holds a demo of other settings; choose another folder or delete it")
            say(f"going on in {self.output}")
            return
        if self.output.exists() and (not self.output.is_dir() or any(self.output.iterdir())):
            raise InputError(f"{self.output} exists and is no demo; choose another folder")
        try:
            self.output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot make {self.output} ({error.strerror}); choose another folder") from None
        write_json(plan, {"settings": settings})
        if real is None:
            say("no real frames found: the report will show simulated touch only (see --real-frames)")

    def _plan_training(self, started: float, real: Path | None) -> tuple[int, float]:
        """Image size, and minutes to train each network; decided once, so that a second run goes on with the same."""
        plan = read_json(self.output / _PLAN)
        if "train_minutes" in plan:
            return plan["image_size"], plan["train_minutes"]
        sizes = _IMAGE_SIZES if self.image_size is None else (self.image_size,)
        rates = _measure_rates(sizes[0])
        real_count = 0 if real is None else sum(1 for _ in real.iterdir())
        explained = len(INPUTS) * _LEVELS + real_count
        left = 60 * self.max_minutes - (time.perf_counter() - started) - _OTHER_SECONDS
        plans = []
        for size in sizes:
            # masks, and deletion in four orders, by the engine that explains and scores; gradients without it
            each = (_POLY_CAM_PASSES + 4 * size) / rates.engine + _GRADIENT_PASSES / rates.plain
            seconds = explained * each * (size / sizes[0]) ** 2
            plans.append((size, round((left - seconds) / 60 / len(INPUTS), 2)))
        smallest = (sizes[-1], _SHORTEST_TRAINING)
        size, minutes = next((plan for plan in plans if plan[1] >= _SHORTEST_TRAINING), smallest)
        say(
            f"this machine answers {rates.plain:.0f} {sizes[0]} px images a second, {rates.engine:.0f} by an engine: "
            f"images of {size} px, {minutes:g} minutes of training for each network"
        )
        write_json(
            self.output / _PLAN, {**plan, "images_a_second": rates, "image_size": size, "train_minutes": minutes}
        )
        wrote(self.output / _PLAN, "settings and training time, kept for a second run")
        return size, minutes


@dataclass(frozen=True, kw_only=True)
class _Rates:
    """Images a second that the default network answers."""

    plain: float
    """In batches, as it is."""
    engine: float
    """By the engine that explains and scores."""


def _measure_rates(image_size: int) -> _Rates:
    """Rates of this machine: the best of a few moments.

    The best, not the mean: what else the machine did at one moment says nothing of the minutes to come.
    """
    import torch

    from sliplens.explainers.frozen_model import frozen
    from sliplens.models import build_model
    from sliplens.models.engines import prepare

    with torch.random.fork_rng(devices=[]), torch.no_grad():
        model = build_model()
        images = torch.zeros(64, 3, image_size, image_size)
        with frozen(model):
            some = images[:2]
            ready = prepare(model, some, model(some).reshape(2), passes=len(INPUTS) * _LEVELS * _POLY_CAM_PASSES)
            engine = _best_rate(lambda: list(ready.run(images.split(ready.batch_size))), images=len(images))
            model = model.to(memory_format=torch.channels_last)
            return _Rates(plain=_best_rate(lambda: model(images), images=len(images)), engine=engine)


def _best_rate(work: Callable[[], object], *, images: int, windows: int = 5, seconds: float = 0.7) -> float:
    """Images a second."""
    work()
    rates = []
    for _ in range(windows):
        started, done = time.perf_counter(), 0
        while time.perf_counter() - started < seconds:
            work()
            done += images
        rates.append(done / (time.perf_counter() - started))
    return max(rates)
