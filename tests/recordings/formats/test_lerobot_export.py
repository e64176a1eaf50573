"""A data set that is exported as LeRobot v3.0 comes back bit by bit, and is laid out as the library itself lays one."""

import json
import tracemalloc
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from data_sets import save_dataset
from labelled import LABELLING
from readers import read_lerobot
from there import there

from sliplens.errors import InputError, RecordingError
from sliplens.images import decode_png
from sliplens.recordings import ContactState, Dataset, Recording, load_dataset
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.dataset import trial_info, trial_path, write_dataset_table
from sliplens.recordings.formats.lerobot_export import DataFiles, number_stats, write_lerobot
from sliplens.recordings.formats.stored import read_stored
from sliplens.recordings.store import forces_path, load_recording, save_forces, save_recording
from sliplens.recordings.trial import Labels
from sliplens.recordings.trial_writer import import_trial

HEIGHT, WIDTH = 24, 32
LENGTHS = {"pressed": 19, "found": 37, "wet": 5}
LIBRARY = Path(__file__).parent / "lerobot_0_4_4.json"
"""What lerobot 0.4.4 wrote for features of these kinds: `info.json`, and the Arrow types of its tables."""


def make_trial(trial: str, rng: np.random.Generator, *, count: int, **changes: Any) -> Recording:
    margin = np.linspace(1, 0, count)
    margin[0] = np.nan
    return replace(
        Recording(
            trial=trial,
            sensor="dome",
            day=3,
            condition="dry",
            reference=rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8),
            frames=rng.integers(0, 256, (count, HEIGHT, WIDTH, 3), dtype=np.uint8),
            # as a camera stamps them: no step like another, and no number that single precision holds
            time_s=1.7e9 + np.cumsum(1 / 30 + rng.uniform(-2e-4, 2e-4, count)),
            normal_force_n=rng.random(count),
            tangential_force_n=rng.random(count),
            friction_coefficient=np.full(count, 0.6),
            safety_margin=margin,
            stick_ratio=margin ** (2 / 3),
            contact_state=tuple(list(ContactState)[index % 5] for index in range(count)),
        ),
        **changes,
    )


def save_found(folder: Path, trial: Recording, rng: np.random.Generator) -> None:
    """A trial as an import leaves it: doubted labels, what they rest on, and samples of the sensor on another clock."""
    found = replace(
        trial,
        sensor="dome",
        day=3,
        object="cup",
        safety_margin_sigma=np.where(np.isnan(trial.safety_margin), np.nan, rng.random(len(trial))),
        valid=rng.random(len(trial)) < 0.5,
        reason=tuple(("", "no contact", "between slips")[index % 3] for index in range(len(trial))),
        labelling=LABELLING,
    )
    save_recording(found, trial_path(folder, trial.trial))
    times = 1.7e9 + np.cumsum(rng.uniform(1e-4, 1e-3, 500))
    samples = Forces(time_s=times, force_n=rng.normal(size=(500, 3)), source="/wrench")
    save_forces(samples, forces_path(folder, trial.trial))


@pytest.fixture
def data(tmp_path: Path, rng: np.random.Generator) -> Dataset:
    """Three trials: one without a word on trust, one from an import, one without forces, that tests."""
    folder = tmp_path / "data"
    unknown = np.full(LENGTHS["wet"], np.nan)
    blind = dict.fromkeys(("normal_force_n", "tangential_force_n", "friction_coefficient"), unknown)
    save_recording(make_trial("pressed", rng, count=LENGTHS["pressed"]), trial_path(folder, "pressed"))
    save_recording(make_trial("wet", rng, count=LENGTHS["wet"], condition="wet", **blind), trial_path(folder, "wet"))
    save_found(folder, make_trial("found", rng, count=LENGTHS["found"]), rng)
    splits = {"pressed": "train", "wet": "test", "found": "train"}
    table = [trial_info(trial_path(folder, name), split=split) for name, split in splits.items()]
    write_dataset_table(folder, table)
    return load_dataset(folder)


@pytest.fixture
def exported(tmp_path: Path, data: Dataset) -> Path:
    folder = tmp_path / "exported"
    folder.mkdir()
    write_lerobot(data, folder)
    return folder


def read_info(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "meta" / "info.json").read_text())


def read_rows(folder: Path) -> pa.Table:
    return pa.concat_tables([pq.read_table(path) for path in sorted(folder.glob("data/*/*.parquet"))])


def read_episodes(folder: Path) -> list[dict[str, Any]]:
    return pq.read_table(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()


def assert_same(first: Capture, second: Capture) -> None:
    """All that is known of two captures is the same, bit by bit, but for where they were found."""
    np.testing.assert_array_equal(list(first.read_frames()), list(second.read_frames()))
    facts = ("trial", "sensor", "day", "condition", "object", "split", "simulated")
    for name in ("frame_time_s", "frame_size", "reference", "notes", *facts):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for field in fields(Labels):
        np.testing.assert_array_equal(getattr(there(first.labels), field.name), getattr(second.labels, field.name))
    assert (first.forces is None) == (second.forces is None)
    if first.forces is not None and second.forces is not None:
        assert first.forces.source == second.forces.source
        np.testing.assert_array_equal(first.forces.time_s, second.forces.time_s)
        np.testing.assert_array_equal(first.forces.force_n, second.forces.force_n)


def test_all_that_is_known_of_a_trial_comes_back(data, exported):
    back = {capture.trial: capture for capture in read_lerobot(exported)}
    found = back["found"]
    assert (found.sensor, found.day, found.condition, found.object) == ("dome", 3, "dry", "cup")
    assert (found.split, found.simulated) == ("train", False)
    assert len(there(back["found"].forces).time_s) == 500
    assert back["wet"].forces is None
    originals = read_stored(data.folder)
    assert len(back) == len(originals) == 3
    for capture in originals:
        assert_same(capture, back[capture.trial])


def test_an_exported_trial_is_imported_as_it_was(data, exported, tmp_path, rng):
    for capture in read_lerobot(exported):
        path = tmp_path / "again" / f"{capture.trial}.parquet"
        import_trial(capture, path, rng=rng)
        original, back = load_recording(trial_path(data.folder, capture.trial)), load_recording(path)
        kept = {field.name for field in fields(Recording)}
        if original.labelling is None:  # an import tells where labels came from
            kept.remove("labelling")
        for name in kept:
            np.testing.assert_array_equal(getattr(back, name), getattr(original, name))


def test_trials_and_episodes_are_chosen(data, exported, tmp_path):
    folder = tmp_path / "one"
    folder.mkdir()
    write_lerobot(data, folder, trials=data.select(split="test"))
    assert [capture.trial for capture in read_lerobot(folder)] == ["wet"]
    # trials of a split follow each other
    assert [capture.trial for capture in read_lerobot(exported)] == ["pressed", "found", "wet"]


def test_progress_is_told_from_trial_to_trial(data, tmp_path):
    told = []
    (tmp_path / "out").mkdir()
    write_lerobot(data, tmp_path / "out", on_progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (61, 61)
    assert [done for done, _ in told] == sorted({done for done, _ in told})


def test_it_is_laid_out_as_the_library_lays_it_out(exported):
    library = json.loads(LIBRARY.read_text())
    info = read_info(exported)
    assert list(info) == list(library["info"])
    ours = {"total_episodes", "total_frames", "total_tasks", "splits", "features"}
    assert {key: value for key, value in info.items() if key not in ours} == {
        key: value for key, value in library["info"].items() if key not in ours
    }
    # of the same features it says the same; size of the image and names are ours
    for name, feature in library["info"]["features"].items():
        assert info["features"][name]["dtype"] == feature["dtype"]
        assert len(info["features"][name]["shape"]) == len(feature["shape"])
        if name in {"timestamp", "frame_index", "episode_index", "index", "task_index"}:
            assert info["features"][name] == feature
    episodes = pq.read_schema(exported / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    data = pq.read_schema(exported / "data" / "chunk-000" / "file-000.parquet")
    for schema, wanted in ((episodes, library["episodes"]), (data, library["data"])):
        assert {name: str(schema.field(name).type) for name in wanted} == wanted
    told = json.loads(data.metadata[b"huggingface"])["info"]["features"]
    assert {name: told[name] for name in library["huggingface"]} == library["huggingface"]
    assert list(told) == data.names == list(info["features"])
    stats = json.loads((exported / "meta" / "stats.json").read_text())
    assert set(stats) == set(info["features"])
    for name, wanted in library["stats"].items():
        assert {key: np.shape(value) for key, value in stats[name].items()} == {
            key: tuple(shape) for key, shape in wanted.items()
        }


def test_counts_and_places_agree(exported):
    info, episodes, rows = read_info(exported), read_episodes(exported), read_rows(exported)
    lengths = list(LENGTHS.values())
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 61, 3)
    assert info["splits"] == {"train": "0:2", "test": "2:3"}
    assert [episode["length"] for episode in episodes] == lengths
    assert [episode["dataset_from_index"] for episode in episodes] == [0, 19, 56]
    assert [episode["dataset_to_index"] for episode in episodes] == [19, 56, 61]
    np.testing.assert_array_equal(rows["index"].to_numpy(), np.arange(61))
    np.testing.assert_array_equal(rows["episode_index"].to_numpy(), np.repeat(range(3), lengths))
    in_episode = np.concatenate([np.arange(length) for length in lengths])
    np.testing.assert_array_equal(rows["frame_index"].to_numpy(), in_episode)
    # as LeRobot makes them: single precision of the frame over the rate
    np.testing.assert_array_equal(rows["timestamp"].to_numpy(), (in_episode / 30).astype(np.float32))
    tasks = pq.read_table(exported / "meta" / "tasks.parquet").to_pydict()
    assert tasks["task"] == ["touch an object (dry)", "touch cup (dry)", "touch an object (wet)"]
    assert [[tasks["task"][at]] for at in (0, 1, 2)] == [episode["tasks"] for episode in episodes]
    np.testing.assert_array_equal(rows["task_index"].to_numpy(), np.repeat(range(3), lengths))


def test_numbers_and_words_are_where_the_features_say(data, exported):
    rows, features = read_rows(exported), read_info(exported)["features"]
    (found,) = (capture for capture in read_stored(data.folder) if capture.trial == "found")
    own = rows.filter(pa.array(rows["episode_index"].to_numpy() == 1))
    labels = there(found.labels)
    force = np.array(own["observation.force"].to_pylist())
    expected = np.stack([labels.tangential_force_n, np.zeros(len(force)), labels.normal_force_n], axis=1)
    np.testing.assert_array_equal(force, expected)
    assert features["observation.force"]["names"] == ["tangential_n", "across_n", "normal_n"]
    np.testing.assert_array_equal(own["observation.safety_margin"].to_numpy(), labels.safety_margin)
    np.testing.assert_array_equal(own["observation.time_s"].to_numpy(), found.frame_time_s)
    for name, words in (("contact_state", labels.contact_state), ("invalid_reason", labels.reason)):
        values = features[f"observation.{name}"]["info"]["values"]
        assert [values[code] for code in own[f"observation.{name}"].to_pylist()] == [str(word) for word in there(words)]


def test_an_image_is_a_png_of_the_frame(data, exported):
    cells = read_rows(exported)["observation.images.tactile"].to_pylist()
    frames = load_recording(trial_path(data.folder, "pressed")).frames
    for index, frame in enumerate(frames):
        assert cells[index]["path"] == f"frame-{index:06d}.png"
        np.testing.assert_array_equal(decode_png(cells[index]["bytes"], where="a cell"), frame)


def test_statistics_are_those_of_the_numbers_that_are_known(data, exported):
    stats, episodes = json.loads((exported / "meta" / "stats.json").read_text()), read_episodes(exported)
    recordings = {info.trial: data.load(info) for info in data.trials}
    ordered = [recordings[name] for name in LENGTHS]
    margin = np.concatenate([one.safety_margin for one in ordered])
    found = stats["observation.safety_margin"]
    assert found["count"] == [61 - 3]
    assert found["min"] == [np.nanmin(margin)]
    assert found["max"] == [np.nanmax(margin)]
    # sums in another order
    np.testing.assert_allclose(found["mean"], np.nanmean(margin), rtol=1e-12)
    np.testing.assert_allclose(found["std"], np.nanstd(margin), rtol=1e-12)
    np.testing.assert_allclose(found["q90"], np.nanquantile(margin, 0.9), rtol=1e-12)
    pixels = np.concatenate([one.frames for one in ordered]).reshape(-1, 3) / 255
    shown = {key: np.ravel(value) for key, value in stats["observation.images.tactile"].items()}
    np.testing.assert_allclose(shown["mean"], pixels.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(shown["std"], pixels.std(axis=0), rtol=1e-9)
    for name, quantile in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        np.testing.assert_array_equal(shown[name], np.quantile(pixels, quantile, axis=0, method="inverted_cdf"))
    # no force is known of the last trial: a count of 0 weighs nothing, and extremes of the whole spoil none
    last = {key: value for key, value in episodes[2].items() if key.startswith("stats/observation.force/")}
    assert last["stats/observation.force/count"] == [0]
    assert last["stats/observation.force/max"] == stats["observation.force"]["max"]
    assert episodes[0]["stats/observation.valid/max"] == [True]


def test_what_is_never_known_has_zeros_for_statistics():
    stats = number_stats(np.full((4, 3), np.nan))
    assert stats["count"] == [0]
    assert all(value == [0, 0, 0] for name, value in stats.items() if name != "count")


def test_a_file_that_would_grow_too_large_is_followed_by_another(tmp_path, rng):
    features = {
        "image": {"dtype": "image", "shape": [8, 8, 3]},
        **{name: {"dtype": "int64", "shape": [1]} for name in ("episode_index", "index")},
    }
    with closing(DataFiles(tmp_path, features, file_mb=0.1)) as files:
        # 40 kB an episode: two are 80 kB, and a third would make 120 kB, more than 0.1 MB
        places = []
        for episode in range(5):
            places.append(files.begin(4))
            columns = {"episode_index": np.full(4, episode), "index": np.arange(4)}
            files.write(columns, images="image", pngs=[rng.bytes(10_000) for _ in range(4)], first=0)
    assert places == [(0, 0), (0, 0), (0, 1), (0, 1), (0, 2)]
    assert [path.name for path in files.paths] == [f"file-00{number}.parquet" for number in range(3)]
    np.testing.assert_array_equal(files.column("episode_index").ravel(), np.repeat(range(5), 4))


def test_memory_does_not_grow_with_the_length_of_a_trial(tmp_path, rng):
    peaks = []
    for count in (64, 512):
        folder, out = tmp_path / f"{count}", tmp_path / f"{count}-out"
        data = save_dataset(folder, make_trial("a", rng, count=count))
        out.mkdir()
        tracemalloc.start()
        write_lerobot(data, out)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # numbers and labels of a frame stay, some hundred bytes; its 2304 bytes of pixels must not
    assert peaks[1] - peaks[0] < (512 - 64) * HEIGHT * WIDTH * 3 / 2


@pytest.mark.parametrize(("rate", "fps"), [(30, 30), (29.97, 30), (12.5, 12.5), (0.25, 0.25)])
def test_the_rate_is_the_median_and_whole_where_it_nearly_is(tmp_path, rng, rate, fps):
    time = np.arange(9) / rate
    time[5:] += 0.7 / rate  # a frame came late, and those after it
    data = save_dataset(tmp_path / "data", make_trial("a", rng, count=9, time_s=time))
    (tmp_path / "out").mkdir()
    write_lerobot(data, tmp_path / "out")
    # the median of steps is the reciprocal of the rate up to rounding
    assert read_info(tmp_path / "out")["fps"] == pytest.approx(fps, rel=1e-12)
    assert isinstance(read_info(tmp_path / "out")["fps"], type(fps))
    np.testing.assert_array_equal(read_lerobot(tmp_path / "out")[0].frame_time_s, time)


def test_one_frame_alone_has_a_rate_too(tmp_path, rng):
    data = save_dataset(tmp_path / "data", make_trial("a", rng, count=1))
    (tmp_path / "out").mkdir()
    write_lerobot(data, tmp_path / "out")
    assert read_info(tmp_path / "out")["fps"] == 30
    assert len(list(read_lerobot(tmp_path / "out")[0].read_frames())) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time_s": np.arange(9) / 60}, "has 60 frames/s, most have .*, and a LeRobot data set has one rate"),
        (
            {"frames": np.zeros((9, 8, 8, 3), np.uint8), "reference": np.zeros((8, 8, 3), np.uint8)},
            "trial b has frames of 8 x 8 pixels, trial a of 24 x 32, and a LeRobot data set has one size",
        ),
    ],
)
def test_trials_that_do_not_go_together_are_refused(tmp_path, rng, changes, message):
    made = [make_trial(name, rng, count=9, **more) for name, more in (("a", {}), ("c", {}), ("b", changes))]
    data = save_dataset(tmp_path / "data", *made)
    (tmp_path / "out").mkdir()
    with pytest.raises(RecordingError, match=message):
        write_lerobot(data, tmp_path / "out")


def test_a_folder_that_cannot_take_it_is_refused(data, exported, tmp_path):
    with pytest.raises(InputError, match="exported holds a LeRobot data set; name a new folder"):
        write_lerobot(data, exported)
    with pytest.raises(InputError, match="nothing does not exist"):
        write_lerobot(data, tmp_path / "nothing")
    (tmp_path / "new").mkdir()
    with pytest.raises(RecordingError, match="there is no trial to export"):
        write_lerobot(data, tmp_path / "new", trials=[])


def test_an_interrupted_export_is_made_anew(data, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()

    def stop(done: int, total: int) -> None:
        if done > 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_lerobot(data, folder, on_progress=stop)
    # left behind by an attempt that was longer
    (folder / "data" / "chunk-000" / "file-007.parquet").write_bytes(b"")
    write_lerobot(data, folder)
    assert [path.name for path in folder.glob("data/*/*")] == ["file-000.parquet"]
    assert len(read_lerobot(folder)) == 3


def test_the_same_data_set_gives_the_same_files(data, exported, tmp_path):
    again = tmp_path / "again"
    again.mkdir()
    write_lerobot(data, again)
    files = sorted(path.relative_to(exported) for path in exported.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    for file in files:
        assert (exported / file).read_bytes() == (again / file).read_bytes()
