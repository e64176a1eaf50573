"""Moving the markers that a map ranks first back to the stick frame, in a simulated trial."""

from dataclasses import replace

import numpy as np
import pytest

import sliplens as sl
from sliplens.explainers.occlusion import marker_regions, to_network_px
from sliplens.recordings import Recording
from sliplens.simulation.trials import put_markers_back, rebuild_trial, visible_markers
from sliplens.study.explaining import prove_map


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("proof") / "data"
    data = sl.simulate(folder, preset="thesis", dry_trials=4, wet_trials=0, days=4, frames_per_trial=24)
    recording = data.load(data.trials[0])
    slips = np.flatnonzero(recording.safety_margin <= 0.1)
    stick = int(np.flatnonzero(recording.safety_margin > 0.97)[-1])
    return data, recording, int(slips[0]), stick


def paint(network, recording, film, frame, weights):
    """Map with a weight on each visible marker, and its markers."""
    visible, size = visible_markers(film.sensor), network.manifest.image_size
    centres = to_network_px(film.marker_px[frame][visible], recording.frames.shape[1:3], image_size=size)
    regions = marker_regions((size, size), centres).numpy()
    values = np.append(weights(len(visible)), 0.0)
    return visible, (values / np.bincount(regions.ravel(), minlength=len(values)))[regions].astype(np.float32)


def test_the_fewest_markers_with_half_of_the_relevance_are_moved(scene):
    data, recording, frame, stick = scene
    network, film = sl.load("thesis-difference"), rebuild_trial(data.folder, recording)

    def weights(count: int) -> np.ndarray:
        values = np.full(count, -0.001)
        values[[3, 5, 8]] = -0.4, -0.3, -0.2  # two hold over half of about 0.94
        return values

    visible, relevance = paint(network, recording, film, frame, weights)
    proof = prove_map(
        network, data.folder, recording, frame=frame, stick=stick, relevance=relevance, rng=np.random.default_rng(1)
    )
    assert proof is not None
    record, drawn = proof
    np.testing.assert_allclose(record.from_px, film.marker_px[frame][visible[[3, 5]]])
    back = np.zeros((3, len(film.marker_rest_px)), dtype=bool)
    back[1, visible[[3, 5]]] = back[2, visible] = True
    images = put_markers_back(film, frame, back, to=stick).draw_all()
    now, after, all_back = network.predict(network.encode(images, recording.reference)).tolist()
    np.testing.assert_array_equal(drawn[0], images[1])
    assert record.prediction == pytest.approx(now, abs=1e-6)
    assert record.change == pytest.approx(now - after, abs=1e-6)
    assert record.change_all == pytest.approx(now - all_back, abs=1e-6)
    assert now < all_back  # a slipping frame, and the same with its markers where they stuck
    assert np.isfinite(record.change_random)


def test_a_map_that_supports_nothing_and_a_trial_that_is_not_simulated_prove_nothing(scene):
    data, recording, frame, stick = scene
    network, film = sl.load("thesis-difference"), rebuild_trial(data.folder, recording)
    _, opposing = paint(network, recording, film, frame, lambda count: np.full(count, 0.1))

    def prove(trial: Recording, relevance: np.ndarray) -> object:
        rng = np.random.default_rng(0)
        return prove_map(network, data.folder, trial, frame=frame, stick=stick, relevance=relevance, rng=rng)

    assert prove(recording, opposing) is None
    assert prove(recording, -opposing) is not None
    assert prove(replace(recording, truth=None), -opposing) is None
