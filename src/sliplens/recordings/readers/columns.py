"""Which column of a table is the time and which are forces, and in what unit."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.recordings.readers.text_table import TextTable

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in a unit of time."""
FORCE_UNITS = {"N": 1.0, "mN": 1e-3, "kN": 1e3, "gf": 9.80665e-3, "kgf": 9.80665, "lbf": 4.4482216152605}
"""Newtons in a unit of force."""

_TIME_SPELLINGS = {
    "s": ("s", "sec", "secs", "second", "seconds"),
    "ms": ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"),
    "us": ("us", "usec", "usecs", "micros", "microsecond", "microseconds", "\u00b5s", "\u03bcs"),  # micro sign, mu
    "ns": ("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds"),
}
_FORCE_SPELLINGS = {
    "N": ("n", "newton", "newtons"),
    "mN": ("mn", "millinewton", "millinewtons"),
    "kN": ("kn", "kilonewton", "kilonewtons"),
    "gf": ("gf", "g", "gram", "grams", "gramforce"),
    "kgf": ("kgf", "kg", "kp", "kilogram", "kilograms"),
    "lbf": ("lbf", "lb", "lbs"),
}
_SPELLINGS = {"time": _TIME_SPELLINGS, "force": _FORCE_SPELLINGS}
_TIME_WORDS = frozenset({"time", "times", "t", "stamp", "timestamp", "timestamps", "ts", "elapsed", "clock"})
_AXES = {
    "x": (("fx",), ("f", "x"), ("force", "x"), ("forcex",)),
    "y": (("fy",), ("f", "y"), ("force", "y"), ("forcey",)),
    "z": (("fz",), ("f", "z"), ("force", "z"), ("forcez",)),
    "normal": (("fn",), ("f", "n"), ("normal",), ("normal", "force"), ("force", "normal"), ("normalforce",)),
    "tangential": (
        *(("ft",), ("f", "t"), ("tangential",), ("tangential", "force"), ("force", "tangential"), ("tangentialforce",)),
        *(("shear",), ("shear", "force"), ("force", "shear")),
    ),
}


def unit_of(name: str, *, quantity: str, path: str) -> str | None:
    """Unit that a column's name gives, in brackets or as its last word; None where it gives none.

    Raises
    ------
    RecordingError
        If the brackets hold a unit that is not known: a voltage must not pass for a force.
    """
    spellings = _SPELLINGS[quantity]
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]", name)
    if bracket:
        unit = _spelled(bracket[1].lower(), spellings)
        if unit is None:
            raise RecordingError(
                f"{path}: {name!r} is in {bracket[1]!r}, which is no known unit of {quantity} "
                f"({', '.join(spellings)}); declare the right one with {quantity}_unit"
            )
        return unit
    words = _words(name)
    # "f_n" is a normal force, "fx_n" one along x in newtons
    if quantity == "force" and (len(words) < 2 or _axis(words) is not None):
        return None
    return _spelled(words[-1], spellings) if words else None


def require_unit(unit: str, *, quantity: str) -> str:
    """Return a declared unit as it is written here.

    Raises
    ------
    RecordingError
        If it is not known.
    """
    known = _spelled(unit.lower(), _SPELLINGS[quantity])
    if known is None:
        raise RecordingError(f"{unit!r} is no unit of {quantity}; use one of {', '.join(_SPELLINGS[quantity])}")
    return known


def guess_time_column(table: TextTable) -> str:
    """Column whose name says that it holds times.

    Raises
    ------
    RecordingError
        If there is none, or more than one.
    """
    units = {spelling for names in _TIME_SPELLINGS.values() for spelling in names}
    found = []
    for name in table.header:
        words = _words(re.sub(r"[\[(].*", "", name))
        named = bool(_TIME_WORDS & set(words)) and _axis(words) is None  # "f_t" is a tangential force
        if named or (len(words) == 1 and words[0] in units):
            found.append(name)
    return _only(found, table=table, what="the time", option="time_column")


def guess_force_columns(table: TextTable) -> tuple[str, ...]:
    """Columns that hold the force along x, y and z, or the normal and the tangential force.

    Raises
    ------
    RecordingError
        If neither set is there, or a force twice.
    """
    found: dict[str, list[str]] = {axis: [] for axis in _AXES}
    for name in table.header:
        words = _words(re.sub(r"[\[(].*", "", name))
        axis = _axis(words) or _axis(words[:-1])
        if axis is not None:
            found[axis].append(name)
    for axes in (("x", "y", "z"), ("normal", "tangential")):
        if all(found[axis] for axis in axes):
            return tuple(
                _only(found[axis], table=table, what=f"the force ({axis})", option="force_columns") for axis in axes
            )
    raise RecordingError(
        f"{table.path} has no columns that look like forces (fx, fy, fz or fn, ft) among "
        f"{', '.join(map(repr, table.header))}; name them with force_columns"
    )


def guess_time_unit(time: Float[np.ndarray, " samples"]) -> str:
    """Unit of times from their size: by the date where they count from 1970, else by the usual step.

    A force sensor is read from 2 to 10 000 times a second, a camera likewise: a step of 0.01 is in seconds, one of 1 or
    10 in milliseconds.
    """
    size = float(np.abs(time[-1]))
    for unit, since_1970 in (("ns", 1e17), ("us", 1e14), ("ms", 1e11), ("s", 1e8)):
        if size >= since_1970 and (unit != "s" or _step(time) < 0.5):
            return unit
    step = _step(time)
    for unit, most in (("s", 0.5), ("ms", 500.0), ("us", 5e5)):
        if step <= most:
            return unit
    return "ns"


def _step(time: Float[np.ndarray, " samples"]) -> float:
    return float(np.median(np.diff(time))) if len(time) > 1 else 0.0


def _words(name: str) -> Sequence[str]:
    return [word for word in re.split(r"[^0-9a-z\u00b5\u03bc]+", name.lower()) if word]


def _axis(words: Sequence[str]) -> str | None:
    """Axis that the last words of a name give: "wrench.force.x" is the force along x."""
    for axis, spellings in _AXES.items():
        if any(tuple(words[-len(spelling) :]) == spelling for spelling in spellings):
            return axis
    return None


def _spelled(text: str, spellings: dict[str, tuple[str, ...]]) -> str | None:
    return next((unit for unit, names in spellings.items() if text in names), None)


def _only(found: Sequence[str], *, table: TextTable, what: str, option: str) -> str:
    if not found:
        raise RecordingError(
            f"{table.path} has no column that looks like {what} among {', '.join(map(repr, table.header))}; "
            f"name it with {option}"
        )
    if len(found) > 1:
        raise RecordingError(
            f"{table.path}: {what} could be any of {', '.join(map(repr, found))}; name the right one with {option}"
        )
    return found[0]
