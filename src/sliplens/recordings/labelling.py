"""Provenance of the labels of a trial, stored with it and shown by the audit and the viewer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TypeAlias

import numpy as np

from sliplens.errors import RecordingError
from sliplens.friction import MOST_FRICTION
from sliplens.recordings.options import LabelSettings, TrialSettings

AXES = ("x", "y", "z")
BY_HAND = "given by hand"  #: Method of a friction that the user gave.

Vector: TypeAlias = tuple[float, float, float]  #: x, y, z of the force sensor, as recorded.


@dataclass(frozen=True, kw_only=True)
class ForceAxes:
    """Axes, sign and tare of a force sensor; an unknown axis or sign is a `RecordingError`."""

    normal: str  #: x, y or z: the axis that presses.
    sign: int  #: 1 where pressing is positive as recorded, else -1.
    tare_n: Vector  #: Reading of the untouched sensor.
    noise_n: Vector  #: Standard deviation of a sample's noise.
    tare_sigma_n: Vector  #: Standard uncertainty of the tare.
    still_until_s: float | None  #: Time until which the sensor is certainly untouched; None where it is never touched.
    drift_n_s: Vector = (0.0, 0.0, 0.0)
    """Rate at which the reading of the untouched sensor drifts; 0 where it is not significant."""
    drift_sigma_n_s: Vector = (0.0, 0.0, 0.0)  #: Standard uncertainty of that rate.
    direction: Vector | None = None
    """Unit vector along which pressing points, where the sensor is tilted; None where that is the axis."""
    direction_sigma: float = 0.0
    """Standard uncertainty of that direction, in radians."""
    notes: tuple[str, ...] = ()  #: Doubts, a sentence each.

    def __post_init__(self) -> None:
        if self.normal not in AXES:
            raise RecordingError(f"the normal axis is {self.normal!r}; name x, y or z")
        if self.sign not in (-1, 1):
            raise RecordingError(f"the sign of the normal force is {self.sign}; give 1, or -1 if pressing is negative")

    @property
    def normal_index(self) -> int:
        """Column of the normal axis."""
        return AXES.index(self.normal)

    @property
    def tilt_deg(self) -> float:
        """Angle between the normal axis and the direction of the press, by which the axes are turned."""
        if self.direction is None:
            return 0.0
        return float(np.rad2deg(np.arccos(np.clip(self.sign * self.direction[self.normal_index], -1, 1))))


@dataclass(frozen=True, kw_only=True)
class FrictionEstimate:
    """Static friction of a trial, and when its contact slipped."""

    mu: float  #: Static coefficient of friction mu_s.
    low: float  #: Lower end of the coefficient's 68 % interval.
    high: float  #: Upper end of the coefficient's 68 % interval.
    onset_s: float | None = None  #: First gross slip, on the force sensor's clock; None where no slip is known.
    method: str = BY_HAND  #: Method of the estimate, in words.
    later_onsets_s: tuple[float, ...] = ()  #: Gross slips of later contacts, at most one each.
    notes: tuple[str, ...] = ()
    """Contradictions with the forces, a sentence each; they count as errors of the friction."""

    def __post_init__(self) -> None:
        if not 0 < self.mu <= MOST_FRICTION:
            raise RecordingError(f"the coefficient of friction is {self.mu:.3g}; give 0 to {MOST_FRICTION:g}")

    @property
    def sigma(self) -> float:
        """Standard uncertainty: half the 68 % interval."""
        return (self.high - self.low) / 2


@dataclass(frozen=True, kw_only=True)
class Lag:
    """Time by which the camera's stamps are later than the force sensor's, for the same event."""

    lag_s: float
    """Positive where the camera is late; an event stamped t by the camera is t - lag_s to the force sensor."""
    sigma_s: float  #: Standard uncertainty of the lag.
    correlation: float | None = None
    """Correlation coefficient of image motion and force rate at this lag; None where it was given by hand."""
    doubt: str = ""  #: Reason why this trial does not determine the lag; empty where it does.

    def __post_init__(self) -> None:
        if not (np.isfinite(self.lag_s) and self.sigma_s >= 0):
            raise RecordingError(f"a lag of {self.lag_s:g} s +- {self.sigma_s:g} s cannot be; give it in seconds")


@dataclass(frozen=True, kw_only=True)
class ReferenceChoice:
    """Choice of the frame that shows the sensor untouched."""

    index: int | None = None  #: Number of the frame; None where the reference was recorded apart from the frames.
    method: str


class Reason(StrEnum):
    """Reason why a frame has no valid label; empty where it has one."""

    NONE = ""
    DROP_OUT = "drop-out of the force"
    STUCK = "stuck force"
    CLIPPED = "clipped force"
    SPIKE = "spike of the force"
    STEP = "step of the force"
    MARKED = "marked by hand"
    EXCLUDED = "excluded by hand"
    MISSING_SAMPLES = "missing samples"
    NO_CONTACT = "no contact"
    AFTER_GROSS_SLIP = "after gross slip"
    TOO_UNCERTAIN = "too uncertain"
    CONTRADICTED = "contradicts its forces"


@dataclass(frozen=True, kw_only=True)
class ForceFault:
    """Stretch of faulty samples of a force sensor."""

    kind: Reason
    start_s: float  #: On the force sensor's clock.
    end_s: float
    largest_n: float | None = None  #: Largest absolute value of any axis in it, as recorded; None for missing samples.


@dataclass(frozen=True, kw_only=True)
class LabelBasis:
    """Estimates and thresholds behind automatic labels."""

    axes: ForceAxes
    friction: FrictionEstimate
    slip_s: float | None  #: First gross slip, on the force sensor's clock; None if there is none.
    lag: Lag | None  #: None where it was neither estimated nor set.
    lag_applied: bool
    contact_threshold_n: float
    faults: tuple[ForceFault, ...] = ()  #: Samples that were left out, in the order of time.
    doubts: tuple[str, ...] = ()  #: Doubts about the labels, those about axes and friction among them, a sentence each.

    @property
    def flags(self) -> tuple[str, ...]:
        """Faults of the force sensor, frames at which are not valid, and doubts; a sentence each."""
        return (*describe_faults(self.faults), *self.doubts)


def describe_faults(faults: Sequence[ForceFault]) -> tuple[str, ...]:
    """Describe the faults of each kind in a sentence."""
    sentences = []
    for kind in dict.fromkeys(fault.kind for fault in faults):
        same = [fault for fault in faults if fault.kind == kind]
        first_s = f"{same[0].start_s:.2f} s"
        where = f"at {first_s}" if len(same) == 1 else f"in {len(same)} places from {first_s} on"
        size = max((fault.largest_n for fault in same if fault.largest_n), default=None)
        up_to = "" if size is None else f", up to {size:.3g} N"
        length = sum(fault.end_s - fault.start_s for fault in same)
        sentences.append(f"{kind} {where}, {length:.2f} s in all{up_to}: frames there are not valid")
    return tuple(sentences)


@dataclass(frozen=True, kw_only=True)
class Corrections(TrialSettings):
    """Settings of one trial that a person set in place of the automatic ones; None where those stay.

    A value that no trial can have is a `RecordingError`.
    """

    exclude: bool = False  #: If True, no frame of the trial has a label.

    def __post_init__(self) -> None:
        for name in ("contact_s", "slip_s", "tare"):
            if (value := getattr(self, name)) is not None and not np.isfinite(value).all():
                raise RecordingError(f"{name} is {value}; give a finite number, or leave it empty")
        if self.mu is not None and not 0 < self.mu <= MOST_FRICTION:
            raise RecordingError(f"mu is {self.mu:g}; give more than 0 and at most {MOST_FRICTION:g}")

    def apply(self, settings: LabelSettings) -> LabelSettings:
        """Replace the settings that are corrected; spans of bad frames add to those of the settings.

        Examples
        --------
        >>> from sliplens.recordings.labelling import Corrections, LabelSettings
        >>> settings = Corrections(slip_s=1.25).apply(LabelSettings(mu=0.5))
        >>> settings.mu, settings.slip_s
        (0.5, 1.25)
        """
        values = {name: value for name, value in vars(self).items() if value is not None and name != "exclude"}
        return replace(settings, **values | {"bad_frames": (*settings.bad_frames, *self.bad_frames)})


@dataclass(frozen=True, kw_only=True)
class Labelling:
    """Origin of a trial and of its labels."""

    source: str  #: File, folder or topic of the frames.
    forces: str | None  #: Topic, file or columns of the forces; None where none were recorded.
    notes: tuple[str, ...]  #: Assumptions made on import, a sentence each.
    reference: ReferenceChoice
    basis: LabelBasis | None = None  #: None where the labels came with the frames.
    corrections: Corrections | None = None  #: Settings that were corrected by hand; None where none were.
    first_reference: ReferenceChoice | None = None  #: Choice before a correction named another; None where none did.
