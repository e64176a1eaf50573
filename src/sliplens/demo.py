"""A first look: a simulated grip, predicted, explained and proved, on one page that grows while the rest is made."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sliplens.errors import InputError
from sliplens.explainers.table import RECOMMENDED_METHOD
from sliplens.files import DIFFERENCE_NETWORK
from sliplens.models.checkpoint import load
from sliplens.progress import OnProgress, open_stage, reporting
from sliplens.recordings import Dataset
from sliplens.report import write_report
from sliplens.results.explanation import Strip
from sliplens.runner import keep_record
from sliplens.simulation.trials import simulate
from sliplens.study.explaining import explain, make_strip
from sliplens.training import evaluate

NETWORKS = {"difference": "thesis-difference", "raw": "thesis-raw"}
"""Networks of the package for the sensor of the demo, by input."""
STRIP_METHOD = RECOMMENDED_METHOD
"""Method of the first picture."""
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


def run_demo(
    out: Path | str,
    *,
    on_page: Callable[[Path], None] | None = None,
    on_progress: OnProgress | None = None,
) -> Path:
    """Simulate a few grips, predict and explain them, and write a page of the results.

    The page is written as soon as the first grip is explained, and again after each further stage. It says whether
    such maps can be trusted, by the study of the package, and tests one: the simulator moves the markers ranked first.
    Real frames follow if `SLIPLENS_REFERENCE` names the folder of the public images. An interrupted call continues.

    Parameters
    ----------
    out
        Folder of the demo, a subfolder a stage; the page is `report.html` in it.
    on_page
        Called with the page each time it was written.

    Raises
    ------
    InputError
        If the folder holds something else.

    See Also
    --------
    run_study : The study on your own data.

    Examples
    --------
    >>> import sliplens as sl
    >>> sl.run_demo("runs/demo")  # doctest: +SKIP
    PosixPath('runs/demo/report.html')
    """
    folder = Path(out)
    reference = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference"))
    images, real_title = reference / "chromatouch" / "difference", "what a network predicts from real frames"
    names = [path.name for path in folder.iterdir() if path.name[0] != "."] if folder.is_dir() else []
    if (folder.exists() and not folder.is_dir()) or (names and "data" not in names):
        raise InputError(f"{folder} exists and is no demo; choose another folder")

    def show(*waiting: str) -> Path:
        with reporting(on_progress), open_stage("Writing the page"):
            page = write_report(folder, waiting_for=waiting).page
        if on_page is not None:
            on_page(page)
        return page

    data = simulate(folder / "data", on_progress=on_progress, **SHOWN_DATA)
    with reporting(on_progress):
        _make_strip(folder / "strip", data, NETWORKS["difference"])
    show("how well both networks predict", *([real_title] if images.is_dir() else []))
    for name, network in NETWORKS.items():
        evaluate(network, data, folder / f"evaluate-{name}", on_progress=on_progress)
    if images.is_dir():
        show(real_title)
        # the networks of the thesis are for one simulated sensor
        real = folder / "explain-real"
        explain(DIFFERENCE_NETWORK, images, method="occlusion", labels_in_names=True, out=real, on_progress=on_progress)
    return show()


def _make_strip(folder: Path, data: Dataset, network: str) -> None:
    """Strip of the first dry trial that tests: chosen by its place, so that no answer plays a part."""
    run = load(network)
    info = data.select(split="test", condition="dry")[0]
    config = {"data_hash": data.hash, "trial": info.trial, "weights_sha256": run.manifest.weights_sha256}

    def make(_: Path) -> Strip:
        with open_stage("Explaining a grip from stick to slip"):
            return make_strip(run, data.load(info), source=data.source, method=STRIP_METHOD, folder=data.folder)

    keep_record(folder, make, stage="strip", config=config, what="a grip from stick to slip")
