"""Table of corrections by hand: how its cells are read, and which are refused."""

from pathlib import Path

import pytest

from sliplens.errors import InputError
from sliplens.recordings import Corrections, LabelSettings, read_corrections

_HEADER = "trial,exclude,reference_frame,contact_s,slip_s,tare,normal_sign,mu,bad_frames,flags"


def test_cells_become_corrections_and_empty_ones_none(tmp_path: Path):
    path = tmp_path / "corrections.csv"
    path.write_text(
        f"\ufeff{_HEADER}\ncup,,3,0.5,1.25,0.1 0 -2e-1,-1,0.7,2..3 9,a step\njar,yes,,,,,,,,\negg,no,,,,,,,,fine\n\n",
        encoding="utf-8",
    )
    assert read_corrections(path) == {
        "cup": Corrections(
            reference_frame=3,
            contact_s=0.5,
            slip_s=1.25,
            tare=(0.1, 0.0, -0.2),
            normal_sign=-1,
            mu=0.7,
            bad_frames=((2, 3), (9, 9)),
        ),
        "jar": Corrections(exclude=True),
    }


def test_corrections_replace_settings_and_add_bad_frames():
    settings = LabelSettings(mu=0.5, slip_s=1.0, apply_lag=True, bad_frames=((0, 1),))
    corrected = Corrections(slip_s=2.0, bad_frames=((5, 6),)).apply(settings)
    assert corrected == LabelSettings(mu=0.5, slip_s=2.0, apply_lag=True, bad_frames=((0, 1), (5, 6)))


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("exclude", "perhaps"), ("reference_frame", "1.5"), ("contact_s", "soon"), ("slip_s", "nan"), ("slip_s", "1 2"),
        ("tare", "1 2"), ("tare", "1 2 inf"), ("normal_sign", "2"), ("mu", "-1"), ("mu", "50"), ("bad_frames", "1.5"),
        ("bad_frames", "1..2..3"), ("bad_frames", "10-12"), ("colour", "red"), ("trial", ""),
    ],
)  # fmt: skip
def test_every_refused_cell_is_named_with_its_cure(tmp_path: Path, column: str, value: str):
    path = tmp_path / "corrections.csv"
    path.write_text(f"trial,{column}\ncup,{value}\n" if column != "trial" else "trial,mu\n,0.5\n")
    with pytest.raises(InputError, match=rf"{path}.*{column}.*(write|give|has|name) "):
        read_corrections(path)


def test_a_trial_has_one_row(tmp_path: Path):
    path = tmp_path / "corrections.csv"
    path.write_text("trial,mu\ncup,0.5\ncup,0.6\n")
    with pytest.raises(InputError, match="line 3: cup has a row already; write one row a trial"):
        read_corrections(path)
