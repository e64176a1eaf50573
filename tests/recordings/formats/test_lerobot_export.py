"""Exported LeRobot v3.0 data sets are laid out as the library itself lays them out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from data_sets import save_dataset
from exportable import LENGTHS, make_trial
from there import there

from sliplens.images import read_image
from sliplens.recordings import Dataset
from sliplens.recordings.exporting import export_lerobot
from sliplens.recordings.formats.lerobot_export import number_stats
from sliplens.recordings.formats.stored import read_stored

LIBRARY = Path(__file__).parent / "lerobot_0_4_4.json"
"""Output of lerobot 0.4.4 for features of these kinds: `info.json`, and the Arrow types of its tables."""


@pytest.fixture(scope="module")
def exported(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "robot"
    export_lerobot(data, folder)
    return folder


def read_info(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "meta" / "info.json").read_text())


def read_rows(folder: Path) -> pa.Table:
    return pa.concat_tables([pq.read_table(path) for path in sorted(folder.glob("data/*/*.parquet"))])


def read_episodes(folder: Path) -> list[dict[str, Any]]:
    return pq.read_table(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()


def test_it_is_laid_out_as_the_library_lays_it_out(exported):
    library = json.loads(LIBRARY.read_text())
    info = read_info(exported)
    assert list(info) == list(library["info"])
    ours = {"total_episodes", "total_frames", "total_tasks", "splits", "features"}
    assert {**info, **dict.fromkeys(ours)} == {**library["info"], **dict.fromkeys(ours)}
    # of the same features it says the same; size of the image and names are ours
    for name, feature in library["info"]["features"].items():
        assert info["features"][name]["dtype"] == feature["dtype"]
        assert len(info["features"][name]["shape"]) == len(feature["shape"])
        if name in {"timestamp", "frame_index", "episode_index", "index", "task_index"}:
            assert info["features"][name] == feature
    episodes = pq.read_schema(exported / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    rows = pq.read_schema(exported / "data" / "chunk-000" / "file-000.parquet")
    for schema, expected in ((episodes, library["episodes"]), (rows, library["data"])):
        assert {name: str(schema.field(name).type) for name in expected} == expected
    described = json.loads(rows.metadata[b"huggingface"])["info"]["features"]
    assert {name: described[name] for name in library["huggingface"]} == library["huggingface"]
    assert list(described) == rows.names == list(info["features"])
    stats = json.loads((exported / "meta" / "stats.json").read_text())
    assert set(stats) == set(info["features"])
    for name, expected in library["stats"].items():
        assert {key: np.shape(value) for key, value in stats[name].items()} == {
            key: tuple(shape) for key, shape in expected.items()
        }


def test_counts_and_places_agree(exported):
    info, episodes, rows = read_info(exported), read_episodes(exported), read_rows(exported)
    lengths = list(LENGTHS.values())
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 62, 2)
    assert info["splits"] == {"train": "0:2", "test": "2:3"}
    assert [episode["length"] for episode in episodes] == lengths
    assert [episode["data/file_index"] for episode in episodes] == [0, 1, 2]
    assert [episode["dataset_from_index"] for episode in episodes] == [0, 40, 57]
    assert [episode["dataset_to_index"] for episode in episodes] == [40, 57, 62]
    np.testing.assert_array_equal(rows["index"].to_numpy(), np.arange(62))
    np.testing.assert_array_equal(rows["episode_index"].to_numpy(), np.repeat(range(3), lengths))
    in_episode = np.concatenate([np.arange(length) for length in lengths])
    np.testing.assert_array_equal(rows["frame_index"].to_numpy(), in_episode)
    # as LeRobot makes them: single precision of the frame over the rate
    np.testing.assert_array_equal(rows["timestamp"].to_numpy(), (in_episode / 30).astype(np.float32))
    tasks = pq.read_table(exported / "meta" / "tasks.parquet").to_pydict()
    assert tasks["task"] == ["touch cup (wet)", "touch an object (wet)"]
    assert [episode["tasks"] for episode in episodes] == [[tasks["task"][at]] for at in (0, 0, 1)]
    np.testing.assert_array_equal(rows["task_index"].to_numpy(), np.repeat([0, 0, 1], lengths))


def test_features_hold_the_labels_and_images_of_the_frames(data, exported):
    rows, features = read_rows(exported).slice(0, 40), read_info(exported)["features"]
    first = read_stored(data.folder)[0]
    labels = there(first.labels)
    expected = np.stack([labels.tangential_force_n, np.zeros(40), labels.normal_force_n], axis=1)
    np.testing.assert_array_equal(np.array(rows["observation.force"].to_pylist()), expected)
    assert features["observation.force"]["names"] == ["tangential_n", "across_n", "normal_n"]
    for name in ("friction_coefficient", "safety_margin", "safety_margin_sigma", "stick_ratio", "valid"):
        np.testing.assert_array_equal(rows[f"observation.{name}"].to_numpy(), getattr(labels, name))
    np.testing.assert_array_equal(rows["observation.time_s"].to_numpy(), first.frame_time_s)
    for name, words in (("contact_state", labels.contact_state), ("invalid_reason", labels.reason)):
        values = features[f"observation.{name}"]["info"]["values"]
        assert [values[code] for code in rows[f"observation.{name}"].to_pylist()] == [*map(str, there(words))]
    cells = rows["observation.images.tactile"].to_pylist()
    for index, frame in enumerate(first.read_frames()):
        assert cells[index]["path"] == f"frame-{index:06d}.png"
        np.testing.assert_array_equal(read_image(cells[index]["bytes"], where="a cell"), frame)


def test_statistics_are_those_of_the_finite_numbers(data, exported):
    stats, episodes = json.loads((exported / "meta" / "stats.json").read_text()), read_episodes(exported)
    recordings = [data.load(info) for info in data.trials]
    margin = np.concatenate([recording.safety_margin for recording in recordings])
    margins = stats["observation.safety_margin"]
    assert margins["count"] == [62 - 3]
    assert margins["min"] == [np.nanmin(margin)]
    assert margins["max"] == [np.nanmax(margin)]
    # sums in another order
    np.testing.assert_allclose(margins["mean"], np.nanmean(margin), rtol=1e-12)
    np.testing.assert_allclose(margins["std"], np.nanstd(margin), rtol=1e-12)
    np.testing.assert_allclose(margins["q90"], np.nanquantile(margin, 0.9), rtol=1e-12)
    pixels = np.concatenate([recording.frames for recording in recordings]).reshape(-1, 3) / 255
    images = {key: np.ravel(value) for key, value in stats["observation.images.tactile"].items()}
    np.testing.assert_allclose(images["mean"], pixels.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(images["std"], pixels.std(axis=0), rtol=1e-9)
    for name, quantile in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        np.testing.assert_array_equal(images[name], np.quantile(pixels, quantile, axis=0, method="inverted_cdf"))
    # no force is known of the last trial: a count of 0 weighs nothing, and extremes of the whole spoil none
    assert episodes[2]["stats/observation.force/count"] == [0]
    assert episodes[2]["stats/observation.force/max"] == stats["observation.force"]["max"]
    assert episodes[0]["stats/observation.valid/max"] == [True]
    unknown = number_stats(np.full((4, 3), np.nan))
    assert unknown.pop("count") == [0]
    assert all(value == [0, 0, 0] for value in unknown.values())


@pytest.mark.parametrize(
    ("rate", "fps", "count"), [(30, 30, 9), (29.97, 30, 9), (12.5, 12.5, 9), (0.25, 0.25, 9), (7, 30, 1)]
)
def test_the_rate_is_the_median_and_whole_where_it_nearly_is(tmp_path, rng, rate, fps, count):
    trial = make_trial("a", rng, count=count)
    trial.time_s[:] = np.arange(count) / rate
    trial.time_s[5:] += 0.7 / rate  # a frame came late, and those after it
    export_lerobot(save_dataset(tmp_path / "data", trial), tmp_path / "out")
    # the median of steps is the reciprocal of the rate up to rounding; of one frame there is none
    assert read_info(tmp_path / "out")["fps"] == pytest.approx(fps, rel=1e-12)
    assert isinstance(read_info(tmp_path / "out")["fps"], type(fps))
