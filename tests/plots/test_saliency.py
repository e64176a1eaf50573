from dataclasses import replace
from pathlib import Path

import numpy as np
from made_up import explained, frames_named
from matplotlib.colors import to_rgb
from PIL import Image

from sliplens.images import read_image
from sliplens.plots.saliency import draw_explanation
from sliplens.plots.style import ORANGE, SKY
from sliplens.results.explanation import Explanation, MethodNotes, full_colour, overlay_relevance


def test_relevance_is_orange_below_zero_and_blue_above():
    relevance = np.zeros((4, 4), dtype=np.float32)
    relevance[0, 0], relevance[3, 3] = -0.2, 0.2

    painted = overlay_relevance(np.full((4, 4, 3), 100, dtype=np.uint8), relevance / full_colour(relevance))

    np.testing.assert_allclose(painted[0, 0] / 255, to_rgb(ORANGE), atol=1 / 255)
    np.testing.assert_allclose(painted[3, 3] / 255, to_rgb(SKY), atol=1 / 255)
    # where nothing happens the picture is grey
    assert len(set(painted[1, 1].tolist())) == 1


def test_relevance_of_another_size_is_laid_on_its_places():
    painted = overlay_relevance(np.zeros((8, 8, 3), dtype=np.uint8), np.array([[1.0, 0.0], [0.0, 0.0]]))

    assert painted[:4, :4].any(axis=-1).all()
    assert not painted[4:].any()
    assert not painted[:, 4:].any()


def test_the_full_colour_is_seen_however_few_pixels_speak():
    alone = np.zeros((100, 100))
    assert full_colour(alone) == 1
    alone[3, 4] = -0.01
    assert full_colour(alone) == 0.01


def test_without_relevance_the_picture_shines_through_in_grey(rng):
    picture = rng.integers(0, 256, (8, 8, 3)).astype(np.uint8)
    grey = overlay_relevance(picture, np.zeros((8, 8)))
    assert np.all(np.ptp(grey, axis=-1) == 0)
    assert np.corrcoef(grey[..., 0].ravel(), (picture @ [0.299, 0.587, 0.114]).ravel())[0, 1] > 0.999


def of_relevance(relevance: np.ndarray) -> Explanation:
    """Explanations of grey frames 0, 1, ..."""
    count, notes = len(relevance), {"occlusion": MethodNotes(seconds_per_frame=0.0, warnings=())}
    frames = frames_named([str(number) for number in range(count)], [0.2] * count, [0.2] * count)
    pictures = np.full((count, 8, 8, 3), 100, dtype=np.uint8)
    return replace(explained("difference", frames, notes, pictures, {}), relevance={"occlusion": relevance})


def test_a_frame_with_nothing_to_explain_looks_empty(tmp_path: Path):
    relevance = np.zeros((2, 8, 8), dtype=np.float32)
    relevance[0, 2:4, 2:4] = -0.2  # 80 points of margin; the second frame changes by a hundredth of a point
    relevance[1, 2:4, 2:4] = 0.000025
    explanation = of_relevance(relevance)
    draw_explanation(explanation, tmp_path)
    strong, empty = (read_image(tmp_path / "overlays" / "occlusion" / f"{one.id}.png") for one in explanation.frames)
    assert np.ptp(strong[2, 2].astype(int)) > 100
    assert np.ptp(empty.astype(int)) <= 1
    with Image.open(tmp_path / "panel.png") as panel:
        assert panel.height > 3 * 120  # two rows, and the bar of their colours


def test_a_panel_of_many_frames_shows_a_few_from_the_first_to_the_last(tmp_path: Path, monkeypatch):
    figures = []
    monkeypatch.setattr("sliplens.plots.saliency.Figure.savefig", lambda figure, *_, **__: figures.append(figure))
    draw_explanation(of_relevance(np.zeros((40, 8, 8), dtype=np.float32)), tmp_path)
    [figure] = figures
    heads = [ax.get_title().partition("\n")[0] for ax in figure.axes]
    columns = [int(head) for head in heads if head.isdigit()]
    assert (columns[0], columns[-1], len(columns)) == (0, 39, 12)
    assert set(np.diff(columns)) == {3, 4}  # 39 steps over 11 gaps
    assert "12 of 40 frames" in figure.axes[-1].get_xlabel()
    assert len(list((tmp_path / "overlays" / "occlusion").iterdir())) == 40
