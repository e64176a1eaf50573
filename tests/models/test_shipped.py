from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import spearmanr

import sliplens
from sliplens.explainers.frames import frames_from_folder
from sliplens.faithfulness.controls import cascade
from sliplens.files import find_run, shipped_names
from sliplens.models import Network
from sliplens.recordings import Recording
from sliplens.simulation import PRESETS, plan_trials, simulate_trial


@pytest.mark.parametrize("name", shipped_names())
def test_every_network_of_the_package_loads_and_says_what_it_learned_from(name: str):
    trained = sliplens.load(name)
    assert not trained.model.training
    assert trained.manifest.input == name.rpartition("-")[2]
    assert trained.manifest.trained_on
    assert trained.manifest.metrics["validation_mse"] < 1 / 12  # that of a constant, of margins spread evenly
    assert find_run(Path(name)).name == name
    assert sum(path.stat().st_size for path in find_run(Path(name)).iterdir()) < 8e6


@pytest.fixture(scope="module")
def known_sensor() -> list[Recording]:
    """A trial of the one sensor of the thesis, on the day that was held out."""
    plans = plan_trials(replace(PRESETS["thesis"], frames_per_trial=30))
    return [simulate_trial(next(plan for plan in plans if plan.split == "test"))]


@pytest.fixture(scope="module")
def pulls() -> list[Recording]:
    """Three trials, no pull like another, of another series and seed than the training's: days it never saw."""
    recipe = replace(PRESETS["small"], seed=78, frames_per_trial=20, pulls="varied")
    return [simulate_trial(plan) for plan in plan_trials(recipe)[:3]]


@pytest.mark.parametrize("name", shipped_names())
def test_it_reads_a_simulated_grip_in_the_right_order(name: str, request: pytest.FixtureRequest):
    trained = sliplens.load(name)
    trial = request.getfixturevalue("known_sensor" if name.startswith("thesis") else "pulls")[0]
    inputs = trained.encode(trial.frames[trial.labelled], trial.reference)
    labels = trial.safety_margin[trial.labelled]

    def judge(network: Network) -> tuple[float, float]:
        margins = network.predict(inputs).numpy()
        return float(np.asarray(spearmanr(labels, margins))[0]), float(np.mean((margins - labels) ** 2) / labels.var())

    ranked, error = judge(trained)
    assert ranked > (0.9 if trained.encoding.empty_is_black else 0.3)
    ((_, drawn_anew),) = cascade(trained.model, seed=0, stages=1, images=inputs[::4])
    of_chance, error_of_chance = judge(replace(trained, model=drawn_anew))
    # it is what it learned: the same network with new weights neither ranks the frames so nor errs as little
    assert ranked > of_chance + 0.2
    assert error < 0.8 * error_of_chance
    if trained.encoding.empty_is_black:
        assert error < 0.5


def test_the_ratio_is_predicted_better_than_chance(pulls: list[Recording]):
    """By how much, `benchmarks/networks.py` measures."""
    trained, columns = sliplens.load("chromatouch-difference"), []
    for trial in pulls:
        rows = np.flatnonzero(trial.labelled)
        one = trained.estimate(trained.encode(trial.frames[rows], trial.reference))
        ratio = trial.tangential_force_n[rows] / trial.normal_force_n[rows]
        assert one.ratio is not None
        columns.append(np.stack([ratio, one.ratio.mean]))
    ratio, read = np.concatenate(columns, axis=1)
    assert np.mean((read - ratio) ** 2) < 0.2 * ratio.var()


@pytest.mark.real
def test_it_reads_real_touch_it_was_never_trained_on(chromatouch_folder: Path):
    trained = sliplens.load("chromatouch-difference")
    frames = frames_from_folder(trained, chromatouch_folder / "difference", labels_in_names=True)
    estimate = trained.estimate(trained.encoding.normalise(frames.images))
    labels = frames.safety_margin
    # from most to least stick; of frames alike in their label none need come first
    for one, other in ((one, other) for one in range(len(labels)) for other in range(len(labels))):
        assert not labels[one] > labels[other] or estimate.margin[one] > estimate.margin[other]
    low, high = estimate.interval(0.9) or (labels, labels)
    # five intervals of 90 %: three or fewer hold with a chance below 0.09
    assert np.count_nonzero((low <= labels) & (labels <= high)) >= 4


def test_the_network_may_be_left_out():
    frames = np.zeros((3, 224, 224, 3), dtype=np.uint8)
    alone, named = sliplens.predict(frames), sliplens.predict("chromatouch-difference", frames)
    assert pa.table(alone).equals(named.to_arrow())
    assert len(alone) == 3
    # camera frames, for whose reference somebody asks, go to the network that sees both
    alone = sliplens.predict(frames + 90, reference=frames[0] + 90)
    assert pa.table(alone).equals(
        sliplens.predict("chromatouch-pair", frames + 90, reference=frames[0] + 90).to_arrow()
    )


@pytest.mark.parametrize("name", ["chromatouch-pair", "chromatouch-difference"])
def test_swapped_colours_are_doubted_and_right_ones_are_not(name: str, pulls: list[Recording]):
    network = sliplens.load(name)
    for trial in pulls:
        assert not network.doubts(frame=trial.reference)
        assert any("swapped" in doubt for doubt in network.doubts(frame=trial.reference[..., ::-1]))
        assert not network.doubts(frame=np.repeat(trial.reference[..., 1:2], 3, axis=-1))[1:]  # grey: only that doubt
    swapped = sliplens.predict(network, pulls[0].frames[:2, ..., ::-1], reference=pulls[0].reference[..., ::-1])
    assert any("swapped" in note for note in swapped.notes)
