"""What is recorded is there again, whatever ends the recording."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TextIO

import numpy as np
import pyarrow as pa
import pytest
from data_sets import contents
from scripted import frame_of
from there import there

import sliplens as sl
from sliplens.errors import RecordingError, SliplensError
from sliplens.live import ForceStream, LiveFrame, LiveOptions, Recorder, open_live
from sliplens.recordings import Dataset, Recording, TrialFacts, load_dataset
from sliplens.recordings.capture import Forces
from sliplens.recordings.dataset import (
    JOURNAL_FOLDER,
    LOCK_FILE,
    Journal,
    JournalHeader,
    begin_recording,
    finish_recording,
    recover_dataset,
)
from sliplens.recordings.store import forces_path, load_forces

FACTS = TrialFacts(trial="cup", sensor="tip", object="a cup", condition="wet", day=3)


def frames_of(recording: Recording, *, begin_s: float = 0.0) -> list[LiveFrame]:
    """Frames with their margins and, but for the first, two force samples each."""
    frames = []
    for number, (image, margin) in enumerate(zip(recording.frames, recording.safety_margin, strict=True)):
        time_s, force_n = begin_s + 0.1 * number, np.array([[number, 0.0, 1.0], [number, 0.5, 1.0]])
        forces = Forces(time_s=time_s + np.array([-0.05, 0.0]), force_n=force_n, source="a sensor")
        frame = frame_of(image, number, time_s=time_s)
        label = None if np.isnan(margin) else float(margin)
        frames.append(replace(frame, safety_margin=label, forces=forces if number else None))
    return frames


@pytest.fixture
def recording(small_dataset: Dataset) -> Recording:
    return small_dataset.load(small_dataset.trials[0])


def journal_of(folder: Path, recording: Recording, frames: list[LiveFrame]) -> tuple[Journal, list[int]]:
    """Write frames as a recording that was cut off has them; gives the size of the file after each."""
    lock, _ = begin_recording(folder, simulated=False)
    header = JournalHeader(facts=FACTS, source="a camera", size=(48, 48))
    journal, ends = Journal(folder, header, reference=recording.reference), []
    for frame in frames:
        journal.append(frame.image, time_s=frame.time_s, safety_margin=frame.safety_margin, forces=frame.forces)
        ends.append(journal.path.stat().st_size)
    journal.close()
    lock.release()
    return journal, ends


def wait_until(condition: Callable[[], object], *, within_s: float = 10.0) -> None:
    """Wait until something is so, or for long enough."""
    end_s = time.monotonic() + within_s
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.01)


def recorder_of(folder: Path, frames: list[LiveFrame], recording: Recording) -> Recorder:
    recorder = Recorder(folder, facts=FACTS, source="a camera")
    for frame in frames:
        recorder.add(frame, recording.reference)
    return recorder


def test_a_recording_is_what_was_seen(recording: Recording, tmp_path: Path):
    data = there(recorder_of(tmp_path / "data", frames_of(recording, begin_s=1000.0), recording).close())
    assert sl.check_dataset(data) == ()
    (info,) = data.trials
    assert replace(FACTS, trial="cup-1") == TrialFacts(**{name: getattr(info, name) for name in vars(FACTS)})
    again = data.load(info)
    np.testing.assert_array_equal(again.frames, recording.frames)
    np.testing.assert_array_equal(again.reference, recording.reference)
    np.testing.assert_array_equal(again.safety_margin, recording.safety_margin)
    np.testing.assert_allclose(again.time_s, 0.1 * np.arange(12), atol=1e-9)
    forces = load_forces(forces_path(data.folder, "cup-1"))
    np.testing.assert_array_equal(forces.force_n[:, 0], np.repeat(np.arange(1, 12), 2))
    np.testing.assert_allclose(forces.time_s, 0.05 * np.arange(1, 23), atol=1e-9)
    assert not (data.folder / JOURNAL_FOLDER).exists()


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.77, 0.999])
def test_what_is_cut_off_is_whole_up_to_the_cut(recording: Recording, tmp_path: Path, share: float):
    journal, ends = journal_of(tmp_path / "data", recording, frames_of(recording))
    cut = round(share * ends[-1])
    os.truncate(journal.path, cut)
    whole = sum(end <= cut for end in ends)
    if whole == 0:
        with pytest.raises(RecordingError, match="held no whole frame and was removed"):
            recover_dataset(tmp_path / "data")
        assert not (tmp_path / "data").exists()
        return
    before = contents(tmp_path / "data")
    with pytest.raises(RecordingError, match="was cut off; stop it, or finish it with `sliplens recover"):
        load_dataset(tmp_path / "data")
    assert contents(tmp_path / "data") == before
    data = recover_dataset(tmp_path / "data")
    assert sl.check_dataset(data) == ()
    np.testing.assert_array_equal(data.load(data.trials[0]).frames, recording.frames[:whole])


_CHILD = """
import sys, time
from pathlib import Path
from typing import Any
import numpy as np
from sliplens.recordings.dataset import begin_recording
from sliplens.recordings.dataset import Journal, JournalHeader
from sliplens.recordings.trial import TrialFacts
lock, _ = begin_recording(Path(sys.argv[1]), simulated=False)
header = JournalHeader(facts=TrialFacts(trial="a"), source="", size=(48, 48))
journal = Journal(Path(sys.argv[1]), header, reference=None)
for number in range(10**6):
    journal.append(np.full((48, 48, 3), number % 256, dtype=np.uint8), time_s=float(number))
    print(number, flush=True)
"""


def test_a_process_that_is_killed_loses_no_frame_that_was_written(tmp_path: Path):
    folder = tmp_path / "data"
    with subprocess.Popen([sys.executable, "-c", _CHILD, folder], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        while (last := int(child.stdout.readline())) < 30:
            pass
        with pytest.raises(RecordingError, match="is being recorded; stop the recording first"):
            recover_dataset(folder)
        child.send_signal(signal.SIGKILL)
        last = max([last, *map(int, child.stdout.read().split()[:-1])])  # the last line may be cut off
    data = recover_dataset(folder)
    assert data.trials[0].frames >= last + 1
    assert sl.check_dataset(data) == ()
    frames = data.load(data.trials[0]).frames
    np.testing.assert_array_equal(frames[:, 0, 0, 0], np.arange(len(frames)) % 256)
    notes = data.read_labels(data.trials[0]).labelling
    assert notes is not None
    assert "the first frame stands for it" in notes.notes[0]


def test_a_recording_that_was_killed_before_it_wrote_its_table_is_begun_anew(tmp_path: Path):
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / LOCK_FILE).touch()
    (tmp_path / ".dataset.json.part").touch()
    lock, trials = begin_recording(tmp_path, simulated=False)
    assert trials == ()
    finish_recording(tmp_path, lock)
    # somebody's own folder of that name is nothing of ours
    (tmp_path / "recording").mkdir(parents=True)
    (tmp_path / "recording" / "mine.png").touch()
    with pytest.raises(RecordingError, match="is no data set of sliplens"):
        begin_recording(tmp_path, simulated=False)


def test_a_damaged_journal_is_whole_frames_or_a_sentence(
    recording: Recording, tmp_path: Path, rng: np.random.Generator
):
    journal, _ = journal_of(tmp_path / "data", recording, frames_of(recording)[:3])
    whole, outcomes = journal.path.read_bytes(), set()
    for number in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 8):
            damaged[at] ^= int(rng.integers(1, 256))
        shutil.copytree(tmp_path / "data", data := tmp_path / str(number))
        (data / JOURNAL_FOLDER / journal.path.name).write_bytes(damaged)
        try:
            recover_dataset(data)
            outcomes.add("read")
        except SliplensError:
            outcomes.add("told")
    assert "told" in outcomes
    with pa.ipc.new_stream(str(journal.path), schema := pa.schema({"time_s": pa.float64()})) as stream:
        stream.write_batch(pa.record_batch([[0.0]], schema=schema))
    with pytest.raises(RecordingError, match=r"is damaged \(it has other columns than a recording\); move it away"):
        recover_dataset(tmp_path / "data")


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """No file of this process grows beyond some bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_stops_the_recording_and_keeps_what_is_there(tmp_path: Path, rng: np.random.Generator):
    images = rng.integers(0, 255, (12, 48, 48, 3), dtype=np.uint8)  # 7 kB each, however they are coded
    recorder = Recorder(tmp_path / "data")
    with room_for(50_000):
        for number, image in enumerate(images):
            recorder.add(frame_of(image, number), images[0])
        wait_until(lambda: recorder.sent + recorder.lost == 12)
    assert 0 < recorder.sent < 8
    assert recorder.lost == 12 - recorder.sent
    assert f"stopped after {recorder.sent} were recorded" in str(recorder.trouble)
    assert "make room, and record again: what is there stays" in str(recorder.trouble)
    data = there(recorder.close())
    assert sl.check_dataset(data) == ()
    kept = data.load(data.trials[0]).frames
    # the frame that did not fit may do so once there is room
    assert recorder.sent <= len(kept) <= recorder.sent + 1
    np.testing.assert_array_equal(kept, images[: len(kept)])


def test_a_disk_that_is_full_at_the_end_keeps_the_journal(recording: Recording, tmp_path: Path):
    recorder = recorder_of(tmp_path / "data", frames_of(recording), recording)
    wait_until(lambda: recorder.sent == 12)
    with room_for(5_000), pytest.raises(OSError, match="large"):
        recorder.close()
    data = recover_dataset(tmp_path / "data")
    np.testing.assert_array_equal(data.load(data.trials[0]).frames, recording.frames)


def test_a_new_reference_a_clock_that_jumps_and_another_size_begin_a_trial(recording: Recording, tmp_path: Path):
    recorder = recorder_of(tmp_path / "data", frames := frames_of(recording), recording)
    other = recording.reference + np.uint8(1)
    for frame in [*frames_of(recording, begin_s=50.0), *frames[:3]]:  # the clock begins anew
        recorder.add(frame, other)
    recorder.add(frame_of(np.zeros((24, 24, 3), dtype=np.uint8), 9, time_s=99.0), other)
    data = there(recorder.close())
    assert [(info.trial, info.frames) for info in data.trials] == [
        ("cup-1", 12), ("cup-2", 12), ("cup-3", 3), ("cup-4", 1),
    ]  # fmt: skip
    np.testing.assert_array_equal(data.load(data.trials[1]).reference, other)
    assert sl.check_dataset(data) == ()


def test_nothing_recorded_leaves_nothing_behind(tmp_path: Path):
    assert Recorder(tmp_path / "data").close() is None
    assert not (tmp_path / "data").exists()


def test_a_folder_that_cannot_be_recorded_into_is_told(small_dataset: Dataset, tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="exists and is no data set of sliplens"):
        Recorder(tmp_path)
    with pytest.raises(RecordingError, match="holds simulated trials, these are real"):
        Recorder(small_dataset.folder)
    recorder = Recorder(tmp_path / "data")
    with pytest.raises(RecordingError, match="is being recorded"):
        Recorder(tmp_path / "data")
    recorder.close()


def test_a_reader_records_every_frame_whether_it_was_read_or_not(recording: Recording, tmp_path: Path):
    source = open_live(recording.frames, options=LiveOptions(rate_hz=500.0))
    reader = sl.LiveReader(source, reference=recording.reference)
    reader.subscribe(lambda *_: time.sleep(0.05))  # most frames are dropped
    reader.record(tmp_path / "data")
    with pytest.raises(RecordingError, match="is being recorded; stop that first"):
        reader.record(tmp_path / "other")
    with reader:
        list(reader.readings())
        data = there(reader.stop_recording())
    assert [info.frames for info in data.trials] == [12]
    assert sl.check_dataset(data) == ()


# force samples that another program writes


def samples_of(stream: ForceStream, count: int, *, time_s: float = 0.0, captured_s: float = 0.0) -> Forces | None:
    """Wait for so many samples, and bring them to the clock of a frame."""
    wait_until(lambda: len(stream._samples) >= count or stream.trouble)
    frame = frame_of(np.zeros((2, 2, 3), dtype=np.uint8), 0, time_s=time_s)
    return stream.attach(replace(frame, captured_s=captured_s)).forces


@contextmanager
def streamed(path: Path, header: str) -> Iterator[tuple[ForceStream, TextIO]]:
    """Stream a file that begins with a header, beside the file to write on."""
    path.write_text(header)
    with ForceStream(path) as stream, path.open("a", buffering=1) as file:
        yield stream, file


def test_samples_keep_their_steps_on_the_clock_of_the_frames(tmp_path: Path):
    header = "# a logger\ntime [ms];fx [mN];fy [mN];fz [mN]\n5;1;1;1\n"
    with streamed(tmp_path / "forces.csv", header) as (stream, file):
        begun_s = time.monotonic()
        file.write("7000;0;0;1500\n7010;250;0;1500\n7030;500;0;15")
        file.flush()
        time.sleep(0.05)
        file.write("00\n")
        file.flush()
        # a frame that was captured just now is at 100 s on the source's clock
        forces = there(samples_of(stream, 3, time_s=100.0, captured_s=begun_s))
    np.testing.assert_allclose(forces.force_n, [[0, 0, 1.5], [0.25, 0, 1.5], [0.5, 0, 1.5]])
    np.testing.assert_allclose(np.diff(forces.time_s), [0.01, 0.02], atol=1e-9)
    # it arrived after the frame, by now
    assert 99.9 < forces.time_s[1] < 100.1 + time.monotonic() - begun_s


def test_samples_without_times_count_from_when_they_arrive(tmp_path: Path):
    with streamed(tmp_path / "forces.csv", "fn,ft\n") as (stream, file):
        begun_s = time.monotonic()
        file.write("2.0,0.5\n")
        forces = there(samples_of(stream, 1, time_s=begun_s, captured_s=begun_s))
    np.testing.assert_array_equal(forces.force_n, [[0.5, 0.0, 2.0]])
    assert begun_s <= forces.time_s[0] <= time.monotonic()


def test_samples_that_drop_out_or_come_late_are_left_out(tmp_path: Path):
    with streamed(tmp_path / "forces.csv", "time_s,fx,fy,fz\n") as (stream, file):
        file.write("1.0,0,0,1\n1.2,nan,0,1\n1.4,0,0,3\n1.1,0,0,9\n1.3,0,0,9\n1.5,0,0,4\n")
        forces = there(samples_of(stream, 6))
        np.testing.assert_array_equal(forces.force_n[:, 2], [1, 3, 4])
        file.write("2.0,nan,nan,nan\n")
        assert samples_of(stream, 1) is None


def test_a_named_pipe_is_read_too(tmp_path: Path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with ForceStream(path) as stream, path.open("w") as file:
        file.write("time_s,fx,fy,fz\n1.0,0,0,1\n1.5,0,0,2\n")
        file.flush()
        forces = there(samples_of(stream, 2))
    np.testing.assert_array_equal(forces.force_n[:, 2], [1, 2])


@pytest.mark.parametrize(
    ("header", "lines", "words"),
    [
        ("a,b\n", "", "has no columns that look like forces"),
        ("time_s,fx,fy,fz\n", "1,2\n", "has a line of 2 columns, 4 are named"),
        ("time_s,fx,fy,fz\n", "1,2,3,x\n", "could not convert"),
    ],
)
def test_lines_that_are_no_forces_are_told(tmp_path: Path, header: str, lines: str, words: str):
    with streamed(tmp_path / "forces.csv", header) as (stream, file):
        file.write(lines)
        wait_until(lambda: stream.trouble)
    assert words in str(stream.trouble)
    assert "the forces of" in str(stream.trouble)
