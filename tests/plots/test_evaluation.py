from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up import made_up_evaluation
from PIL import Image

from sliplens.errors import InputError
from sliplens.plots.errors import draw_evaluation
from sliplens.results.evaluation import Baselines, BaselineScores, Evaluation, ScoredFrames


def evaluation(*, sure: bool = True) -> Evaluation:
    """Two dry trials that are read well, and a wet one that is read too high."""
    rng = np.random.default_rng(0)
    time = np.arange(60) / 8
    labels = np.clip(1.1 - time / 6.5, 0, 1)
    bias = np.repeat([0.0, 0.03, 0.2], 60)
    condition = np.repeat(["dry", "dry", "wet"], 60)
    answers = np.tile(labels, 3) + bias + rng.normal(0, 0.04, 180)
    sigma = np.where(condition == "wet", 0.12, 0.05) * rng.uniform(0.7, 1.3, 180) if sure else np.full(180, np.nan)
    predictions = ScoredFrames(
        trial=np.repeat(["a", "b", "c_$1"], 60),
        condition=condition,
        day=np.zeros(180, dtype=np.int64),
        frame=np.tile(np.arange(60), 3),
        time_s=np.tile(time, 3),
        safety_margin=np.tile(labels, 3),
        prediction=answers,
        sigma=sigma,
        low_90=np.clip(answers - 1.6 * sigma, 0, 1),
        high_90=np.clip(answers + 1.6 * sigma, 0, 1),
        withheld=np.full(180, ""),
    )
    return made_up_evaluation(predictions, sure=sure)


@pytest.mark.parametrize("sure", [True, False])
def test_the_picture_of_an_evaluation_is_drawn_with_and_without_uncertainty(tmp_path: Path, sure: bool):
    draw_evaluation(evaluation(sure=sure), tmp_path / "page.png", title="train-difference, test trials")
    with Image.open(tmp_path / "page.png") as image:
        pixels = np.array(image.convert("L"))
    # 12 inches at 150 dots, and something is drawn in every third of it
    assert pixels.shape[1] == 1800
    assert all(part.std() > 10 for part in np.array_split(pixels, 3, axis=1))


def test_the_same_numbers_give_the_same_picture(tmp_path: Path):
    for name in "ab":
        draw_evaluation(evaluation(), tmp_path / f"{name}.png", title="same")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def with_estimators(found: Evaluation, *, r2: float) -> Evaluation:
    """Two estimators beside the network."""
    scores = {name: replace(one, r2=r2, mae=0.2) for name, one in found.conditions.items()}
    lost = {name: replace(one, r2=None) for name, one in scores.items()}
    baselines = Baselines(
        markers="chromatouch",
        hold="found",
        offered_trials=3,
        training_trials=3,
        known_trials=0,
        shared_trials=0,
        training_frames=60,
        followed=1.0,
        failed={},
        estimators={
            name: BaselineScores(conditions=one, lead_times=found.lead_times)
            for name, one in (("a", scores), ("b", lost))
        },
    )
    return replace(found, baselines=baselines)


def test_estimators_stand_below_a_page_that_stays_as_it_was(tmp_path: Path):
    found = evaluation()
    pictures = []
    for name, own in (
        ("none", found),
        ("half", with_estimators(found, r2=0.5)),
        ("bad", with_estimators(found, r2=-7.0)),
    ):
        draw_evaluation(own, tmp_path / f"{name}.png", title="same")
        with Image.open(tmp_path / f"{name}.png") as image:
            pictures.append(np.array(image.convert("RGB")).astype(int))
    plain, half, bad = pictures
    # letters may fall between pixels otherwise where the page is taller; nothing moves by a whole one
    assert np.abs(half[: len(plain)] - plain).mean() < 1.0
    below = half[len(plain) :]
    assert len(below) > 150
    orange = np.abs(below - (230, 159, 0)).max(axis=-1) < 20
    blue = np.abs(below - (0, 114, 178)).max(axis=-1) < 20
    assert orange.sum() > 1000
    assert blue.sum() > 1000
    assert not np.array_equal(half, bad)
    assert bad.shape == half.shape


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="does not end in"):
        draw_evaluation(evaluation(), tmp_path / "page.doc", title="no")
