import numpy as np
import pytest

from sliplens.codec import load_result, save_result
from sliplens.recordings import Dataset
from sliplens.results.study import Choice, MarkerPlaces, States
from sliplens.study.choice import network_places, show_states


@pytest.fixture(scope="module")
def states(choice: Choice, fine_dataset: Dataset) -> States:
    return show_states(choice, fine_dataset)


def test_a_trial_without_markers_is_named_and_the_result_comes_back(states: States, tmp_path):
    save_result(states, tmp_path)
    back = load_result(tmp_path, States, command="sliplens study")
    for one in (states, back):
        assert len(one.untracked) == 2
        assert one.markers == {}


def test_a_marker_stands_halfway_and_scales_with_the_image():
    # a grid of pitch 20 that moved by 4 to the right, seen at half the size: edges stay edges, centres by half a pixel
    x, y = np.meshgrid(np.arange(10, 100, 20.0), np.arange(10, 100, 20.0))
    rest = np.stack([x.ravel(), y.ravel()], axis=1)
    marked = MarkerPlaces(rest_px=rest, now_px=rest + np.array([4.0, 0.0]))
    centres, reach = network_places(marked, frame_size=(100, 100), image_size=50)
    np.testing.assert_allclose(centres, (rest + np.array([2.0, 0.0]) + 0.5) / 2 - 0.5)
    assert reach == pytest.approx(5.0)


def test_markers_that_were_lost_are_left_out():
    rest = np.array([[10.0, 10.0], [30.0, 10.0], [50.0, 10.0]])
    now = rest.copy()
    now[1] = np.nan
    centres, reach = network_places(MarkerPlaces(rest_px=rest, now_px=now), frame_size=(60, 60), image_size=60)
    np.testing.assert_allclose(centres, rest[[0, 2]])
    assert reach == pytest.approx(20.0)
