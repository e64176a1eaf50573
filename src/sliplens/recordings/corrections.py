"""Table of corrections (CSV): a row a trial, a column a setting; `sliplens label DATA --corrections` applies it."""

import csv
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np

from sliplens.errors import InputError, RecordingError
from sliplens.files import MOST_TEXT, require_file, whole_file
from sliplens.recordings.dataset import Dataset, load_dataset
from sliplens.recordings.labelling import Corrections
from sliplens.recordings.manifest import read_csv
from sliplens.recordings.trial import ContactState, Recording

_SETTINGS = tuple(field.name for field in fields(Corrections))
_CURRENT = ("reference_frame", "contact_s", "slip_s", "tare", "normal_sign", "mu")
_COLUMNS = ("trial", *_SETTINGS, *(f"current_{name}" for name in _CURRENT), "valid_frames", "frames", "flags")
_WORDS = {**dict.fromkeys(("yes", "true", "1", "x"), True), **dict.fromkeys(("no", "false", "0"), False)}
_CURES = {
    "exclude": "write yes or no",
    **dict.fromkeys(("reference_frame", "normal_sign"), "write a whole number"),
    **dict.fromkeys(("contact_s", "slip_s", "mu"), "write a number with a decimal point"),
    "tare": "write three numbers, such as 0.01 0 -0.2",
    "bad_frames": "write spans of frames, such as 10..19 34",
}


def read_corrections(path: Path | str) -> dict[str, Corrections]:
    """Read a table of corrections; gives those of each trial that has any.

    The column `trial` names the trial, the others are fields of `Corrections`. An empty cell leaves the automatic
    value. Columns that `draft_corrections` writes for information are ignored.
    """
    path = Path(path)
    require_file(path, most=MOST_TEXT, missing="write one with `sliplens label DATA --draft corrections.csv`")
    corrections: dict[str, Corrections] = {}
    for where, cells in read_csv(path, _COLUMNS, what="a table of corrections"):
        if "trial" not in cells:
            raise RecordingError(f"{where}: the column trial is empty; name the trial that the row corrects")
        if cells["trial"] in corrections:
            raise RecordingError(f"{where}: {cells['trial']} has a row already; write one row a trial")
        corrections[cells["trial"]] = _parse_row(cells, where)
    return {trial: row for trial, row in corrections.items() if row != Corrections()}


def _parse_row(cells: dict[str, str], where: str) -> Corrections:
    values = {}
    for name in _SETTINGS:
        if name in cells:
            try:
                values[name] = _PARSERS[name](cells[name])
            except (ValueError, KeyError):
                raise RecordingError(f"{where}: {name} is {cells[name][:40]!r}; {_CURES[name]}") from None
    try:
        return Corrections(**values)
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from None


def _parse_tare(text: str) -> tuple[float, float, float]:
    x, y, z = map(float, re.split(r"[\s;]+", text))
    return x, y, z


def _parse_spans(text: str) -> tuple[tuple[int, int], ...]:
    # two dots: a spreadsheet would take 10-12 for a date
    ends = [span.split("..") for span in re.split(r"[\s;]+", text)]
    if any(len(span) > 2 for span in ends):
        raise ValueError(text)
    return tuple((int(span[0]), int(span[-1])) for span in ends)


_PARSERS: dict[str, Callable[[str], object]] = {
    "exclude": lambda text: _WORDS[text.lower()],
    **dict.fromkeys(("reference_frame", "normal_sign"), int),
    **dict.fromkeys(("contact_s", "slip_s", "mu"), float),
    "tare": _parse_tare,
    "bad_frames": _parse_spans,
}


def draft_corrections(data: Dataset | Path | str, path: Path | str) -> None:
    """Write a table of corrections to be edited: a row a trial, with its corrections so far and its current labels.

    Columns that begin with `current_` show the values of the present labels and are ignored on reading: write the value
    that should hold instead into the column without that prefix. `sliplens label DATA --corrections` applies the table.
    """
    data, path = data if isinstance(data, Dataset) else load_dataset(data), Path(path)
    if path.exists():
        raise InputError(f"{path} exists and may hold corrections; name a file that does not")
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, _COLUMNS)
        writer.writeheader()
        for info in data.trials:
            writer.writerow({"trial": info.trial, **_draft_row(data.read_labels(info))})


def _draft_row(labels: Recording) -> dict[str, str]:
    labelling, row = labels.labelling, {"valid_frames": str(labels.labelled.sum()), "frames": str(len(labels))}
    if labelling is None:
        return row
    if labelling.corrections is not None:
        row |= {name: _cell(getattr(labelling.corrections, name)) for name in _SETTINGS}
    current: dict[str, object] = {"reference_frame": labelling.reference.index}
    if (basis := labelling.basis) is not None:
        touching = [state not in (ContactState.NO_CONTACT, ContactState.UNKNOWN) for state in labels.contact_state]
        time_s = labels.time_s if labels.force_time_s is None else labels.force_time_s
        current |= {
            "contact_s": float(time_s[np.argmax(touching)]) if any(touching) else None,
            "slip_s": basis.slip_s,
            "tare": basis.axes.tare_n,
            "normal_sign": basis.axes.sign,
            "mu": basis.friction.mu,
        }
        row["flags"] = "; ".join(basis.flags)
    return row | {f"current_{name}": _cell(value) for name, value in current.items()}


def _cell(value: object) -> str:
    match value:
        case None | False:
            return ""
        case True:
            return "yes"
        case float():
            return f"{value:.6g}"
        case tuple():
            return " ".join("..".join(map(str, item)) if isinstance(item, tuple) else _cell(item) for item in value)
    return str(value)
