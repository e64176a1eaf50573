"""`score` of a linear network, where the effect of every pixel is known; alarms and the deletion score."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from captum import attr
from hypothesis import given
from hypothesis import strategies as st
from small import network_of
from there import there
from torch import Tensor, nn

import sliplens
from sliplens.errors import CheckpointError, InputError, SaliencyError
from sliplens.explainers.table import get_explainer
from sliplens.faithfulness import scoring
from sliplens.faithfulness.removal import AREAS
from sliplens.models import Network
from sliplens.results.study import Setting

SIZE = 10
SLOPES = torch.linspace(-0.02, 0.01, SIZE * SIZE, dtype=torch.float64).reshape(SIZE, SIZE)
FRAMES = np.random.default_rng(0).integers(0, 256, (3, SIZE, SIZE, 3), dtype=np.uint8)


class Linear(nn.Module):
    """0.9 plus the sum of slope x brightness: the margin falls where the dark half of the slopes is touched."""

    def __init__(self) -> None:
        super().__init__()
        self.slopes = nn.Parameter(SLOPES)

    def forward(self, images: Tensor) -> Tensor:
        return 0.9 + (images.double().mean(dim=1) * self.slopes).sum(dim=(1, 2))


@pytest.fixture
def run() -> Network:
    return network_of(Linear(), input="amplitude", image_size=SIZE)


EFFECTS = SLOPES.numpy() * FRAMES.astype(np.float64).mean(axis=-1) / 255
TOWARDS = np.sign(EFFECTS.sum(axis=(1, 2)))[:, None, None]


def gain_of(faithfulness, method: str = "maps") -> np.ndarray:
    return next(curve for (_, _, name), curve in faithfulness.curves.items() if name == method).symmetric_gain


def test_the_gain_of_the_true_effects_is_their_ordered_sum(run):
    faithfulness = sliplens.score(run, FRAMES, EFFECTS, random_orders=3)
    removed = np.round(np.array(AREAS) * SIZE * SIZE).astype(int)
    curve = faithfulness.curves["reference", "pixel", "maps"]
    for image, effects in enumerate((EFFECTS * TOWARDS).reshape(3, -1)):
        most, least = (np.append(0, np.cumsum(order))[removed] for order in (np.sort(effects)[::-1], np.sort(effects)))
        np.testing.assert_allclose(curve.most_first[image], most, atol=1e-6)
        np.testing.assert_allclose(curve.least_first[image], least, atol=1e-6)
    score = faithfulness.score("maps")
    assert score.srg.estimate == pytest.approx(curve.symmetric_gain.mean())
    assert all(score.srg.estimate > other.srg.estimate for other in faithfulness.scores if other.control)
    assert there(score.lead_over_controls).gap.estimate > 0
    assert not any("gains" in alarm for alarm in faithfulness.alarms)
    assert faithfulness.to_arrow().num_rows == len(faithfulness.scores) * 3 * len(AREAS)


def test_frames_with_next_to_nothing_to_explain_count_and_an_alarm_says_so(run):
    # grey everywhere: 0.9 + 100 x (-0.005 x level / 255), which changes by 0.02 at a level of 10.2
    dark, less_dark = (np.full((1, SIZE, SIZE, 3), level, dtype=np.uint8) for level in (10, 11))
    frames = np.concatenate([dark, less_dark, dark])
    faithfulness = sliplens.score(run, frames, EFFECTS, random_orders=1, steps=0)
    assert (faithfulness.frames, faithfulness.deletion) == (3, None)
    assert any(alarm.startswith("next to nothing to explain in 2 of 3 frames") for alarm in faithfulness.alarms)
    others = sliplens.score(run, less_dark, EFFECTS[:1], steps=0).alarms
    assert not any("nothing to explain" in alarm for alarm in others)


def test_an_explanation_is_scored_by_what_works_towards_its_target(run):
    explanation = sliplens.explain(run, FRAMES, method=get_explainer("occlusion", tile_px=1))
    np.testing.assert_allclose(explanation.relevance["occlusion"], EFFECTS, atol=1e-6)
    scored = sliplens.score(run, explanation, random_orders=1)
    by_hand = sliplens.score(run, FRAMES, EFFECTS * TOWARDS, signed=False, random_orders=1)
    np.testing.assert_allclose(gain_of(scored, "occlusion"), gain_of(by_hand), atol=1e-6)
    same = sliplens.score(run, FRAMES, explanation, random_orders=1)
    np.testing.assert_array_equal(gain_of(same, "occlusion"), gain_of(scored, "occlusion"))


def test_several_methods_are_scored_together_and_as_each_alone(run):
    both = sliplens.explain(run, FRAMES, method=[get_explainer("occlusion", tile_px=1), "integrated-gradients"])
    scored = sliplens.score(run, both, random_orders=1, steps=5)
    assert {score.method for score in scored.scores if not score.control} == set(both.methods)
    assert [(gap.first, gap.second) for gap in scored.comparisons] == [("occlusion", "integrated-gradients")]
    assert set(there(scored.deletion).methods) == {*both.methods, "random"}


def test_a_map_the_wrong_way_round_loses_to_every_control(run):
    faithfulness = sliplens.score(run, FRAMES, -EFFECTS, random_orders=1)
    assert any("maps does not beat a random order" in alarm for alarm in faithfulness.alarms)


def test_deletion_removes_the_most_salient_first_and_a_random_order_beside(run):
    scores = there(sliplens.score(run, FRAMES, EFFECTS, random_orders=1, steps=5).deletion_scores)
    base = 0.9 + EFFECTS.sum(axis=(1, 2))
    curve = scores.curves["maps"]
    # grey replaces what a pixel was by a half
    change = (EFFECTS - SLOPES.numpy() / 2).reshape(3, -1)
    orders = np.argsort(np.maximum(EFFECTS * TOWARDS, 0).astype(np.float32).reshape(3, -1), axis=1, kind="stable")
    lost = np.take_along_axis(change, orders[:, ::-1][:, :20], axis=1).sum(axis=1)
    np.testing.assert_allclose(curve.predictions[:, 0], base - lost, atol=1e-6)
    np.testing.assert_allclose(curve.predictions[:, -1], 0.9 + SLOPES.numpy().sum() / 2, atol=1e-6)
    np.testing.assert_allclose(curve.scores, (1 - np.abs(base[:, None] - curve.predictions)) ** 2, atol=1e-6)
    assert (scores.fill, scores.steps) == ("grey", 5)
    assert set(scores.methods) == {"maps", "random"}


def test_a_folder_holds_the_record_that_is_returned_without_one(run, tmp_path):
    explanation = sliplens.explain(run, FRAMES, method=get_explainer("occlusion", tile_px=1))
    score = partial(sliplens.score, run, explanation, random_orders=1, steps=4)
    scored, saved = score(), score(out=tmp_path / "scores")
    assert saved.scores == scored.scores
    assert saved.deletion == scored.deletion
    np.testing.assert_array_equal(saved.table.most_first, scored.table.most_first)
    progress, out = [], tmp_path / "scores"
    again = score(out=out, on_progress=lambda *step: progress.append(step))
    assert again.scores == scored.scores
    assert not progress
    assert not (tmp_path / "scores" / "parts").exists()


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        (EFFECTS[:2], "there are 2 maps of 3 frames; explain the frames that are scored"),
        (EFFECTS[:, 1:], r"map 0 has shape \(9, 10\) but its image is 10 x 10 pixels"),
        (EFFECTS * np.nan, "map 0 holds NaN or infinity in 100 of 100 pixels"),
    ],
)
def test_maps_that_are_not_of_the_frames_are_refused(run, maps, message):
    with pytest.raises(SaliencyError, match=message):
        sliplens.score(run, FRAMES, maps)


def test_what_cannot_be_scored_is_refused_an_impossible_option_before_a_network_is_loaded(run):
    with pytest.raises(InputError, match="there is no fill named 'pink'"):
        sliplens.score("no such run", FRAMES, EFFECTS, fill="pink")
    with pytest.raises(InputError, match="0 random orders are too few; --random-orders must be at least 1"):
        sliplens.score("no such run", FRAMES, EFFECTS, random_orders=0)
    with pytest.raises(InputError, match="no maps to score; give an explanation"):
        sliplens.score(run, FRAMES)
    explanation = sliplens.explain(run, FRAMES, method="integrated-gradients")
    other = replace(run, manifest=replace(run.manifest, weights_sha256="other"))
    with pytest.raises(CheckpointError, match="made with another network; explain the frames again with this run"):
        sliplens.score(other, explanation)


class Curved(Linear):
    """A network whose gradients change on the way from the reference."""

    def forward(self, images: Tensor) -> Tensor:
        return torch.sigmoid(2 * super().forward(images))


UP = np.where((SLOPES.numpy() > 0)[..., None], FRAMES, FRAMES // 8)
BOTH_WAYS = np.concatenate([UP, FRAMES])


@pytest.fixture
def curved(run: Network) -> Network:
    return replace(run, model=Curved().eval())


@pytest.fixture
def captum_maps(curved: Network) -> np.ndarray:
    """Integrated Gradients as Captum gives them, from the untouched sensor."""
    inputs = torch.as_tensor(BOTH_WAYS).permute(0, 3, 1, 2).double() / 255
    method = attr.IntegratedGradients(curved.model)
    attributions = method.attribute(inputs, baselines=torch.zeros_like(inputs), n_steps=200)
    return attributions.sum(dim=1).detach().numpy()


@pytest.mark.parametrize("fill", ["reference", "grey", "black", "white", "blur", "noisy-linear"])
@pytest.mark.parametrize("unit", ["pixel", "tile"])
def test_an_array_of_captum_and_our_explanation_score_alike(curved: Network, captum_maps: np.ndarray, fill: str, unit):
    ours = sliplens.explain(curved, BOTH_WAYS, method="integrated-gradients")
    assert ours.towards.tolist() == [1] * 3 + [-1] * 3
    # Captum integrates by 200 points of Gauss and Legendre, ours until the sum is complete
    np.testing.assert_allclose(ours.relevance["integrated-gradients"], captum_maps, atol=1e-5)
    options = {"fill": fill, "unit": unit, "random_orders": 1, "steps": 10 if unit == "pixel" else 0}
    by_array, by_record = (sliplens.score(curved, BOTH_WAYS, maps, **options) for maps in (captum_maps, ours))
    # pixels that differ by less than the integration may be removed in another order
    np.testing.assert_allclose(gain_of(by_array), gain_of(by_record, "integrated-gradients"), atol=1e-3)
    for score in by_array.scores:
        if score.control:
            assert score.srg.estimate == by_record.score(score.method).srg.estimate
    if by_array.deletion is not None:
        first, second = (there(by.deletion_scores).curves for by in (by_array, by_record))
        np.testing.assert_allclose(first["maps"].predictions, second["integrated-gradients"].predictions, atol=1e-3)


def test_a_signed_map_gains_in_every_frame_and_its_negative_loses_as_much(curved: Network, captum_maps: np.ndarray):
    gain, loss = (
        gain_of(sliplens.score(curved, BOTH_WAYS, maps, random_orders=1, steps=0))
        for maps in (captum_maps, -captum_maps)
    )
    assert (gain > 0).all()
    np.testing.assert_allclose(loss, -gain, atol=1e-6)  # single precision of the network's input


def test_an_array_without_negatives_cannot_explain_a_fall_unless_it_is_called_unsigned(curved: Network):
    score = partial(sliplens.score, curved, steps=0, random_orders=1)
    with pytest.raises(SaliencyError, match=r"map 0 has no number below 0.*give signed=False"):
        score(FRAMES, np.abs(EFFECTS))
    score(FRAMES, np.abs(EFFECTS), signed=False)
    score(UP, np.abs(EFFECTS))
    score(FRAMES, np.zeros_like(EFFECTS))  # an alarm says that it ranks nothing


def test_a_fill_that_is_answered_like_the_image_decides():
    told = scoring.fill_decides(np.array([0.5, 0.5, 0.9]), np.array([0.52, 0.6, 0.91]), fill="grey")
    assert told == ["the fill decides in 2 of 3 frames: an image of nothing but grey is answered within 5% of the "
                    "whole frame"]  # fmt: skip
    assert scoring.fill_decides(np.array([0.5]), np.array([0.1]), fill="grey") == []


def test_a_score_that_follows_its_last_step_measures_the_fill(rng: np.random.Generator):
    last = rng.uniform(size=40)
    assert (
        "correlates with its last step by 0.9"
        in scoring.follows_last_step(last + 0.1 * rng.normal(size=40), last, name="D")[0]
    )
    assert scoring.follows_last_step(rng.uniform(size=400), rng.uniform(size=400), name="D") == []
    assert scoring.follows_last_step(np.ones(5), np.arange(5.0), name="D") == []


@pytest.mark.real
@pytest.mark.parametrize(("method", "tied"), [("gradcam", 0.87), ("ig", 0.98), ("pcampm", 0.99)])
def test_the_recorded_scores_of_the_thesis_raise_it(chromatouch_folder: Path, method: str, tied: float):
    suffix = "-4" if method == "pcampm" else ""
    path = chromatouch_folder / "scores" / "grey" / f"del_details_{method}-diff-shufflenetv2{suffix}.csv"
    recorded = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(1, 225))
    (told,) = scoring.follows_last_step(recorded.mean(axis=1), recorded[:, -1], name="D_AUC")
    assert f"D_AUC correlates with its last step by {tied:.2f}" in told


def test_answers_at_an_end_move_one_way_only():
    assert scoring.saturated(np.array([0.0, 0.5, 1.0, 1.2])) == [
        "3 of 4 answers lie at an end of the margin: they can move one way only"
    ]
    assert scoring.saturated(np.array([0.2, 0.8])) == []


def test_maps_that_rank_nothing_are_told():
    maps = {"good": np.random.default_rng(0).uniform(size=(2, 4, 4)), "flat": np.zeros((2, 4, 4))}
    assert scoring.flat_maps(maps) == ["flat: 2 of 2 maps are constant and rank nothing"]


GREY, BLUR, BLACK = (Setting(fill=fill, unit="pixel") for fill in ("grey", "blur", "black"))


def test_fills_that_rank_the_methods_otherwise_are_told():
    one = {"a": 0.1, "b": 0.2, "c": 0.3}
    told = scoring.ranking_alarms(
        {GREY: one, BLUR: {"a": 0.3, "b": 0.2, "c": 0.1}, BLACK: {"a": 1.0, "b": 2.0, "c": 3.0}}
    )
    assert len(told) == 2  # blur against each of the others
    assert "grey and blur rank the methods differently (Kendall's tau -1.00)" in told[0]
    assert scoring.ranking_alarms({GREY: {"a": 1.0, "b": 2.0}, BLUR: {"a": 2.0, "b": 1.0}}) == []  # two are too few


def test_a_control_that_wins_is_told():
    control = "poly-cam-new-weights"
    assert f"no more than the control {control}" in scoring.ranking_alarms({GREY: {"poly-cam": 0.2, control: 0.3}})[0]
    assert scoring.ranking_alarms({GREY: {"poly-cam": 0.4, control: 0.3}}) == []


@given(st.floats(0, 1), st.floats(0, 1))
def test_deletion_score_is_symmetric_and_one_where_nothing_changed(base: float, masked: float):
    one, other = np.array([base]), np.array([masked])
    score = scoring.deletion_score(one, other)
    assert score == scoring.deletion_score(other, one)
    assert scoring.deletion_score(one, one) == 1
    assert 0 <= score <= 1


def test_the_thesis_removes_224_pixels_at_each_of_224_steps():
    steps = scoring.deletion_steps((224, 224))
    np.testing.assert_array_equal(steps, 224 * np.arange(1, 225))


def test_impossible_numbers_of_steps_are_refused():
    with pytest.raises(InputError, match="deletion in 17 steps is impossible with 16 pixels; choose 1 to 16"):
        scoring.deletion_steps((4, 4), steps=17)


def test_so_many_pixels_of_an_order_are_gone(rng: np.random.Generator):
    order = rng.permutation(30)
    images = torch.rand(1, 3, 6, 5)
    seen: list[torch.Tensor] = []

    def look(batch: torch.Tensor) -> torch.Tensor:
        seen.extend(batch)
        return batch.mean(dim=(1, 2, 3))

    scoring.delete_pixels(look, images, order[None], fill="black", steps=30)
    for step, image in enumerate(seen[:30], start=1):
        for flat in range(30):  # one pixel at a time, the slow way
            row, column = divmod(flat, 5)
            expected = torch.zeros(3) if flat in order[:step] else images[0, :, row, column]
            assert torch.equal(image[:, row, column], expected)
