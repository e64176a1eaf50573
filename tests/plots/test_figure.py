"""One figure of whatever result."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from made_up import write_workspace

import sliplens as sl
from sliplens.errors import InputError
from sliplens.live.reading import Reading
from sliplens.models.predictions import Predictions
from sliplens.recordings.check import Violation
from sliplens.report import load_results
from sliplens.results.evaluation import ScoredFrames
from sliplens.results.explanation import Explanation


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return load_results(write_workspace(tmp_path_factory.mktemp("made") / "runs"))


@pytest.fixture
def explanation(results) -> Explanation:
    """Two frames, the second with one pixel that raises the prediction and one that lowers it."""
    some = results.explanations["raw"].take([0, 1])
    relevance = np.zeros(some.relevance["grad-cam"].shape, dtype=np.float32)
    relevance[1, 2, 3], relevance[1, 6, 6] = 0.4, -0.4
    frames = tuple(replace(frame, prediction=0.2, reference_prediction=1.0) for frame in some.frames)
    methods = {"grad-cam": some.methods["grad-cam"]}
    return replace(some, frames=frames, methods=methods, relevance={"grad-cam": relevance})


def test_what_raises_is_blue_and_what_lowers_is_orange(explanation):
    ax = sl.plot(explanation, index=1).axes[0]

    pixels = np.asarray(ax.images[0].get_array())
    assert pixels[2, 3, 2] > pixels[2, 3, 0]
    assert pixels[6, 6, 0] > pixels[6, 6, 2]
    assert "why 20" in ax.get_title(loc="left")


def test_the_frame_with_most_to_explain_is_drawn_with_unit_and_warnings(explanation):
    frames = (explanation.frames[0], replace(explanation.frames[1], id="most", prediction=0.1))
    notes = replace(explanation.methods["grad-cam"], warnings=("the map is flat",))
    picture, bar = sl.plot(replace(explanation, frames=frames, methods={"grad-cam": notes})).axes

    assert "most: why 10" in picture.get_title(loc="left")
    assert "untouched sensor" in picture.get_title(loc="left").replace("\n", " ")
    assert picture.get_xlabel() == "the map is flat"
    assert "per 1 % of the image" in bar.get_ylabel()


def test_a_prediction_that_is_that_of_the_baseline_has_nothing_to_explain(explanation):
    frames = tuple(replace(frame, prediction=0.99) for frame in explanation.frames)
    assert "nothing to explain" in sl.plot(replace(explanation, frames=frames)).axes[0].get_title(loc="left")


def test_what_is_not_there_and_what_has_no_picture_is_told(explanation):
    with pytest.raises(InputError, match="there is no number 2 among 2; count from 0"):
        sl.plot(explanation, index=2)
    for nothing in (SimpleNamespace(), None, ["text"], {}, np.zeros(3)):
        with pytest.raises(InputError, match=f"there is no picture of a {type(nothing).__name__}; plot a result"):
            sl.plot(nothing)
    with pytest.raises(InputError, match="nothing to draw"):
        sl.plot(())  # a check without a fault


def test_a_warning_of_other_frames_is_not_written_beneath_a_map(explanation):
    warnings = tuple(f"1 of 2 frames ({frame.id}): the map {frame.id} is flat" for frame in explanation.frames)
    notes = replace(explanation.methods["grad-cam"], warnings=warnings)
    picture, _ = sl.plot(replace(explanation, methods={"grad-cam": notes}), index=1).axes
    assert picture.get_xlabel().replace("\n", " ") == warnings[1]


def test_records_in_a_list_are_counted_or_drawn_over_time():
    faults = [Violation(where=trial, what=f"fault {number}") for number, trial in enumerate("aba")]
    for counted in (faults, tuple(faults)):
        ax = sl.plot(counted).axes[0]
        names, bars = [label.get_text() for label in ax.get_yticklabels()], cast("Any", ax.patches)
        assert dict(zip(names, (bar.get_width() for bar in bars), strict=True)) == {"a": 2, "b": 1}
    readings = [Reading(number=at, time_s=at / 30, captured_s=0.0, margin=1 - at / 10) for at in range(5)]
    [line] = [line for line in sl.plot(readings).axes[0].lines if line.get_label() == "predicted"]
    np.testing.assert_allclose(np.asarray(line.get_xydata()), [(at / 30, 100 - 10 * at) for at in range(5)])


def test_predictions_of_any_trial_are_drawn(results):
    frames: ScoredFrames = results.evaluations["raw"].predictions
    predictions = Predictions(frames=len(frames.trial), engine="torch", path=None, rows=frames.to_arrow())

    assert sl.plot(predictions, index=1).axes[0].get_title(loc="left") == "day4-dry-001"
