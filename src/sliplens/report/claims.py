"""Record of the claims of the thesis, as it comes with the package: made by `python benchmarks/claims.py`.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, sections 5 and 6, appendices.
"""

from dataclasses import dataclass
from functools import cache
from importlib.resources import as_file, files

from sliplens.codec import load_record
from sliplens.report.verdict import MethodRow, Outcome


@dataclass(frozen=True, kw_only=True)
class ClaimRow:
    """A claim of the thesis with its number, ours, and what follows."""

    source: str
    """Table or figure of the thesis."""
    claim: str
    subject: str
    thesis: str
    ours: str
    """Estimate and 95 % interval."""
    outcome: Outcome
    why: str


@dataclass(frozen=True, kw_only=True)
class ShiftPoint:
    """R2 of the networks on test trials seen by a shifted camera."""

    shift_px: float
    r2: dict[str, tuple[float, float, float]]
    """Estimate and ends of the 95 % interval, by input."""


@dataclass(frozen=True, kw_only=True)
class ThesisRecord:
    """Results on the networks of the thesis that come with the package."""

    sample: str
    claims: tuple[ClaimRow, ...]
    methods: tuple[MethodRow, ...]
    """Of the test trials."""
    shift: tuple[ShiftPoint, ...]
    shift_frames: str


@cache
def load_thesis() -> ThesisRecord:
    """Load the record that comes with the package."""
    with as_file(files("sliplens.report") / "thesis.json") as path:
        return load_record(path, ThesisRecord, command="python benchmarks/claims.py")
