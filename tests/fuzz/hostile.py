"""Hostile inputs of every format that is read: valid files, changed where their structure is, and read as commands do.

An input is a format, a change and a seed: the same three make the same bytes. `read` gives what a command would take
from the file, so that what is accepted can be held against the original.
"""

import json
import os
import pickle
import shutil
import socket
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from data_sets import save_dataset
from made_up import write_workspace
from own_recording import write_images, write_video
from PIL import Image
from ros_bags import CAMERA, FORCE, frame_ns, raw_image, wrench, wrench_ns, write_bag
from small import make_recording, save_untrained

from sliplens.errors import SliplensError
from sliplens.files import hash_file, scratch_folder
from sliplens.models import predict
from sliplens.recordings import import_recordings, label_dataset, load_dataset
from sliplens.recordings.capture import Forces
from sliplens.recordings.check import check_dataset
from sliplens.recordings.corrections import read_corrections
from sliplens.recordings.labelling import Reason
from sliplens.recordings.options import LabelSettings, ReadOptions
from sliplens.recordings.sensor import load_profile
from sliplens.recordings.source import open_source
from sliplens.recordings.splits import assign_splits, read_split_table
from sliplens.recordings.store import forces_path, save_forces
from sliplens.recordings.trial import Labels, TrialFacts
from sliplens.results.study import load_results

Rng = np.random.Generator
Change = Callable[[Path, Rng], object]
"""Spoils a file in place."""


@dataclass(frozen=True)
class Format:
    """A kind of input: how a valid one is made, which of its files are spoilt and how, and what reads it."""

    make: Callable[[Path], object]
    files: tuple[str, ...]
    """Patterns of the files to spoil."""
    changes: dict[str, Change]
    read: Callable[[Path], object]
    after: Callable[[Path], None] = lambda _: None
    """Makes hashes right again, so that what lies behind them is reached."""


@dataclass(frozen=True, kw_only=True)
class Input:
    """Hostile input."""

    format: str
    change: str
    seed: int


def _draw(values: Sequence[str], rng: Rng) -> str:
    return values[int(rng.integers(len(values)))]


def _keep(path: Path, change: Callable[[bytearray, Rng], bytes | bytearray], rng: Rng) -> None:
    path.write_bytes(bytes(change(bytearray(path.read_bytes()), rng)))


def _flip(data: bytearray, rng: Rng) -> bytearray:
    for at in rng.integers(0, len(data), int(rng.integers(1, 9))):
        data[at] ^= int(rng.integers(1, 256))
    return data


def _zero(data: bytearray, rng: Rng) -> bytearray:
    at = int(rng.integers(len(data)))
    data[at : at + 64] = bytes(min(64, len(data) - at))
    return data


def _instead(make: Callable[[Path], object]) -> Change:
    """Put something else in the place of a file."""
    return lambda path, _: (path.unlink(), make(path))


def _socket(path: Path) -> None:
    with chdir(path.parent), socket.socket(socket.AF_UNIX) as server:  # the name of a socket is short
        server.bind(path.name)


ANY: dict[str, Change] = {
    "flipped bytes": lambda path, rng: _keep(path, _flip, rng),
    "cut off": lambda path, rng: _keep(path, lambda data, rng: data[: int(rng.integers(len(data)))], rng),
    "zeros inside": lambda path, rng: _keep(path, _zero, rng),
    "bytes added": lambda path, rng: _keep(path, lambda data, rng: data + rng.bytes(100), rng),
    "empty": lambda path, rng: _keep(path, lambda *_: b"", rng),
    "noise": lambda path, rng: _keep(path, lambda data, rng: rng.bytes(len(data)), rng),
    "pipe": _instead(os.mkfifo),
    "device": _instead(lambda path: path.symlink_to("/dev/zero")),
    "folder": _instead(Path.mkdir),
    "socket": _instead(_socket),
    "link to itself": _instead(lambda path: path.symlink_to(path.name)),
}
"""What can happen to any file."""

_HOSTILE = (
    "null", "true", "-1", "0", "1", "1.5", '""', '"x"', "[]", "{}", "[1]", '["x"]', "NaN", "Infinity", "1e308",
    "-1e308", "1e999", "1" * 30, "9" * 5000, "1e56", "1e-320", '"../../x"', '"/etc/passwd"', '"\\u0000"', '"a\\nb"',
    '"\\ud800"', '"\\u001b[2J<script>"', '"' + "x" * 300 + '"', '"' + "x" * 2_000_000 + '"', "[" * 5000 + "]" * 5000,
    '{"a":' * 500 + "1" + "}" * 500,
)  # fmt: skip
"""Values that stand in the place of others, as JSON writes them."""


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from _places(value[key])


def spoil_json(text: bytes, rng: Rng, how: str) -> bytes:
    """JSON with one of its values changed, dropped or repeated."""
    value = json.loads(text)
    places = list(_places(value))
    inside, key = places[int(rng.integers(len(places)))]
    if how == "dropped":
        del inside[key]
    elif how == "added":
        if isinstance(inside, dict):
            inside["new"] = 1
        else:
            inside.append(inside[0])
    elif how == "larger":
        inside[key] = inside[key] * 10**40 if isinstance(inside[key], int | float) else [inside[key]]
    else:
        inside[key] = "@here@"
        return json.dumps(value).replace('"@here@"', _draw(_HOSTILE, rng)).encode()
    return json.dumps(value).encode()


def _json(how: str) -> Change:
    return lambda path, rng: _keep(path, lambda data, rng: spoil_json(bytes(data), rng, how), rng)


JSON: dict[str, Change] = {f"value {how}": _json(how) for how in ("replaced", "dropped", "added", "larger")}
JSON["whole value"] = lambda path, rng: _keep(path, lambda *_: _draw(_HOSTILE, rng).encode(), rng)


def _columns(
    change: Callable[[pa.Table, str, Rng], pa.Table], fits: Callable[[pa.DataType], bool] = lambda _: True
) -> Change:
    """Change a column whose type fits; a table without any loses its rows but the first."""

    def spoil(path: Path, rng: Rng) -> None:
        table = pq.read_table(path)
        names = [field.name for field in table.schema if fits(field.type)]
        part = path.with_name("part")
        pq.write_table(change(table, _draw(names, rng), rng) if names else table.slice(0, 1), part)
        part.replace(path)

    return spoil


def _set(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, values)


def _filled(value: object) -> Change:
    """Put one value into all rows of a column of another type."""
    kind = pa.scalar(value).type
    return _columns(lambda table, name, _: _set(table, name, pa.array([value] * len(table))), lambda one: one != kind)


def _moved(value: float) -> Change:
    def change(table: pa.Table, name: str, rng: Rng) -> pa.Table:
        numbers = table.column(name).to_numpy().copy()
        numbers[int(rng.integers(len(numbers)))] = value
        return _set(table, name, pa.array(numbers))

    return _columns(change, pa.types.is_floating)


def _far(table: pa.Table, _: str, rng: Rng) -> pa.Table:
    time = table.column("time_s").to_numpy().copy()
    time[int(rng.integers(1, len(time))) :] += float(rng.choice([1e6, 1e12, 1e300]))
    return _set(table, "time_s", pa.array(time))


COLUMNS: dict[str, Change] = {
    "column dropped": _columns(lambda table, name, _: table.drop_columns([name])),
    "column of texts": _filled("x"),
    "column of whole numbers": _filled(1),
    "column of lists": _filled([1.0, 2.0]),
    "column of bytes": _filled(b"\xff"),
    "column of nothing": _columns(lambda table, name, _: _set(table, name, pa.nulls(len(table)))),
    "column of gaps": _columns(
        lambda table, name, _: _set(table, name, pa.array([None] * len(table), table.schema.field(name).type))
    ),
    "column twice": _columns(lambda table, name, _: table.append_column(name, table.column(name))),
    "no row": _columns(lambda table, _name, _: table.slice(0, 0)),
    "rows turned": _columns(lambda table, _name, _: table.take(np.arange(len(table))[::-1])),
    "rows doubled": _columns(lambda table, _name, _: pa.concat_tables([table, table])),
    "no metadata": _columns(lambda table, _name, _: table.replace_schema_metadata(None)),
    "infinity": _moved(np.inf),
    "1e56": _moved(1e56),
    "-1e9": _moved(-1e9),
    "times far apart": _columns(_far),
}
"""What can happen to a table of Parquet."""


def _header(path: Path, rng: Rng) -> None:
    table = pq.read_table(path)
    metadata = dict(table.schema.metadata or {})
    key = list(metadata)[int(rng.integers(len(metadata)))]
    if key == b"sliplens":
        metadata[key] = spoil_json(metadata[key], rng, _draw(["replaced", "dropped", "larger"], rng))
    else:
        metadata[key] = bytes(_flip(bytearray(metadata[key]), rng))
    pq.write_table(table.replace_schema_metadata(metadata), path)


def _blobs(path: Path, rng: Rng) -> None:
    table = pq.read_table(path)
    blobs = table.column("image").to_pylist()
    at = int(rng.integers(len(blobs)))
    bomb = pa.compress(bytes(50_000_000), codec="zstd").to_pybytes()
    blobs[at] = (b"", rng.bytes(50), bomb, bytes(_flip(bytearray(blobs[at]), rng)))[int(rng.integers(4))]
    pq.write_table(_set(table, "image", pa.array(blobs, pa.binary())), path)


TABLES = {name: change for name, change in {**ANY, **COLUMNS}.items() if "times" not in name}
TRIAL = {**ANY, **COLUMNS, "header": _header, "images": _blobs}


# what is read ----------------------------------------------------------------------------------------------------


def _data_set(folder: Path) -> None:
    trials = [make_recording(f"trial-{index}", seed=index) for index in range(2)]
    for index, trial in enumerate(trials):
        time = np.linspace(-0.5, 0.5, 200)
        force = np.random.default_rng(index).normal(0, 0.02, (200, 3)) + np.clip(time, 0, 0.2)[:, None] * [1, 0, 9]
        save_forces(Forces(time_s=time, force_n=force, source="made up"), forces_path(folder, trial.trial))
    save_dataset(folder, *trials, split=("train", "test"))


def _hashes(folder: Path) -> None:
    """Make the hashes of a data set's table right again."""
    values = json.loads((folder / "dataset.json").read_text())
    for trial in values["trials"]:
        for key, path in (("sha256", folder / "trials"), ("forces_sha256", folder / "forces")):
            file = path / f"{trial['trial']}.parquet"
            if file.is_file() and not file.is_symlink():
                trial[key] = hash_file(file)
    (folder / "dataset.json").write_text(json.dumps(values))


def _read_data_set(folder: Path) -> object:
    data = load_dataset(folder)
    told = [finding for finding in check_dataset(data) if not finding.doubt]
    if told:
        raise _FoundError(told[0].what)
    trials = map(data.open, data.trials)
    return [(one.trial, one.safety_margin, [*one.read_frames()], one.frame_time_s) for one in trials]


class _FoundError(Exception):
    """A finding of `sliplens check`, which is a sentence as an error is."""


def _require_no_fault(labels: Labels) -> None:
    """Take what labels tell of wrong samples for the sentence that it is; what was marked by hand is none."""
    basis = labels.labelling and labels.labelling.basis
    if faults := [one for one in basis.faults if one.kind != Reason.MARKED] if basis else []:
        raise _FoundError(f"{faults[0].kind} at {faults[0].start_s} s")


def _labels(folder: Path) -> object:
    data = label_dataset(folder, out=folder / "out", labelling=LabelSettings(mu=0.6), overwrite=True)
    labels = data.read_labels(data.find("trial-0"))
    _require_no_fault(labels)
    return labels.safety_margin


def _own(folder: Path) -> None:
    """A folder of images with forces and times beside it, and a manifest."""
    trial = make_recording("cup", frames=60)
    write_images(folder / "cup", trial.frames, "{:03d}.png")
    rng = np.random.default_rng(0)
    time = np.arange(0, 2, 0.002)
    normal = 5 * np.clip((time - 0.3) / 0.2, 0, 1)
    pull = np.where(time < 1.5, 3.5 * np.clip((time - 0.6) / 0.9, 0, 1), 2.4)
    forces = np.stack([pull, 0 * time, normal], axis=1) + rng.normal(0, 0.01, (len(time), 3))
    lines = [",".join(f"{value:.5f}" for value in (at, *force)) for at, force in zip(time, forces, strict=True)]
    (folder / "forces.csv").write_text("\n".join(["time_s,fx,fy,fz", *lines]) + "\n")
    (folder / "many.csv").write_text("trial,video,forces,day,mu,sensor\ncup,cup,forces.csv,1,0.6,tip\n")


def _import(folder: Path, source: str = "cup", **options: Any) -> object:
    data = import_recordings(
        folder / source,
        out=folder / "out",
        sensor="tip",
        labelling=LabelSettings(mu=0.6),
        reading=ReadOptions(frame_rate=30.0, **options),
    )
    if data.left_out:
        raise _FoundError(data.left_out[0].why)
    labels = [data.read_labels(one) for one in data.trials]
    for one in labels:
        _require_no_fault(one)
    return [one.safety_margin for one in labels]


def _lines(change: Callable[[list[str], int, Rng], Any]) -> Change:
    def spoil(path: Path, rng: Rng) -> None:
        lines = path.read_text().splitlines()
        change(lines, int(rng.integers(1, len(lines))), rng)
        path.write_text("\n".join(lines) + "\n", errors="surrogateescape")

    return spoil


def _cell(lines: list[str], at: int, rng: Rng) -> None:
    cells = lines[at].split(",")
    cells[int(rng.integers(len(cells)))] = _draw(_CELLS, rng)
    lines[at] = ",".join(cells)


_CELLS = (
    "", "nan", "inf", "x", "1e400", "1e56", "-1e300", "9" * 5000, "1_000", "\x00", "\x1b[2J", '"', "../../x", "=1+1",
    "0x10",
)  # fmt: skip


def _put(at: int | None, text: Callable[[str, int], str]) -> Callable[[list[str], int, Rng], None]:
    """Another text in the place of a line, `at` or any, or of all from it on where `at` is negative."""

    def change(lines: list[str], drawn: int, _: Rng) -> None:
        rows = [drawn] if at is None else [at] if at >= 0 else range(drawn, len(lines))
        for row in rows:
            lines[row] = text(lines[row], row)

    return change


def _stamped(stamp: Callable[[int], float]) -> Change:
    return _lines(_put(-1, lambda line, row: f"{stamp(row):.15f},{line.split(',', 1)[1]}"))


TABLE: dict[str, Change] = {
    "cell replaced": _lines(_cell),
    "line twice": _lines(lambda lines, at, _: lines.insert(at, lines[at])),
    "line dropped": _lines(lambda lines, at, _: lines.pop(at)),
    "line without end": _lines(_put(None, lambda *_: "1," * 400_000)),
    "header dropped": _lines(lambda lines, *_: lines.pop(0)),
    "header doubled": _lines(_put(0, lambda line, _: f"{line},{line}")),
    "times far apart": _stamped(lambda row: 1e6 + row * 0.002),
    "times close": _stamped(lambda row: 10 + row * 1e-12),
}
MANY = {name: change for name, change in {**ANY, **TABLE}.items() if "times" not in name}


@cache
def bomb() -> bytes:
    """A picture of 507 MB in few bytes, whose making takes longer than all that is done with it."""
    Image.new("RGB", (13_000, 13_000)).save(packed := BytesIO(), format="PNG", compress_level=1)
    return packed.getvalue()


def _as(form: str, mode: str) -> Change:
    def spoil(path: Path, rng: Rng) -> None:
        with Image.open(path) as image:
            image.convert(mode).save(path, format=form)

    return spoil


def claim_size(path: Path, size: tuple[int, int]) -> None:
    """Write another width and height into the header of a PNG, its checksum right."""
    data = bytearray(path.read_bytes())
    data[16:24] = np.array(size).astype(">u4").tobytes()
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    path.write_bytes(data)


PICTURE: dict[str, Change] = {
    **ANY,
    "bomb": lambda path, _: path.write_bytes(bomb()),
    "claims a size": lambda path, rng: claim_size(path, tuple(rng.integers(1, 2**15, 2).tolist())),
    "jpeg": _as("JPEG", "RGB"), "palette": _as("PNG", "P"), "alpha": _as("PNG", "RGBA"), "gif": _as("GIF", "P"),
}  # fmt: skip


def _read_frames(source: Path, **options: Any) -> object:
    return [np.stack([*one.read_frames()]) for one in open_source(source, options=ReadOptions(**options))]


def _video(folder: Path) -> None:
    write_video(make_recording("cup", frames=20), folder / "cup.mkv")


def _npz(folder: Path) -> None:
    frames = make_recording("cup", frames=20).frames
    forces = {name: np.linspace(0, 2, 20) for name in ("fx", "fy", "fz")}
    np.savez(folder / "cup.npz", allow_pickle=False, frames=frames, time_s=np.arange(20) / 30, **forces)


def _bag(folder: Path) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (20, 12, 16, 3), dtype=np.uint8)
    frames = [(CAMERA, raw_image(each, frame_ns(at)), frame_ns(at)) for at, each in enumerate(pixels)]
    samples = [(FORCE, wrench((0.0, 0.0, float(at)), wrench_ns(at)), wrench_ns(at)) for at in range(60)]
    write_bag(folder / "bag", sorted([*frames, *samples], key=itemgetter(2)))


def _read_workspace(folder: Path) -> object:
    return repr(load_results(folder / "work"))


def _arrays(change: Callable[[dict[str, np.ndarray], str, Rng], Any]) -> Change:
    def spoil(path: Path, rng: Rng) -> None:
        with np.load(path) as archive:
            arrays = dict(archive)
        change(arrays, _draw(list(arrays), rng), rng)
        with path.open("wb") as stream:
            np.savez_compressed(stream, **arrays)

    return spoil


def _huge_claim(path: Path, _: Rng) -> None:
    """An array whose header claims a terabyte."""

    with np.load(path) as archive:
        name = archive.files[0]
    head = BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": (2**38,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.npy", head.getvalue() + bytes(64))


ARRAYS: dict[str, Change] = {
    **ANY,
    "array dropped": _arrays(lambda arrays, name, _: arrays.pop(name)),
    "array of texts": _arrays(lambda arrays, name, _: arrays.__setitem__(name, np.array(["x"]))),
    "array of no number": _arrays(lambda arrays, name, _: arrays.__setitem__(name, arrays[name] * np.float32(np.nan))),
    "array of another shape": _arrays(lambda arrays, name, _: arrays.__setitem__(name, arrays[name][:1])),
    "claims a terabyte": _huge_claim,
}  # fmt: skip


def _network(folder: Path) -> None:
    save_untrained(folder / "run")


def _weights_hash(folder: Path) -> None:
    weights, manifest = folder / "run" / "model.safetensors", folder / "run" / "manifest.json"
    if weights.is_file() and not weights.is_symlink() and manifest.is_file():
        values = json.loads(manifest.read_text())
        manifest.write_text(json.dumps({**values, "weights_sha256": hash_file(weights)}))


def _read_network(folder: Path) -> object:
    frames = np.random.default_rng(0).integers(0, 255, (2, 48, 48, 3), dtype=np.uint8)
    table = predict(folder / "run", frames, reference_frame=0).to_arrow()
    return table.column("prediction").to_numpy()


def _tensors(path: Path, rng: Rng) -> None:
    """Another header over the same numbers."""
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    head = spoil_json(data[8 : 8 + size].strip(), rng, _draw(["replaced", "dropped", "larger"], rng))
    path.write_bytes(len(head).to_bytes(8, "little") + head + data[8 + size :])


def _not_finite(path: Path, rng: Rng) -> None:
    data = bytearray(path.read_bytes())
    at = 8 + int.from_bytes(data[:8], "little") + 4 * int(rng.integers(1000, 100_000))
    data[at : at + 4] = np.float32(rng.choice([np.nan, np.inf])).tobytes()
    path.write_bytes(data)


def _value(path: Path, rng: Rng) -> None:
    lines = path.read_text().splitlines()
    at = int(rng.choice([row for row, line in enumerate(lines) if "=" in line]))
    value = _draw((*_HOSTILE, "nan", "inf", "1979-05-27", "'x", "{ a = 1 }"), rng)
    lines[at] = lines[at].split("=")[0] + "= " + value
    path.write_text("\n".join(lines))


TOML: dict[str, Change] = {**ANY, "value replaced": _value, "line dropped": _lines(lambda lines, at, _: lines.pop(at))}


def _read_toml(folder: Path) -> object:
    profile = load_profile(folder / "tip.toml")
    return profile, profile.output_size((480, 640))


def _read_splits(folder: Path) -> object:
    trials = [TrialFacts(trial=f"{name}-{day}", day=day) for name in ("mug", "cup", "jar") for day in (1, 2)]
    return assign_splits(trials, read_split_table(folder / "splits.csv")).splits


TEXTS = {
    "splits.csv": "trial,split\nmug-1,test\nc*,validation\n*,train\n",
    "corrections.csv": "trial,exclude,reference_frame,slip_s,tare,normal_sign,mu,bad_frames\n"
    "trial-0,,5,1.25,0.1 0 -0.2,-1,0.7,2..3 9\ntrial-1,yes,,,,,,\n",
    "tip.toml": 'name = "tip"\ncamera_size_px = [640, 480]\ncrop_px = [80, 0, 480, 480]\nresize_px = [224, 224]\n'
    "frame_rate_hz = 30.0\n",
}


def _text(name: str) -> Callable[[Path], object]:
    """Maker of a folder with one of `TEXTS`."""
    return lambda folder: (folder / name).write_text(TEXTS[name])


def _read_corrections(folder: Path) -> object:
    return read_corrections(folder / "corrections.csv")


def _frames_of(name: str, **options: Any) -> Callable[[Path], object]:
    return lambda folder: _read_frames(folder / name, **options)


_WEIGHTS = {**ANY, "header": _tensors, "not finite": _not_finite}
FORMATS = {
    "data set": Format(_data_set, ("dataset.json",), {**ANY, **JSON}, _read_data_set),
    "trial": Format(_data_set, ("trials/trial-0.parquet",), TRIAL, _read_data_set, _hashes),
    "samples": Format(_data_set, ("forces/trial-0.parquet",), {**ANY, **COLUMNS}, _labels, _hashes),
    "corrections": Format(_text("corrections.csv"), ("corrections.csv",), MANY, _read_corrections),
    **{
        name: Format(lambda folder: write_workspace(folder / "work", trials=2), (files,), changes, _read_workspace)
        for name, files, changes in (
            ("stages", "work/*/*.json", {**ANY, **JSON}),
            ("tables", "work/*/*.parquet", TABLES),
            ("arrays", "work/*/arrays.npz", ARRAYS),
        )
    },
    "network": Format(_network, ("run/manifest.json",), {**ANY, **JSON}, _read_network),
    "weights": Format(_network, ("run/model.safetensors",), _WEIGHTS, _read_network, _weights_hash),
    "forces": Format(
        _own, ("forces.csv",), {**ANY, **TABLE}, lambda folder: _import(folder, forces=folder / "forces.csv")
    ),
    "splits": Format(_text("splits.csv"), ("splits.csv",), MANY, _read_splits),
    "manifest": Format(_own, ("many.csv",), MANY, lambda folder: _import(folder, "many.csv")),
    "images": Format(_own, ("cup/0*.png",), PICTURE, _frames_of("cup", frame_rate=30.0)),
    "video": Format(_video, ("cup.mkv",), ANY, _frames_of("cup.mkv")),
    "bag": Format(_bag, ("bag/bag.mcap",), ANY, _frames_of("bag/bag.mcap")),
    "npz": Format(_npz, ("cup.npz",), ARRAYS, _frames_of("cup.npz")),
    "toml": Format(_text("tip.toml"), ("*.toml",), TOML, _read_toml),
}
"""Every kind of input."""

IMPOSSIBLE = frozenset({
    "pipe", "device", "folder", "socket", "link to itself", "noise", "column of texts", "column of lists",
    "column of gaps", "column of bytes", "infinity", "1e56", "-1e9", "times far apart", "times close", "bomb",
    "claims a terabyte",
    "not finite", "array of texts", "array of another shape", "line without end",
})  # fmt: skip
"""Changes after which no input is right."""


def inputs(count: int, *, seed: int = 0) -> Iterator[Input]:
    """So many inputs, every change of every format before any comes again."""
    pairs = [(name, change) for name, kind in FORMATS.items() for change in kind.changes]
    order = np.random.default_rng(seed).permutation(len(pairs))
    for number in range(count):
        name, change = pairs[order[number % len(pairs)]]
        yield Input(format=name, change=change, seed=seed + number // len(pairs))


@cache
def original(name: str, folder: Path) -> Path:
    """Folder of a valid input, made once."""
    if not (made := folder / name.replace(" ", "-")).is_dir():
        part = made.with_name(f"{made.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        FORMATS[name].make(part)
        part.rename(made)
    return made


def spoil(one: Input, originals: Path, folder: Path) -> Path:
    """Make a hostile input out of a valid one, in a new folder."""
    kind, rng = FORMATS[one.format], np.random.default_rng((one.seed, len(one.change), len(one.format)))
    shutil.copytree(original(one.format, originals), folder)
    files = sorted(path for pattern in kind.files for path in folder.glob(pattern))
    kind.changes[one.change](files[int(rng.integers(len(files)))], rng)
    kind.after(folder)
    return folder


def same(first: object, second: object) -> bool:
    """Whether two readings are alike, NaN and all."""
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return np.array_equal(first, second, equal_nan=first.dtype.kind == "f")
    if isinstance(first, list | tuple) and isinstance(second, list | tuple):
        return len(first) == len(second) and all(same(*pair) for pair in zip(first, second, strict=True))
    return bool(first == second)


def left_behind(folder: Path) -> list[str]:
    """Files of an output that was refused."""
    return [
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and (".partial" in str(path) or path.suffix == ".part")
    ]


def outcome(one: Input, originals: Path, folder: Path) -> tuple[str, str]:
    """What became of an input: refused (and the sentence), same, accepted, wrong, or partial.

    Whatever is raised but a sentence goes on.
    """
    reading = FORMATS[one.format].read
    spoilt = spoil(one, originals, folder)
    try:
        found = reading(spoilt)
    except (SliplensError, _FoundError) as error:
        if "\n" in str(error) or len(str(error)) > 2000:
            return "traceback", f"a sentence of {len(str(error))} characters in {str(error).count(chr(10)) + 1} lines"
        return ("partial", left[0]) if (left := left_behind(folder)) else ("refused", str(error))
    if same(found, whole_reading(one.format, originals)):
        return "same", ""
    return ("wrong" if one.change in IMPOSSIBLE else "accepted"), ""


def whole_reading(name: str, originals: Path) -> object:
    """Reading of a valid input, stored beside it."""
    stored = originals / f"{name}.pickle"
    if not stored.is_file():
        with scratch_folder() as folder:
            shutil.copytree(original(name, originals), folder / "input")
            stored.write_bytes(pickle.dumps(FORMATS[name].read(folder / "input")))
    return pickle.loads(stored.read_bytes())  # noqa: S301 (written by this function)
