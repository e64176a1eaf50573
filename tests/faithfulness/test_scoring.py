"""`score` and `score_by_deletion` of a linear network, where the effect of every pixel is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from captum import attr
from torch import Tensor, nn

import sliplens
from sliplens.errors import InputError, SaliencyError
from sliplens.faithfulness.removal import AREAS
from sliplens.faithfulness.scoring import score_by_deletion
from sliplens.models import Network
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
def run() -> Network:
    manifest = Manifest(
        backbone="linear", input="amplitude", image_size=SIZE, frame_size=(SIZE, SIZE), sensor="", data_hash=""
    )
    return Network(model=Linear().eval(), manifest=manifest)


EFFECTS = SLOPES.numpy() * FRAMES.astype(np.float64).mean(axis=-1) / 255
TOWARDS = np.sign(EFFECTS.sum(axis=(1, 2)))[:, None, None]


def test_the_gain_of_the_true_effects_is_their_ordered_sum(run):
    faithfulness = sliplens.score(run, FRAMES, EFFECTS, random_orders=3)
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
    by_hand = sliplens.score(run, FRAMES, EFFECTS * TOWARDS, signed=False, random_orders=1)
    np.testing.assert_allclose(scored.symmetric_gain, by_hand.symmetric_gain, atol=1e-6)
    assert scored.method == "occlusion"


def test_a_map_the_wrong_way_round_loses_to_every_control(run):
    faithfulness = sliplens.score(run, FRAMES, -EFFECTS, random_orders=1)
    assert any("maps does not beat a random order" in alarm for alarm in faithfulness.alarms)


def test_deletion_removes_the_most_salient_first_and_a_random_order_beside(run):
    curves = score_by_deletion(run, FRAMES, EFFECTS, fill="black", steps=5)
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


def test_predictions_of_these_frames_rise_and_fall(curved: Network):
    explanation = sliplens.explain(curved, BOTH_WAYS, method="integrated-gradients")
    assert (explanation.change[:3] > 0).all()
    assert (explanation.change[3:] < 0).all()


@pytest.mark.parametrize("fill", ["reference", "grey", "black", "white", "blur", "noisy-linear"])
@pytest.mark.parametrize("unit", ["pixel", "tile"])
def test_an_array_of_captum_and_our_explanation_score_alike(
    curved: Network, captum_maps: np.ndarray, fill: str, unit: str
):
    ours = sliplens.explain(curved, BOTH_WAYS, method="integrated-gradients")
    # Captum integrates by 200 points of Gauss and Legendre, ours until the sum is complete
    np.testing.assert_allclose(ours.relevance.numpy(), captum_maps, atol=1e-5)
    options = {"fill": fill, "unit": unit, "random_orders": 1}
    by_array, by_record = (sliplens.score(curved, BOTH_WAYS, maps, **options) for maps in (captum_maps, ours))
    # pixels that differ by less than the integration may be removed in another order
    np.testing.assert_allclose(by_array.symmetric_gain, by_record.symmetric_gain, atol=1e-3)
    for name, control in by_array.controls.items():
        np.testing.assert_array_equal(control.symmetric_gain, by_record.controls[name].symmetric_gain)


def test_a_signed_map_gains_in_every_frame_and_its_negative_loses_as_much(curved: Network, captum_maps: np.ndarray):
    gain, loss = (
        sliplens.score(curved, BOTH_WAYS, maps, random_orders=1).symmetric_gain for maps in (captum_maps, -captum_maps)
    )
    assert (gain > 0).all()
    np.testing.assert_allclose(loss, -gain, atol=1e-6)  # single precision of the network's input


def test_deletion_takes_an_array_as_it_takes_an_explanation(curved: Network, captum_maps: np.ndarray):
    ours = sliplens.explain(curved, BOTH_WAYS, method="integrated-gradients")
    by_array, by_record = (score_by_deletion(curved, BOTH_WAYS, maps, steps=10) for maps in (captum_maps, ours))
    np.testing.assert_allclose(by_array.predictions, by_record.predictions, atol=1e-3)  # as above


@pytest.mark.parametrize("score", [sliplens.score, score_by_deletion])
def test_an_array_without_negatives_cannot_explain_a_fall_unless_it_is_called_unsigned(score, curved: Network):
    with pytest.raises(SaliencyError, match=r"map 0 has no number below 0.*give signed=False"):
        score(curved, FRAMES, np.abs(EFFECTS))
    score(curved, FRAMES, np.abs(EFFECTS), signed=False)
    score(curved, UP, np.abs(EFFECTS))
    score(curved, FRAMES, np.zeros_like(EFFECTS))  # an alarm says that it ranks nothing
