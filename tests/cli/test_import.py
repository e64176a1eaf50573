"""`sliplens import`: from files of one's own to a data set that trains a network."""

from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import pytest
from command_line import refused, run
from data_sets import save_dataset
from own_recording import TARE, write_forces, write_video
from there import there

from sliplens.images import write_png
from sliplens.recordings import Recording, load_dataset
from sliplens.recordings.store import read_header, write_trial
from sliplens.runner import read_status


@pytest.fixture(scope="module")
def table(trial: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_forces(trial, tmp_path_factory.mktemp("forces") / "forces.csv")


@pytest.fixture(scope="module")
def video(trial: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(trial, tmp_path_factory.mktemp("video") / "cup.mkv")


@pytest.fixture(scope="module")
def recorded(video: Path, table: Path) -> tuple[Path, Path]:
    return video, table


def test_labels_of_an_imported_video_are_those_of_the_simulator(
    tmp_path: Path, trial: Recording, table: Path, video: Path, capsys: pytest.CaptureFixture[str]
):
    command = ("import", video, "-o", tmp_path / "data", "--sensor", "mine", "--forces", table)
    assert run(*command) == 0
    assert run("check", tmp_path / "data") == 0
    data = load_dataset(tmp_path / "data")
    back = data.load(data.trials[0])
    assert (back.trial, back.sensor, data.simulated) == ("cup", "mine", False)
    np.testing.assert_array_equal(back.frames, trial.frames)
    assert back.valid is not None
    assert back.safety_margin_sigma is not None
    # the labels' own goal: Gamma within 0.03 rms, mu within 5 %
    assert back.valid.sum() > 180
    error = (back.safety_margin - trial.safety_margin)[back.valid]
    assert np.sqrt(np.mean(error**2)) < 0.03
    labelling = there(read_header(tmp_path / "data" / "trials" / "cup.parquet").labelling)
    basis = there(labelling.basis)
    slip = int(np.argmax(trial.safety_margin == 0))
    assert basis.friction.mu == pytest.approx(there(trial.truth).static_friction[slip], rel=0.05)
    assert (basis.axes.normal, basis.axes.sign) == ("z", -1)
    np.testing.assert_allclose(basis.axes.tare_n, TARE, atol=0.01)
    # the reference was taken before the contact
    np.testing.assert_array_equal(back.reference, trial.frames[labelling.reference.index])
    assert np.isnan(trial.safety_margin[labelling.reference.index])
    assert run(*command) == 0
    assert "kept" in capsys.readouterr().out


def test_friction_given_or_not_frames_after_the_slip_are_0_and_a_wrong_one_is_told_everywhere(
    tmp_path: Path, trial: Recording, table: Path, video: Path, capsys: pytest.CaptureFixture[str]
):
    slip = int(np.argmax(trial.safety_margin == 0))
    mu = float(there(trial.truth).static_friction[slip])
    for name, given in (("right", mu), ("wrong", 0.5 * mu)):
        command = ("import", video, "-o", tmp_path / name, "--sensor", "mine", "--forces", table)
        assert run(*command, "--mu", f"{given:.3f}") == 0
        flagged = f"at the slip at {trial.time_s[slip]:.1f}" in capsys.readouterr().err
        data = load_dataset(tmp_path / name)
        labels = data.read_labels(data.trials[0])
        after = np.arange(len(trial)) > slip + 1
        assert np.all(labels.safety_margin[after] == 0)
        assert not labels.labelled[after].any()
        assert run("check", tmp_path / name) == 0
        checked = capsys.readouterr()
        assert flagged == ("is sound" not in checked.out) == (name == "wrong")
        assert (f"{given:.2f} was given" in checked.err) == (name == "wrong")
        page = (tmp_path / name / "trials.html").read_text()
        assert (f"{given:.2f} was given" in page) == (name == "wrong")


def test_bad_samples_of_the_force_sensor_cost_their_frames_and_are_told(
    tmp_path: Path, trial: Recording, table: Path, video: Path, capsys: pytest.CaptureFixture[str]
):
    head, *rows = [line.split(",") for line in table.read_text().splitlines()]
    times = np.array([float(row[0]) for row in rows])
    # an instrument that loses samples, and then shoots up
    for row in rows[int(np.searchsorted(times, 2.5)) : int(np.searchsorted(times, 2.7))]:
        row[1:] = "", "nan", ""
    rows[int(np.searchsorted(times, 4.0))][3] = "70"
    spoilt = tmp_path / "spoilt.csv"
    spoilt.write_text("\n".join(",".join(row) for row in (head, *rows)) + "\n")
    command = ("import", video, "-o", tmp_path / "data", "--sensor", "mine", "--forces", spoilt)
    assert run(*command) == 0
    flags = (
        "cup: drop-out of the force at 2.50 s, 0.20 s in all",
        "cup: spike of the force at 4.00 s, 0.00 s in all, up to 70 N",
    )
    told = capsys.readouterr().err
    assert all(told.count(flag) == 1 for flag in flags)
    assert (tmp_path / "data" / "audit" / "cup.png").is_file()
    assert run("check", tmp_path / "data") == 0
    repeated = capsys.readouterr()
    assert all(repeated.err.count(flag) == 1 for flag in flags)
    assert "is sound" in repeated.out
    data = load_dataset(tmp_path / "data")
    labels = data.read_labels(data.trials[0])
    reasons = dict(zip(np.round(trial.time_s, 3).tolist(), there(labels.reason), strict=True))
    assert {reason for time, reason in reasons.items() if 2.5 <= time <= 2.7} == {"drop-out of the force"}
    assert "spike of the force" in {reason for time, reason in reasons.items() if 3.95 <= time <= 4.05}
    error = (labels.safety_margin - trial.safety_margin)[there(labels.valid)]
    assert len(error) > 150  # the random draws behind the uncertainty decide about some
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_a_folder_of_images_gives_the_labels_of_the_video(tmp_path: Path, trial: Recording, table: Path, video: Path):
    folder = tmp_path / "cup"
    folder.mkdir()
    for index, frame in enumerate(trial.frames):
        write_png(folder / f"frame_{index}.png", frame)
    shared = ("--sensor", "mine", "--forces", table)
    assert run("import", folder, "-o", tmp_path / "a", *shared, "--frame-rate", 30) == 0
    assert run("import", video, "-o", tmp_path / "b", *shared, "--frame-rate", 30) == 0
    one, other = (load_dataset(tmp_path / name) for name in "ab")
    np.testing.assert_array_equal(one.load(one.trials[0]).safety_margin, other.load(other.trials[0]).safety_margin)


def test_lag_and_tare_by_hand_are_taken(tmp_path: Path, table: Path, video: Path):
    late = tmp_path / "late.csv"
    rows = [line.split(",") for line in table.read_text().splitlines()]
    # stamps of the forces that are 50 ms early are a camera that is 50 ms late
    shifted = [[f"{float(time) - 0.05:.5f}", *values] for time, *values in rows[1:]]
    late.write_text("\n".join(",".join(row) for row in (rows[0], *shifted)) + "\n")
    words = ("--sensor", "mine", "--tare", *TARE, "--no-audit")
    assert run("import", video, "-o", tmp_path / "a", "--forces", table, "--lag-ms", 0, *words) == 0
    assert run("import", video, "-o", tmp_path / "b", "--forces", late, "--lag-ms", 50, *words) == 0
    one, other = (load_dataset(tmp_path / name) for name in "ab")
    first, second = one.load(one.trials[0]), other.load(other.trials[0])
    # the same samples at the same times, but for the rounding of their stamps to 10 us, of forces that change by some
    # 50 N/s at most
    np.testing.assert_allclose(first.normal_force_n, second.normal_force_n, atol=1e-3)
    basis = there(there(read_header(tmp_path / "b" / "trials" / "cup.parquet").labelling).basis)
    assert (there(basis.lag).lag_s, basis.lag_applied, basis.axes.tare_found) == (0.05, True, "declared")


def test_times_of_images_come_from_a_table_or_from_their_names(
    tmp_path: Path, trial: Recording, table: Path, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "cup"
    folder.mkdir()
    names = [f"frame_{round(1e6 * time)}.png" for time in trial.time_s]
    for name, frame in zip(names, trial.frames, strict=True):
        write_png(folder / name, frame)
    times = tmp_path / "times.csv"
    lines = [f"{name},{time:.6f}" for name, time in zip(names, trial.time_s, strict=True)]
    times.write_text("\n".join(["file,time [s]", *lines]) + "\n")
    shared = ("--sensor", "mine", "--forces", table, "--no-audit")
    assert run("import", folder, "-o", tmp_path / "a", *shared, "--times", times) == 0
    assert run("import", folder, "-o", tmp_path / "b", *shared, "--name-unit", "us") == 0
    for name in "ab":
        data = load_dataset(tmp_path / name)
        np.testing.assert_allclose(data.load(data.trials[0]).time_s, trial.time_s, atol=1e-6)
    capsys.readouterr()
    both = ("--times", times, "--name-unit", "us")
    assert "more than one source of times" in refused(capsys, "import", folder, "-o", tmp_path / "c", *shared, *both)


def test_friction_by_hand_is_taken(tmp_path: Path, table: Path, video: Path):
    assert run("import", video, "-o", tmp_path / "data", "--sensor", "mine", "--forces", table, "--mu", 1.4) == 0
    data = load_dataset(tmp_path / "data")
    basis = there(there(read_header(tmp_path / "data" / "trials" / "cup.parquet").labelling).basis)
    assert (basis.friction.mu, basis.friction.found) == (1.4, "declared")
    # with more friction than there was the trial never comes near slip, until it slips all the same
    labels = data.load(data.trials[0])
    slip = int(np.argmax(labels.safety_margin == 0))
    assert np.nanmin(labels.safety_margin[:slip]) > 0.2
    assert labels.time_s[slip] == pytest.approx(there(basis.friction.onset_s), abs=0.05)
    assert basis.friction.notes


def test_an_interrupted_import_goes_on_where_it_stopped(
    tmp_path: Path, trial: Recording, monkeypatch: pytest.MonkeyPatch
):
    source = tmp_path / "source"
    save_dataset(source, replace(trial, trial="a"), replace(trial, trial="b"))
    whole, broken = (("import", source, "-o", tmp_path / name, "--no-audit") for name in "wb")
    assert run(*whole) == 0
    written = []

    turn = Lock()

    def write(path: Path, *arguments: Any, **more: Any) -> None:
        with turn:  # trials are written by several threads
            if written:
                raise KeyboardInterrupt
            write_trial(path, *arguments, **more)
            written.append(path)

    with monkeypatch.context() as patch:
        patch.setattr("sliplens.recordings.trial_writer.write_trial", write)
        assert run(*broken) == 130
    assert not (tmp_path / "b").exists()
    [kept] = (tmp_path / ".b.partial" / "parts").glob("trial=*/0*/trials/*.parquet")
    made_ns = kept.stat().st_mtime_ns
    (status,) = read_status(tmp_path / "b")
    assert (status.title, status.done, status.parts) == ("Importing frames", 1, 2)
    assert run(*broken, "--on", "processes=1") == 0  # wherever it goes on
    assert (tmp_path / "b" / "trials" / kept.name).stat().st_mtime_ns == made_ns
    assert {path.name for path in (tmp_path / "b").iterdir()} == {path.name for path in (tmp_path / "w").iterdir()}
    for name in ("dataset.json", "trials/a.parquet", "trials/b.parquet"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "w" / name).read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "has no forces, and without them there is no label; give the table of the force sensor"),
        (("--forces", "MISSING.csv"), "MISSING.csv does not exist"),
        (
            ("--format", "papyrus"),
            "there is no format named 'papyrus'; choose one of sliplens, rosbag, lerobot",
        ),
        (("--image-topic", "/camera"), "is read as video, which does not take --image-topic"),
        (("--forces", "TABLE", "--test-trials", "2"), "2 to test are more than the 1 there are; give fewer"),
        (("--forces", "TABLE", "--test-trials", "-1"), "numbers of trials are not negative"),
        (("--forces", "TABLE", "--reference-frame", "999"), "the reference is frame 999 of 240"),
    ],
)
def test_mistakes_are_told_in_one_line_and_leave_nothing(
    tmp_path: Path,
    recorded: tuple[Path, Path],
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    message: str,
):
    video, table = recorded
    named = [str(table) if word == "TABLE" else word for word in words]
    assert message in refused(capsys, "import", video, "-o", tmp_path / "data", "--sensor", "mine", *named)
    assert not list(tmp_path.iterdir())


def test_recordings_of_one_name_are_refused(tmp_path: Path, video: Path, capsys: pytest.CaptureFixture[str]):
    line = refused(capsys, "import", video, video, "-o", tmp_path / "data", "--sensor", "mine")
    assert "several recordings are named cup; rename their files" in line


def test_a_real_bag_without_images_is_refused_with_its_topics(
    tmp_path: Path, reference_folder: Path, capsys: pytest.CaptureFixture[str]
):
    bag = reference_folder / "rosbags" / "tactip_db3"
    if not bag.is_dir():
        pytest.skip(f"the real bags are not at {bag}")
    line = refused(capsys, "import", bag, "-o", tmp_path / "data", "--sensor", "mine")
    assert "/sensors/tactip" in line
    assert not list(tmp_path.iterdir())
