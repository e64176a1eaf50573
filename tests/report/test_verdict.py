"""The verdicts flip where the data flips, and networks are judged by their errors."""

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from there import there

from sliplens.intervals import Difference
from sliplens.plots.style import UNKNOWN
from sliplens.report import load_results, verdict
from sliplens.report.sections import build_opening, build_sections
from sliplens.report.verdict import compare_errors, judge_accuracy, judge_results
from sliplens.results.evaluation import RegressionScores, ScoredFrames
from sliplens.results.study import Study

from .study_results import GAINS, MAP_MEASURES, SPEARMAN, Made, edit, write_choice, write_study

BENCHMARK = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "claims.py")))
DIFFERENCE, RAW = "Difference images", "Raw images"


@pytest.fixture
def made(tmp_path):
    """Results of a made-up study."""
    return lambda made=None: load_results(write_study(tmp_path, made or Made()))


@pytest.fixture
def judged(made, rng):
    """Rows of the claims by their first words and network."""

    def judge(**options: object) -> dict[tuple[str, str], verdict.ClaimRow]:
        results = made(Made(as_run="-thesis", **options))  # pyright: ignore[reportArgumentType]
        return {(row.claim, row.subject): row for row in BENCHMARK.judge_claims(results, results, rng=rng)}

    return judge


def rougher(variation: float) -> dict[str, object]:
    own = {**MAP_MEASURES["integrated-gradients"], "total_variation": variation}
    return {"looks": {**MAP_MEASURES, "integrated-gradients": own}}


LOWEST = "Poly-CAM has the lowest D", DIFFERENCE
LOWER = "Maps of difference images have a lower D", "both"
NOISIEST = "Integrated Gradients is the noisiest", RAW


@pytest.mark.parametrize(
    ("claim", "options", "outcome"),
    [
        # a curve that falls later has a larger D; one rival that is ahead is enough
        (LOWEST, {}, "holds"),
        (LOWEST, {"gains": GAINS | {"grad-cam": 0.3}}, "does not hold"),
        (LOWEST, {"gains": GAINS | {"poly-cam": -0.1}}, "does not hold"),
        (LOWER, {"raw_more": -0.3}, "holds"),
        (LOWER, {"raw_more": 0.5}, "does not hold"),
        # the made-up intervals reach 0.001 either way; Poly-CAM's maps have 0.05
        (NOISIEST, rougher(0.2), "holds"),
        (NOISIEST, rougher(0.0505), "undecided"),
        (NOISIEST, rougher(0.005), "does not hold"),
    ],
)
def test_a_claim_holds_beyond_its_interval_alone(judged, claim, options, outcome):
    assert judged(**options)[claim].outcome == outcome


@pytest.mark.parametrize(
    ("share", "mass", "outcomes"),
    [(0.8, 0.3, ("holds", "holds")), (0.2, 0.01, ("does not hold", "does not hold"))],
)
def test_two_markers_pass_in_an_additive_game_where_they_hold_over_half(judged, share, mass, outcomes):
    rows = judged(top_share=share, edge_mass=mass)
    two = rows["The network looks at two markers (over half of the change)", DIFFERENCE]
    assert (two.outcome, rows["Poly-CAM highlights the edges of markers", DIFFERENCE].outcome) == outcomes
    # effects were scaled by up to 2 %, each on its own
    assert float(two.ours.split()[0]) == pytest.approx(share - 0.5, abs=0.01)


def test_the_record_of_the_package_has_every_kind_of_claim():
    record = verdict.load_thesis()
    assert [point.shift_px for point in record.shift] == [0.0, 0.25, 0.5, 1.0, 2.0]
    # raw images lose what difference images keep
    assert record.shift[-1].r2["raw"][0] < 0 < record.shift[-1].r2["difference"][0]
    sources = " ".join(row.source for row in record.claims)
    assert all(name in sources for name in ("Table 1", "Table 2", "Fig. 7", "Fig. 11", "Fig. 12", "Figs. 9", "21"))
    assert {row.outcome for row in record.claims} >= {"holds", "does not hold"}
    assert {row.input for row in record.methods} == {"difference", "raw"}


def test_outcomes_join():
    assert BENCHMARK.all_of(["holds", "holds"]) == "holds"
    assert BENCHMARK.all_of(["holds", "undecided"]) == BENCHMARK.all_of([]) == "undecided"
    assert BENCHMARK.all_of(["holds", "undecided", "does not hold"]) == "does not hold"


def test_too_few_trials_decide_nothing_and_one_has_no_interval():
    assert verdict.judge_gap(Difference(estimate=1.0, low=0.9, high=1.1, units=3)) == "undecided"
    gap = Difference(estimate=1.0, low=None, high=None, units=1)
    assert verdict.judge_gap(gap) == "undecided"
    assert verdict.write_gap(gap) == "+1.000 (no interval of one trial)"


def status(results: Study) -> dict[tuple[str, str], str]:
    return {(row.input, row.method): row.status for row in verdict.judge_study(results)}


# the control has 0.1, and intervals reach 0.05 either way
@pytest.mark.parametrize(("value", "expected"), [(0.7, "ahead"), (0.14, "tied"), (-0.1, "behind")])
def test_a_method_is_ahead_or_behind_beyond_the_interval_over_the_best_control(made, value, expected):
    results = made(Made(spearman=SPEARMAN | {"poly-cam": value}))
    assert status(results)["raw", "poly-cam"] == expected
    scores = [float(row.score.split()[0].replace("\N{MINUS SIGN}", "-")) for row in verdict.judge_study(results)]
    assert scores[: len(SPEARMAN)] == sorted(scores[: len(SPEARMAN)], reverse=True)


def test_without_truth_a_method_is_ahead_where_it_beats_the_controls_under_most_fills(made):
    results = made(Made(gains=GAINS | {"integrated-gradients": 0.4}))
    rows = status(replace(results, truth={}))
    of_input = {method: judged for (name, method), judged in rows.items() if name == "difference"}
    assert of_input == {"integrated-gradients": "ahead", "poly-cam": "ahead", "grad-cam": "behind"}


def test_a_fill_votes_once_and_not_where_it_cannot_tell_the_truth(made):
    study = made()
    faithful, truth = study.faithfulness["difference"], study.truth["difference"]
    # the untouched frame was tried by pixel and by marker
    every = [("reference", "pixel"), ("grey", "pixel"), ("blur", "pixel"), ("true", "marker")]
    assert verdict.voting_settings(faithful) == verdict.voting_settings(faithful, truth) == every
    (meta,) = truth.meta
    # ahead by its mean, but not for sure
    unsure = replace(meta, fill="grey", gap=replace(there(meta.gap), low=-0.01))
    assert verdict.voting_settings(faithful, replace(truth, meta=(meta, unsure))) == [every[0], *every[2:]]


def with_r2(results: Study, r2: float) -> Study:
    """The same, with a raw network of this R2 on dry test trials."""
    evaluation = results.evaluations["raw"]
    dry = replace(evaluation.conditions["dry"], r2=r2)
    poor = replace(evaluation, conditions=evaluation.conditions | {"dry": dry})
    return replace(results, evaluations=results.evaluations | {"raw": poor})


def test_a_network_that_predicts_badly_gets_no_verdict_and_a_worse_one_no_map(made):
    results = made()
    assert verdict.why_no_verdict(results, "raw") is None
    unsure = with_r2(results, 0.6)
    assert {value for (name, _), value in status(unsure).items() if name == "raw"} == {"no verdict"}
    assert "ahead" in {value for (name, _), value in status(unsure).items() if name == "difference"}
    assert verdict.without_weak(unsure) == (unsure, ())
    shown, sentences = verdict.without_weak(with_r2(results, 0.4))
    assert not [name for name in shown.explanations if name == "raw"]
    assert set(shown.truth) == {"difference"}
    assert "raw images are not shown" in sentences[0]


def test_too_few_trials_decide_nothing_and_the_page_says_so_first(made):
    results = made(Made(trials=3))
    for each in (results, replace(results, truth={})):
        assert set(status(each).values()) == {"no verdict"}
    assert verdict.cautions(results)[0].startswith("This study explains 3 trials, and fewer than 5 decide")
    assert "5 are needed" in build_opening(results, verdict.judge_study(results)).answer


def test_frames_that_are_left_out_of_the_scores_are_named(made):
    results = made()
    assert results.left_out == {}
    truth = results.truth["raw"]
    fewer = replace(results, truth=results.truth | {"raw": replace(truth, frames=truth.frames - 2)})
    assert list(fewer.left_out) == ["raw"]
    sections = {section.id: section for section in build_sections(fewer)}
    assert f"2 of {truth.frames} frames to score are left out with the raw network" in str(sections["choice"].blocks[1])


@pytest.mark.parametrize("sound", [False, True])
def test_an_unsound_sample_is_named_before_the_verdict(made, sound):
    results = made(Made(sound=sound))
    both = "off by 7 points (difference images) and 13 points (raw images) on average"
    assert any(both in caution for caution in verdict.cautions(results)) is not sound


def test_the_answer_names_what_is_ahead_and_what_is_not():
    def row(method: str, status: str) -> verdict.MethodRow:
        return verdict.MethodRow(input="raw", method=method, score="", control="", lead="", status=status)  # pyright: ignore[reportArgumentType]

    both = verdict.answer_trust([row("poly-cam", "ahead"), row("grad-cam", "behind")], ())
    assert both.startswith("Raw images: yes, Poly-CAM; no, Grad-CAM")
    assert verdict.answer_trust([row("poly-cam", "tied")], ()).startswith("Raw images: no;")
    assert verdict.answer_trust([row("poly-cam", "no verdict")], ["why"]) == "Raw images: not known. Why."


def test_without_scores_nothing_is_believed(tmp_path: Path):
    write_choice(tmp_path, Made())
    results = load_results(tmp_path)
    assert verdict.judge_study(results) == ()
    assert build_opening(results, ()).answer.startswith("Not known")


@pytest.fixture
def claims_of(workspace, rng):
    """Rows of the workspace as it is when called, by claim and network."""
    return lambda: {(row.claim, row.subject): row for row in judge_results(load_results(workspace), rng=rng)}


def replace_column(path, column, values):
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index(column), column, pa.array(values)), path)


@pytest.mark.parametrize(
    ("r2", "trials", "outcome"),
    [
        (0.1, 5, "holds"),
        (0.0, 5, "does not hold"),
        (-0.1, 5, "does not hold"),
        (None, 5, "undecided"),
        (0.9, 4, "undecided"),
    ],
)
def test_a_network_is_held_against_the_mean_label_over_five_trials(r2, trials, outcome):
    score = RegressionScores(frames=9, trials=trials, mse=0.01, r2=r2, mae=0.1, bins=())
    assert judge_accuracy(score) == outcome


def test_a_smaller_error_holds_only_beyond_the_interval(workspace, claims_of, rng):
    claim = "Smaller error than raw images on dry objects", DIFFERENCE
    assert claims_of()[claim].outcome == "holds"
    assert "over 6 trials, one day, one network" in claims_of()[claim].why
    # the same predictions but for noise that favours neither
    path = workspace / "test-raw" / "predictions.parquet"
    predictions = pq.read_table(workspace / "test-difference" / "predictions.parquet")["prediction"].to_numpy()
    replace_column(path, "prediction", predictions + rng.normal(0, 1e-4, len(predictions)))
    assert claims_of()[claim].outcome == "undecided"


@pytest.mark.parametrize(
    ("prediction", "trials", "expected"),
    [
        (None, 6, ("holds", "0 points")),
        # the best constant is off by 30
        (0.9, 6, ("does not hold", "43 points")),
        (0.9, 0, ("undecided", UNKNOWN)),  # without labels
        (None, 4, ("undecided", "0 points")),  # too few trials
    ],
)
def test_real_touch_is_compared_with_the_best_constant(workspace, claims_of, prediction, trials, expected):
    def label(value):
        for at, (frame, margin) in enumerate(zip(value["frames"], (1.0, 0.8, 0.6, 0.4, 0.2, 0.0), strict=True)):
            told = margin if prediction is None else prediction
            frame.update(trial=f"t{at % max(1, trials)}", safety_margin=margin if trials else None, prediction=told)

    edit(workspace / "maps-raw-real" / "result.json", label)
    row = claims_of()["Predicts real touch better than a constant", RAW]
    assert (row.outcome, row.ours) == expected


def predictions(error: np.ndarray, *, order: np.ndarray | None = None) -> ScoredFrames:
    trials, frames = error.shape
    rows = np.arange(error.size) if order is None else order
    return ScoredFrames(
        trial=np.repeat([f"t{index}" for index in range(trials)], frames)[rows],
        condition=np.full(error.size, "dry")[rows],
        day=np.zeros(error.size, dtype=np.int64),
        frame=np.tile(np.arange(frames), trials)[rows],
        time_s=np.zeros(error.size),
        safety_margin=np.full(error.size, 0.5),
        prediction=(0.5 + error.ravel())[rows],
        **{name: np.full(error.size, np.nan) for name in ("sigma", "low_90", "high_90")},
        withheld=np.full(error.size, ""),
    )


def test_errors_differ_by_the_means_of_their_squares_over_trials(rng):
    first, second = rng.normal(size=(2, 8, 5))
    gap = there(compare_errors(predictions(first), predictions(second), rng=rng))
    assert gap.estimate == pytest.approx(np.mean(first**2) - np.mean(second**2))
    assert gap.units == 8


def test_rows_are_matched_whatever_their_order_and_other_frames_are_not_compared(rng):
    error = rng.normal(size=(8, 5))
    gap = there(compare_errors(predictions(error), predictions(error, order=rng.permutation(40)), rng=rng))
    assert (gap.low, gap.estimate, gap.high) == (0, 0, 0)
    assert compare_errors(predictions(error), predictions(error[:7]), rng=rng) is None
