"""Origin of a saved result."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Run:
    """Where a result comes from: what `run.json` of its folder says."""

    folder: Path
    stage: str
