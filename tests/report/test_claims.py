"""The verdicts flip where the data flips."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sliplens.intervals import Difference
from sliplens.report import load_results
from sliplens.report.claims import judge_claims
from sliplens.report.comparisons import compare_gain, share_of_strongest, voting_settings, write_gap
from sliplens.report.results import Results
from sliplens.report.sections import build_sections
from sliplens.report.verdict import Row, all_of, cautions, judge_gap, judge_results, most_of, recommend

from .study_results import (
    GAINS as OURS,
)
from .study_results import (
    MAP_MEASURES as MADE_MEASURES,
)
from .study_results import (
    METHODS,
    SPEARMAN,
    Made,
    write_choice,
    write_faithfulness,
    write_others,
    write_quality,
    write_truth,
)

AS_RUN = tuple(f"{name}-thesis" for name in METHODS)
GAINS = {f"{name}-thesis" if name in METHODS else name: value for name, value in OURS.items()}
MAP_MEASURES = {f"{name}-thesis": own for name, own in MADE_MEASURES.items()}


def thesis(**options) -> Made:
    """A study of the thesis's methods as they were run there."""
    return Made(**{"methods": AS_RUN, "gains": GAINS, "looks": MAP_MEASURES, **options})


@pytest.fixture
def judged(tmp_path, rng):
    """Rows of each claim, by the claim's id and the network."""

    def judge(made: Made):
        write_choice(tmp_path, made)
        for name in made.inputs:
            write_faithfulness(tmp_path, name, made, rng=rng)
            write_others(tmp_path, name, made)
            write_truth(tmp_path, name, made, rng=rng)
        claims = judge_claims(load_results(tmp_path), rng=rng)
        return {(claim.id, row.subject): row for claim in claims for row in claim.rows}

    return judge


DIFFERENCE, RAW, BOTH = "Difference images", "Raw images", "Difference images and raw images"


@pytest.mark.parametrize(
    ("gains", "outcome"),
    [
        ({}, "holds"),
        # overtaken by one of the two is enough
        ({"grad-cam-thesis": 0.3}, "does not hold"),
        ({"poly-cam-thesis": -0.1}, "does not hold"),
        # the same gain but for what trials add: no interval leaves zero out in most fills
        ({"integrated-gradients-thesis": GAINS["poly-cam-thesis"]}, "undecided"),
    ],
)
def test_poly_cam_is_most_faithful_only_where_it_gains_more(judged, gains, outcome):
    answer = judged(thesis(gains=GAINS | gains))["most-faithful", DIFFERENCE]

    assert answer.outcome == outcome


@pytest.mark.parametrize(("raw_more", "outcome"), [(0.0, "holds"), (0.3, "does not hold")])
def test_difference_images_lead_only_where_their_gain_is_larger(judged, raw_more, outcome):
    assert judged(thesis(raw_more=raw_more))["difference", BOTH].outcome == outcome


@pytest.mark.parametrize(("gain", "outcome"), [(-0.05, "holds"), (0.2, "does not hold"), (0.021, "undecided")])
def test_grad_cam_is_unfaithful_only_where_a_control_or_chance_beats_it(judged, gain, outcome):
    # the best control gains 0.02: a gain of 0.021 is above chance for sure and beats nothing
    answer = judged(thesis(gains=GAINS | {"grad-cam-thesis": gain, "edges": 0.02}))["grad-cam", DIFFERENCE]

    assert answer.outcome == outcome


# the made-up intervals reach 0.001 either way; Poly-CAM's maps have 0.05
@pytest.mark.parametrize(
    ("variation", "outcome"), [(0.2, "holds"), (0.0505, "undecided"), (0.03, "does not hold"), (0.005, "does not hold")]
)
def test_rougher_counts_beyond_the_interval_alone(judged, variation, outcome):
    own = {**MAP_MEASURES["integrated-gradients-thesis"], "total_variation": variation}
    answer = judged(thesis(looks={**MAP_MEASURES, "integrated-gradients-thesis": own}))["noisy", RAW]
    assert answer.outcome == outcome
    assert any("less Poly-CAM as in" in finding.compared and finding.gap is not None for finding in answer.findings)


@pytest.mark.parametrize(
    ("top_share", "edge_mass", "outcome"),
    [(0.8, 0.3, "holds"), (0.2, 0.3, "does not hold"), (0.8, 0.01, "does not hold"), (0.8, 0.075, "undecided")],
)
def test_edges_of_two_markers_need_both_the_share_and_the_edges(judged, top_share, edge_mass, outcome):
    answer = judged(thesis(top_share=top_share, edge_mass=edge_mass))["two-markers", DIFFERENCE]

    assert answer.outcome == outcome


def test_only_the_methods_as_the_thesis_ran_them_decide(judged):
    ours = Made(methods=METHODS, gains={"poly-cam": 0.5, "grad-cam": 0.3, "integrated-gradients": 0.1, "edges": 0.0})
    answers = judged(ours)
    decided = {claim for (claim, _), answer in answers.items() if answer.outcome != "undecided"}
    assert not decided & {"most-faithful", "difference", "grad-cam", "noisy"}
    assert "as it ran them, were not scored together" in answers["most-faithful", DIFFERENCE].sentence


def test_claims_without_results_stay_undecided_and_say_so(judged, tmp_path, rng):
    write_choice(tmp_path, thesis())

    claims = judge_claims(load_results(tmp_path), rng=rng)

    answers = [answer for claim in claims for answer in claim.rows]
    assert len(claims) == 5
    assert {answer.outcome for answer in answers} == {"undecided"}
    assert all("Not tested: " in answer.sentence for answer in answers)


def test_estimates_are_the_gaps_that_were_put_in(judged, tmp_path, rng):
    judged(thesis(spread=0.0))
    curves = load_results(tmp_path).study.faithfulness["difference"].curves

    first, second = (curves["grey", "pixel", f"{name}-thesis"] for name in ("poly-cam", "grad-cam"))
    gap = compare_gain((first, second), rng=rng)

    # curves were built to have that area; trapezoids of 21 steps add no error to an area set by trapezoids
    assert gap is not None
    assert gap.estimate == pytest.approx(GAINS["poly-cam-thesis"] - GAINS["grad-cam-thesis"], abs=1e-9)


def test_share_of_the_strongest_is_that_of_the_effects(judged, tmp_path, rng):
    judged(thesis(top_share=0.7))

    share = share_of_strongest(load_results(tmp_path).study.truth["raw"].effects, count=2, rng=rng)

    # effects were scaled by up to 2 %, each on its own
    assert share is not None
    assert share.estimate == pytest.approx(0.7, abs=0.01)


@pytest.mark.parametrize(
    ("outcomes", "joined", "most"),
    [
        (["holds", "holds"], "holds", "holds"),
        (["holds", "undecided"], "undecided", "undecided"),
        (["holds", "holds", "undecided"], "undecided", "holds"),
        (["holds", "holds", "does not hold"], "does not hold", "undecided"),
        (["does not hold", "does not hold", "undecided"], "does not hold", "does not hold"),
        ([], "undecided", "undecided"),
    ],
)
def test_outcomes_join(outcomes, joined, most):
    assert all_of(outcomes) == joined
    assert most_of(outcomes) == most


def test_too_few_trials_decide_nothing_and_one_has_no_interval():
    assert judge_gap(Difference(estimate=1.0, low=0.9, high=1.1, units=3)) == "undecided"
    gap = Difference(estimate=1.0, low=None, high=None, units=1)
    assert judge_gap(gap) == "undecided"
    assert write_gap(gap) == "+1.000 (no interval of one trial)"


def test_a_study_of_one_trial_is_judged_and_shown_without_intervals(judged, tmp_path, rng):
    answers = judged(thesis(trials=1))

    assert {answer.outcome for answer in answers.values()} == {"undecided"}
    assert answers["two-markers", "Raw images"].interval == "no interval of one trial"
    results = load_results(tmp_path)
    assert judge_results(results, rng=rng)[0].rows[0].sentence.startswith("Not known: one trial is too few")
    assert build_sections(results, rng=rng)


def believed(results: Results, rng) -> dict[tuple[str, str], Row]:
    """Rows of the methods by name and network."""
    table = judge_results(results, rng=rng)[0]
    assert table.id == "believe"
    return {(row.claim, row.subject): row for row in table.rows}


def without_truth(folder: Path) -> Results:
    """Results of a study whose scenes cannot be drawn anew."""
    results = load_results(folder)
    return replace(results, study=replace(results.study, truth={}))


def test_without_truth_the_method_to_believe_is_the_one_that_beats_the_controls(judged, tmp_path, rng):
    judged(Made(gains=OURS | {"integrated-gradients": 0.4}))
    rows = believed(without_truth(tmp_path), rng)
    outcomes = {method: row.outcome for (method, network), row in rows.items() if network == DIFFERENCE}
    assert outcomes == {"Integrated Gradients": "holds", "Poly-CAM": "holds", "Grad-CAM": "does not hold"}
    first, second = rows["Integrated Gradients", DIFFERENCE], rows["Poly-CAM", DIFFERENCE]
    assert first.sentence.startswith("Believe it: it beats chance and every control under 4 of 4 fills.")
    assert second.sentence.startswith("Beats chance and every control under ")


@pytest.mark.parametrize(
    ("spearman", "expected"),
    [
        ({}, ("Believe it: it leads", "holds")),
        # a lead of 0.04 is not off zero: intervals reach 0.05 either way
        ({"grad-cam": 0.66}, ("First, but not shown to be best", "holds")),
        # the control has 0.1
        (dict.fromkeys(SPEARMAN, -0.1) | {"poly-cam": 0.14}, ("Not shown to beat every control", "undecided")),
    ],
)
def test_recommended_is_what_leads_every_control_and_every_method(judged, tmp_path, rng, spearman, expected):
    sentence, outcome = expected
    judged(Made(spearman=SPEARMAN | spearman))
    results = load_results(tmp_path)
    row = believed(results, rng)["Poly-CAM", RAW]
    assert row.outcome == outcome
    assert row.sentence.startswith(sentence)
    value = (SPEARMAN | spearman)["poly-cam"]
    assert (row.number, row.interval) == (f"+{value:.2f}", f"+{value - 0.05:.2f} to +{value + 0.05:.2f}")
    best = recommend(results.study.truth["raw"])
    assert best is not None
    assert best.method == "poly-cam"
    assert best.shown == sentence.startswith("Believe it")
    # the best comes first
    rows = [row for (_, network), row in believed(results, rng).items() if network == RAW]
    numbers = [float(row.number.replace("\N{MINUS SIGN}", "-")) for row in rows]
    assert numbers == sorted(numbers, reverse=True)


def test_a_fill_votes_once_and_not_where_it_cannot_tell_the_truth(judged, tmp_path):
    judged(Made())
    study = load_results(tmp_path).study
    faithful, truth = study.faithfulness["difference"], study.truth["difference"]
    # the untouched frame was tried by pixel and by marker
    every = [("reference", "pixel"), ("grey", "pixel"), ("blur", "pixel"), ("true", "marker")]
    assert voting_settings(faithful) == voting_settings(faithful, truth) == every
    (meta,) = truth.meta
    assert meta.gap is not None
    # ahead by its mean, but not for sure
    unsure = replace(meta, fill="grey", gap=replace(meta.gap, low=-0.01))
    assert voting_settings(faithful, replace(truth, meta=(meta, unsure))) == [every[0], *every[2:]]


def test_where_no_fill_can_judge_nothing_is_believed_and_it_says_why(judged, tmp_path, rng):
    judged(Made())
    results = load_results(tmp_path)
    unknown = [
        replace(test, gap=None, fill=fill)
        for test in results.study.truth["raw"].meta
        for fill in ("reference", "grey", "blur", "true")
    ]
    truth = {name: replace(own, methods={}, meta=tuple(unknown)) for name, own in results.study.truth.items()}
    rows = believed(replace(results, study=replace(results.study, truth=truth)), rng)
    assert {row.outcome for row in rows.values()} == {"undecided"}
    assert all("under no fill that can judge it" in row.sentence for row in rows.values())


def test_a_fill_that_cannot_judge_has_no_vote_on_a_claim(judged, tmp_path, rng):
    judged(thesis())
    results = load_results(tmp_path)
    table, truth = results.study.faithfulness["difference"].table, results.study.truth["difference"]

    def told(*, unfit: tuple[str, ...], turned: tuple[str, ...]):
        """The answer where some fills let half of the truth win, and under some the order is the opposite."""
        gap = Difference(estimate=0.0, low=-0.1, high=0.1, units=14)
        meta = [replace(truth.meta[0], fill=fill, gap=gap) for fill in unfit]
        own = (table.method == "poly-cam-thesis") & np.isin(table.fill, turned)
        pairs = (table.least_first, table.most_first), (table.most_first, table.least_first)
        first, last = (np.where(own, *pair) for pair in pairs)
        curves = replace(table, most_first=first, least_first=last)
        faithful = replace(results.study.faithfulness["difference"], table=curves)
        study = replace(
            results.study,
            faithfulness=results.study.faithfulness | {"difference": faithful},
            truth=results.study.truth | {"difference": replace(truth, meta=(*truth.meta, *meta))},
        )
        return judge_claims(replace(results, study=study), rng=rng)[0].rows[0]

    assert told(unfit=(), turned=("grey", "blur")).outcome == "undecided"
    answer = told(unfit=("grey", "blur"), turned=("grey", "blur"))
    assert answer.outcome == "holds"
    silent = [one for one in answer.findings if one.where in ("grey", "blur")]
    assert silent
    assert all(one.outcome is None for one in silent)
    none = told(unfit=("reference", "grey", "blur", "true"), turned=())
    assert none.outcome == "undecided"
    assert "under no fill that was scored does a map made from the truth win for sure" in none.sentence


def test_frames_that_are_left_out_of_the_scores_are_told(judged, tmp_path, rng):
    judged(thesis())
    results = load_results(tmp_path)
    assert results.study.left_out == {}
    truth = results.study.truth["raw"]
    fewer = replace(results.study, truth=results.study.truth | {"raw": replace(truth, frames=truth.frames - 2)})
    assert list(fewer.left_out) == ["raw"]
    sections = {one.id: one for one in build_sections(replace(results, study=fewer), rng=rng)}
    assert f"2 of {truth.frames} frames to score are left out with the raw network" in str(sections["choice"].blocks[0])


@pytest.mark.parametrize("sound", [False, True])
def test_an_unsound_sample_is_named_before_the_verdict_and_above_its_scores(judged, tmp_path, rng, sound):
    judged(thesis(sound=sound))
    results = load_results(tmp_path)
    both = "off by 7 points (difference images) and 13 points (raw images) on average;"
    assert any(both in caution for caution in cautions(results)) is not sound
    sections = {section.id: section for section in build_sections(results, rng=rng)}
    for name in ("claims", "faithfulness", "randomisation", "maps", "truth"):
        assert both in sections[name].intro


def test_too_few_trials_decide_nothing(judged, tmp_path, rng):
    answers = judged(thesis(trials=3))
    assert {answer.outcome for answer in answers.values()} == {"undecided"}
    for results in (load_results(tmp_path), without_truth(tmp_path)):
        rows = believed(results, rng)
        assert {row.outcome for row in rows.values()} == {"undecided"}
        too_few = "3 trials are too few to tell a method from chance; 5 or more"
        assert all(too_few in row.sentence for row in rows.values())
        assert cautions(results)[0].startswith("This study explains 3 trials, and fewer than 5 decide")


def test_without_scores_nothing_is_believed(tmp_path, rng):
    write_choice(tmp_path, Made())
    write_quality(tmp_path, "raw", {})
    rows = believed(load_results(tmp_path), rng)
    assert [row.outcome for row in rows.values()] == ["undecided"] * 2
    assert all("`sliplens study` does that" in row.sentence for row in rows.values())
