"""Repairs of labels by hand: kept beside a data set, one line of JSON each, with who and when."""

import getpass
import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from sliplens.codec import from_builtins, to_builtins
from sliplens.errors import InputError, RecordingError
from sliplens.files import MOST_TEXT, parse_json, require_file
from sliplens.recordings.dataset import Dataset
from sliplens.recordings.formats.stored import read_stored_trial
from sliplens.recordings.labelling import Edit, EditKind
from sliplens.recordings.labels.margin import require_inside
from sliplens.recordings.options import LabelSettings

EDITS_FILE = "edits.jsonl"
"""File of a data set that keeps its edits, in the order in which they were made."""


def make_edit(
    trial: str, kind: EditKind | str, value: float | int | Sequence[float | int] | None = None, *, by: str | None = None
) -> Edit:
    """Edit of now, its value in frames, seconds or newtons as its kind asks; by who is logged in if `by` is None.

    Examples
    --------
    >>> from sliplens.recordings.edits import make_edit
    >>> make_edit("cup", "slip_s", 1.25, by="ana").value
    1.25
    """
    now = datetime.now(UTC).isoformat(timespec="seconds")
    numbers = tuple(map(float, value)) if isinstance(value, Sequence) else None if value is None else float(value)
    return Edit(trial=trial, kind=EditKind(kind), value=numbers, by=by or login_name(), at=now)


def login_name() -> str:
    """Name of who is logged in, "unknown" where the system does not tell."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return "unknown"


def read_edits(folder: Path) -> tuple[Edit, ...]:
    """Read all edits of a data set, those that were undone too; none where there is no file.

    Raises
    ------
    RecordingError
        If a line of the file is damaged.
    """
    path = folder / EDITS_FILE
    if not path.exists() and not path.is_symlink():
        return ()
    require_file(path, most=MOST_TEXT)
    edits = []
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        if not line.strip():
            continue
        try:
            values = parse_json(line, where=path, cure="")
            edits.append(from_builtins(values, Edit, where=path, command="sliplens label --page"))
        except InputError as error:
            why = str(error).removeprefix(f"{path} ").partition(";")[0]
            raise RecordingError(
                f"line {number} of {path} is no edit ({why}); mend that line or take it out, the others stay"
            ) from None
    return tuple(edits)


def keep_edit(data: Dataset, edit: Edit) -> None:
    """Add an edit to those of a data set, on disk before this returns.

    Raises
    ------
    RecordingError
        If there is no such trial, what is set lies outside it or contradicts what was set before, there is nothing to
        undo, or the file is damaged.
    """
    info, before = data.find(edit.trial), read_edits(data.folder)
    in_force = edits_in_force(before, edit.trial)
    if edit.kind is not EditKind.UNDO:
        capture = read_stored_trial(data, info)
        times = capture.frame_time_s if capture.forces is None else capture.forces.time_s
        # by itself first: the reason is then its own
        for edits in ([edit], [*in_force, edit]):
            require_inside(apply_edits(LabelSettings(), edits), frames=len(capture), time_s=times)
    elif not in_force:
        raise RecordingError(f"{edit.trial} has no edit that could be undone")
    path = data.folder / EDITS_FILE
    # a last line whose end somebody took away is ended first
    apart = b"\n" if path.is_file() and not path.read_bytes().endswith(b"\n") and path.stat().st_size else b""
    with path.open("ab") as stream:
        stream.write(apart + msgspec.json.encode(to_builtins(edit)) + b"\n")
        stream.flush()
        os.fsync(stream.fileno())


def undo_edit(data: Dataset, trial: str, *, by: str | None = None) -> Edit:
    """Take back the last edit of a trial that is in force; gives that edit.

    Raises
    ------
    RecordingError
        If there is no such trial, or no edit that could be undone.
    """
    in_force = edits_in_force(read_edits(data.folder), trial)
    keep_edit(data, make_edit(trial, EditKind.UNDO, by=by))
    return in_force[-1]


def undo_command(folder: Path, trial: str) -> str:
    """Command that takes back the last edit of a trial."""
    return shlex.join(["sliplens", "label", str(folder), "--undo", trial])


def edits_in_force(edits: Sequence[Edit], trial: str) -> tuple[Edit, ...]:
    """Edits of a trial that were not undone, in their order."""
    kept: list[Edit] = []
    for edit in edits:
        if edit.trial != trial:
            continue
        if edit.kind is not EditKind.UNDO:
            kept.append(edit)
        elif kept:
            kept.pop()
    return tuple(kept)


def apply_edits(settings: LabelSettings, edits: Sequence[Edit]) -> LabelSettings:
    """Settings as edits of one trial change them: the last of a kind counts, marks of frames add up.

    Examples
    --------
    >>> from sliplens.recordings import LabelSettings
    >>> from sliplens.recordings.edits import apply_edits, make_edit
    >>> edits = [make_edit("cup", "bad", (10, 19)), make_edit("cup", "good", (12, 14)), make_edit("cup", "mu", 0.7)]
    >>> settings = apply_edits(LabelSettings(), edits)
    >>> settings.bad_frames, settings.mu
    (((10, 11), (15, 19)), 0.7)
    """
    bad = list(settings.bad_frames)
    changes: dict[str, Any] = {}
    for edit in edits:
        if edit.kind in {EditKind.BAD, EditKind.GOOD}:
            first, last = map(int, edit.numbers)
            before = [(start, min(end, first - 1)) for start, end in bad]
            after = [(max(start, last + 1), end) for start, end in bad]
            bad = [(start, end) for start, end in (*before, *after) if start <= end]
            bad += [(first, last)] if edit.kind is EditKind.BAD else []
        elif edit.kind is not EditKind.UNDO:
            whole = edit.kind in {EditKind.REFERENCE, EditKind.SIGN} and edit.value is not None
            changes[edit.kind] = int(edit.numbers[0]) if whole else edit.value
    return replace(settings, **changes, bad_frames=tuple(sorted(bad)))


__all__ = [
    "EDITS_FILE", "Edit", "EditKind", "apply_edits", "edits_in_force", "keep_edit", "login_name", "make_edit",
    "read_edits", "undo_command", "undo_edit",
]  # fmt: skip
