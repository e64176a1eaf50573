"""Tables of labelled stills, and the lists of the thesis: every image meets the forces or the margin of its row."""

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


LISTS = ("set_images_L.txt", "set_images_Lref.txt", "set_gamma.csv")
PATHS = [f"trial{trial}/L/image_{number}.png" for trial in (77, 83) for number in (9, 10, 51)]
REFERENCES = [f"trial{trial}/L/image_0.png" for trial in (77, 83) for _ in range(3)]
MARGINS = ["1.0", "0.6", "0.2", "0.9", "0.5", "0.1"]


@pytest.fixture
def images(tmp_path: Path, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Two trials of frames and their references, by their paths under the folder `data`."""
    images = {}
    for name in (*PATHS, *REFERENCES[::3]):
        (path := tmp_path / "data" / name).parent.mkdir(parents=True, exist_ok=True)
        images[name] = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
        write_png(path, images[name])
    return images


def write_lists(folder: Path, paths: list[str], references: list[str], margins: list[str]) -> Path:
    for name, lines in zip(LISTS, (paths, references, margins), strict=True):
        (folder / name).write_text("\n".join(lines) + "\n")
    return folder


def require_trials(source: Path, images: dict[str, np.ndarray], *names: str, **options: object) -> None:
    """Check the frames, references and margins of both trials."""
    trials = open_source(source, options=ReadOptions(**options))  # pyright: ignore[reportArgumentType]
    assert [trial.trial for trial in trials] == list(names)
    for place, trial in enumerate(trials):
        at = slice(3 * place, 3 * place + 3)
        np.testing.assert_array_equal(list(trial.read_frames()), [images[name] for name in PATHS[at]])
        np.testing.assert_array_equal(there(trial.reference), images[REFERENCES[at][0]])
        np.testing.assert_allclose(there(trial.safety_margin), [float(margin) for margin in MARGINS[at]])


@pytest.mark.parametrize("order", [range(6), [2, 3, 0, 5, 4, 1]], ids=["in order", "shuffled"])
@pytest.mark.parametrize("percent", [False, True])
def test_the_lists_of_the_thesis_give_a_trial_for_each_reference(
    tmp_path: Path, images: dict[str, np.ndarray], order: list[int], percent: bool
):
    margins = [f"{100 * float(margin):g}" for margin in MARGINS] if percent else MARGINS
    paths, references, margins = ([values[at] for at in order] for values in (PATHS, REFERENCES, margins))
    write_lists(tmp_path / "data", paths, references, ["gamma", *margins] if percent else margins)
    assert recognise(tmp_path / "data") == "stills"
    require_trials(tmp_path / "data", images, "set-1", "set-2")


@pytest.mark.parametrize("prefix", ["/home/training-pc/Data/", "C:\\Users\\max\\Data\\", "./", "november/"])
def test_paths_of_another_computer_are_found_under_the_root(tmp_path: Path, images: dict[str, np.ndarray], prefix: str):
    moved = [[prefix + name.replace("/", prefix[-1]) for name in names] for names in (PATHS, REFERENCES)]
    (tmp_path / "lists").mkdir()
    lists = write_lists(tmp_path / "lists", moved[0], moved[1], MARGINS)
    require_trials(lists / LISTS[0], images, "set-1", "set-2", image_root=tmp_path / "data")


def test_a_table_of_margins_gives_what_the_lists_give(tmp_path: Path, images: dict[str, np.ndarray]):
    rows = zip(PATHS, REFERENCES, MARGINS, strict=True)
    path = tmp_path / "data" / "states.csv"
    path.write_text("file,reference,safety_margin\n" + "".join(",".join(row) + "\n" for row in rows))
    require_trials(path, images, "data-1", "data-2", frame_rate=30.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({1: REFERENCES[:2]}, r"L\.txt has 6 frames, .* 2 references and set_gamma\.csv 6 margins; give as many"),
        ({2: ["gamma"]}, r"gamma\.csv 1 margins"),
        ({2: ["much", *MARGINS[1:]]}, "entry 1, 'safety_margin' is 'much', not a finite number"),
        ({2: ["1.2", *MARGINS[1:]]}, r"safety_margin of frame 0 is 1\.2, outside \[0, 1\]"),
        ({2: ["150", *MARGINS[1:]]}, r"safety_margin of frame 0 is 1\.5, outside"),
        ({2: ["nan"] * 6}, "holds no safety margin"),
        ({0: [*PATHS[:5], "trial77/L/image_7.png"]}, "entry 6: .* is not there, nor under"),
        ({0: [PATHS[0], *PATHS[:5]]}, "entry 2 names .* again"),
        ({0: [*PATHS[:5], "../../etc/passwd"]}, "entry 6: .* leads out of"),
        ({0: [*PATHS[:5], "x" * 5000]}, "entry 6: .* is not there"),
        ({0: ["\0\xff"] * 6}, "is not a text file"),
    ],
)
def test_lists_that_do_not_fit_are_refused(
    tmp_path: Path, images: dict[str, np.ndarray], change: dict[int, list[str]], message: str
):
    paths, references, margins = (change.get(at, lines) for at, lines in enumerate((PATHS, REFERENCES, MARGINS)))
    write_lists(tmp_path / "data", paths, references, margins)
    with pytest.raises(InputError, match=message):
        open_source(tmp_path / "data" / LISTS[0])


def test_lists_that_are_missing_or_too_many_are_refused(tmp_path: Path, images: dict[str, np.ndarray]):
    lists = write_lists(tmp_path / "data", PATHS, REFERENCES, MARGINS)
    (lists / LISTS[1]).rename(lists / "test_images_L.txt")
    with pytest.raises(InputError, match="no table of stills, or more than one; name the table itself"):
        open_source(lists, format="stills")
    with pytest.raises(InputError, match=r"Lref\.txt does not exist"):
        open_source(lists / LISTS[0])
