"""Maps held against what each marker does: networks that add up how far the pixels changed, and additive games."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import pearsonr
from simulated_data import simulate_recipe
from small import network_of
from there import there
from torch import Tensor, nn

from sliplens.codec import load_result, save_result
from sliplens.errors import CheckpointError
from sliplens.explainers.explain import explain_frames, join_maps, network_inputs
from sliplens.explainers.frames import FrameSelection, frames_from_dataset
from sliplens.faithfulness.controls import control_maps
from sliplens.faithfulness.removal import SHARES, unit_means
from sliplens.models import Network
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation, MethodNotes
from sliplens.results.study import Truth
from sliplens.simulation import CHROMATOUCH, SimulationRecipe
from sliplens.simulation.trials import put_markers_back, visible_markers
from sliplens.study.truth import (
    FrameEffects,
    JudgingByTruth,
    correlate_groups,
    draw_groups,
    mean_of_defined,
    meta_test,
    neutral_frame,
    rank_correlation,
    redrawing,
    shuffle_half,
    stage_frames,
    true_curves,
)

SIZE = 112
RECIPE = SimulationRecipe(dry_trials=3, wet_trials=1, frames_per_trial=20, seed=5)
LEVELS = (1.0, 0.3)
"""Nothing slips in the first."""


PAIRS = 100


class Linear(nn.Module):
    """A weight for each pixel. If all are positive, whatever is put back lowers the answer."""

    weight: nn.Parameter

    def __init__(self, *, two_signed: bool = False) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        # smooth, so that markers differ as wholes
        coarse = torch.rand(1, 3, 7, 7, generator=generator) ** 2 / 1000
        if two_signed:
            coarse = coarse - coarse.median()
        self.weight = nn.Parameter(nn.functional.interpolate(coarse, size=(SIZE, SIZE), mode="bilinear"))

    def forward(self, images: Tensor) -> Tensor:
        return (images * self.weight).sum(dim=(1, 2, 3))[:, None] + 0.5


CONTROLS = ("change", "local-change", "centre", "edges", "random")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Dataset:
    return simulate_recipe(tmp_path_factory.mktemp("simulated") / "data", RECIPE)


@pytest.fixture(scope="module")
def trained() -> Network:
    return run_of(Linear())


def run_of(model: nn.Module, *, input: str = "amplitude") -> Network:
    """A network that reads the size of the difference to the untouched sensor, as it is."""
    return network_of(model, input=input, image_size=SIZE, frame_size=224)


@pytest.fixture(scope="module")
def explained(trained: Network, data: Dataset) -> Explanation:
    return explain(trained, data)


def explain(trained: Network, data: Dataset) -> Explanation:
    chosen = frames_from_dataset(trained, data, FrameSelection(levels=LEVELS))
    assert isinstance(trained.model, Linear)
    # what each pixel adds to the answer
    attribution = (trained.encoding.normalise(chosen.images) * trained.model.weight).sum(dim=1).detach().numpy()
    notes = MethodNotes(seconds_per_frame=0.0, warnings=())
    explained = join_maps(trained, chosen, {})
    return replace(explained, methods={"attribution": notes}, relevance={"attribution": attribution})


@pytest.fixture(scope="module")
def maps(trained: Network, explained: Explanation) -> dict[str, np.ndarray]:
    return maps_of(trained, explained)


def judge(trained: Network, explained: Explanation, data: Dataset, **more: Any) -> JudgingByTruth:
    return JudgingByTruth(trained=trained, explained=explained, data=data, **more)


def maps_of(trained: Network, explained: Explanation) -> dict[str, np.ndarray]:
    inputs = network_inputs(trained, explained)
    towards = explained.towards[:, None, None]
    controls = control_maps(trained.model, inputs, torch.zeros_like(inputs))
    return {"attribution": explained.relevance["attribution"] * towards, **controls}


@pytest.fixture(scope="module")
def judged(trained, explained, data, maps, tmp_path_factory) -> Truth:
    folder = tmp_path_factory.mktemp("truth")
    save_result(judge(trained, explained, data, maps=maps, fills=("reference", "grey"), pairs=PAIRS).make(), folder)
    return load_result(folder, Truth, command="sliplens study")


@pytest.fixture(scope="module")
def two_signed(data) -> tuple[Network, Explanation, Truth]:
    """A network to which markers speak for and against the answer, what it answers, and its judgement."""
    trained = run_of(Linear(two_signed=True))
    explained = explain(trained, data)
    maps = maps_of(trained, explained)
    return trained, explained, judge(trained, explained, data, maps=maps, fills=(), pairs=PAIRS).make()


def rows_of(truth: Truth, frame: str) -> list[dict]:
    return truth.effects.groups("frame_id")[frame,].to_arrow().to_pylist()


def single_effects(trained: Network, explained: Explanation, data: Dataset, index: int) -> np.ndarray:
    """Prediction of a frame less that with each marker put back alone, drawn one by one."""
    frame = stage_frames(trained, explained, data)[index]
    film, changed = frame.film, []
    whole = trained.predict(network_inputs(trained, explained)[index, None])[0]
    for marker in visible_markers(CHROMATOUCH):
        back = np.zeros((1, len(film.marker_rest_px)), dtype=bool)
        back[0, marker] = True
        drawn = put_markers_back(film, frame.number, back).draw_all()
        changed.append(float(whole - trained.predict(trained.encode(drawn, frame.reference))[0]))
    return np.array(changed)


def test_shapley_values_of_a_linear_network_are_its_single_effects(two_signed, data):
    trained, explained, truth = two_signed
    assert truth.pairs == PAIRS
    for index, frame in enumerate(stage_frames(trained, explained, data)):
        rows = rows_of(truth, frame.explained.id)
        assert [row["marker"] for row in rows] == visible_markers(CHROMATOUCH).tolist()
        effects, values = single_effects(trained, explained, data, index), np.array([row["shapley"] for row in rows])
        # but for rounding to grey levels, and for markers that overlap
        assert np.abs(values - effects).max() < 0.02 * np.ptp(effects)
        assert max(row["shapley_error"] for row in rows) < 0.02 * np.ptp(effects)
        # half a dozen markers at least speak for either side
        assert min((effects > 0).sum(), (effects < 0).sum()) > 5
        film, scene = frame.film, data.load(data.find(frame.explained.trial)).truth
        for row in rows[::9]:
            # one pixel of the network is two of the camera
            x, y = film.marker_px[frame.number, row["marker"]]
            assert (row["x_px"], row["y_px"]) == pytest.approx(((x + 0.5) / 2 - 0.5, (y + 0.5) / 2 - 0.5))
            assert row["state"] == scene.contact_map[frame.number][round(y), round(x)]


def test_markers_of_the_frame_are_put_back_and_the_reference_beside_it_stays(data):
    trained = run_of(nn.Sequential(nn.AdaptiveAvgPool3d(1), nn.Flatten()), input="pair")
    explained = explain_frames(trained, frames_from_dataset(trained, data, FrameSelection(levels=LEVELS[1:])), {})
    (frame,) = frames = stage_frames(trained, explained, data)
    (empty,) = trained.encoding.encode(frame.reference[None], frame.reference, image_size=SIZE)
    drawn = redrawing(trained, frames)(0, np.array([[False] * len(frame.markers), [True] * len(frame.markers)]))
    assert torch.equal(drawn[:, 3:], empty[3:].expand(2, -1, -1, -1))
    as_it_was, without = (one - empty for one in drawn)
    # a grey level where it was resized elsewhere
    torch.testing.assert_close(drawn[0], network_inputs(trained, explained)[0], atol=1.5 / 255, rtol=0)
    markers = torch.from_numpy(frame.units < len(frame.markers))
    assert without[:3, markers].abs().mean() < 0.5 * as_it_was[:3, markers].abs().mean()


def test_neutral_effects_and_correlations_follow_from_frames_drawn_one_by_one(trained, explained, data, maps):
    judging = judge(trained, explained, data, maps=maps, fills=(), pairs=PAIRS)
    records = list(map(judging.prepare(), range(len(LEVELS))))
    rows = {(row["frame_id"], row["method"]): row for row in judging.join(records).neutral.to_arrow().to_pylist()}
    for index, (frame, record) in enumerate(zip(stage_frames(trained, explained, data), records, strict=True)):
        film = frame.film
        stored = data.load(data.find(frame.explained.trial)).frames[frame.number]
        whole = trained.predict(trained.encode(stored[None], frame.reference))[0]
        effects, sums = [], []
        for members in record.groups.tolist():
            back = np.zeros((1, len(film.marker_rest_px)), dtype=bool)
            back[0, frame.markers[members]] = True
            drawn = put_markers_back(film, frame.number, back, to=frame.neutral_frame).draw_all()
            effects.append(float(whole - trained.predict(trained.encode(drawn, frame.reference))[0]))
            sums.append(sum(maps["attribution"][index][frame.regions == member].sum() for member in members))
        np.testing.assert_allclose(record.moved, effects, atol=1e-6)
        expected = pearsonr(sums, explained.towards[index] * np.array(effects))[0]
        assert rows[frame.explained.id, "attribution"]["correlation"] == pytest.approx(expected, abs=1e-3)


def test_an_additive_network_agrees_with_the_stick_game_from_the_neutral_frame(two_signed, data):
    trained, explained, _ = two_signed
    frames = stage_frames(trained, explained, data)
    rows = zip(explained.frames, frames, strict=True)
    stuck = replace(explained, frames=tuple(replace(row, baseline_frame=at.neutral_frame) for row, at in rows))
    records = list(map(judge(trained, stuck, data, maps={}, pairs=PAIRS).prepare(), range(len(LEVELS))))
    points = np.zeros((len(LEVELS), SIZE, SIZE))
    for values, record, frame, towards in zip(points, records, frames, stuck.towards, strict=True):
        x, y = np.round(frame.now_px).astype(int).T
        values[y, x] = towards * record.stick
    truth = judge(trained, stuck, data, maps={"points": points, "flat": 0 * points}, pairs=PAIRS).join(records)
    points, flat = (there(truth.methods[name].neutral).estimate for name in ("points", "flat"))
    assert points > 0.99
    assert flat == 0
    np.testing.assert_array_equal(truth.effects.stick, np.concatenate([record.stick for record in records]))


def test_the_oracle_is_right_and_chance_knows_nothing(judged, explained):
    assert judged.frames == len(explained.frames)
    methods = judged.methods
    assert set(methods) == {"attribution", *CONTROLS, "oracle", "degraded-oracle"}
    assert methods["oracle"].shapley.estimate == pytest.approx(1)
    assert 0 < methods["degraded-oracle"].shapley.estimate < 1
    # exact for a linear network, but for rounding to grey levels and for what of a marker lies beyond its rim
    assert methods["attribution"].shapley.estimate > 0.9
    assert methods["oracle"].shapley.units == 1


def test_shapley_values_add_up_to_the_change_of_the_scene(two_signed, data):
    trained, explained, truth = two_signed
    redraw = redrawing(trained, stage_frames(trained, explained, data))
    for index, frame in enumerate(explained.frames):
        values = np.array([row["shapley"] for row in rows_of(truth, frame.id)])
        answers = trained.predict(redraw(index, np.array([[False] * len(values), [True] * len(values)])))
        assert values.sum() == pytest.approx(float(answers[0] - answers[1]), abs=1e-6)


def test_a_map_without_signs_never_outranks_the_attribution_of_a_network_with_two(two_signed):
    methods = two_signed[2].methods
    assert methods["attribution"].shapley.estimate > 0.9
    for control in CONTROLS:
        assert methods[control].shapley.estimate < 0.5
    # of two trials nothing is sure, and only a method can lead
    lead = methods["attribution"].lead_over_controls
    # a control may have either sign
    best = max(abs(methods[control].neutral.estimate) for control in CONTROLS if control != "random")
    assert lead.gap.estimate == pytest.approx(methods["attribution"].neutral.estimate - best)
    assert {name for name, own in methods.items() if own.lead_over_controls is not None} == {"attribution"}


def test_supporting_evidence_alone_ties_what_opposes(rng):
    values = rng.permutation(np.concatenate([-rng.uniform(0.1, 2, 24), rng.uniform(0.1, 2, 18)]))
    n, tied = 42, 24
    # ranks that are means over ties: their variance over that of all
    expected = np.sqrt(1 - (tied**3 - tied) / (n**3 - n))
    assert rank_correlation(np.clip(values, 0, None), values) == pytest.approx(expected)
    assert rank_correlation(-values, values) == pytest.approx(-1)


def test_markers_areas_and_rims_are_where_they_are(trained, explained, data):
    frame = stage_frames(trained, explained, data)[1]
    # the middle of a marker is no rim, its neighbourhood is its own
    for number, (x, y) in enumerate(np.round(frame.now_px).astype(int)):
        assert frame.units[y, x] == number
    painted = frame.paint(np.arange(1.0, len(frame.markers) + 1))
    np.testing.assert_array_equal(unit_means(painted, frame.units)[:-1], np.arange(1.0, len(frame.markers) + 1))


def test_the_meta_test_tells_fills_apart(judged):
    meta = {test.fill: test for test in judged.meta}
    assert set(meta) == {"reference", "grey", "true"}
    for test in meta.values():
        assert there(test.gap).estimate == pytest.approx(test.oracle - test.degraded)
        # of a single trial nothing is sure
        assert (there(test.gap).low, test.holds) == (None, False)
    # each marker of this network counts for itself and all one way: the oracle's order is the best there is
    assert meta["true"].gap.estimate > 0
    assert meta["true"].oracle >= meta["true"].changed


@pytest.mark.parametrize(("trials", "holds"), [(1, False), (4, False), (5, True)])
def test_a_gain_is_put_to_the_test_by_several_trials_or_not_at_all(trials, holds, rng):
    # frames of one trial, each well ahead of the map that is half wrong
    gains = np.array([0.5, 0.3, 0.1])
    none = np.zeros(2)
    effects = [
        FrameEffects(shapley=none, shapley_error=none, shuffled=none, stick=none,
                     groups=np.zeros((2, 1), dtype=np.int64), moved=none,
                     gains={"true": gains + 0.01 * rng.normal(size=3)})
        for _ in range(3 * trials)
    ]  # fmt: skip
    clusters = np.stack([np.zeros(3 * trials), np.arange(3 * trials) % trials])
    (test,) = meta_test(effects, partial(mean_of_defined, clusters=clusters, seed=0))
    assert there(test.gap).estimate == pytest.approx(0.2, abs=0.03)
    assert test.holds == holds


def test_curves_under_the_true_fill_know_the_oracle(trained, explained, data, maps, judged):
    frames = stage_frames(trained, explained, data)
    oracle = np.stack(
        [
            sign * one.paint(np.array([row["shapley"] for row in rows_of(judged, frame.id)]))
            for sign, one, frame in zip(explained.towards, frames, explained.frames, strict=True)
        ]
    )
    rng = np.random.default_rng(0)
    noise = {f"noise {index}": rng.random(oracle.shape) for index in range(3)}
    found = true_curves(trained, explained, {"oracle": oracle, **maps, **noise}, data=data, random_orders=4)
    np.testing.assert_array_equal(found["oracle"].areas, SHARES)
    for name in noise:
        assert np.all(found["oracle"].symmetric_gain > found[name].symmetric_gain)
    # where all are put back, no order matters
    ends = [[curve.most_first[:, -1], curve.least_first[:, -1], curve.random[:, -1]] for curve in found.values()]
    assert np.ptp(ends, axis=0) == pytest.approx(0, abs=1e-12)


def test_redrawn_inputs_are_those_that_were_explained(trained, explained, data):
    frames = stage_frames(trained, explained, data)
    redraw = redrawing(trained, frames)
    inputs = network_inputs(trained, explained)
    for index, frame in enumerate(frames):
        nobody = np.zeros((2, len(frame.markers)), dtype=bool)
        assert torch.equal(redraw(index, nobody), inputs[index : index + 1].expand(2, -1, -1, -1))


def test_half_of_the_effects_are_shuffled(rng):
    values = np.arange(40.0)
    shuffled = shuffle_half(values, rng=rng)
    np.testing.assert_array_equal(np.sort(shuffled), values)
    moved = np.flatnonzero(shuffled != values)
    # of 20 that are shuffled one stays on average
    assert 14 <= len(moved) <= 20


def test_another_network_is_refused(trained, explained, data, maps):
    with pytest.raises(CheckpointError, match="made with another network"):
        judge(trained, replace(explained, weights_sha256="of others"), data, maps=maps).make()


GAME_MARKERS = 40


def test_an_additive_game_agrees_with_its_own_values_and_not_with_chance(rng):
    values, groups = rng.normal(size=GAME_MARKERS), draw_groups(GAME_MARKERS, rng=rng)
    assert all(len(set(members)) == 5 for members in groups.tolist())
    effects = 0.1 * values[groups].sum(axis=1)
    assert correlate_groups(values, groups, effects) == pytest.approx(1)
    assert correlate_groups(-values, groups, effects) == pytest.approx(-1)
    # the standard deviation of one is about 0.2
    chance = [correlate_groups(rng.normal(size=GAME_MARKERS), groups, effects) for _ in range(400)]
    assert np.mean(chance) == pytest.approx(0, abs=0.05)


def test_effects_that_do_not_vary_judge_nothing_and_maps_that_do_not_vary_score_zero(rng):
    values, groups = rng.normal(size=GAME_MARKERS), draw_groups(GAME_MARKERS, rng=rng)
    assert np.isnan(correlate_groups(values, groups, np.zeros(len(groups))))
    assert correlate_groups(np.zeros(GAME_MARKERS), groups, rng.normal(size=len(groups))) == 0


def test_markers_move_to_a_frame_before_the_first_slip():
    margins = np.array([np.nan, 1.0, 0.84, 0.5, 0.31, 0.0, 0.85, 0.3, 0.0])
    assert neutral_frame(margins, 4) == 2
    assert neutral_frame(margins, 7) == 2
    assert neutral_frame(margins, 1) == 4  # too near to .85 itself
    assert neutral_frame(margins, 2) == 4
