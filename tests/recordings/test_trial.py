from dataclasses import replace

import numpy as np
import pytest

from sliplens.errors import RecordingError
from sliplens.recordings import Recording
from sliplens.recordings.capture import Forces


def test_a_label_outside_the_unit_interval_is_refused(recording: Recording):
    margin = recording.safety_margin.copy()
    margin[3] = 80.0
    with pytest.raises(RecordingError, match=r"trial trial: safety_margin of frame 3 is 80, outside \[0, 1\]; give it"):
        replace(recording, safety_margin=margin)


def test_time_must_rise(recording: Recording):
    time = recording.time_s.copy()
    time[4] = time[3]
    with pytest.raises(RecordingError, match=r"time does not rise at sample 4"):
        replace(recording, time_s=time)


@pytest.mark.parametrize(
    ("step_s", "words"),
    [(1e9, "more than a day"), (1e-9, "the right unit of time"), (np.inf, "is inf, no number"), (np.nan, "is nan")],
)
def test_times_that_no_sensor_has_are_refused_before_any_array_is_made_of_their_span(step_s: float, words: str):
    time_s = np.append(0, step_s + np.arange(200) * min(step_s, 0.01))
    with pytest.raises(RecordingError, match=words):
        Forces(time_s=time_s, force_n=np.ones((201, 3)), source="sensor")
