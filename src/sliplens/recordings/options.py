"""Options of reading and labelling recordings: arguments of the library, and of the command line."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal


def option_flags(names: Iterable[str]) -> str:
    """Write fields of options as flags of the command line."""
    return ", ".join(f"--{name.replace('_', '-')}" for name in names)


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Facts about a source; each format takes some of them and refuses the others."""

    forces: Path | None = None
    """Table of forces beside a video or folder of images (CSV)."""
    time_column: str | None = None
    """Column of the table with the times; guessed if not given."""
    force_columns: tuple[str, ...] | None = None
    """Columns with the forces, three (x y z) or two (normal and tangential, which become z and x); guessed if not
    given."""
    time_unit: str | None = None
    """s, ms, us or ns; guessed if not given."""
    force_unit: str | None = None
    """N, mN, kN, gf, kgf or lbf; guessed if not given."""
    frame_rate: float | None = None
    """Frames a second, where a video's stamps are missing or wrong."""
    times: Path | None = None
    """Table with the name and the time of every image of a folder (CSV)."""
    skip_frames: int | None = None
    """Number of frames to leave out at the start of a video."""
    start_s: float | None = None
    """When the first frame was taken, in seconds on the clock of the forces."""
    image_topic: str | None = None
    """Topic of the images; the only one if not given."""
    wrench_topic: str | None = None
    """Topic of the forces; the only one if not given."""
    image_root: Path | None = None
    """Folder that now holds the images whose old paths a table of stills names."""

    def given(self) -> tuple[str, ...]:
        """Return the names of the options that are set, of those that a reader must support."""
        return tuple(name for name, value in vars(self).items() if value is not None)


@dataclass(frozen=True, kw_only=True)
class TrialSettings:
    """Settings of one trial; what is not set is estimated."""

    reference_frame: int | None = None
    """Number of the untouched frame."""
    contact_s: float | None = None
    """Time at which the contact begins, on the clock of the forces; estimated if not given."""
    slip_s: float | None = None
    """Time at which the contact slips as a whole, on the clock of the forces; estimated if not given."""
    tare: tuple[float, float, float] | None = None
    """Output of the untouched force sensor (x y z), in newtons; estimated if not given."""
    normal_sign: Literal[1, -1] | None = None
    """1 if pressing is positive as recorded, -1 if negative; estimated if not given."""
    mu: float | None = None
    """Static coefficient of friction, if you know it; estimated where the contact begins to slip otherwise."""
    bad_frames: tuple[tuple[int, int], ...] = ()
    """First and last frame of each span that is wrong: its frames are not valid, and its forces are left out."""


@dataclass(frozen=True, kw_only=True)
class LabelSettings(TrialSettings):
    """Settings for labels from forces; what is not given is estimated from the trial."""

    friction_change: float = 0.0
    """Relative standard deviation by which friction may change from touch to slip; on wet objects some 0.1 to 0.2. It
    widens the uncertainty."""
    drift_rate: float | None = None
    """Standard deviation of the rate at which the force sensor's zero may drift, in N/s; 0 for none. Estimated from the
    untouched sensor if not given."""
    lag_ms: float | None = None
    """Milliseconds by which the camera's clock is late, if you know them; the forces are then shifted by them."""
    apply_lag: bool = False
    """Shift the forces by the estimated lag between camera and force sensor; it is always shown."""
    normal_axis: Literal["x", "y", "z"] | None = None
    """Axis of the force sensor that presses; estimated if not given."""
