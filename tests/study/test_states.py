import json
from pathlib import Path

import numpy as np
import pytest

from sliplens.images import absolute_difference, read_image
from sliplens.recordings import Dataset
from sliplens.study.choice import Choice
from sliplens.study.states import MarkedFrame, load_markers, network_places, save_states


def test_pictures_are_those_of_the_camera(choice: Choice, fine_dataset: Dataset, tmp_path: Path):
    save_states(choice, fine_dataset, tmp_path)
    recordings = {info.trial: fine_dataset.load(info) for info in fine_dataset.trials}
    for pick in choice.frames:
        raw = tmp_path / "frames" / f"{pick.id}.raw.png"
        assert raw.exists() == pick.shown
        if pick.shown:
            recording = recordings[pick.trial]
            np.testing.assert_array_equal(read_image(raw), recording.frames[pick.frame])
            difference = absolute_difference(recording.frames[pick.frame][None], recording.reference)[0]
            np.testing.assert_array_equal(read_image(tmp_path / "frames" / f"{pick.id}.difference.png"), difference)


def test_a_trial_without_markers_is_named(choice: Choice, fine_dataset: Dataset, tmp_path: Path):
    save_states(choice, fine_dataset, tmp_path)
    told = json.loads((tmp_path / "result.json").read_text())
    assert len(told["untracked"]) == 2
    assert load_markers(tmp_path) == {}
    assert told["markers_from"] == "tracking"


def test_a_marker_stands_halfway_and_scales_with_the_image():
    # a grid of pitch 20 that moved by 4 to the right, seen at half the size: edges stay edges, centres by half a pixel
    x, y = np.meshgrid(np.arange(10, 100, 20.0), np.arange(10, 100, 20.0))
    rest = np.stack([x.ravel(), y.ravel()], axis=1)
    found = MarkedFrame(rest_px=rest, now_px=rest + np.array([4.0, 0.0]))
    centres, reach = network_places(found, frame_size=(100, 100), image_size=50)
    np.testing.assert_allclose(centres, (rest + np.array([2.0, 0.0]) + 0.5) / 2 - 0.5)
    assert reach == pytest.approx(5.0)


def test_markers_that_were_lost_are_left_out():
    rest = np.array([[10.0, 10.0], [30.0, 10.0], [50.0, 10.0]])
    now = rest.copy()
    now[1] = np.nan
    centres, reach = network_places(MarkedFrame(rest_px=rest, now_px=now), frame_size=(60, 60), image_size=60)
    np.testing.assert_allclose(centres, rest[[0, 2]])
    assert reach == pytest.approx(20.0)
