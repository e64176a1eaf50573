from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from sliplens.errors import InputError
from sliplens.files import to_jsonable
from sliplens.plots.errors import draw_evaluation
from sliplens.training import regression_scores
from sliplens.training.evaluate import Reliability, lead_times


def evaluation(*, sure: bool = True) -> tuple[pa.Table, dict[str, Any]]:
    """Two dry trials that are read well, and a wet one that is read too high."""
    rng = np.random.default_rng(0)
    time = np.arange(60) / 8
    columns: dict[str, list] = {name: [] for name in ("trial", "condition", "time_s", "safety_margin", "prediction")}
    for trial, condition, bias in (("a", "dry", 0.0), ("b", "dry", 0.03), ("c_$1", "wet", 0.2)):
        labels = np.clip(1.1 - time / 6.5, 0, 1)
        columns["trial"] += [trial] * len(time)
        columns["condition"] += [condition] * len(time)
        columns["time_s"] += time.tolist()
        columns["safety_margin"] += labels.tolist()
        columns["prediction"] += (labels + bias + rng.normal(0, 0.04, len(time))).tolist()
    table = {name: np.array(values) for name, values in columns.items()}
    if sure:
        table["sigma"] = np.where(table["condition"] == "wet", 0.12, 0.05) * rng.uniform(0.7, 1.3, len(table["trial"]))
        table["low_90"] = np.clip(table["prediction"] - 1.6 * table["sigma"], 0, 1)
        table["high_90"] = np.clip(table["prediction"] + 1.6 * table["sigma"], 0, 1)
    told: dict[str, Any] = {"conditions": {}, "trials": {}, "reliability": {}, "lead_times": {}}
    for name in ("dry", "wet"):
        rows = table["condition"] == name
        labels, answers = table["safety_margin"][rows], table["prediction"][rows]
        told["conditions"][name] = regression_scores(labels, answers)
        shares = {"0.5": 0.48, "0.9": 0.88 if name == "dry" else 0.6} if sure else {}
        told["reliability"][name] = Reliability(coverage=shares, mean_width_90=None)
        told["lead_times"][name] = lead_times(table["trial"][rows].tolist(), table["time_s"][rows], labels, answers)
    for name in np.unique(table["trial"]):
        rows = table["trial"] == name
        told["trials"][str(name)] = regression_scores(table["safety_margin"][rows], table["prediction"][rows])
    told["wet_auroc"] = 0.97 if sure else None
    return pa.table({name: values.tolist() for name, values in table.items()}), to_jsonable(told)


@pytest.mark.parametrize("sure", [True, False])
def test_the_picture_of_an_evaluation_is_drawn_with_and_without_uncertainty(tmp_path: Path, sure: bool):
    draw_evaluation(*evaluation(sure=sure), tmp_path / "page.png", title="train-difference, test trials")
    with Image.open(tmp_path / "page.png") as image:
        pixels = np.array(image.convert("L"))
    # 12 inches at 150 dots, and something is drawn in every third of it
    assert pixels.shape[1] == 1800
    assert all(part.std() > 10 for part in np.array_split(pixels, 3, axis=1))


def test_the_same_numbers_give_the_same_picture(tmp_path: Path):
    for name in "ab":
        draw_evaluation(*evaluation(), tmp_path / f"{name}.png", title="same")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def with_estimators(told: dict[str, Any], *, r2: float) -> dict[str, Any]:
    """Two estimators beside the network."""
    scores = {name: {**told["conditions"][name], "r2": r2, "mae": 0.2} for name in told["conditions"]}
    lost = {name: {**one, "r2": None} for name, one in scores.items()}
    return {**told, "baselines": {"estimators": {"a": {"conditions": scores}, "b": {"conditions": lost}}}}


def test_estimators_stand_below_a_page_that_stays_as_it_was(tmp_path: Path):
    table, told = evaluation()
    pictures = []
    for name, own in (("none", told), ("half", with_estimators(told, r2=0.5)), ("bad", with_estimators(told, r2=-7.0))):
        draw_evaluation(table, own, tmp_path / f"{name}.png", title="same")
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
        draw_evaluation(*evaluation(), tmp_path / "page.doc", title="no")
