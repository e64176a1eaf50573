"""Forces from a table in a text file (CSV), with what had to be guessed told in sentences."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces
from sliplens.recordings.readers.columns import (
    FORCE_UNITS,
    TIME_UNITS,
    guess_force_columns,
    guess_time_column,
    guess_time_unit,
    require_unit,
    unit_of,
)
from sliplens.recordings.readers.text_table import TextTable, open_table, read_numbers, require_rising

MOST_FORCE_N = 1e4
"""No fingertip survives more; a larger number is in another unit."""


@dataclass(frozen=True, kw_only=True)
class ForceTable:
    """Forces of a table, and how its columns were read."""

    forces: Forces
    notes: tuple[str, ...]
    """What was declared or guessed, a sentence each, to be shown to the user."""


def read_force_table(
    path: Path,
    *,
    time_column: str | None = None,
    force_columns: Sequence[str] | None = None,
    time_unit: str | None = None,
    force_unit: str | None = None,
) -> ForceTable:
    """Read times and forces from a text table with a header.

    Columns are separated by commas, semicolons or tabs, decimals by points or (where columns are not separated by
    commas) commas; lines that begin with # or % are comments. What is not declared is guessed from the names of the
    columns (`time_s`, `t [ms]`, `stamp`; `fx`, `force_x [mN]`, `wrench.force.x`; `fn` and `ft`), the unit of the time
    also from its steps.

    Parameters
    ----------
    path
        The table.
    time_column
        Name of the column with the times.
    force_columns
        Names of three columns, forces along x, y and z; or of two, the normal and the tangential force, which become
        z and x.
    time_unit
        s, ms, us or ns.
    force_unit
        N, mN, kN, gf, kgf or lbf.

    Raises
    ------
    RecordingError
        If the file is missing, empty or no text, lacks a column, holds what is no finite number, times do not rise,
        or a force is too large to be one.
    """
    table = open_table(path)
    time_name = guess_time_column(table) if time_column is None else table.require(time_column, option="time_column")
    names = _force_names(table, force_columns)
    numbers = read_numbers(table, [time_name, *names])
    time = numbers.values[:, 0]
    require_rising(time, numbers.lines, path=path, column=time_name)
    unit, how = _time_unit(table, time_name, time_unit, time)
    scales, units = _force_scales(table, names, force_unit)
    forces = numbers.values[:, 1:] * scales
    large = np.abs(forces).max(axis=1) > MOST_FORCE_N
    if large.any():
        at = int(np.argmax(large))
        raise RecordingError(
            f"{path}, line {numbers.lines[at]}: {np.abs(forces[at]).max():.4g} N is no force of a fingertip; "
            "declare the right force_unit"
        )
    declared = "declared" if time_column is not None else "by its name"
    notes = [
        f"{path.name}: times are those of column {time_name!r} ({declared}), in {unit} ({how}).",
        f"{path.name}: forces are those of {_listed(names, force_columns is not None)}, in {units}.",
    ]
    if numbers.decimal_comma:
        notes.append(f"{path.name}: commas were read as decimal points.")
    return ForceTable(
        forces=Forces(time_s=time * TIME_UNITS[unit], force_n=_to_axes(forces), source=str(path)), notes=tuple(notes)
    )


def _force_names(table: TextTable, declared: Sequence[str] | None) -> tuple[str, ...]:
    if declared is None:
        return guess_force_columns(table)
    if len(declared) not in {2, 3}:
        raise RecordingError(
            f"{len(declared)} force columns were named; name three (x, y, z) or two (normal, tangential)"
        )
    names = tuple(table.require(name, option="force_columns") for name in declared)
    if len(set(names)) < len(names):
        raise RecordingError(f"the force columns {', '.join(names)} repeat; name each once")
    return names


def _to_axes(forces: Float[np.ndarray, "samples columns"]) -> Float[np.ndarray, "samples 3"]:
    if forces.shape[1] == 3:
        return np.ascontiguousarray(forces)
    # normal and tangential: z points into the gel, the tangential force has no direction and is laid along x
    return np.stack([forces[:, 1], np.zeros(len(forces)), forces[:, 0]], axis=1)


def _time_unit(
    table: TextTable, name: str, declared: str | None, time: Float[np.ndarray, " samples"]
) -> tuple[str, str]:
    if declared is not None:
        return require_unit(declared, quantity="time"), "declared"
    unit = unit_of(name, quantity="time", path=str(table.path))
    if unit is not None:
        return unit, "by its name"
    unit = guess_time_unit(time)
    span = (time[-1] - time[0]) * TIME_UNITS[unit]
    return unit, f"guessed: {len(time)} samples in {span:.4g} s"


def _force_scales(
    table: TextTable, names: Sequence[str], declared: str | None
) -> tuple[Float[np.ndarray, " columns"], str]:
    if declared is not None:
        unit = require_unit(declared, quantity="force")
        return np.full(len(names), FORCE_UNITS[unit]), f"{unit} (declared)"
    named = [unit_of(name, quantity="force", path=str(table.path)) for name in names]
    units = [unit or "N" for unit in named]
    how = "assumed, for the names give no unit" if None in named else "by their names"
    return np.array([FORCE_UNITS[unit] for unit in units]), f"{', '.join(dict.fromkeys(units))} ({how})"


def _listed(names: Sequence[str], declared: bool) -> str:
    axes = "x, y, z" if len(names) == 3 else "normal (laid along z), tangential (laid along x)"
    return f"{', '.join(map(repr, names))} as {axes} ({'declared' if declared else 'by their names'})"
