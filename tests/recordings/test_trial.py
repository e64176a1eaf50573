from dataclasses import replace

import numpy as np
import pytest

from sliplens.errors import RecordingError
from sliplens.recordings import Recording
from sliplens.recordings.capture import Forces


def test_an_empty_trial_is_refused(recording: Recording):
    with pytest.raises(RecordingError, match="trial trial has no frames; leave it out or record it again"):
        replace(recording, frames=recording.frames[:0])


def test_a_label_outside_the_unit_interval_is_refused(recording: Recording):
    margin = recording.safety_margin.copy()
    margin[3] = 80.0
    with pytest.raises(RecordingError, match=r"trial trial: safety_margin of frame 3 is 80, outside \[0, 1\]; give it"):
        replace(recording, safety_margin=margin)


def test_no_label_is_allowed_where_there_is_no_contact(recording: Recording):
    assert np.isnan(recording.safety_margin[0])


def test_time_must_rise(recording: Recording):
    time = recording.time_s.copy()
    time[4] = time[3]
    with pytest.raises(RecordingError, match=r"time does not rise at frame 4 \(0\.1 s, then 0\.1 s\)"):
        replace(recording, time_s=time)


@pytest.mark.parametrize(("step_s", "words"), [(1e9, "more than a day"), (1e-9, "declare the right unit of time")])
def test_times_that_no_sensor_has_are_refused_before_any_array_is_made_of_their_span(step_s: float, words: str):
    time_s = np.append(0, step_s + np.arange(200) * min(step_s, 0.01))
    with pytest.raises(RecordingError, match=words):
        Forces(time_s=time_s, force_n=np.ones((201, 3)), source="sensor")


def test_one_value_a_frame(recording: Recording):
    with pytest.raises(RecordingError, match="has 12 frames but 11 values of normal_force_n"):
        replace(recording, normal_force_n=recording.normal_force_n[1:])


def test_frames_and_reference_are_of_one_size(recording: Recording):
    with pytest.raises(RecordingError, match=r"frames of \(48, 48\) pixels but a reference of \(40, 48\)"):
        replace(recording, reference=recording.reference[:40])
