"""`sliplens explain`: the folder it makes, and what is said to mistakes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import typed
from PIL import Image

from sliplens.explainers.occlusion import marker_regions
from sliplens.files import read_json
from sliplens.images import read_image
from sliplens.recordings import Dataset
from sliplens.results.explanation import load_explanation

QUICK = ("--method", "grad-cam", "occlusion")


def run(*words: object) -> None:
    typed("explain", *words)


def test_maps_overlays_and_a_panel(difference_run: Path, small_dataset: Dataset, tmp_path: Path, capsys):
    output = tmp_path / "maps"
    run(difference_run, small_dataset.folder, "-o", output, *QUICK, "--levels", 1, 0)
    explained = load_explanation(output)
    assert list(explained.relevance) == ["grad-cam", "occlusion"]
    for method in explained.relevance:
        assert explained.relevance[method].dtype == np.float32
        overlays = output / "overlays" / method
        assert {path.stem for path in overlays.iterdir()} == {frame.id for frame in explained.frames}
        for frame, relevance in zip(explained.frames, explained.relevance[method], strict=True):
            picture = read_image(overlays / f"{frame.id}.png")
            assert picture.shape == (32, 32, 3)
            # colour is relevance: where there is none the picture is grey, what raises is blue and what lowers orange
            red, _, blue = picture.astype(int).transpose(2, 0, 1)
            assert (red == blue)[relevance == 0].all()
            assert (blue >= red)[relevance > 0].all()
            assert (red >= blue)[relevance < 0].all()
    # a row for the input and for each method, a column for each frame
    with Image.open(output / "panel.png") as panel:
        assert panel.height > panel.width
    told = capsys.readouterr().err
    notes = {note for one in read_json(output / "result.json")["methods"].values() for note in one["warnings"]}
    assert 1 <= told.count("note: ") <= len(notes)  # what several methods warn of, or other numbers, is told once
    run(difference_run, small_dataset.folder, "-o", output, *QUICK, "--levels", 1, 0)
    assert "kept" in capsys.readouterr().out


def test_a_budget_reaches_poly_cam(difference_run: Path, difference_folder: Path, tmp_path: Path, monkeypatch):
    budgets = []

    def interrupt(network, chosen, explainer, rows, **_):
        budgets.append(explainer.budget)
        raise KeyboardInterrupt

    monkeypatch.setattr("sliplens.study.explaining.explain_rows", interrupt)
    words = ("--budget", 0.25, "--method", "poly-cam", "-o", tmp_path / "maps")
    with pytest.raises(KeyboardInterrupt):
        run(difference_run, "--frames", difference_folder, *words)
    assert budgets == [0.25]


def test_expected_gradients_take_the_frames_without_slip(
    difference_run: Path, small_dataset: Dataset, tmp_path: Path, capsys
):
    common = ("--method", "expected-gradients", "--levels")
    run(difference_run, small_dataset.folder, "-o", tmp_path / "with", *common, 1, 0)
    assert "no background" not in capsys.readouterr().err
    run(difference_run, small_dataset.folder, "-o", tmp_path / "without", *common, 0)
    assert "no background was given" in capsys.readouterr().err.replace("\n", " ")


MARKERS = torch.tensor([[8.0, 8.0], [24.0, 9.0], [15.0, 22.0]])


def test_markers_are_occluded_where_each_frame_has_them(
    difference_run: Path, small_dataset: Dataset, tmp_path: Path, monkeypatch
):
    asked = []

    def places(recording, row, *, image_size):
        asked.append(f"{recording.trial}-f{row:04d}")
        return MARKERS + len(asked)  # elsewhere in every frame

    monkeypatch.setattr("sliplens.explainers.frames.markers_in_recording", places)
    words = ("--method", "occlusion-marker", "--baseline", "untouched")
    run(difference_run, small_dataset.folder, "-o", tmp_path / "maps", *words)
    explained = load_explanation(tmp_path / "maps")
    assert explained.baseline == "untouched"
    assert asked == [frame.id for frame in explained.frames]
    for number, relevance in enumerate(explained.relevance["occlusion-marker"], start=1):
        regions = marker_regions((32, 32), MARKERS + number).numpy()
        # each marker has one value, and so has what lies between them
        assert all(np.ptp(relevance[regions == region]) == 0 for region in range(4))
        assert np.unique(relevance).size > 1
