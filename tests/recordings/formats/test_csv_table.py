from pathlib import Path

import numpy as np
import pytest
from readers import read_force_table, refused

from sliplens.recordings.formats.tables import open_text_table

TIME = [0.0, 0.01, 0.02]
FORCE = [[0.5, -0.25, 2.0], [0.75, -0.5, 4.0], [1.0, -0.75, 6.0]]


def write(folder: Path, text: str, *, encoding: str = "utf-8") -> Path:
    path = folder / "forces.csv"
    path.write_text(text, encoding=encoding)
    return path


def table(*, header: str = "time_s,fx,fy,fz", separator: str = ",", comma: bool = False) -> str:
    rows = [[time, *force] for time, force in zip(TIME, FORCE, strict=True)]
    lines = [separator.join(f"{value:g}" for value in row) for row in rows]
    if comma:
        lines = [line.replace(".", ",") for line in lines]
    return "\n".join([header.replace(",", separator), *lines]) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        table(separator=";"),
        table(separator="\t"),
        table(separator=";", comma=True),
        "\ufeff" + table(),
        "# logged by hand\n\n" + table().replace("\n", "\n# a note, with commas, in between\n", 2),
        table().replace("\n", "\r\n"),
        table().replace("time_s,fx", '"time_s","fx"'),
        table(header="Time (s),Fx,Fy,Fz"),
        table(header="timestamp,force_x,force_y,force_z"),
        table(header="sec,Force X (N),Force Y (N),Force Z (N)"),
        table(header="t,wrench.force.x,wrench.force.y,wrench.force.z"),
        table(header="elapsed_s,sensor_fx_n,sensor_fy_n,sensor_fz_n"),
        table(header="Zeit [s],Fx [N],Fy [N],Fz [N]", separator=";", comma=True),
        table(separator="  "),
        "sep=;\n" + table(separator=";"),
        "Messung von Hand, am Montag\nSensor: ATI Mini40, Nr. 3\n\n" + table(separator=";"),
        "%" + table(header="time,field.wrench.force.x,field.wrench.force.y,field.wrench.force.z"),
        "# time_s fx fy fz\n" + table(separator=" ").partition("\n")[2],
        table(header="Time,Fx,Fy,Fz").replace("\n", "\ns,N,N,N\n", 1),
        table(header="Zeit;Fx;Fy;Fz;Tx", separator=";")
        .replace("\n", ";0\n")
        .replace(";Tx;0\n", ";Tx\n[s];[N];[N];[N];[Nm]\n"),
        table().replace("-", "\u2212"),
        "F/T Sequence," + table(header="Time,Fx,Fy,Fz").rstrip().replace("\n", "\n7,"),
    ],
)
def test_layout_and_names_of_columns_do_not_matter(tmp_path: Path, text: str):
    forces, _ = read_force_table(write(tmp_path, text))
    np.testing.assert_allclose(forces.time_s, TIME)
    np.testing.assert_allclose(forces.force_n, FORCE)


@pytest.mark.parametrize(
    "number", ["1.234,5", "1,234.5", "1 234,5", "1'234.5", "1\u202f234,5", "\u22121.234.567,5", "1234.5"]
)
def test_separated_thousands_are_no_decimals(tmp_path: Path, number: str):
    forces, _ = read_force_table(write(tmp_path, f"t [s];fx [mN];fy [mN];fz [mN]\n0;{number};0;0\n1;0;0;1\n"))
    assert forces.force_n[0, 0] == pytest.approx(-1234.5675 if number.startswith("\u2212") else 1.2345)


def test_seconds_and_nanoseconds_of_two_columns_are_one_time(tmp_path: Path):
    text = "header.stamp.sec,header.stamp.nanosec,fx,fy,fz\n3,999000000,0,0,1\n4,1000000,0,0,1\n"
    forces, _ = read_force_table(write(tmp_path, text))
    np.testing.assert_allclose(forces.time_s, [3.999, 4.001])


def test_the_stamp_of_a_message_goes_before_its_arrival(tmp_path: Path):
    text = "%time,field.header.stamp,fx,fy,fz\n1700000000500000000,1700000000000000000,0,0,1\n"
    text += "1700000000600000000,1700000000010000000,0,0,1\n"
    forces, _ = read_force_table(write(tmp_path, text))
    np.testing.assert_allclose(np.diff(forces.time_s), [0.01], rtol=1e-3)


def test_samples_that_share_the_stamp_of_a_coarse_clock_are_spread(tmp_path: Path):
    text = "t [ms],fx,fy,fz\n" + "".join(f"{row // 4 * 10},0,0,{row}\n" for row in range(20))
    forces, notes = read_force_table(write(tmp_path, text))
    np.testing.assert_allclose(forces.time_s, np.arange(20) * 0.0025)
    assert "15 samples share a stamp" in notes[0]


def test_a_row_of_labels_is_no_row_of_units(tmp_path: Path):
    opened = open_text_table(write(tmp_path, "file,slips,who\na.avi,n,me\nb.avi,s,me\n"))
    assert [cells[:2] for _, cells in opened.rows] == [["a.avi", "n"], ["b.avi", "s"]]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8"])
def test_a_micro_sign_is_read_in_any_encoding(tmp_path: Path, encoding: str):
    text = "t [\u00b5s];fx [mN];fy [mN];fz [mN]\n0;1;2;3\n1000;4;5;6\n"
    forces, _ = read_force_table(write(tmp_path, text, encoding=encoding))
    np.testing.assert_allclose(forces.time_s, [0, 1e-3])
    np.testing.assert_allclose(forces.force_n, [[1e-3, 2e-3, 3e-3], [4e-3, 5e-3, 6e-3]])


@pytest.mark.parametrize(
    "names", ["t,Fn,Ft", "t,normal_force_n,tangential_force_n", "t,f_n,f_t", "t,normal [N],shear [N]"]
)
def test_a_normal_and_a_tangential_force_lie_along_z_and_x(tmp_path: Path, names: str):
    forces, _ = read_force_table(write(tmp_path, f"{names}\n0,5,1\n0.1,6,2\n"))
    np.testing.assert_array_equal(forces.force_n, [[1, 0, 5], [2, 0, 6]])


@pytest.mark.parametrize(
    ("unit", "newtons"), [("N", 1.0), ("mN", 1e-3), ("gf", 9.80665e-3), ("kgf", 9.80665), ("kN", 1e3)]
)
def test_units_are_read_from_brackets_or_declared(tmp_path: Path, unit: str, newtons: float):
    named, _ = read_force_table(write(tmp_path, table(header=f"t,fx [{unit}],fy [{unit}],fz [{unit}]")))
    declared, _ = read_force_table(write(tmp_path, table()), force_unit=unit)
    np.testing.assert_allclose(named.force_n, newtons * np.array(FORCE))
    np.testing.assert_allclose(declared.force_n, newtons * np.array(FORCE))


@pytest.mark.parametrize("since", [0, 1_700_000_000])
@pytest.mark.parametrize("per_s", [1, 10**3, 10**6, 10**9])
def test_the_unit_of_time_is_guessed_from_steps_or_dates(tmp_path: Path, since: int, per_s: int):
    times = [f"{since + 0.001 * row:.3f}" if per_s == 1 else since * per_s + row * per_s // 1000 for row in range(3)]
    text = "t,fx,fy,fz\n" + "".join(f"{time},0,0,1\n" for time in times)
    forces, notes = read_force_table(write(tmp_path, text))
    # double precision holds seconds since 1970 to 0.24 us
    np.testing.assert_allclose(np.diff(forces.time_s), 1e-3, rtol=1e-3)
    assert "guessed: 3 samples in" in notes[0]


def test_what_is_declared_is_not_guessed(tmp_path: Path):
    text = "t,clock,a,b,c\n9,0,1,2,3\n8,10,4,5,6\n"
    forces, notes = read_force_table(
        write(tmp_path, text), time_column="clock", force_columns=("C", "b", "a"), time_unit="ms", force_unit="mN"
    )
    np.testing.assert_allclose(forces.time_s, [0, 0.01])
    np.testing.assert_allclose(forces.force_n, [[3e-3, 2e-3, 1e-3], [6e-3, 5e-3, 4e-3]])
    assert [note.count("(declared)") for note in notes] == [2, 2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"forces\.csv is empty"),
        ("time,fx,fy,fz\n", "has a header but no row"),
        ("0,1,2,3\n1,1,2,3\n", "begins with numbers"),
        ("time\n1\n2\n", "has a single column 'time'"),
        ("when,fx,fy,fz\n0,1,2,3\n", "no columns that look like the time among 'when', 'fx', 'fy', 'fz'; .*--time-col"),
        ("time,stamp,fx,fy,fz\n0,0,1,2,3\n", "2 columns that look like the time"),
        ("time,fx,fy\n0,1,2\n", "no columns that look like forces.*--force-columns"),
        ("time,fx,fx,fy,fz\n0,1,2,3,4\n", "no columns that look like forces"),
        ("time,fz\n0,1\n", "no columns that look like forces"),
        ("time,fx,fy,fz\n0,1,2,3\n1,1,much,3\n", r"line 3, 'fy' is 'much', not a finite number"),
        ("time,fx,fy,fz\nnan,1,2,3\n", r"line 2, 'time' is 'nan', not a finite number"),
        ("time,fx,fy,fz\n0,1,nan,3\n1,,2,3\n", "has no sample that is a number"),
        ("time,fx,fy,fz\n0,1,2,3\n0,1,2,3\n", r"line 3: 'time' repeats \(0, then 0\)"),
        ("time,fx,fy,fz\n0,1,2,3\n1,1,2\n", "line 3 has 3 columns but the header 4; correct the line"),
        ("time,fx,fy,fz\n0,1,1,5,2,5,3,5\n", "where decimals are commas, separate the columns by semicolons"),
        ("time;fx;fy;fz\n0;1,5;2;3\n1;1.5;2;3\n", "mixes decimal commas and points"),
        ("time,fx,fy,fz\n0,1,2,3\n1,1,2,20000\n", r"line 3: 2e\+04 N is no force of a fingertip"),
        ("time,fx [V],fy [V],fz [V]\n0,1,2,3\n", "column 'fx .V.': 'V' is no unit of force"),
        ("time [h],fx,fy,fz\n0,1,2,3\n", "column 'time .h.': 'h' is no unit of time"),
    ],
)
def test_a_table_that_cannot_be_trusted_is_refused(tmp_path: Path, text: str, message: str):
    refused(read_force_table, write(tmp_path, text), message)


def test_what_is_no_text_is_refused(tmp_path: Path, rng: np.random.Generator):
    path = tmp_path / "forces.csv"
    path.write_bytes(rng.bytes(5000))
    refused(read_force_table, path, r"forces\.csv is not a text file; export the table as CSV")
    refused(read_force_table, tmp_path / "nothing.csv", "does not exist; check the path")
    refused(read_force_table, tmp_path, "is a folder, not a file")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time_column": "when"}, r"no column 'when', it has 'time_s', 'fx', 'fy', 'fz'; name it with"),
        ({"force_columns": ("fx", "fy", "fw")}, "no column 'fw'"),
        ({"force_columns": ("fx",)}, "columns 'fx' are no force"),
        ({"force_columns": ("fx", "fx", "fz")}, "columns 'fx', 'fx', 'fz' are no force"),
        ({"time_unit": "weeks"}, "'weeks' is no unit of time; use one of s, ms, us, ns"),
        ({"force_unit": "V"}, "'V' is no unit of force; use one of N, mN, kN, gf, kgf, lbf"),
    ],
)
def test_a_declaration_that_fits_nothing_is_refused(tmp_path: Path, options: dict, message: str):
    refused(read_force_table, write(tmp_path, table()), message, **options)
