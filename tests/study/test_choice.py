"""Trials, frames, markers and methods of a study."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small import Returning

from sliplens.codec import load_result, save_result
from sliplens.errors import InputError, RecordingError
from sliplens.explainers.explain import with_markers
from sliplens.models import Network
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation
from sliplens.results.study import Choice, States, StudyConfig
from sliplens.study import choice as choosing
from sliplens.study.choice import choose_frames, study_explainers, worth_scoring
from sliplens.study.run import load_networks

from .conftest import marker_table


def says(network: Network, answer: float) -> Network:
    """A network that always gives the same answer."""
    return replace(network, model=Returning(lambda images: torch.full((len(images),), answer)))


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


def test_frames_with_nothing_to_explain_are_not_scored(explained: Explanation, choice: Choice):
    scored = tuple(frame for frame in choice.frames if frame.scored)

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
    # scored are 40, 20 and 0 %: 0.5 is off by 0.3 on average, 0.9 by 0.7, and labels lie within 1/39 of a level
    assert found.mean_error == pytest.approx({"difference": 0.3, "raw": 0.7}, abs=1 / 39)
    told = [f"{100 * found.mean_error[name]:.0f} points ({name} images)" for name in networks]
    assert f"off by {told[0]} and {told[1]} on average" in found.summary


def test_where_too_few_qualify_the_text_says_what_was_done(network: Network, fine_dataset: Dataset):
    found = choose_frames({"difference": says(network, 0.5)}, fine_dataset, StudyConfig(trials=5, tolerance=0.01))
    assert "3 of 5 wanted were taken: 0 are predicted within 5 points" in found.summary
    assert found.close == 0
    assert not found.sound
    enough = choose_frames({"difference": says(network, 0.5)}, fine_dataset, StudyConfig(trials=2, tolerance=0.9))
    assert [one.trial for one in enough.trials] == ["test-dry-0", "test-dry-1"]


def test_an_impossible_study_is_refused(network: Network, fine_dataset: Dataset, small_dataset: Dataset):
    for config, sentence in (
        (StudyConfig(trials=0), "0 trials is impossible"),
        (StudyConfig(tolerance=2.0), "between 0 and 1"),
    ):
        with pytest.raises(InputError, match=sentence):
            choose_frames({"difference": network}, fine_dataset, config)
    # its labels are elevenths: none lies within 5 % of full stick
    with pytest.raises(RecordingError, match="choose another split or condition"):
        choose_frames({"difference": network}, small_dataset, StudyConfig())
    with pytest.raises(InputError, match="needs a network"):
        load_networks([])


def test_a_trial_without_markers_is_named_and_the_result_comes_back(choice: Choice, fine_dataset: Dataset, tmp_path):
    states = choosing.show_states(choice, fine_dataset)
    save_result(states, tmp_path)
    back = load_result(tmp_path, States, command="sliplens study")
    for one in (states, back):
        assert len(one.untracked) == 2
        assert one.markers == {}


def test_a_marker_stands_halfway_and_scales_with_the_image(network: Network):
    # a grid of pitch 20 that moved by 4 to the right, seen at half the size: edges stay edges, centres by half a pixel
    x, y = np.meshgrid(np.arange(10, 100, 20.0), np.arange(10, 100, 20.0))
    rest = np.stack([x.ravel(), y.ravel()], axis=1)
    markers = marker_table(rest, rest + np.array([4.0, 0.0]))
    centres, reach = choosing.network_places(markers, replace(network.manifest, frame_size=(100, 100), image_size=50))
    np.testing.assert_allclose(centres, (rest + np.array([2.0, 0.0]) + 0.5) / 2 - 0.5)
    assert reach == pytest.approx(5.0)


def test_markers_that_were_lost_are_left_out(network: Network):
    rest = np.array([[10.0, 10.0], [30.0, 10.0], [50.0, 10.0]])
    now = np.where([[False], [True], [False]], np.nan, rest)
    manifest = replace(network.manifest, frame_size=(60, 60), image_size=60)
    centres, reach = choosing.network_places(marker_table(rest, now), manifest)
    np.testing.assert_allclose(centres, rest[[0, 2]])
    assert reach == pytest.approx(20.0)


def test_markers_are_told_by_frame_and_asked_once_where_they_are_needed():
    images, asked = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0)), []

    def find():
        asked.append(1)
        return [torch.full((2, 2), float(row)) for row in range(3)]

    table = with_markers(study_explainers(("shapley-marker", "occlusion-marker", "occlusion")), images, find)
    assert len(asked) == 1
    for row, image in enumerate(images):
        # noise, or one pixel of the next frame, leaves an image what it is
        near = image + 0.05 * torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(1))
        assert all(
            float(vars(table[name])["markers_px"](near, images[0]).mean()) == row
            for name in ("shapley-marker", "occlusion-marker")
        )
    with_markers(study_explainers(("occlusion", "grad-cam")), images, find)
    assert len(asked) == 1


def test_without_markers_tiles_are_asked():
    named = choosing.without_markers(study_explainers(("poly-cam", "shapley-marker")))
    assert list(named) == ["poly-cam", "shapley"]
    assert vars(named["shapley"])["markers_px"] is None
