"""Fixtures that several tests share."""

import os
import pickle
import shutil
from pathlib import Path

from data_sets import save_dataset

# threads that spin while they wait take the cores from those that work; must be set before torch is imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import pytest
from hypothesis import settings
from small import TRACTION, make_recording, save_untrained

from sliplens.images import absolute_difference, write_png
from sliplens.recordings import Dataset, Recording
from sliplens.runner import EXECUTORS
from sliplens.simulation import CHROMATOUCH, FLAT_GEL, SimulationRecipe, plan_trials, simulate_trial

# the same examples every time: a change is judged by its own doing, and a failure can be looked at again
settings.register_profile("sliplens", derandomize=True, deadline=None)
settings.load_profile("sliplens")

MOST_WORKERS = 8  # each imports the package and makes its own fixtures: more gain little


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A process a core for the whole suite; none for what was named, which is sooner done than they would start."""
    if config.args_source is pytest.Config.ArgsSource.ARGS:
        return 0
    # for the processes to come, a thread each: more would only wait for each other
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, MOST_WORKERS)


@pytest.fixture(scope="session", autouse=True)
def _no_disk_is_waited_for():
    """Files get their names at once: nobody pulls the plug of a test, and a disk takes 8 ms a file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="module")
def browser():
    """A Chromium of this machine's: Playwright's own would have to be fetched from outside the package index."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="a browser is led by Playwright")
    chromium = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("there is no Chromium on this machine")
    with sync_api.sync_playwright() as playwright:
        # a container's root has no sandbox; the pages are our own
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def reference_folder() -> Path:
    """Folder of real recordings; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference"))
    if not folder.is_dir():
        pytest.skip(f"the real recordings are not at {folder}; set SLIPLENS_REFERENCE to their folder")
    return folder


@pytest.fixture(scope="session")
def chromatouch_folder(reference_folder: Path) -> Path:
    """The real ChromaTouch images, maps and recorded answers."""
    folder = reference_folder / "chromatouch"
    if not folder.is_dir():
        pytest.skip(f"the real ChromaTouch data are not at {folder}")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)


@pytest.fixture
def recording() -> Recording:
    return make_recording("trial")


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Eight small trials in all splits, dry and wet."""
    folder = tmp_path_factory.mktemp("data")
    plan = [("train", "dry")] * 4 + [("validation", "dry")] * 2 + [("test", "dry"), ("test", "wet")]
    recordings = [
        make_recording(f"{split}-{condition}-{index}", condition=condition, day=1 + index % 4, seed=index)
        for index, (split, condition) in enumerate(plan)
    ]
    return save_dataset(folder, *recordings, split=[split for split, _ in plan], simulated=True)


@pytest.fixture(scope="session")
def fine_dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Three dry trials and a wet one to test on, with a frame near every margin."""
    recordings = [
        make_recording(f"test-{condition}-{index}", condition=condition, frames=40, seed=index)
        for index, condition in enumerate(("dry", "dry", "dry", "wet"))
    ]
    return save_dataset(tmp_path_factory.mktemp("fine-data"), *recordings, split="test")


@pytest.fixture(scope="session")
def ratio_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of the ChromaTouch that answers with the margin and with F_t / F_n."""
    return save_untrained(tmp_path_factory.mktemp("ratio-run"), frame_size=224, traction=TRACTION)


@pytest.fixture(scope="session")
def difference_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_untrained(tmp_path_factory.mktemp("difference-run"))


@pytest.fixture(scope="session")
def raw_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_untrained(tmp_path_factory.mktemp("raw-run"), kind="raw", seed=1)


@pytest.fixture(scope="session")
def pair_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_untrained(tmp_path_factory.mktemp("pair-run"), kind="pair", seed=2)


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> str:
    """A place to work that gets what another process gets, without the seconds in which that imports torch."""
    serial = EXECUTORS["serial"]
    monkeypatch.setitem(EXECUTORS, "elsewhere", lambda work, *_: serial(pickle.loads(pickle.dumps(work)), "", 1))  # noqa: S301
    return "elsewhere"


@pytest.fixture
def difference_folder(tmp_path: Path, small_dataset: Dataset) -> Path:
    """Difference images of a test trial as PNG, their labels in their names."""
    folder = tmp_path / "frames"
    folder.mkdir()
    recording = small_dataset.load(small_dataset.select(split="test", condition="dry")[0])
    for index in (1, 6, 11):
        percent = round(100 * recording.safety_margin[index])
        write_png(
            folder / f"frame{index}_{percent}.png", absolute_difference(recording.frames[index], recording.reference)
        )
    return folder


@pytest.fixture(scope="session")
def trials() -> dict[str, Recording]:
    """A simulated trial of each sensor, to full slip and back."""
    return {
        sensor.name: simulate_trial(
            plan_trials(
                SimulationRecipe(dry_trials=3, wet_trials=0, frames_per_trial=40, release=True, sensor=sensor, seed=7)
            )[0]
        )
        for sensor in (CHROMATOUCH, FLAT_GEL)
    }
