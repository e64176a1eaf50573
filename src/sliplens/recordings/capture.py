"""What a reader finds in a file: frames and forces as they were recorded, nothing interpreted."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, UInt8

from sliplens.errors import RecordingError
from sliplens.mechanics import stick_ratio
from sliplens.recordings.store import DAMAGED_PARQUET, one_line
from sliplens.recordings.trial import ContactState

GIVEN_SIGNALS = (
    "normal_force_n",
    "tangential_force_n",
    "friction_coefficient",
    "safety_margin",
    "stick_ratio",
)
"""The numbers of a frame that its time does not tell."""


@dataclass(frozen=True, kw_only=True)
class GivenLabels:
    """One value a frame of each, as a `Recording` has them; NaN where nothing is known.

    Raises
    ------
    RecordingError
        If lengths disagree.
    """

    normal_force_n: Float[np.ndarray, " _"]
    tangential_force_n: Float[np.ndarray, " _"]
    friction_coefficient: Float[np.ndarray, " _"]
    safety_margin: Float[np.ndarray, " _"]
    stick_ratio: Float[np.ndarray, " _"]
    contact_state: tuple[ContactState, ...]
    safety_margin_sigma: Float[np.ndarray, " _"] | None = None
    valid: Bool[np.ndarray, " _"] | None = None
    reason: tuple[str, ...] | None = None
    """Why a label is not valid; empty where it is."""
    labelling: dict[str, Any] | None = None
    """What they rest on, as `import_trial` keeps it; None where that is not told."""
    clip: dict[str, Any] | None = None
    """What is known of the whole recording and of no frame by itself, such as whether it slips."""

    def __post_init__(self) -> None:
        """Check that there is one of each a frame."""
        count = len(self.safety_margin)
        for name in (*GIVEN_SIGNALS, "contact_state", "safety_margin_sigma", "valid", "reason"):
            values = getattr(self, name)
            if values is not None and len(values) != count:
                raise RecordingError(f"there are {count} safety margins but {len(values)} of {name}; give one a frame")

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.safety_margin)

    @property
    def found(self) -> bool:
        """Whether they were found from forces by an import, and so can be found again."""
        return self.labelling is not None and self.labelling.get("friction") is not None

    def count(self) -> dict[str, int]:
        """Count the frames by the reason why they have no valid label, those that have one as 'valid'."""
        valid = np.isfinite(self.safety_margin)
        valid = valid if self.valid is None else valid & self.valid
        reasons = self.reason or [""] * len(self)
        return dict(
            Counter(
                "valid" if fine else reason or "no label" for fine, reason in zip(valid.tolist(), reasons, strict=True)
            )
        )


def labels_of_margins(
    safety_margin: Float[np.ndarray, " frames"], *, clip: dict[str, Any] | None = None
) -> GivenLabels:
    """Labels where no force is known, but the margin, or not even that.

    Full slip is where the margin is 0, contact where it is 1; the stick ratio is that of a sphere, as everywhere.

    Parameters
    ----------
    safety_margin
        In [0, 1]; NaN where it is not known.
    clip
        What is known of the whole recording.
    """
    unknown = np.full(len(safety_margin), np.nan)
    names = (ContactState.UNKNOWN, ContactState.FULL_SLIP, ContactState.CONTACT, ContactState.INCIPIENT_SLIP)
    told = np.select([np.isnan(safety_margin), safety_margin <= 0, safety_margin >= 1], [0, 1, 2], default=3)
    return GivenLabels(
        normal_force_n=unknown,
        tangential_force_n=unknown,
        friction_coefficient=unknown,
        safety_margin=safety_margin,
        stick_ratio=stick_ratio(safety_margin),
        contact_state=tuple(names[at] for at in told),
        reason=tuple("" if known else "not labelled" for known in np.isfinite(safety_margin)),
        clip=clip,
    )


@dataclass(frozen=True, kw_only=True)
class Forces:
    """Samples of a force sensor, on its own clock and axes.

    Raises
    ------
    RecordingError
        If there is no sample, lengths disagree, times do not rise, or a value is not finite.
    """

    time_s: Float[np.ndarray, " _"]
    force_n: Float[np.ndarray, "_ 3"]
    """x, y, z of the sensor, sign and tare as recorded."""
    source: str
    """Topic, file or column names, for people."""

    def __post_init__(self) -> None:
        """Check what every reader must hold."""
        if len(self.time_s) == 0:
            raise RecordingError(f"{self.source} has no force sample; record the force sensor too")
        if len(self.force_n) != len(self.time_s):
            raise RecordingError(
                f"{self.source} has {len(self.time_s)} times but {len(self.force_n)} forces; give one force a time"
            )
        _require_rising(self.time_s, what=self.source)
        bad = ~np.isfinite(self.force_n).all(axis=1)
        if bad.any():
            raise RecordingError(f"{self.source}: sample {int(np.argmax(bad))} is not a number; mend or drop it")


@dataclass(frozen=True, kw_only=True)
class Told:
    """What a source says of a trial itself; None where it says nothing."""

    sensor: str | None = None
    day: int | None = None
    condition: str | None = None
    object: str | None = None
    split: str | None = None
    simulated: bool = False


@dataclass(frozen=True, kw_only=True)
class Capture:
    """One trial as recorded. Frames are read one at a time, so that a long recording needs no more memory than a short.

    Raises
    ------
    RecordingError
        If there is no frame or times do not rise.
    """

    name: str
    """Of the trial: letters, digits, dots, dashes and underscores."""
    source: str
    """File, folder or topic, for people."""
    frame_time_s: Float[np.ndarray, " _"]
    """On the clock of the camera, from the same zero as the forces."""
    frame_size: tuple[int, int]
    """Height and width, in pixels."""
    read_frames: Callable[[], Iterator[UInt8[np.ndarray, "height width 3"]]]
    """Begins anew at every call: one RGB image for each time, in their order."""
    forces: Forces | None
    """None where only images were recorded."""
    notes: tuple[str, ...] = ()
    """What the reader had to assume or leave out, a sentence each, to be shown to the user."""
    labels: GivenLabels | None = None
    """Labels that came with the frames; None where they are to be found."""
    reference: UInt8[np.ndarray, "height width 3"] | None = None
    """The sensor untouched, where it was recorded apart from the frames."""
    reference_index: int | None = None
    """Frame that a source, or its reader, takes for the untouched one."""
    told: Told = field(default_factory=Told)

    def __post_init__(self) -> None:
        """Check what every reader must hold."""
        if len(self.frame_time_s) == 0:
            raise RecordingError(f"{self.source} has no frame; leave it out or record it again")
        _require_rising(self.frame_time_s, what=f"the frames of {self.source}")
        if self.labels is not None and len(self.labels) != len(self.frame_time_s):
            raise RecordingError(
                f"{self.source} has {len(self.frame_time_s)} frames but {len(self.labels)} labels; give one a frame"
            )
        if self.reference is not None and self.reference.shape[:2] != self.frame_size:
            raise RecordingError(
                f"{self.source} has frames of {self.frame_size[0]} x {self.frame_size[1]} pixels but a reference of "
                f"{self.reference.shape[0]} x {self.reference.shape[1]}; record both with the same camera settings"
            )


def _require_rising(time_s: Float[np.ndarray, " samples"], *, what: str) -> None:
    steps = np.diff(time_s)
    if not np.all(steps > 0):
        at = int(np.argmax(~(steps > 0))) + 1
        raise RecordingError(
            f"{what}: time does not rise at sample {at} ({time_s[at - 1]:.6f} s, then {time_s[at]:.6f} s); "
            "sort the samples or mend their stamps"
        )


_AXES = ("x_n", "y_n", "z_n")


def forces_path(folder: Path, trial: str) -> Path:
    """File that holds the force samples of a trial of a data set."""
    return folder / "forces" / f"{trial}.parquet"


def save_forces(forces: Forces, path: Path) -> None:
    """Write samples as one Parquet file, a row a sample; whole or not at all."""
    columns = {"time_s": forces.time_s, **{name: forces.force_n[:, at] for at, name in enumerate(_AXES)}}
    table = pa.table(columns).replace_schema_metadata({"source": forces.source})
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    pq.write_table(table, part, compression="zstd")
    part.replace(path)


def load_forces(path: Path) -> Forces:
    """Read samples written by `save_forces`.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or breaks a law of `Forces`.
    """
    try:
        table = pq.read_table(path)
        source = (table.schema.metadata or {}).get(b"source", b"the force sensor").decode()
        values = [table.column(name).to_numpy().astype(np.float64) for name in ("time_s", *_AXES)]
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; make the data set again") from None
    except (*DAMAGED_PARQUET, TypeError) as error:  # the latter of values that are missing
        raise RecordingError(
            f"{path} does not hold samples of forces ({one_line(error)}); make the data set again"
        ) from None
    return Forces(time_s=values[0], force_n=np.stack(values[1:], axis=-1), source=source)
