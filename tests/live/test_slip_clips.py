"""Labelled clips: thresholds never see the object they classify, and mistakes of a table are named."""

from pathlib import Path

import numpy as np
import pytest
from dots import draw_dots
from PIL import Image

import sliplens as sl
from sliplens.errors import InputError
from sliplens.live.slip_clips import score_guesses, threshold_left_out

PLACES = np.stack(np.meshgrid(np.arange(5) * 22.0 + 20, np.arange(5) * 22.0 + 20), axis=-1).reshape(-1, 2)


def write_lifts(folder: Path) -> Path:
    """Write lifts as folders of images: the shear grows by 0.5 px a frame, and falls by a third where one slips."""
    rows = ["file,slips,object,width"]
    for number in range(6):
        slips = number % 2
        clip = folder / f"clip{number}"
        clip.mkdir()
        for frame in range(12):
            shear = min(frame, 8) * 0.5 * (0.65 if slips and frame > 8 else 1)
            Image.fromarray(draw_dots(PLACES + np.array([0, shear]))).save(clip / f"{frame:02}.png")
        rows.append(f"clip{number},{slips},object{number // 2},{number}")
    table = folder / "lifts.csv"
    table.write_text("\n".join(rows))
    return table


def test_lifts_that_lose_shear_are_detected_and_a_decision_before_the_slip_is_blind_to_it(tmp_path):
    table = write_lifts(tmp_path)
    whole, early = sl.evaluate_slip(table), sl.evaluate_slip(table, after=8)
    scores = dict(zip(whole.scores.method.tolist(), whole.scores.balanced_accuracy.tolist(), strict=True))
    assert scores["detector"] == scores["fall of the mean shear"] == 1
    assert set(scores) >= {"frame count", "largest displacement", "gripper width"}
    assert not early.detected.any()


def test_a_threshold_is_chosen_without_the_object_it_classifies():
    labels, groups = np.array([True, False] * 4), np.repeat(np.arange(4), 2)
    separated = np.where(labels, 2.0, 1.0)
    # either sign separates; a value that names the object alone tells nothing of others
    for values, accuracy in ((separated, 1.0), (-separated, 1.0), (groups.astype(float), 0.5)):
        guess = threshold_left_out(values, labels, groups)
        assert score_guesses(guess, labels, groups)[0] == accuracy


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("file,object\na.mp4,cup", "needs the columns file and slips"),
        ("file,slips\na.mp4,maybe\nb.mp4,1", "line 2, 'slips' is 'maybe'"),
        ("file,slips\na.mp4,1\nb.mp4,1", "all labelled alike"),
        ("file,slips,start_frame\na.mp4,1,soon\nb.mp4,0,2", "line 2, 'start_frame' is 'soon'"),
        ("file,slips,start_frame\na.mp4,1,-1\nb.mp4,0,2", "count the frames from 0"),
    ],
)
def test_mistakes_of_the_table_are_named(tmp_path, text, words):
    table = tmp_path / "lifts.csv"
    table.write_text(text)
    with pytest.raises(InputError, match=words):
        sl.evaluate_slip(table)
