from pathlib import Path

import numpy as np
import pytest
import torch

from sliplens.codec import load_result, save_result
from sliplens.explainers.explain import network_inputs
from sliplens.faithfulness.scoring import influences
from sliplens.models import Network
from sliplens.progress import reporting
from sliplens.results.explanation import Explanation
from sliplens.results.faithfulness import Faithfulness
from sliplens.results.study import MarkerTable, Setting
from sliplens.study.choice import removal_units
from sliplens.study.scoring import STUDY_AREAS, Removal

PIXELS = Setting(fill="grey", unit="pixel")
MARKERS = Setting(fill="reference", unit="marker")


@pytest.fixture(scope="module")
def removal(network: Network, explained: Explanation, markers: dict[str, MarkerTable]) -> Removal:
    return Removal(
        trained=network,
        explained=explained,
        maps=influences(network, explained),
        units=removal_units(network, explained, markers),
        settings=(PIXELS, MARKERS),
        random_orders=2,
    )


@pytest.fixture(scope="module")
def scored(removal: Removal) -> Faithfulness:
    return removal.make()


def test_removing_by_hand_gives_the_same_change(network: Network, explained: Explanation, scored: Faithfulness):
    frame, area = explained.frames[0], 0.2
    relevance = explained.relevance["grad-cam"][0]
    towards = np.sign(frame.prediction - frame.reference_prediction)
    side = relevance.shape[-1]
    order = np.lexsort((np.arange(side * side), -(relevance * towards).ravel()))
    gone = np.zeros(side * side, dtype=bool)
    gone[order[: round(area * side * side)]] = True
    image = network_inputs(network, explained)[0].clone()
    image[:, torch.from_numpy(gone.reshape(side, side))] = 0.5
    # what spoke for the target and is gone
    expected = towards * (frame.prediction - float(network.predict(image[None])[0]))
    curve = scored.curves["grey", "pixel", "grad-cam"]
    found = curve.most_first[curve.frame_ids.index(frame.id), STUDY_AREAS.index(area)]
    assert found == pytest.approx(expected, abs=1e-5)


def test_every_method_and_control_is_scored_under_every_setting(explained: Explanation, scored: Faithfulness):
    names = {*explained.methods, "edges", "change", "local-change", "weights-1", "centre"}
    keys = {(setting.fill, setting.unit, name) for setting in (PIXELS, MARKERS) for name in names}
    assert {score.key for score in scored.scores} == set(scored.curves) == keys
    assert {score.method for score in scored.scores if not score.control} == set(explained.methods)
    assert (scored.frames, scored.trials, scored.random_orders) == (6, 2, 2)


def test_scores_are_the_areas_under_the_stored_curves(scored: Faithfulness, tmp_path: Path):
    save_result(scored, tmp_path)
    back = load_result(tmp_path, Faithfulness, command="sliplens study")
    assert back.scores == scored.scores
    for score in back.scores:
        curve = back.curves[score.key]
        gain = np.trapezoid(curve.most_first - curve.least_first, np.array(STUDY_AREAS), axis=-1)
        assert score.srg.estimate == pytest.approx(gain.mean())


def test_markers_that_are_not_known_everywhere_are_no_unit(network: Network, explained: Explanation, removal: Removal):
    assert set(removal.units) == {"pixel", "tile", "marker"}
    assert set(removal_units(network, explained, {})) == {"pixel", "tile"}


def test_an_interrupted_run_goes_on_after_the_last_trial(removal: Removal, tmp_path: Path, scored: Faithfulness):
    calls = []

    def interrupt(done: int, total: int) -> None:
        calls.append((done, total))
        if done > 3:  # of three frames each trial has
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), reporting(interrupt):
        removal.make(tmp_path)
    assert len(list(tmp_path.glob("trial=*/*/result.json"))) == 1
    before = len(calls)
    with reporting(lambda done, total: calls.append((done, total))):
        again = removal.make(tmp_path)
    assert all(done >= 3 for done, _ in calls[before:])
    assert calls[-1] == (12, 12)
    assert again.scores == scored.scores
