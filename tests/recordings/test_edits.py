"""Repairs by hand: what they change, who made them, and that each can be taken back."""

import json
from pathlib import Path

import pytest

from sliplens.errors import InputError, RecordingError
from sliplens.recordings import Dataset, LabelSettings
from sliplens.recordings.edits import (
    EDITS_FILE,
    Edit,
    apply_edits,
    edits_in_force,
    keep_edit,
    make_edit,
    read_edits,
    undo_edit,
)
from sliplens.recordings.importing import import_recordings, label_dataset


def test_an_edit_changes_its_own_setting_and_the_last_one_counts():
    given = LabelSettings(mu=0.5, apply_lag=True)
    edits = [make_edit("cup", "slip_s", 1.0), make_edit("cup", "reference_frame", 3.0), make_edit("cup", "slip_s", 2.0)]
    changed = LabelSettings(mu=0.5, apply_lag=True, slip_s=2.0, reference_frame=3)
    assert apply_edits(given, edits) == changed
    assert isinstance(apply_edits(given, edits).reference_frame, int)
    assert apply_edits(given, [*edits, make_edit("cup", "slip_s"), make_edit("cup", "mu")]).slip_s is None


def test_marks_of_frames_are_those_of_a_set():
    spans = [
        ("bad", (2, 9)),
        ("good", (4, 5)),
        ("bad", (20, 20)),
        ("good", (0, 2)),
        ("bad", (8, 34)),
        ("good", (30, 40)),
    ]
    marked: set[int] = set()
    for kind, (first, last) in spans:
        frames = set(range(first, last + 1))
        marked = marked | frames if kind == "bad" else marked - frames
    settings = apply_edits(LabelSettings(), [make_edit("cup", kind, span) for kind, span in spans])
    assert {frame for first, last in settings.bad_frames for frame in range(first, last + 1)} == marked


def test_an_undo_takes_back_the_last_edit_of_its_own_trial():
    one, two, other = make_edit("cup", "mu", 0.5), make_edit("cup", "mu", 0.6), make_edit("egg", "mu", 0.7)
    undo = make_edit("cup", "undo")
    assert edits_in_force([one, two, other, undo], "cup") == (one,)
    assert edits_in_force([one, two, other, undo], "egg") == (other,)
    assert edits_in_force([one, undo, undo, two], "cup") == (two,)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("tare", (1.0, 2.0)), ("tare", 1.0), ("slip_s", (1.0, 2.0)), ("slip_s", float("nan")), ("normal_sign", 2.0),
        ("reference_frame", 1.5), ("mu", -1.0), ("mu", 50.0), ("bad", None), ("bad", (1.0, 2.5)), ("undo", 1.0),
    ],
)  # fmt: skip
def test_a_value_that_does_not_fit_is_refused(kind: str, value: float | tuple[float, ...] | None):
    with pytest.raises(RecordingError, match=f"an edit of {kind}"):
        make_edit("cup", kind, value)


def test_edits_are_kept_with_who_and_when_and_found_again(tmp_path: Path, small_dataset: Dataset):
    data = Dataset(folder=tmp_path, trials=small_dataset.trials)
    (tmp_path / "trials").symlink_to(small_dataset.folder / "trials")
    name = data.trials[0].trial
    edits = [make_edit(name, "bad", (1, 2), by="ana"), make_edit(name, "tare", (0.1, 0.0, -0.2), by="bo")]
    for edit in edits:
        keep_edit(data, edit)
    assert list(read_edits(tmp_path)) == edits
    assert [edit.by for edit in read_edits(tmp_path)] == ["ana", "bo"]
    assert all(json.loads(line)["at"] for line in (tmp_path / EDITS_FILE).read_text().splitlines())
    for _ in edits:
        keep_edit(data, make_edit(name, "undo"))
    with pytest.raises(RecordingError, match="no edit that could be undone"):
        keep_edit(data, make_edit(name, "undo"))
    kept = (tmp_path / EDITS_FILE).read_bytes()
    outside: list[tuple[Edit, str]] = [
        (make_edit(name, "bad", (10, 12)), "frames 10 to 12 cannot be marked"),
        (make_edit(name, "reference_frame", 12), "frame 12 of 12"),
        (make_edit(name, "slip_s", 9.0), "the slip is set to 9.00 s, and the forces are from 0.00 to"),
        (make_edit("nobody", "mu", 0.5), "has no trial nobody"),
    ]
    for edit, why in outside:
        with pytest.raises(RecordingError, match=why):
            keep_edit(data, edit)
    assert (tmp_path / EDITS_FILE).read_bytes() == kept


def test_an_edit_that_contradicts_is_refused_with_the_reason_and_keeps_nothing(tmp_path: Path, small_dataset: Dataset):
    data = Dataset(folder=tmp_path, trials=small_dataset.trials)
    (tmp_path / "trials").symlink_to(small_dataset.folder / "trials")
    name = data.trials[0].trial
    contact = make_edit(name, "contact_s", 0.2)
    keep_edit(data, contact)
    with pytest.raises(RecordingError, match=r"slip is set to 0\.10 s and the contact to 0\.20 s"):
        keep_edit(data, make_edit(name, "slip_s", 0.1))
    assert read_edits(tmp_path) == (contact,)
    assert undo_edit(data, name) == contact
    keep_edit(data, make_edit(name, "slip_s", 0.1))


def test_an_import_in_the_place_of_a_data_set_keeps_its_edits(tmp_path: Path, small_dataset: Dataset):
    out = tmp_path / "data"
    data = import_recordings(small_dataset.folder, out=out)
    edit = make_edit(data.trials[0].trial, "mu", 0.5)
    keep_edit(data, edit)
    import_recordings(small_dataset.folder, out=out, test_trials=1, overwrite=True)
    assert read_edits(out) == (edit,)
    # and labels of another data set do not take their place
    with pytest.raises(InputError, match=r"has edits by hand that .* has not"):
        label_dataset(small_dataset, out=out, overwrite=True)
    assert read_edits(out) == (edit,)


@pytest.mark.parametrize(
    "line", ['{"trial": "cup", "kind": "slip_s", "val', '{"trial": "cup", "kind": "slide", "by": "", "at": ""}', "\xff"]
)
def test_a_damaged_line_is_named(tmp_path: Path, line: str):
    whole = '{"trial": "cup", "kind": "mu", "value": 0.5, "by": "ana", "at": "2026-11-23T00:00:00+00:00"}\n'
    (tmp_path / EDITS_FILE).write_bytes((whole + line + "\n" + whole).encode("latin-1"))
    with pytest.raises(RecordingError, match=rf"line 2 of .*{EDITS_FILE} is no edit .*; mend that line"):
        read_edits(tmp_path)
