"""Arrays of frames and forces: the same recording as images and a table, or one sentence."""

from pathlib import Path

import numpy as np
import pytest
from own_recording import write_forces, write_images
from readers import read_arrays, refused
from there import there

from sliplens.recordings import Dataset, ReadOptions, Recording, import_recordings

COUNT = 6
Arrays = dict[str, np.ndarray]


@pytest.fixture
def arrays(rng: np.random.Generator) -> Arrays:
    return {
        "frames": rng.integers(0, 256, (COUNT, 8, 10, 3), dtype=np.uint8),
        "time_s": np.arange(COUNT) / 30,
        **{name: rng.normal(size=COUNT) for name in ("fx", "fy", "fz")},
        "labels": np.array(["x"] * COUNT),
    }


def write(path: Path, arrays: Arrays) -> Path:
    if path.suffix == ".npz":
        np.savez_compressed(path, **arrays)  # pyright: ignore[reportArgumentType]
    else:
        with pytest.importorskip("h5py").File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array.astype("S") if array.dtype.kind == "U" else array
    return path


@pytest.mark.parametrize("name", ["a.npz", "a.h5"])
def test_arrays_give_the_data_set_of_images_and_a_table(trials: dict[str, Recording], tmp_path: Path, name: str):
    trial = trials["chromatouch"]
    write_images(tmp_path / "a", trial.frames)
    table = write_forces(trial, tmp_path / "forces.csv")
    time_s, *force = np.loadtxt(table, delimiter=",", skiprows=1).T
    times_ms = 1000 * (time_s[0] + np.arange(len(trial)) / 30)
    rows = (f"{number}.png,{time!r}\n" for number, time in enumerate(times_ms.tolist()))
    (tmp_path / "times.csv").write_text("file,t [ms]\n" + "".join(rows))
    source = write(
        tmp_path / name,
        {"images": trial.frames, "t [ms]": times_ms, "force_time_s": time_s, "forces_n": np.stack(force, axis=1)},
    )
    reading = ReadOptions(times=tmp_path / "times.csv", forces=table)

    def imported(source: Path, out: str, reading: ReadOptions | None) -> Dataset:
        return import_recordings(source, out=tmp_path / out, sensor="tip", reading=reading)

    first, second = imported(tmp_path / "a", "images", reading), imported(source, "arrays", None)
    expected, actual = (data.load(data.trials[0]) for data in (first, second))
    for field in ("frames", "time_s", "reference", "safety_margin", "safety_margin_sigma", "valid", "normal_force_n"):
        np.testing.assert_array_equal(getattr(actual, field), getattr(expected, field))
    assert actual.trial == expected.trial
    assert first.trials[0].forces_sha256 != ""
    forces = [there(data.open(data.trials[0]).forces).force_n for data in (first, second)]
    np.testing.assert_array_equal(forces[1], forces[0])


@pytest.mark.parametrize("name", ["a.npz", "a.h5"])
def test_names_and_units_are_those_of_tables(tmp_path: Path, arrays: Arrays, name: str):
    force = np.stack([arrays.pop(axis) for axis in ("fx", "fy", "fz")], axis=1)
    frames = np.asfortranarray(arrays["frames"])  # as a transposed array is stored
    plain = {"frames": frames, "t [ms]": 1000 * arrays["time_s"], "reference": frames[2]}
    capture = read_arrays(write(tmp_path / name, plain | {"force_mn": 1000 * force, "ids": np.arange(3)}))
    np.testing.assert_array_equal(list(capture.read_frames()), arrays["frames"])
    np.testing.assert_array_equal(capture.reference, arrays["frames"][2])
    np.testing.assert_allclose(capture.frame_time_s, arrays["time_s"])
    np.testing.assert_array_equal(there(capture.forces).time_s, capture.frame_time_s)
    np.testing.assert_allclose(there(capture.forces).force_n, force)
    capture = read_arrays(
        write(tmp_path / f"b{name}", plain | {"normal": force[:, 2], "ft": force[:, 0]}), frame_rate=5.0
    )
    np.testing.assert_allclose(there(capture.forces).force_n[:, [2, 0]], force[:, [2, 0]])
    np.testing.assert_allclose(capture.frame_time_s, np.arange(COUNT) / 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": None}, "holds .*fx.*; name the array of its frames 'frames'"),
        ({"frames": np.zeros((COUNT, 8, 10, 3))}, r"hold float64, and sliplens takes 8-bit RGB \(uint8\)"),
        ({"frames": np.array([{}] * COUNT)}, "hold object, and sliplens takes"),
        ({"frames": np.zeros((COUNT, 8, 10), dtype=np.uint8)}, "which does not end in"),
        ({"frames": np.zeros((0, 8, 10, 3), dtype=np.uint8)}, "has 0 of 'frames'"),
        ({"reference": np.zeros((8, 9, 3), dtype=np.uint8)}, "reference of .* store both alike"),
        ({"time_s": np.arange(COUNT + 1) / 30}, "6 of 'frames' but 7 of 'time_s'"),
        ({"fy": np.zeros(COUNT - 1)}, "but 5 of 'fy'; give as many, or force_time_s"),
        ({"fy": None}, "no columns that look like forces"),
        ({"fy": np.array([{}] * COUNT)}, "no columns that look like forces"),
        ({"time_s": None}, "no columns that look like the time"),
        ({"time_s": np.zeros(COUNT)}, r"row 1: 'time_s' repeats"),
        ({"fz": np.full(COUNT, np.inf)}, "row 0, 'fz' is 'inf', not a finite number"),
        ({"fz": np.full(COUNT, 1e6)}, r"row 0: 1e\+06 N is no force of a fingertip"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, arrays: Arrays, change: Arrays, message: str):
    changed = {name: array for name, array in (arrays | change).items() if array is not None}
    refused(read_arrays, write(tmp_path / "a.npz", changed), message)


def test_data_of_other_files_are_never_read(tmp_path: Path, arrays: Arrays):
    h5py = pytest.importorskip("h5py")
    write(tmp_path / "other.h5", arrays)
    (tmp_path / "secret").write_bytes(bytes(range(240)))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = h5py.ExternalLink("other.h5", "frames")
        file.create_dataset("images", (1, 8, 10, 3), dtype="u1", external=[(str(tmp_path / "secret"), 0, 240)])
    refused(read_arrays, tmp_path / "a.h5", "holds no array; name the array of its frames 'frames'")


def test_what_reads_hdf5_is_named_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    (tmp_path / "a.h5").write_bytes(b"")
    refused(read_arrays, tmp_path / "a.h5", r"a\.h5 needs h5py, which is not installed; .*sliplens\[hdf5\]")
