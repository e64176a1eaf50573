"""Many recordings at once: which files belong to which trial."""

from pathlib import Path

import pytest

from sliplens.errors import RecordingError
from sliplens.recordings.manifest import ManifestRow, find_rows, pair_recordings, read_rows
from sliplens.recordings.options import ReadOptions


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).touch()
    return folder


def test_recordings_and_tables_are_paired_by_name(tmp_path: Path):
    touch(tmp_path, "cup.mp4", "cup.csv", "jar.MKV", "jar_forces.csv", "mug.avi", "notes.txt", "tip.toml", ".x.mp4")
    rows = pair_recordings(tmp_path)
    assert find_rows(tmp_path) == rows
    pairs = {row.trial: (row.video.name, row.reading.forces and row.reading.forces.name) for row in rows}
    assert pairs == {"cup": ("cup.mp4", "cup.csv"), "jar": ("jar.MKV", "jar_forces.csv"), "mug": ("mug.avi", None)}


def test_recordings_that_end_like_tables_and_names_of_any_script_find_theirs(tmp_path: Path):
    touch(tmp_path, "left.mp4", "left.csv", "lift_ft.mp4", "lift_ft.csv", "\u676f\u5b50.mp4", "\u676f\u5b50.csv")
    touch(tmp_path, "pru\u0308fung.mp4", "pr\u00fcfung_forces.csv")
    rows = {row.trial: row.reading.forces and row.reading.forces.name for row in pair_recordings(tmp_path)}
    assert rows == {
        "left": "left.csv",
        "lift_ft": "lift_ft.csv",
        "\u676f\u5b50": "\u676f\u5b50.csv",
        "pr\u00fcfung": "pr\u00fcfung_forces.csv",
    }


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("cup.mp4", "cup.avi"), "trials named cup"),
        (("cup.mp4", "cup.csv", "cup_ft.csv"), "several tables of forces"),
        (("a b.mp4", "a-b.avi"), "trials named a-b"),
        (("notes.txt",), "no recording"),
    ],
)
def test_a_folder_that_leaves_a_choice_is_refused(tmp_path: Path, names, words):
    with pytest.raises(RecordingError, match=words):
        pair_recordings(touch(tmp_path, *names))


def test_a_column_named_as_an_option_of_reading_sets_it_for_its_trial(tmp_path: Path):
    path = tmp_path / "trials.csv"
    path.write_text(
        "video;forces;time_unit;force_columns;start_s;skip_frames\na.mp4;a.csv;ms;Fz Ft;1.5;3\nb.mp4;b.csv;;;;\n"
    )
    first, second = read_rows(path)
    options = {"time_unit": "ms", "force_columns": ("Fz", "Ft"), "start_s": 1.5, "skip_frames": 3}
    assert first.reading == ReadOptions(forces=tmp_path / "a.csv", **options)
    assert second.reading == ReadOptions(forces=tmp_path / "b.csv")


def test_a_manifest_says_all_of_a_trial(tmp_path: Path):
    path = tmp_path / "trials.csv"
    path.write_text(
        "\ufefftrial,video,forces,sensor,day,object,condition,mu,reference\n"
        "one,a.mp4,a.csv,tip.toml,2,cup,wet,0.7,12\n"
        ",b.mp4,,digit,,,,,still.png\n\n",
        encoding="utf-8",
    )
    one, two = read_rows(path)
    profile = str(tmp_path / "tip.toml")
    assert one == ManifestRow(
        trial="one", video=tmp_path / "a.mp4", sensor=profile, day=2, object="cup",
        condition="wet", mu=0.7, reference=12, reading=ReadOptions(forces=tmp_path / "a.csv"),
    )  # fmt: skip
    assert two == ManifestRow(trial="b", video=tmp_path / "b.mp4", sensor="digit", reference=tmp_path / "still.png")
    assert find_rows(path) == (one, two)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("trial,video,colour\na,a.mp4,red\n", "colour"),
        ("trial,video\na,\n", "line 2: the column video is empty"),
        ("trial,video,day\na,a.mp4,first\n", "line 2: day is 'first'"),
        ("trial,video\na,a.mp4\na,b.mp4\n", "trials named a"),
        ("trial,video\na,b,c\n", "line 2: 3 cells"),
        ("trial,video\n", "no trial"),
    ],
)
def test_a_manifest_that_cannot_be_is_refused_with_its_line(tmp_path: Path, text, words):
    path = tmp_path / "trials.csv"
    path.write_text(text)
    with pytest.raises(RecordingError, match=words):
        read_rows(path)
