"""Tables of labelled stills: every image meets the forces of its row, whatever the table calls its columns."""

from pathlib import Path

import numpy as np
import pytest
from there import there

from sliplens.errors import InputError
from sliplens.images import write_png
from sliplens.recordings import check_dataset, import_recordings
from sliplens.recordings.formats import recognise
from sliplens.recordings.options import LabelSettings, ReadOptions
from sliplens.recordings.source import open_source

FORCES = np.array([[0.5, -1.0, 2.0], [0.0, 0.0, 0.0], [-0.25, 0.5, 1.5]])  # tangential twice, normal


@pytest.fixture
def frames(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (3, 24, 32, 3), dtype=np.uint8)


def write_stills(folder: Path, frames: np.ndarray, text: str) -> Path:
    """Write images b, a, c and a table of them; in the table `{}` stands for the folder of the images."""
    (folder / "pictures").mkdir(parents=True)
    for name, frame in zip("bac", frames, strict=True):
        write_png(folder / "pictures" / f"{name}.png", frame)
    (folder / "states.csv").write_text(text, encoding="utf-8")
    return folder


def table(header: str, columns: np.ndarray, *, separator: str = ",", place: str = "pictures/") -> str:
    rows = (
        separator.join([f"{place}{name}.png", *map(str, row)])
        for name, row in zip("bac", columns.tolist(), strict=True)
    )
    return "\n".join([header, *rows]) + "\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (table("file,shear_x_n,shear_z_n,normal_n", FORCES), FORCES),
        (table("Image;Fx [mN];Fy [mN];Fz [mN]", FORCES * 1000, separator=";"), FORCES),
        (table("path,normal,tangential_y,tangential_x", FORCES[:, [2, 0, 1]], place="pictures\\"), FORCES),
        (
            table("file,fn,ft", np.stack([FORCES[:, 2], np.hypot(FORCES[:, 0], FORCES[:, 1])], axis=1)),
            np.stack([np.hypot(FORCES[:, 0], FORCES[:, 1]), np.zeros(3), FORCES[:, 2]], axis=1),
        ),
        (table("file,fx,fy,fz", FORCES, place="/home/somebody/pictures/"), FORCES),
    ],
    ids=["shear and normal", "millinewtons", "backslashes", "without direction", "moved"],
)
def test_each_image_has_the_forces_of_its_row(tmp_path: Path, frames: np.ndarray, text: str, expected: np.ndarray):
    folder = write_stills(tmp_path / "dome", frames, text)
    for source in (folder, folder / "states.csv"):
        assert recognise(source) == "stills"
        (trial,) = open_source(source)
        np.testing.assert_array_equal(list(trial.read_frames()), frames)
        np.testing.assert_allclose(there(trial.forces).force_n, expected)
        labels = there(trial.labels)
        np.testing.assert_allclose(labels.normal_force_n, expected[:, 2])
        np.testing.assert_allclose(labels.tangential_force_n, np.hypot(expected[:, 0], expected[:, 1]))
        assert (trial.trial, trial.reference_index) == ("dome", 1)  # the row without a force


def test_margins_are_those_of_the_given_friction_and_none_without_it(tmp_path: Path, frames: np.ndarray):
    folder = write_stills(tmp_path / "dome", frames, table("file,fx,fy,fz", FORCES))
    for mu, expected in (
        (None, [np.nan] * 3),
        (0.8, [1 - np.sqrt(1.25) / 2 / 0.8, np.nan, 1 - np.hypot(1, 2) / 6 / 0.8]),
    ):
        data = import_recordings(folder, out=tmp_path / f"{mu}", sensor="dome", labelling=LabelSettings(mu=mu))
        assert check_dataset(data) == ()
        recording = data.load(data.trials[0])
        np.testing.assert_allclose(recording.normal_force_n, FORCES[:, 2])
        np.testing.assert_array_equal(recording.frames, frames)
        np.testing.assert_allclose(recording.safety_margin, expected)
        assert recording.contact_state[1] == "no contact"
    with pytest.raises(InputError, match=r"reaches 0\.56, above the given friction 0\.5"):
        import_recordings(folder, out=tmp_path / "slippery", sensor="dome", labelling=LabelSettings(mu=0.5))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,fx,fy,fz\npictures/a.png,0,0,1\npictures/a.png,0,0,2\n", r"line 3 names 'pictures/a.png' again"),
        ("file,fx,fy,fz\npictures/a.png,0,0,1\npictures/none.png,0,0,2\n", r"line 3: .* is not there"),
        ("file,fx,fy,fz\npictures/a.png,0,0,1\n../../etc/passwd,0,0,2\n", r"line 3: .* leads out of"),
        ("file,fx,fy,fz\npictures/a.png,0,0,1\npictures/b.png,0,0,-2\n", r"line 3: the normal force is -2 N"),
        ("file,fx,fy,fz\npictures/a.png,0,0,soft\n", r"line 2, 'fz' is 'soft', not a finite number"),
    ],
)
def test_a_table_that_cannot_be_trusted_is_refused(tmp_path: Path, frames: np.ndarray, text: str, message: str):
    with pytest.raises(InputError, match=message):
        open_source(write_stills(tmp_path / "dome", frames, text))


def test_numbers_of_frames_are_no_files(tmp_path: Path, frames: np.ndarray):
    folder = write_stills(tmp_path / "dome", frames, "frame,time_s,fx,fy,fz\n0,0.0,0,0,1\n1,0.1,0,0,1\n2,0.2,0,0,1\n")
    forces = (folder / "states.csv").rename(folder / "pictures" / "forces.csv")
    assert recognise(folder / "pictures") == "images"
    options = ReadOptions(forces=forces, frame_rate=10.0)
    np.testing.assert_allclose(there(open_source(folder / "pictures", options=options)[0].forces).force_n[:, 2], 1)
