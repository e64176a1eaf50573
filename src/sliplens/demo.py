"""A first look: a simulated grip, predicted, explained and proved, on one page that grows while the rest is made."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from sliplens.codec import load_record, load_result, save_record, save_result
from sliplens.errors import InputError
from sliplens.explainers.table import RECOMMENDED_METHOD
from sliplens.files import DIFFERENCE_NETWORK, output_folder, require_folder
from sliplens.models.checkpoint import load
from sliplens.progress import OnProgress, open_stage, report_file, reporting
from sliplens.recordings import Dataset
from sliplens.report import write_report
from sliplens.results.explanation import Strip
from sliplens.simulation.trials import simulate
from sliplens.study.explaining import explain, make_strip
from sliplens.training import evaluate, train

NETWORKS = {"difference": "thesis-difference", "raw": "thesis-raw"}
"""Networks of the package for the sensor of the demo, by input."""
INPUTS = tuple(NETWORKS)
STRIP_METHOD = RECOMMENDED_METHOD
"""Method of the first picture."""
DEMO_SEED = 20261122
"""Seed of the data of networks that are trained here."""
SHOWN_DATA: dict[str, Any] = {
    "preset": "thesis",
    "seed": 0,
    "days": 12,
    "test_days": 3,
    "dry_trials": (2, 1, 1, *[0] * 6, 2, 2, 2),
    "wet_trials": 2,
    "frames_per_trial": 40,
}
"""Trials of the sensor that the networks of the package were trained for, on three days that none of them met."""
TRAINING_DATA: dict[str, Any] = {"dry_trials": 96, "wet_trials": 8, "frames_per_trial": 48, "days": 12}
"""Trials to train networks of one's own on."""
_OTHER_MINUTES = 3.5
"""Minutes of everything but the training, on two cores."""
SHORTEST_TRAINING = 1.4
"""Minutes below which a network has not learned enough to be worth explaining."""


def run_demo(
    out: Path | str,
    *,
    train_minutes: float | None = None,
    image_size: int = 96,
    real_frames: Path | str | None = None,
    seed: int = DEMO_SEED,
    on_page: Callable[[Path], None] | None = None,
    on_progress: OnProgress | None = None,
) -> Path:
    """Simulate a few grips, predict and explain them, and write a page of the results.

    The page is written as soon as the first grip is explained, and again after each further stage. It says whether
    such maps can be trusted, by the study that comes with the package, and proves one of them: the simulator moves the
    markers that it ranks first. After an interruption the same call continues.

    Parameters
    ----------
    out
        Folder of the demo, a subfolder a stage; the page is `report.html` in it.
    train_minutes
        Train two networks of one's own for so many minutes in all, everything included, instead of those that come
        with the package.
    image_size
        Height and width of the input of networks that are trained here, in pixels.
    real_frames
        Folder of real difference images named ..._GG.png with the safety margin in percent. The public ChromaTouch
        images where `SLIPLENS_REFERENCE` (or ../shared/reference) holds them, if None.
    on_page
        Called with the page each time it was written.

    Raises
    ------
    InputError
        If the folder holds something else, or there are no real frames where they are named.
    """
    folder = Path(out)
    real = find_real_frames(real_frames)
    if train_minutes is not None and train_minutes <= 0:
        raise InputError(f"train_minutes must be above 0, got {train_minutes:g}")
    _open_folder(folder, _Settings(train_minutes=train_minutes, image_size=image_size, real_frames=real, seed=seed))

    def show(*waiting: str) -> Path:
        with reporting(on_progress), open_stage("Writing the page"):
            page = write_report(folder, waiting_for=waiting).page
        if on_page is not None:
            on_page(page)
        return page

    real_title = "what a network predicts from real frames"
    trials = SHOWN_DATA if train_minutes is None else TRAINING_DATA
    settings: dict[str, Any] = {"seed": seed} | trials
    data = simulate(folder / "data", on_progress=on_progress, **settings)
    networks = dict(NETWORKS)
    if train_minutes is not None:
        minutes = max(SHORTEST_TRAINING, (train_minutes - _OTHER_MINUTES) / len(INPUTS))
        for name in INPUTS:
            networks[name] = str(folder / f"train-{name}")
            trained = partial(train, image_size=image_size, epochs=60, max_minutes=minutes, seed=seed)
            trained(data, networks[name], input=name, on_progress=on_progress)
    with reporting(on_progress):
        _make_strip(folder / "strip", data, networks["difference"])
    show("how well both networks predict", *([real_title] if real is not None else []))
    for name in INPUTS:
        evaluate(networks[name], data, folder / f"evaluate-{name}", on_progress=on_progress)
    if real is not None:
        show(real_title)
        # the networks of the thesis are for one simulated sensor
        network = networks["difference"] if train_minutes is not None else DIFFERENCE_NETWORK
        explain(
            network,
            real,
            method="occlusion",
            labels_in_names=True,
            out=folder / "explain-real",
            on_progress=on_progress,
        )
    return show()


def find_real_frames(folder: Path | str | None = None) -> Path | None:
    """Folder of real difference images: the one that is named, else the public ChromaTouch images where they are."""
    if folder is not None:
        return require_folder(Path(folder), what="the folder of real frames")
    reference = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference"))
    images = reference / "chromatouch" / "difference"
    return images if images.is_dir() else None


@dataclass(frozen=True, kw_only=True)
class _Settings:
    """Settings that a demo was begun with."""

    train_minutes: float | None
    image_size: int
    real_frames: Path | None
    seed: int


def _open_folder(folder: Path, settings: _Settings) -> None:
    """Make the folder of a demo, or go on in one that was begun with the same settings."""
    path = folder / "demo.json"
    if settings.real_frames is not None:  # the same folder, named from elsewhere
        settings = replace(settings, real_frames=settings.real_frames.resolve())
    if path.is_file():
        if load_record(path, _Settings, command="sliplens demo") != settings:
            raise InputError(f"{folder} holds a demo of other settings; choose another folder or delete it")
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} exists and is no demo; choose another folder")
    folder.mkdir(parents=True, exist_ok=True)
    save_record(settings, path)


def _make_strip(folder: Path, data: Dataset, network: str) -> Strip:
    """Strip of the first dry trial that tests: chosen by its place, so that no answer plays a part."""
    run = load(network)
    info = data.select(split="test", condition="dry")[0]
    config = {"data_hash": data.hash, "trial": info.trial, "weights_sha256": run.manifest.weights_sha256}
    with output_folder(folder, stage="strip", config=config) as output:
        if not output.complete:
            with open_stage("Explaining a grip from stick to slip"):
                strip = make_strip(run, data.load(info), source=data.source, method=STRIP_METHOD, folder=data.folder)
            save_result(strip, output.folder)
    report_file(folder, "a grip from stick to slip", kept=output.complete)
    return load_result(folder, Strip, command="sliplens demo")


__all__ = ["DEMO_SEED", "find_real_frames", "run_demo"]
