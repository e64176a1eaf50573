import numpy as np
import pytest
import torch

from sliplens.codec import load_result, save_result
from sliplens.faithfulness.scoring import deletion_order
from sliplens.results.faithfulness import Remedies
from sliplens.study.choice import Material
from sliplens.study.scoring import Deletion, RemedialDeletion

STEPS = 8


@pytest.fixture(scope="module")
def remedies(material: Material) -> Remedies:
    frames = {"trained": material.trained, "explained": material.explained, "steps": STEPS}
    return RemedialDeletion(grey=Deletion(**frames).make(), **frames).make()


def test_insertion_shows_only_the_most_salient_pixels(material: Material, remedies: Remedies):
    frame, side = material.explained.frames[0], material.inputs.shape[-1]
    order = deletion_order(material.explained.saliency["grad-cam"][0])
    curve = remedies.curves["insertion", "grad-cam"][frame.id]
    for removed, prediction in zip(curve.pixels_removed, curve.predictions[0], strict=True):
        image = torch.full_like(material.inputs[0], 0.5).flatten(1)
        kept = torch.from_numpy(order[: side * side - int(removed)].copy())
        image[:, kept] = material.inputs[0].flatten(1)[:, kept]
        expected = float(material.trained.predict(image.view(1, 3, side, side))[0])
        assert prediction == pytest.approx(expected, abs=1e-5)


def test_insertion_ends_with_the_whole_image(material: Material, remedies: Remedies):
    for frame in material.explained.frames:
        curve = remedies.curves["insertion", "random"][frame.id]
        assert (curve.pixels_removed[-1], curve.scores[0, -1]) == (0, 1.0)


def test_deletion_stops_once_no_pixel_above_a_half_is_left(material: Material, remedies: Remedies):
    pixels = material.inputs.shape[-1] ** 2
    for index, frame in enumerate(material.explained.frames):
        above = int((material.explained.saliency["grad-cam"][index] > 0.5).sum())
        steps = remedies.curves["stop-at-half", "grad-cam"][frame.id].pixels_removed.tolist()
        assert steps[-1] >= above
        # one step fewer would have left some
        assert len(steps) == 1 or steps[-2] < above
        assert steps == [round(pixels * (step + 1) / STEPS) for step in range(len(steps))]


def test_the_scores_are_the_means_of_every_curve(material: Material, remedies: Remedies):
    assert remedies.variants["background"].fill == "black"
    for variant, about in remedies.variants.items():
        for method, score in about.methods.items():
            curves = remedies.curves[variant, method]
            assert set(curves) == {frame.id for frame in material.explained.frames}
            means = [curve.scores.mean() for curve in curves.values()]
            assert score.mean == pytest.approx(np.mean(means))
            assert score.sd == pytest.approx(np.std(means))
            assert score.frames == 6


def test_remedies_come_back_as_they_were(remedies: Remedies, tmp_path):
    save_result(remedies, tmp_path)
    back = load_result(tmp_path, Remedies, command="sliplens study")
    assert back.variants == remedies.variants
    assert back.alarms == remedies.alarms
    assert back.table.table().equals(remedies.table.table())
