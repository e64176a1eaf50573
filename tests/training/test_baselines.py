import json
import shutil
from dataclasses import fields
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import torch
from command_line import refused, run

import sliplens as sl
from sliplens.errors import ImageError, InputError
from sliplens.markers import track_markers
from sliplens.markers.estimators import ESTIMATORS, field_trial, get_estimator
from sliplens.models import Manifest, build_model, save_checkpoint
from sliplens.recordings import Dataset
from sliplens.results.evaluation import BaselinePredictions, Baselines, ScoredFrames
from sliplens.simulation import SimulationRecipe, simulate_dataset
from sliplens.training.evaluation import BaselinePlan, evaluate_baselines

pytest.importorskip("cv2", reason="markers are found with OpenCV, of the extra `markers`")

CHOSEN = ("constant", "mean-shear", "dong-rigid-residual")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Simulated presses and pulls of a ChromaTouch, dry and wet."""
    recipe = SimulationRecipe(dry_trials=5, wet_trials=1, frames_per_trial=20, days=3, seed=4)
    return simulate_dataset(tmp_path_factory.mktemp("simulated") / "data", recipe)


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one test followed, the next need not."""
    return tmp_path_factory.mktemp("fields")


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights for frames of that size."""
    folder = tmp_path_factory.mktemp("network")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = build_model()
    manifest = Manifest(
        backbone="shufflenet_v2_x1_0",
        input="difference",
        image_size=32,
        frame_size=(224, 224),
        sensor="chromatouch",
        data_hash="none",
    )
    save_checkpoint(folder, model.eval(), manifest)
    return folder


def labelled_frames(data: Dataset, *, split: str = "test") -> ScoredFrames:
    """The frames of a split, as if a network had answered with nothing."""
    parts = []
    for info in data.select(split=split):
        recording = data.load(info, truth=False)
        rows = np.flatnonzero(recording.labelled)
        unknown = np.full(len(rows), np.nan)
        parts.append(
            ScoredFrames(
                trial=np.full(len(rows), info.trial),
                condition=np.full(len(rows), info.condition),
                day=np.full(len(rows), info.day),
                frame=rows,
                time_s=recording.time_s[rows],
                safety_margin=recording.safety_margin[rows],
                prediction=unknown,
                sigma=unknown,
                low_90=unknown,
                high_90=unknown,
                withheld=np.full(len(rows), ""),
            )
        )
    return ScoredFrames(
        **{item.name: np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(ScoredFrames)}
    )


def plan(data: Dataset, *, names: tuple[str, ...] = CHOSEN, condition: str | None = None) -> BaselinePlan:
    training = data.select(split="train", condition=condition)
    return BaselinePlan(estimators=names, training=training, offered_trials=len(training), markers="chromatouch")


def evaluated(data: Dataset, folder: Path) -> tuple[Baselines, BaselinePredictions]:
    return evaluate_baselines(plan(data), data, labelled_frames(data), folder=folder)


def test_answers_are_those_of_estimators_fitted_by_hand(data: Dataset, followed: Path):
    found, answered = evaluated(data, followed)
    tracked, margins = {}, {}
    for info in data.trials:
        recording = data.load(info, truth=False)
        tracked[info.trial] = field_trial(track_markers(recording.frames, recording.reference, "chromatouch"))
        margins[info.trial] = np.where(recording.labelled, recording.safety_margin, np.nan)
    train = [info.trial for info in data.select(split="train")]
    frames = labelled_frames(data)
    for name in CHOSEN:
        estimator = get_estimator(name).fit([tracked[one] for one in train], [margins[one] for one in train])
        answers = {one: estimator.estimate(field) for one, field in tracked.items()}
        expected = [answers[trial][frame] for trial, frame in zip(frames.trial, frames.frame, strict=True)]
        shown = answered.where(answered.estimator == name)
        assert (shown.trial == frames.trial).all()
        assert (shown.frame == frames.frame).all()
        # frames are stored without loss, so only the order of sums may differ
        np.testing.assert_allclose(shown.prediction, expected, atol=1e-9)
        for condition, scores in found.estimators[name].conditions.items():
            rows = frames.condition == condition
            assert scores.mae == pytest.approx(np.abs(np.array(expected) - frames.safety_margin)[rows].mean())
            assert scores.frames == rows.sum()
    assert found.training_trials == len(train)
    assert found.training_frames == sum(np.isfinite(margins[one]).sum() for one in train)
    assert found.followed > 0.9


def test_trials_without_markers_are_named_and_answered_with_the_training_mean(
    data: Dataset, followed: Path, tmp_path: Path, monkeypatch
):
    evaluated(data, followed)
    blind = data.select(split="test", condition="dry")[0].trial
    lost = data.select(split="train")[0].trial
    for path in followed.iterdir():
        if path.name not in {blind, lost}:
            shutil.copytree(path, tmp_path / path.name)

    def find_none(*_: object) -> None:
        raise ImageError("the reference shows 0 whole markers")

    monkeypatch.setattr("sliplens.training.evaluation.track_markers", find_none)
    found, answered = evaluated(data, tmp_path)
    assert found.failed == dict.fromkeys((lost, blind), "the reference shows 0 whole markers")
    assert found.training_trials == len(data.select(split="train")) - 1
    constant = answered.prediction[answered.estimator == "constant"][0]
    np.testing.assert_allclose(answered.prediction[answered.trial == blind], constant)


def test_no_trial_with_markers_is_refused(small_dataset: Dataset, tmp_path: Path):
    # frames of noise with a square: nothing round in them
    with pytest.raises(InputError, match="markers were followed in none of the training trials"):
        evaluated(small_dataset, tmp_path)


def test_the_command_puts_them_beside_the_network(data: Dataset, network: Path, tmp_path: Path, capsys):
    plain, beside = tmp_path / "plain", tmp_path / "beside"
    assert run("evaluate", network, data.folder, "-o", plain) == 0
    words = ("evaluate", network, data.folder, "-o", beside, "--baselines", "all", "--baseline-trials", "2")
    assert run(*words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"of 2 of the {len(data.select(split='train'))} training trials" in said
    assert "last frame before the pull" in said
    results = [json.loads((folder / "result.json").read_text()) for folder in (plain, beside)]
    own = results[1]["baselines"]
    # who reads the network's scores finds them where they were
    for name in ("baselines", "baseline_predictions"):
        assert results[0].pop(name) is None
        results[1].pop(name, None)
    assert results[0] == results[1]
    assert list(own["estimators"]) == list(ESTIMATORS)
    assert (own["training_trials"], own["known_trials"], own["failed"]) == (2, 0, {})
    assert own["estimators"]["constant"]["conditions"].keys() == results[0]["conditions"].keys()
    tables = [pq.read_table(beside / name) for name in ("predictions.parquet", "baseline_predictions.parquet")]
    constant = tables[1].filter(pc.field("estimator") == "constant")
    assert constant.select(["trial", "frame"]) == tables[0].select(["trial", "frame"])
    assert sorted(path.name for path in beside.iterdir()) == [
        "baseline_predictions.parquet",
        "evaluation.png",
        "predictions.parquet",
        "result.json",
        "run.json",
    ]
    assert run(*words) == 0
    assert "kept" in capsys.readouterr().out


def test_what_was_followed_before_an_interruption_is_not_followed_again(
    data: Dataset, network: Path, tmp_path: Path, monkeypatch
):
    command = partial(sl.evaluate, sl.load(network), data, tmp_path / "out", baselines=("constant",), baseline_trials=2)
    count = 2 + len(data.select(split="test"))
    calls = []

    def follow(*given):
        calls.append(given)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return track_markers(*given)

    monkeypatch.setattr("sliplens.training.evaluation.track_markers", follow)
    with pytest.raises(KeyboardInterrupt):
        command()
    assert not (tmp_path / "out").exists()
    command()
    # two were done, the third was begun and is begun anew
    assert len(calls) == count + 1
    assert json.loads((tmp_path / "out" / "result.json").read_text())["baselines"]["failed"] == {}


def test_what_cannot_be_compared_is_refused_at_once(data: Dataset, network: Path, tmp_path: Path, capsys, monkeypatch):
    command = ("evaluate", network, data.folder, "-o", tmp_path / "out", "--baselines")
    assert "there is no estimator named 'magic'" in refused(capsys, *command, "magic")
    assert "0 training trials are too few" in refused(capsys, *command, "all", "--baseline-trials", "0")
    assert "there is no kind of markers named 'digit'" in refused(capsys, *command, "all", "--markers", "digit")
    alone = Dataset(folder=data.folder, trials=data.select(split="test"))
    monkeypatch.setattr("sliplens.training.evaluation.load_dataset", lambda _: alone)
    assert "has no training trials to fit baselines on" in refused(capsys, *command, "all")
    monkeypatch.undo()
    monkeypatch.setattr("sliplens.extras.find_spec", lambda _: None)
    assert "OpenCV, which is not installed" in refused(capsys, *command, "all")
    assert not list(tmp_path.iterdir())
