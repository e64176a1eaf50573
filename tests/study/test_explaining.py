"""`explain` of a data set in a folder, the strip of a trial, and the markers that prove a map."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sliplens as sl
from sliplens.errors import InputError, RecordingError
from sliplens.explainers.explain import network_inputs
from sliplens.explainers.frames import FrameSelection
from sliplens.explainers.occlusion import marker_regions, to_network_px
from sliplens.explainers.table import RECOMMENDED_METHOD
from sliplens.files import output_folder
from sliplens.images import read_image
from sliplens.models import Network
from sliplens.recordings import Dataset, Recording
from sliplens.recordings.options import ReadOptions
from sliplens.results.explanation import Explanation, Strip, load_explanation
from sliplens.simulation.trials import put_markers_back, rebuild_trial, visible_markers
from sliplens.study.explaining import explain, make_strip, prove_map

from ..conftest import make_recording
from ..helpers.own_recording import write_video

METHODS = ("grad-cam", "integrated-gradients")
MakeMaps = Callable[..., Explanation]


@pytest.fixture(scope="module")
def explain_all(network: Network, small_dataset: Dataset) -> MakeMaps:
    return partial(explain, network, small_dataset, method=METHODS, select=FrameSelection(levels=(1.0, 0.0)))


@pytest.fixture(scope="module")
def folder(explain_all: MakeMaps, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("explained") / "maps"
    explain_all(out=target)
    return target


def require_same(first: Explanation, second: Explanation) -> None:
    assert first.frames == second.frames
    for name in ("images", "references", "pictures"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for method in METHODS:
        np.testing.assert_array_equal(first.relevance[method], second.relevance[method])
        np.testing.assert_array_equal(first.saliency[method], second.saliency[method])


def test_a_folder_holds_the_record_that_is_returned_without_one(explain_all: MakeMaps, network: Network, folder: Path):
    progress = []
    explanation = explain_all(on_progress=lambda *step: progress.append(step))
    assert progress[-1] == (4, 4)
    saved = load_explanation(folder)
    require_same(saved, explanation)
    assert list(saved.methods) == list(METHODS)
    predictions = network.predict(network_inputs(network, saved)).numpy()
    np.testing.assert_allclose([frame.prediction for frame in saved.frames], predictions, atol=1e-6)


def test_a_complete_folder_is_read_and_not_made_again(explain_all: MakeMaps, folder: Path):
    progress = []
    again = explain_all(out=folder, on_progress=lambda *step: progress.append(step))
    assert not progress
    assert again.methods == load_explanation(folder).methods


def part_times(parts: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in parts.rglob("arrays.npz")}


def test_an_interrupted_explanation_continues_after_the_last_map(explain_all: MakeMaps, folder: Path, tmp_path: Path):
    def interrupt(done: int, total: int) -> None:
        assert total == 4
        if done == 3:
            raise KeyboardInterrupt

    out, parts = tmp_path / "maps", tmp_path / ".maps.partial" / "parts"
    with pytest.raises(KeyboardInterrupt):
        explain_all(out=out, on_progress=interrupt)
    before = part_times(parts)
    assert len(before) == 3
    overlays = [read_image(path) for path in (parts.parent / "overlays").rglob("*.png")]  # each whole, at once
    assert len(overlays) == 3
    after: dict[str, int] = {}
    explain_all(out=out, on_progress=lambda *_: after.update(part_times(parts)))
    assert before.items() <= after.items()  # the three maps were not made again
    require_same(load_explanation(out), load_explanation(folder))


def test_a_failure_after_the_last_map_loses_none(
    explain_all: MakeMaps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def fail(*_: object, **__: object) -> None:
        raise OSError("no space left on device")

    out = tmp_path / "maps"
    with monkeypatch.context() as patch:
        patch.setattr("sliplens.plots.saliency.draw_explanation", fail)
        with pytest.raises(OSError, match="no space left"):
            explain_all(method="grad-cam", out=out)
    monkeypatch.setattr("sliplens.explainers.cam.capture", fail)  # no map is made again
    assert len(explain_all(method="grad-cam", out=out).frames) == 2
    assert not (out / "parts").exists()


def test_maps_are_the_same_in_another_process(explain_all: MakeMaps, folder: Path, tmp_path: Path, elsewhere: str):
    require_same(explain_all(out=tmp_path / "maps", on=elsewhere), load_explanation(folder))


def test_a_folder_of_another_stage_is_refused(tmp_path: Path):
    with output_folder(tmp_path / "run", stage="train", config={}) as out:
        (out.folder / "result.json").write_text("{}")
    with pytest.raises(InputError, match="holds no explanations; make them with sliplens explain"):
        load_explanation(tmp_path / "run")


@pytest.fixture(scope="module")
def strip(network: Network) -> Strip:
    levels = (10 / 11, 6 / 11, 0.0)
    return make_strip(network, make_recording("t"), source="simulated", levels=levels)


def test_a_strip_shows_the_frames_nearest_to_its_levels(strip):
    margins = strip.readings.safety_margin[list(strip.shown)]
    # 12 frames fall evenly from 1 to 0, and the first has no contact
    assert margins == pytest.approx([10 / 11, 6 / 11, 0.0])
    assert np.array_equal(strip.pictures, make_recording("t").frames[list(strip.shown)])


def test_a_strip_compares_with_the_last_frame_before_the_pull(strip, network):
    assert strip.baseline == "stick"
    assert strip.shown[0] == 1  # the stick frame itself
    np.testing.assert_allclose(strip.relevance[0], 0, atol=1e-9)
    untouched = make_strip(network, make_recording("t"), source="simulated", levels=(0.0,), baseline="untouched")
    assert untouched.baseline == "untouched"


def test_a_strip_is_explanation_by_the_recommended_method_of_tiles_where_no_markers_show(strip):
    assert strip.method == RECOMMENDED_METHOD.removesuffix("-marker")


def test_explain_takes_the_facts_that_predict_takes(network: Network, small_dataset: Dataset, tmp_path: Path):
    recording = small_dataset.load(small_dataset.trials[-1])
    video = write_video(recording, tmp_path / "cup.mkv")
    options: dict[str, Any] = {"method": "grad-cam"}
    chosen = explain(network, small_dataset, trial=recording.trial, select=FrameSelection(levels=(0.0,)), **options)
    assert list(chosen.trials) == [recording.trial]
    whole = explain(network, recording, **options)  # with its labels, which name the stick frame
    assert whole.baseline == "stick"
    row = int(chosen.frames[0].id.rpartition("f")[2])
    np.testing.assert_allclose(whole.relevance["grad-cam"][row], chosen.relevance["grad-cam"][0], atol=1e-6)
    # an untouched frame is taken for the reference, as by `predict`
    shown = replace(network, manifest=replace(network.manifest, input="signed"))
    facts: dict[str, Any] = {}
    for source, facts in ((video, {}), (str(video), {"format": "video", "options": ReadOptions(frame_rate=25.0)})):
        assumed = explain(shown, source, baseline="untouched", **options, **facts)
        assert "first frame was taken for the untouched sensor" in " ".join(assumed.methods["grad-cam"].warnings)
        given = explain(shown, source, baseline="untouched", **options, **facts, reference_frame=0)
        np.testing.assert_array_equal(assumed.images, given.images)
        assert len(assumed.frames) == sl.predict(shown, source, **facts).frames
    for facts in ({"reference": recording.reference}, {"reference_frame": 0}, {"options": ReadOptions()}):
        with pytest.raises(InputError, match=f"leave out --{next(iter(facts)).replace('_', '-')}"):
            explain(network, small_dataset, **facts)


def test_a_strip_reads_as_the_network_does(strip, network):
    recording = make_recording("t")
    answers = network.predict(network.encode(recording.frames, recording.reference)).numpy()
    # float32 answers of the same passes, kept as float64
    assert strip.readings.prediction == pytest.approx(answers, abs=1e-6)
    assert np.isnan(strip.readings.safety_margin[0])


def test_a_trial_without_labels_is_refused(network):
    recording = make_recording("t")
    recording.safety_margin[:] = np.nan
    with pytest.raises(RecordingError, match="no labelled frame"):
        make_strip(network, recording, source="real")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("proof") / "data"
    data = sl.simulate(folder, preset="thesis", dry_trials=4, wet_trials=0, days=4, frames_per_trial=24)
    recording = data.load(data.trials[0])
    slips = np.flatnonzero(recording.safety_margin <= 0.1)
    stick = int(np.flatnonzero(recording.safety_margin > 0.97)[-1])
    return data, recording, int(slips[0]), stick


def paint(thesis, recording, film, frame, weights):
    """Map with a weight on each visible marker, and its markers."""
    visible, size = visible_markers(film.sensor), thesis.manifest.image_size
    centres = to_network_px(film.marker_px[frame][visible], recording.frames.shape[1:3], image_size=size)
    regions = marker_regions((size, size), centres).numpy()
    values = np.append(weights(len(visible)), 0.0)
    return visible, (values / np.bincount(regions.ravel(), minlength=len(values)))[regions].astype(np.float32)


def test_the_fewest_markers_with_half_of_the_relevance_are_moved(scene):
    data, recording, frame, stick = scene
    thesis, film = sl.load("thesis-difference"), rebuild_trial(data.folder, recording)

    def weights(count: int) -> np.ndarray:
        values = np.full(count, -0.001)
        values[[3, 5, 8]] = -0.4, -0.3, -0.2  # two hold over half of about 0.94
        return values

    visible, relevance = paint(thesis, recording, film, frame, weights)
    proof = prove_map(
        thesis, data.folder, recording, frame=frame, stick=stick, relevance=relevance, rng=np.random.default_rng(1)
    )
    assert proof is not None
    record, drawn = proof
    np.testing.assert_allclose(record.from_px, film.marker_px[frame][visible[[3, 5]]])
    back = np.zeros((3, len(film.marker_rest_px)), dtype=bool)
    back[1, visible[[3, 5]]] = back[2, visible] = True
    images = put_markers_back(film, frame, back, to=stick).draw_all()
    now, after, all_back = thesis.predict(thesis.encode(images, recording.reference)).tolist()
    np.testing.assert_array_equal(drawn[0], images[1])
    assert record.prediction == pytest.approx(now, abs=1e-6)
    assert record.change == pytest.approx(now - after, abs=1e-6)
    assert record.change_all == pytest.approx(now - all_back, abs=1e-6)
    assert now < all_back  # a slipping frame, and the same with its markers where they stuck
    assert np.isfinite(record.change_random)


def test_a_map_that_supports_nothing_and_a_trial_that_is_not_simulated_prove_nothing(scene):
    data, recording, frame, stick = scene
    thesis, film = sl.load("thesis-difference"), rebuild_trial(data.folder, recording)
    _, opposing = paint(thesis, recording, film, frame, lambda count: np.full(count, 0.1))

    def prove(trial: Recording, relevance: np.ndarray) -> object:
        rng = np.random.default_rng(0)
        return prove_map(thesis, data.folder, trial, frame=frame, stick=stick, relevance=relevance, rng=rng)

    assert prove(recording, opposing) is None
    assert prove(recording, -opposing) is not None
    assert prove(replace(recording, truth=None), -opposing) is None
