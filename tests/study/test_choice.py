from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from sliplens.errors import InputError, RecordingError
from sliplens.models import Network
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation
from sliplens.results.study import Choice, StudyConfig
from sliplens.study.choice import Material, choose_frames, worth_scoring
from sliplens.study.run import load_networks


class Says(nn.Module):
    """A network that always gives the same answer, or the mean brightness of a trial's frames times a factor."""

    def __init__(self, answer: float) -> None:
        super().__init__()
        self.answer = answer

    def forward(self, images: Tensor) -> Tensor:
        return torch.full((len(images),), self.answer)


def says(network: Network, answer: float) -> Network:
    return Network(model=Says(answer), manifest=network.manifest)


def test_each_level_gets_the_frame_whose_label_is_nearest(choice: Choice, fine_dataset: Dataset):
    labels = {info.trial: fine_dataset.load(info).safety_margin for info in fine_dataset.trials}
    for pick in choice.frames:
        margin = labels[pick.trial]
        assert margin[pick.frame] == pytest.approx(pick.safety_margin)
        assert abs(pick.safety_margin - pick.level) == pytest.approx(np.nanmin(np.abs(margin - pick.level)))


def test_every_trial_has_six_frames_to_look_at_and_three_to_score(choice: Choice):
    shown = [pick for pick in choice.frames if pick.pictured]
    assert [pick.level for pick in shown] == [1.0, 0.8, 0.6, 0.4, 0.2, 0.0]
    assert len({pick.trial for pick in shown}) == 1
    scored = [pick for pick in choice.frames if pick.scored]
    assert len(scored) == 3 * len(choice.trials) == 6
    assert len({pick.id for pick in choice.frames}) == len(choice.frames) == 12


def test_frames_with_nothing_to_explain_are_not_scored(material: Material, choice: Choice):
    explained, scored = material.explained, tuple(frame for frame in choice.frames if frame.scored)

    def changing_by(*changes: float) -> Explanation:
        frames = zip(explained.frames, changes, strict=True)
        changed = (replace(one, prediction=one.reference_prediction + by) for one, by in frames)
        return replace(explained, frames=tuple(changed))

    found = worth_scoring(scored, changing_by(0.3, 1e-4, -1e-4, -0.3, 0.0199, -0.0201))
    assert [frame.id for frame in found] == [explained.frames[row].id for row in (0, 3, 5)]
    # a network that tells none from the untouched sensor: each explanation says so
    assert worth_scoring(scored, changing_by(*[1e-4] * 6)) == scored


# at levels 1 and 0 a constant answer c is wrong by about max(1 - c, c): 0.5 by half, 0.9 by nine tenths
@pytest.mark.parametrize(("answer", "worst"), [(0.5, 0.5), (0.9, 0.9), (0.2, 0.8)])
def test_a_trial_qualifies_when_its_worst_answer_is_within_the_tolerance(
    network: Network, fine_dataset: Dataset, answer: float, worst: float
):
    # labels lie within 1/39 of a level
    for tolerance, expected in ((worst + 0.03, 3), (worst - 0.03, 0)):
        found = choose_frames(
            {"difference": says(network, answer)}, fine_dataset, StudyConfig(trials=3, tolerance=tolerance)
        )
        assert (found.considered, found.qualified) == (3, expected)
        assert all(abs(one.worst_error["difference"] - worst) < 0.03 for one in found.trials)


def test_of_two_networks_the_worse_decides(network: Network, fine_dataset: Dataset):
    networks = {"difference": says(network, 0.5), "raw": says(network, 0.9)}
    assert choose_frames(networks, fine_dataset, StudyConfig(tolerance=0.6)).qualified == 0
    assert choose_frames(networks, fine_dataset, StudyConfig(tolerance=0.95)).qualified == 3
    found = choose_frames(networks, fine_dataset, StudyConfig(tolerance=0.6))
    assert found.qualified_alone == {"difference": 3, "raw": 0}
    # scored are 40, 20 and 0 %: 0.5 is off by 0.3 on average, 0.9 by 0.7, and labels lie within 1/39 of a level
    assert found.mean_error == pytest.approx({"difference": 0.3, "raw": 0.7}, abs=1 / 39)
    told = [f"{100 * found.mean_error[name]:.0f} points ({name} images)" for name in networks]
    assert f"off by {told[0]} and {told[1]} on average" in found.summary


def test_where_too_few_qualify_the_text_says_what_was_done(network: Network, fine_dataset: Dataset):
    found = choose_frames({"difference": says(network, 0.5)}, fine_dataset, StudyConfig(trials=5, tolerance=0.01))
    assert "3 of 5 wanted were taken: 0 are predicted within 5 points" in found.summary
    assert found.close == 0
    assert (found.sound, found.qualified_alone) == (False, {"difference": 0})
    enough = choose_frames({"difference": says(network, 0.5)}, fine_dataset, StudyConfig(trials=2, tolerance=0.9))
    assert [one.trial for one in enough.trials] == ["test-dry-0", "test-dry-1"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"trials": 0}, "0 trials is impossible"),
        ({"tolerance": 2.0}, "between 0 and 1"),
    ],
)
def test_impossible_wishes_are_refused(
    network: Network, fine_dataset: Dataset, change: dict[str, object], sentence: str
):
    with pytest.raises(InputError, match=sentence):
        choose_frames({"difference": network}, fine_dataset, StudyConfig(**change))  # pyright: ignore[reportArgumentType]


def test_data_without_frames_near_the_levels_are_refused(network: Network, small_dataset: Dataset):
    # its labels are elevenths: none lies within 5 % of full stick
    with pytest.raises(RecordingError, match="choose another split or condition"):
        choose_frames({"difference": network}, small_dataset, StudyConfig())


def test_a_study_without_a_network_is_refused():
    with pytest.raises(InputError, match="needs a network"):
        load_networks([])
