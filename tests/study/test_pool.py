"""Studies of several networks, made up with what the networks differ by."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_ends import width_of

from sliplens.errors import InputError
from sliplens.report.results import load_results
from sliplens.results.study import PooledScore, PooledScores, Study
from sliplens.study import pool_studies

from ..report.study_results import GAINS, Made, write_study

TRIALS = 6


def make_study(folder: Path, seed: int, *, gain: float, maps: str = "truth") -> Study:
    """Study whose Poly-CAM gains so much on difference images; its maps are the truth, or the truth turned round."""
    made = Made(trials=TRIALS, gains=GAINS | {"poly-cam": gain}, inputs=("difference",))
    study = load_results(write_study(folder / str(seed), made, seed=seed)).study
    explained, truth = study.explanations["difference"], study.truth["difference"]
    relevance = 0 * explained.relevance["poly-cam"]
    rows = [[frame.id for frame in explained.frames].index(name) for name in truth.frame_ids]
    relevance[rows] = truth.shapley_maps if maps == "truth" else -truth.shapley_maps
    told = replace(explained, weights_sha256=f"network {seed}", relevance=explained.relevance | {"poly-cam": relevance})
    return replace(study, explanations={"difference": told})


def of(pooled: PooledScores, method: str) -> PooledScore:
    return next(one for one in pooled.scores if (one.fill, one.unit, one.method) == ("grey", "pixel", method))


@pytest.fixture(scope="module")
def alike(tmp_path_factory: pytest.TempPathFactory) -> list[Study]:
    folder = tmp_path_factory.mktemp("alike")
    return [make_study(folder, seed, gain=0.16) for seed in range(3)]


def test_networks_that_agree_lead_for_sure(alike):
    found = of(pool_studies(alike), "poly-cam")
    means = [np.mean(study.faithfulness["difference"].curves["grey", "pixel", "poly-cam"].srg) for study in alike]
    assert found.gain.estimate == pytest.approx(np.mean(means))
    assert found.gain.over == "6 trials, one day, 3 networks"
    assert found.lead is not None
    assert found.lead.control == "edges"
    assert found.lead.shows_something
    assert of(pool_studies(alike), "edges").lead is None


def test_a_lead_that_one_network_has_is_not_for_sure(alike, tmp_path):
    differing = [*alike[:1], make_study(tmp_path, 1, gain=0.02), make_study(tmp_path, 2, gain=0.06)]
    alone, together = (of(pool_studies(some), "poly-cam").lead for some in (differing[:1], differing))
    assert alone is not None
    assert together is not None
    assert alone.shows_something
    assert not together.shows_something
    assert width_of(together.gap) > 3 * width_of(alone.gap)


def test_maps_are_held_against_the_truth_with_their_sign(alike, tmp_path):
    right, wrong = (
        of(pool_studies([study]), "poly-cam").truth
        for study in (alike[0], make_study(tmp_path, 0, gain=0.16, maps="turned"))
    )
    assert right is not None
    assert wrong is not None
    assert (right.estimate, wrong.estimate) == (pytest.approx(1), pytest.approx(-1))


def test_the_same_network_twice_is_one(alike):
    assert of(pool_studies([alike[0], alike[0]]), "poly-cam").gain.networks == 1


def test_the_table_has_a_row_a_score(alike):
    pooled = pool_studies(alike[:2])
    table = pooled.frame()
    assert len(table) == len(pooled.scores)
    assert set(table["networks"].to_pylist()) == {2}
    assert table["gain"].to_pylist() == [one.gain.estimate for one in pooled.scores]


def test_studies_without_a_common_input_are_refused(alike):
    with pytest.raises(InputError, match="no input has scores in every study"):
        pool_studies([*alike, Study()])
    with pytest.raises(InputError, match="no input has scores"):
        pool_studies([])
