"""Where the markers of a frame lie: in truth, and found."""

import numpy as np
import pytest
import torch
from there import there

from sliplens.explainers.occlusion import find_markers, markers_in_recording
from sliplens.recordings import Recording
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

ROW = 3  # pressed a little


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate_trial(plan_trials(PRESETS["small"])[0])


def test_the_truth_is_brought_to_the_size_of_the_networks_image(recording):
    expected = there(recording.truth).marker_px[ROW]
    np.testing.assert_allclose(markers_in_recording(recording, ROW, image_size=224), expected, atol=1e-9)
    # half the size: pixels 0 and 1 become pixel 0, whose centre lies between theirs
    half = markers_in_recording(recording, ROW, image_size=112)
    np.testing.assert_allclose(half, (expected - 0.5) / 2, atol=1e-6)


def test_markers_found_in_a_frame_are_those_of_the_truth(recording):
    pytest.importorskip("cv2", reason="OpenCV, of the extra markers, is not installed")
    places = there(recording.truth).marker_px[ROW]
    frame, untouched = (
        torch.from_numpy(one).permute(2, 0, 1).float() / 255 for one in (recording.frames[ROW], recording.reference)
    )
    found = find_markers(frame, untouched).numpy()
    inside = ((places > 8) & (places < 215)).all(axis=1)
    apart = np.linalg.norm(places[inside, None] - found[None], axis=-1).min(axis=1)
    # a marker's radius is 6.5 px: a pixel apart is the same marker; shading hides some
    assert np.mean(apart < 1) > 0.9
