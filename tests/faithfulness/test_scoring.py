"""`score` and `score_by_deletion` of a linear network, where the effect of every pixel is known."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import sliplens
from sliplens.errors import InputError, SaliencyError
from sliplens.faithfulness import score_by_deletion
from sliplens.faithfulness.removal import AREAS
from sliplens.models import Run
from sliplens.models.checkpoint import Manifest

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
def run() -> Run:
    manifest = Manifest(
        backbone="linear", input="amplitude", image_size=SIZE, frame_size=(SIZE, SIZE), sensor="", data_hash=""
    )
    return Run(model=Linear().eval(), manifest=manifest)


EFFECTS = SLOPES.numpy() * FRAMES.astype(np.float64).mean(axis=-1) / 255
TOWARDS = np.sign(EFFECTS.sum(axis=(1, 2)))[:, None, None]


def test_the_gain_of_the_true_effects_is_their_ordered_sum(run):
    faithfulness = sliplens.score(run, FRAMES, EFFECTS * TOWARDS, random_orders=3)
    removed = np.round(np.array(AREAS) * SIZE * SIZE).astype(int)
    for image, effects in enumerate((EFFECTS * TOWARDS).reshape(3, -1)):
        most, least = (np.append(0, np.cumsum(order))[removed] for order in (np.sort(effects)[::-1], np.sort(effects)))
        np.testing.assert_allclose(faithfulness.curves[:2, image], [most, least], atol=1e-6)
    gains = faithfulness.symmetric_gain
    assert faithfulness.interval().low <= gains.mean() <= faithfulness.interval().high
    assert all(gains.mean() > control.symmetric_gain.mean() for control in faithfulness.controls.values())
    assert not any("gains" in alarm for alarm in faithfulness.alarms)
    assert faithfulness.frame().num_rows == 3 * len(AREAS)


def test_frames_with_next_to_nothing_to_explain_count_and_an_alarm_says_so(run):
    # grey everywhere: 0.9 + 100 x (-0.005 x level / 255), which changes by 0.02 at a level of 10.2
    dark, less_dark = (np.full((1, SIZE, SIZE, 3), level, dtype=np.uint8) for level in (10, 11))
    frames = np.concatenate([dark, less_dark, dark])
    faithfulness = sliplens.score(run, frames, EFFECTS, random_orders=1)
    assert len(faithfulness.symmetric_gain) == 3
    assert any(alarm.startswith("next to nothing to explain in 2 of 3 frames") for alarm in faithfulness.alarms)
    assert not any("nothing to explain" in alarm for alarm in sliplens.score(run, less_dark, EFFECTS[:1]).alarms)


def test_an_explanation_is_scored_by_what_works_towards_its_target(run):
    explanation = sliplens.explain(run, FRAMES, method="occlusion", tile_px=1)
    np.testing.assert_allclose(explanation.relevance, EFFECTS, atol=1e-6)
    scored = sliplens.score(run, FRAMES, explanation, random_orders=1)
    by_hand = sliplens.score(run, FRAMES, EFFECTS * TOWARDS, random_orders=1)
    np.testing.assert_allclose(scored.symmetric_gain, by_hand.symmetric_gain, atol=1e-6)
    assert scored.method == "occlusion"


def test_a_map_the_wrong_way_round_loses_to_every_control(run):
    faithfulness = sliplens.score(run, FRAMES, -EFFECTS * TOWARDS, random_orders=1)
    assert any("maps does not beat a random order" in alarm for alarm in faithfulness.alarms)


def test_deletion_removes_the_most_salient_first_and_a_random_order_beside(run):
    curves = score_by_deletion(run, FRAMES, EFFECTS * TOWARDS, fill="black", steps=5)
    base = 0.9 + EFFECTS.sum(axis=(1, 2))
    np.testing.assert_allclose(curves.base, base, atol=1e-6)
    np.testing.assert_allclose(curves.predictions[:, -1], 0.9, atol=1e-6)
    salient = np.sort(np.maximum(EFFECTS * TOWARDS, 0).reshape(3, -1))[:, ::-1]
    lost = TOWARDS[:, 0, 0] * salient[:, :20].sum(axis=1)
    np.testing.assert_allclose(curves.predictions[:, 0], base - lost, atol=1e-6)
    assert curves.control is not None
    assert (curves.auc < curves.control.auc).all()
    assert curves.frame().num_rows == 15


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        (EFFECTS[:2], "there are 2 maps of 3 frames; explain the frames that are scored"),
        (EFFECTS[:, 1:], r"map 0 has shape \(9, 10\) but its image is 10 x 10 pixels"),
        (EFFECTS * np.nan, "map 0 holds NaN or infinity in 100 of 100 pixels"),
    ],
)
def test_maps_that_are_not_of_the_frames_are_refused(run, maps, message):
    for score in (sliplens.score, score_by_deletion):
        with pytest.raises(SaliencyError, match=message):
            score(run, FRAMES, maps)


def test_an_unknown_fill_is_refused_before_anything_is_read():
    with pytest.raises(InputError, match="there is no fill named 'pink'"):
        sliplens.score("no such run", FRAMES, EFFECTS, fill="pink")
