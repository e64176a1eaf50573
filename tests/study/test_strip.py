import numpy as np
import pytest

from sliplens.errors import RecordingError
from sliplens.explainers.table import RECOMMENDED_METHOD
from sliplens.models import Network
from sliplens.results.explanation import Strip
from sliplens.study.explaining import make_strip

from ..conftest import make_recording


@pytest.fixture(scope="module")
def strip(network: Network) -> Strip:
    levels = (10 / 11, 6 / 11, 0.0)
    return make_strip(network, make_recording("t"), source="simulated", levels=levels)


def test_a_strip_shows_the_frames_nearest_to_its_levels(strip):
    margins = strip.readings.safety_margin[list(strip.shown)]
    # 12 frames fall evenly from 1 to 0, and the first has no contact
    assert margins == pytest.approx([10 / 11, 6 / 11, 0.0])
    assert np.array_equal(strip.pictures, make_recording("t").frames[list(strip.shown)])


def test_a_strip_compares_with_the_last_frame_before_the_pull(strip, network):
    assert strip.baseline == "stick"
    assert strip.shown[0] == 1  # the stick frame itself
    np.testing.assert_allclose(strip.relevance[0], 0, atol=1e-9)
    untouched = make_strip(network, make_recording("t"), source="simulated", levels=(0.0,), baseline="untouched")
    assert untouched.baseline == "untouched"


def test_a_strip_is_explanation_by_the_recommended_method_of_tiles_where_no_markers_show(strip):
    assert strip.method == RECOMMENDED_METHOD.removesuffix("-marker")


def test_a_strip_reads_as_the_network_does(strip, network):
    recording = make_recording("t")
    answers = network.predict(network.encode(recording.frames, recording.reference)).numpy()
    # float32 answers of the same passes, kept as float64
    assert strip.readings.prediction == pytest.approx(answers, abs=1e-6)
    assert np.isnan(strip.readings.safety_margin[0])


def test_a_trial_without_labels_is_refused(network):
    recording = make_recording("t")
    recording.safety_margin[:] = np.nan
    with pytest.raises(RecordingError, match="no labelled frame"):
        make_strip(network, recording, source="real")
