"""The verdicts flip where the data flips."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sliplens.intervals import Difference
from sliplens.report import load_results
from sliplens.report.claims import all_of, judge_claims, judge_gap, most_of
from sliplens.report.comparisons import compare_gain, gap_from, share_of_strongest, tell_interval
from sliplens.report.results import Results
from sliplens.report.sections import build_sections
from sliplens.report.tables import Table
from sliplens.report.verdict import _tell_lead, judge, rank_methods, tell_too_few

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
    write_maps,
    write_others,
    write_quality,
    write_thesis_scores,
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
    """Answers of each claim, by the claim's id and the subject."""

    def judge(made: Made):
        write_choice(tmp_path, made)
        for name in made.inputs:
            write_faithfulness(tmp_path, name, made, rng=rng)
            write_others(tmp_path, name, made)
            write_truth(tmp_path, name, made, rng=rng)
        claims = judge_claims(load_results(tmp_path), rng=rng)
        return {(claim.id, answer.subject): answer for claim in claims for answer in claim.answers}

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


def test_grad_cam_below_an_edge_filter_is_unfaithful_though_above_chance(judged):
    answer = judged(thesis(gains=GAINS | {"grad-cam-thesis": 0.05, "edges": 0.2}))["grad-cam", DIFFERENCE]

    assert answer.outcome == "holds"
    assert "less Edge filter (control)" in answer.text


@pytest.mark.parametrize(
    ("stability", "rougher_told", "outcome"), [(0.6, True, "holds"), (0.99, True, "holds"), (0.6, False, "undecided")]
)
def test_stability_which_has_no_interval_decides_nothing(judged, stability, rougher_told, outcome):
    own = {**MAP_MEASURES["integrated-gradients-thesis"], "noise_stability": stability}

    made = thesis(looks={**MAP_MEASURES, "integrated-gradients-thesis": own}, rougher_told=rougher_told)
    assert judged(made)["noisy", RAW].outcome == outcome


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
    assert "as it ran them, were not scored together" in answers["most-faithful", DIFFERENCE].text


def test_claims_without_results_stay_undecided_and_say_so(judged, tmp_path, rng):
    write_choice(tmp_path, thesis())

    claims = judge_claims(load_results(tmp_path), rng=rng)

    answers = [answer for claim in claims for answer in claim.answers]
    assert len(claims) == 5
    assert {answer.outcome for answer in answers} == {"undecided"}
    assert all("Not tested: " in answer.text for answer in answers)


def test_one_network_alone_is_judged_alone(judged):
    answers = judged(thesis(inputs=("raw",)))

    assert {subject for _, subject in answers} == {RAW}
    assert "scored were raw images" in answers["difference", RAW].text


def test_every_interval_of_a_claim_is_told_with_its_setting(judged):
    answer = judged(thesis())["most-faithful", DIFFERENCE]

    assert {finding.where for finding in answer.findings} == {
        "untouched frame",
        "grey",
        "blur",
        "untouched frame (markers)",
        "true scene",
    }
    assert all(finding.gap is not None and finding.gap.low < finding.gap.high for finding in answer.findings)


def test_the_score_of_the_thesis_is_told_but_does_not_decide(tmp_path, rng):
    made = thesis(inputs=("difference",))
    write_choice(tmp_path, made)
    write_faithfulness(tmp_path, "difference", made, rng=rng)
    drawn = write_maps(tmp_path, "difference", made, rng=rng)
    maps = {f"{name}-thesis": stack for name, stack in drawn.items()}
    # by the thesis's score Poly-CAM is the worst
    write_thesis_scores(tmp_path, "difference", thesis(gains=GAINS | {"poly-cam-thesis": -0.5}), maps, rng=rng)

    answer = judge_claims(load_results(tmp_path), rng=rng)[0].answers[0]

    told = [finding for finding in answer.findings if finding.where == "score of the thesis"]
    assert answer.outcome == "holds"
    assert len(told) == 2
    assert all(finding.outcome is None and finding.gap is not None and finding.gap.above_zero for finding in told)


def test_estimates_are_the_gaps_that_were_put_in(judged, tmp_path, rng):
    judged(thesis(spread=0.0))
    curves = load_results(tmp_path).study.faithfulness["difference"].curves

    first, second = (curves["grey", "pixel", f"{name}-thesis"] for name in ("poly-cam", "grad-cam"))
    gap = compare_gain((first, second), rng=rng)

    # curves were built to have that area; trapezoids of 21 steps add no error to an area set by trapezoids
    assert gap is not None
    assert gap.estimate == pytest.approx(GAINS["poly-cam-thesis"] - GAINS["grad-cam-thesis"], abs=1e-9)


def test_same_data_give_the_same_claims(judged, tmp_path):
    judged(thesis())
    results = load_results(tmp_path)

    again = [judge_claims(results, rng=np.random.default_rng(0)) for _ in range(2)]

    assert again[0] == again[1]


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


def test_a_gap_over_too_few_trials_decides_nothing():
    gap = Difference(estimate=1.0, low=0.9, high=1.1, units=3)

    assert judge_gap(gap) == "undecided"


def test_a_single_trial_decides_nothing_and_is_told_without_an_interval():
    gap = Difference(estimate=1.0, low=None, high=None, units=1)

    assert judge_gap(gap) == "undecided"
    assert tell_interval(gap) == "+1.000 (no interval of one trial)"


def test_a_study_of_one_trial_is_judged_and_shown_without_intervals(judged, tmp_path, rng):
    answers = judged(thesis(trials=1))

    assert {answer.outcome for answer in answers.values()} == {"undecided"}
    assert "no interval of one trial" in answers["two-markers", "Raw images"].text
    results = load_results(tmp_path)
    assert judge(results, rng=rng)[0].text.startswith("Not known: one trial is too few")
    assert not re.findall(r"\b1 (?:\w+ )?(?:frame|trial|day|method|pair)s\b", str(build_sections(results, rng=rng)))


def removal_alone(folder: Path) -> Results:
    """What a study finds where the scene cannot be drawn anew."""
    results = load_results(folder)
    return replace(results, study=replace(results.study, truth={}))


def test_without_truth_the_method_to_believe_is_the_one_that_beats_the_controls(judged, tmp_path, rng):
    judged(Made(gains=OURS | {"integrated-gradients": 0.4}))

    statements = {one.topic: one for one in judge(removal_alone(tmp_path), rng=rng)}

    found = statements["What to believe, difference images"]
    assert found.tone == "good"
    assert found.text.startswith("Believe Integrated Gradients. Under 4 of 4 fills")
    assert "ahead of Poly-CAM, the next, under untouched frame, grey, blur and true scene" in found.text
    assert "Grad-CAM does not beat the controls" in found.text
    assert "no truth tells whether" in found.text


@pytest.mark.parametrize(
    ("spearman", "expected"),
    [
        ({}, ("Believe Poly-CAM: of 4 methods its map tells best", "good")),
        # a lead of 0.04 is not off zero: intervals reach 0.05 either way
        ({"grad-cam": 0.66}, ("No method is shown to be best: Poly-CAM comes first, and 1 of 3 others tie", "plain")),
        # the control has 0.1
        (dict.fromkeys(SPEARMAN, -0.1) | {"poly-cam": 0.14}, ("None: no map is shown to tell", "caution")),
    ],
)
def test_recommended_is_what_leads_every_control_and_every_method(judged, tmp_path, rng, spearman, expected):
    first, tone = expected
    judged(Made(spearman=SPEARMAN | spearman))
    statements = judge(load_results(tmp_path), rng=rng)
    found = {one.topic: one for one in statements}["What to believe, raw images"]
    assert found.text.startswith(first)
    assert found.tone == tone
    assert "Found over 6 trials, one day, one network: another network or day may say otherwise." in found.text
    assert "It would be overturned by a study of other trials" in found.text
    assert ("Not told apart from it, by the lead over each: Grad-CAM (+0.04" in found.text) is first.startswith(
        "No method"
    )
    assert "a perfect map would reach 0.95." in found.text  # the root of 0.9


@pytest.mark.parametrize(("name", "kin"), [("integrated-gradients", True), ("poly-cam", False)])
def test_a_method_that_is_kin_to_the_truth_is_called_so(judged, tmp_path, rng, name, kin):
    judged(Made(inputs=("raw",), spearman=SPEARMAN | {name: 0.9}))
    found = judge(load_results(tmp_path), rng=rng)[0]
    assert found.topic == "What to believe, raw images"
    assert ("kin to that truth by construction" in found.text) is kin


def test_what_was_found_over_several_networks_and_days_is_not_told_of_one(judged, tmp_path, rng):
    judged(Made(inputs=("raw",)))
    results = load_results(tmp_path)
    truth = results.study.truth["raw"]
    assert truth.methods["poly-cam"].shapley is not None
    over = replace(truth.methods["poly-cam"].shapley, networks=3, days=4)
    methods = truth.methods | {"poly-cam": replace(truth.methods["poly-cam"], shapley=over)}
    study = replace(results.study, truth={"raw": replace(truth, methods=methods)})
    found = judge(replace(results, study=study), rng=rng)[0]
    assert "Found over 6 trials, 4 days, 3 networks. It would" in found.text


def test_the_claims_of_the_thesis_are_counted_by_outcome(judged, tmp_path, rng):
    judged(thesis(gains=GAINS | {"poly-cam-thesis": -0.1}))
    results = load_results(tmp_path)
    claims = judge_claims(results, rng=rng)
    found = {one.topic: one for one in judge(results, claims=claims, rng=rng)}["The thesis's claims"]
    counted = [{answer.outcome for answer in claim.answers} for claim in claims]
    assert found.text.startswith("Of the thesis's 5 claims ")
    hold, fail = (counted.count({outcome}) for outcome in ("holds", "does not hold"))
    assert f" {hold} {'holds' if hold == 1 else 'hold'}: “" in found.text
    assert (
        f" {fail} {'does' if fail == 1 else 'do'} not hold: “Poly-CAM is the most faithful of the three" in found.text
    )
    assert "Poly-CAM as it ran it, is not borne out on raw images: Poly-CAM leads that map by +0.50" in found.text
    assert "The thesis's claims" not in {one.topic for one in judge(results, rng=rng)}


def test_where_the_next_method_gains_more_it_is_told_with_both_means(judged, tmp_path, rng):
    judged(Made(gains=OURS | {"integrated-gradients": 0.4}))
    faithful = load_results(tmp_path).study.faithfulness["difference"]
    ranked = rank_methods(faithful)
    turned = tuple(
        replace(one, gap=gap_from(one, one.second))
        if one.fill == "blur"
        and "integrated-gradients" in {one.first, one.second}
        and "poly-cam" in {one.first, one.second}
        else one
        for one in faithful.comparisons
    )

    told = _tell_lead(replace(faithful, comparisons=turned), ranked[0], ranked[1:])

    assert "ahead of Poly-CAM, the next, under untouched frame, grey and true scene, and behind it under blur;" in told
    means = [f"+{one.mean_gain:.3f}" for one in ranked[:2]]
    assert told.endswith(f"their mean gains are {means[0]} and {means[1]}.")


def test_no_method_is_believed_where_a_control_wins(judged, tmp_path, rng):
    judged(Made(gains=OURS | {"edges": 0.5}))

    found = judge(removal_alone(tmp_path), rng=rng)[0]

    assert found.tone == "caution"
    assert found.text.startswith("None: no method beats both chance and the best control under most fills.")
    assert "Poly-CAM comes nearest, under 0 of 4" in found.text


def test_a_fill_that_cannot_tell_the_truth_has_no_vote(judged, tmp_path, rng):
    judged(Made(gains=OURS | {"integrated-gradients": 0.4}))
    study = load_results(tmp_path).study
    (meta,) = study.truth["difference"].meta
    assert meta.gap is not None
    # ahead by its mean, but not for sure
    unsure = replace(meta, fill="grey", gap=replace(meta.gap, low=-0.01))
    truth = replace(study.truth["difference"], meta=(meta, unsure))

    best = rank_methods(study.faithfulness["difference"], truth)[0]

    assert best.tested == (("reference", "pixel"), ("blur", "pixel"), ("true", "marker"))


def test_where_no_fill_can_judge_nothing_is_believed_and_it_says_why(judged, tmp_path, rng):
    judged(Made())
    results = load_results(tmp_path)
    unknown = [
        replace(one, gap=None, fill=fill)
        for one in results.study.truth["raw"].meta
        for fill in ("reference", "grey", "blur", "true")
    ]
    truth = {name: replace(own, methods={}, meta=tuple(unknown)) for name, own in results.study.truth.items()}

    found = judge(replace(results, study=replace(results.study, truth=truth)), rng=rng)[0]

    assert found.text.startswith("Not known: no method was compared with a control under a fill that can judge it.")
    assert "Left out: " in found.text


def test_too_few_trials_believe_nothing(judged, tmp_path, rng):
    judged(Made(trials=3))

    found = judge(load_results(tmp_path), rng=rng)[0]

    assert found.text.startswith("Not known: 3 trials are too few to tell a method from chance; 5 or more are needed.")


def test_too_few_trials_decide_no_claim(judged, tmp_path):
    stable = {**MAP_MEASURES["integrated-gradients-thesis"], "noise_stability": 0.99}

    answers = judged(thesis(trials=3, looks=MAP_MEASURES | {"integrated-gradients-thesis": stable}))

    assert {answer.outcome for answer in answers.values()} == {"undecided"}
    assert tell_too_few(load_results(tmp_path)).startswith("This study explains 3 trials, and fewer than 5 decide")


def test_a_fill_counts_once_whatever_the_units(judged, tmp_path):
    judged(Made())

    best = rank_methods(load_results(tmp_path).study.faithfulness["raw"])[0]

    # the untouched frame was tried by pixel and by marker
    assert best.tested == (("reference", "pixel"), ("grey", "pixel"), ("blur", "pixel"), ("true", "marker"))


def test_a_claim_counts_a_fill_once_too(judged, tmp_path, rng):
    judged(thesis())
    results = load_results(tmp_path)
    faithful = results.study.faithfulness["difference"]
    table = faithful.table
    turned = (table.fill == "reference") & (table.unit == "marker") & (table.method == "poly-cam-thesis")
    first, last = (
        np.where(turned, *pair)
        for pair in ((table.least_first, table.most_first), (table.most_first, table.least_first))
    )
    changed = replace(faithful, table=replace(table, most_first=first, least_first=last))
    study = replace(results.study, faithfulness=results.study.faithfulness | {"difference": changed})

    answer = judge_claims(replace(results, study=study), rng=rng)[0].answers[0]

    # by markers the untouched frame says the opposite, but by pixels it has voted
    assert answer.outcome == "holds"
    opposite = [one for one in answer.findings if one.where == "untouched frame (markers)"]
    assert opposite
    assert all(one.outcome is None and one.gap is not None and one.gap.below_zero for one in opposite)


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
        return judge_claims(replace(results, study=study), rng=rng)[0].answers[0]

    assert told(unfit=(), turned=("grey", "blur")).outcome == "undecided"
    answer = told(unfit=("grey", "blur"), turned=("grey", "blur"))
    assert answer.outcome == "holds"
    silent = [one for one in answer.findings if one.where in ("grey", "blur")]
    assert silent
    assert all(one.outcome is None for one in silent)
    none = told(unfit=("reference", "grey", "blur", "true"), turned=())
    assert none.outcome == "undecided"
    assert "under no fill that was scored does a map made from the truth win for sure" in none.text


def test_frames_that_are_left_out_of_the_scores_are_told(judged, tmp_path, rng):
    judged(thesis())
    results = load_results(tmp_path)
    assert results.study.left_out == {}
    truth = results.study.truth["raw"]
    fewer = replace(results.study, truth=results.study.truth | {"raw": replace(truth, frames=truth.frames - 2)})
    assert list(fewer.left_out) == ["raw"]
    sections = {one.id: one for one in build_sections(replace(results, study=fewer), rng=rng)}
    assert f"2 of {truth.frames} frames to score are left out with the raw network" in str(sections["choice"].intro)


def test_without_scores_nothing_is_believed(tmp_path, rng):
    write_choice(tmp_path, Made())
    write_quality(tmp_path, "raw", {})

    statements = judge(load_results(tmp_path), rng=rng)

    assert [one.text.split(":")[0] for one in statements] == ["Not known", "Not known"]


def test_an_unsound_sample_is_said_beside_each_verdict_and_score_and_nothing_is_good(judged, tmp_path, rng):
    judged(thesis(sound=False))
    results = load_results(tmp_path)
    statements = {one.topic: one for one in judge(results, rng=rng)}
    assert not [one.topic for one in statements.values() if one.tone == "good"]
    told = "The sample explains answers that are off by 13 points on average; 5 of 60 trials qualified at ±3 points"
    assert told in statements["What to believe, raw images"].text
    assert "off by 7 points on average" in statements["What to believe, difference images"].text
    both = "off by 7 points (difference images) and 13 points (raw images) on average; 5 of 60 trials"
    sections = {one.id: one for one in build_sections(results, rng=rng)}
    for name in ("claims", "faithfulness", "randomisation", "maps", "truth"):
        assert both in str(sections[name].intro)
        assert all(both in block.caption for block in sections[name].blocks if isinstance(block, Table))


def test_a_sound_sample_may_carry_a_verdict(judged, tmp_path, rng):
    judged(thesis(sound=True))
    assert "good" in {one.tone for one in judge(load_results(tmp_path), rng=rng)}
