import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from sliplens.faithfulness import deletion_order
from sliplens.study.material import Material
from sliplens.study.scoring import load_curves, score_explanations, score_remedies

STEPS = 8


@pytest.fixture(scope="module")
def scored(material: Material, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, score = (tmp_path_factory.mktemp(name) for name in ("remedies", "score"))
    score_explanations(material.trained, material.explained, score, steps=STEPS)
    score_remedies(material, folder, grey=load_curves(score, material.explained), steps=STEPS)
    return folder


def rows(folder: Path, variant: str, method: str, frame: str) -> list[dict[str, Any]]:
    table = pq.read_table(folder / "deletion.parquet").to_pylist()
    return [one for one in table if (one["variant"], one["method"], one["frame_id"]) == (variant, method, frame)]


def test_insertion_shows_only_the_most_salient_pixels(material: Material, scored: Path):
    frame, side = material.explained.frames[0], material.inputs.shape[-1]
    order = deletion_order(material.explained.saliency["grad-cam"][0])
    for row in rows(scored, "insertion", "grad-cam", frame.id):
        seen = side * side - int(row["pixels_removed"])
        image = torch.full_like(material.inputs[0], 0.5).flatten(1)
        kept = torch.from_numpy(order[:seen].copy())
        image[:, kept] = material.inputs[0].flatten(1)[:, kept]
        expected = float(material.trained.predict(image.view(1, 3, side, side))[0])
        assert row["prediction"] == pytest.approx(expected, abs=1e-5)


def test_insertion_ends_with_the_whole_image(material: Material, scored: Path):
    for frame in material.explained.frames:
        last = rows(scored, "insertion", "random", frame.id)[-1]
        assert (last["pixels_removed"], last["score"]) == (0, 1.0)


def test_deletion_stops_once_no_pixel_above_a_half_is_left(material: Material, scored: Path):
    pixels = material.inputs.shape[-1] ** 2
    for index, frame in enumerate(material.explained.frames):
        above = int((material.explained.saliency["grad-cam"][index] > 0.5).sum())
        steps = [int(row["pixels_removed"]) for row in rows(scored, "stop-at-half", "grad-cam", frame.id)]
        assert steps[-1] >= above
        # one step fewer would have left some
        assert len(steps) == 1 or steps[-2] < above
        assert steps == [round(pixels * (step + 1) / STEPS) for step in range(len(steps))]


def test_the_table_holds_the_mean_of_every_curve(material: Material, scored: Path):
    told = json.loads((scored / "result.json").read_text())
    assert told["variants"]["background"]["fill"] == "black"
    for variant, about in told["variants"].items():
        for method, score in about["methods"].items():
            means = [
                np.mean([row["score"] for row in rows(scored, variant, method, frame.id)])
                for frame in material.explained.frames
            ]
            assert score["mean"] == pytest.approx(np.mean(means))
            assert score["sd"] == pytest.approx(np.std(means))
            assert score["frames"] == 6


def test_deletion_to_grey_is_read_back_as_it_was_scored(material: Material, tmp_path: Path):
    result = score_explanations(material.trained, material.explained, tmp_path, steps=STEPS)
    for name, curves in load_curves(tmp_path, material.explained).items():
        assert curves.auc.mean() == pytest.approx(result.methods[name].mean, abs=1e-5)  # of an engine, to its parity
