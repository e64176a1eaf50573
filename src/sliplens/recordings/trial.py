"""One trial of a tactile sensor: frames, forces, labels and facts."""

from collections import Counter
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from sliplens.codec import Result
from sliplens.errors import RecordingError
from sliplens.mechanics import stick_ratio
from sliplens.recordings.labelling import Labelling

OUTSIDE, SLIPS, STICKS = 0, 1, 2  #: Values of a contact map.


@dataclass(frozen=True, kw_only=True)
class TrialFacts:
    """Facts of a trial: name, sensor, day and object, by which trials are grouped."""

    trial: str  #: Name of the trial: letters, digits, dots, dashes and underscores.
    sensor: str = ""  #: Name of the sensor; empty where it is unknown.
    day: int = 1  #: Day of the recording, counted from 1.
    condition: str = "dry"  #: dry or wet, or any other word for the state of the surface.
    object: str = ""  #: Name of the object in the grasp; empty where it is unknown.


class ContactState(StrEnum):
    """Phase of a grasp, as in Fig. 4 of the thesis; unknown where it was not measured."""

    NO_CONTACT = "no contact"
    CONTACT = "contact"
    INCIPIENT_SLIP = "incipient slip"
    FULL_SLIP = "full slip"
    UNKNOWN = "unknown"


def contact_states(margin: Float[np.ndarray, " frames"], *, without: ContactState) -> tuple[ContactState, ...]:
    """Derive contact states from safety margins; `without` is the state of frames without a margin."""
    states = (without, ContactState.FULL_SLIP, ContactState.CONTACT, ContactState.INCIPIENT_SLIP)
    kinds = np.select([np.isnan(margin), margin <= 0, margin >= 1], [0, 1, 2], default=3)
    return tuple(states[kind] for kind in kinds)


SIGNALS = ("time_s", "normal_force_n", "tangential_force_n", "friction_coefficient", "safety_margin", "stick_ratio")
"""The per-frame numbers of a `Recording`, in the order they are stored."""


@dataclass(frozen=True, kw_only=True)
class Labels:
    """Forces and labels of the frames of a trial, one value a frame; NaN where unknown.

    Forces are in newtons, the normal force positive when pressing. Without contact the safety margin has no meaning
    and is NaN. Lengths that disagree are a `RecordingError`.
    """

    normal_force_n: Float[np.ndarray, " _"]
    tangential_force_n: Float[np.ndarray, " _"]
    friction_coefficient: Float[np.ndarray, " _"]
    safety_margin: Float[np.ndarray, " _"]
    stick_ratio: Float[np.ndarray, " _"]
    contact_state: tuple[ContactState, ...]
    safety_margin_sigma: Float[np.ndarray, " _"] | None = None
    """Standard uncertainty of the safety margin; None where it is exact or was not estimated."""
    valid: Bool[np.ndarray, " _"] | None = None  #: Frames whose label can be trusted; None where all that have one can.
    reason: tuple[str, ...] | None = None  #: Why a label is not valid; empty where it is.
    force_time_s: Float[np.ndarray, " _"] | None = None
    """Times of the frames on the force sensor's clock, where forces were interpolated."""
    labelling: Labelling | None = None  #: Provenance of the labels; None where it is unknown.

    def __post_init__(self) -> None:
        self._require_consistent(len(self.safety_margin), "")

    def _require_consistent(self, count: int, where: str) -> None:
        """Check that there is one value a frame, each in its range."""
        for name in (*SIGNALS, "contact_state", *OPTIONAL_LABELS):
            values = getattr(self, name, None)
            if values is not None and len(values) != count:
                begin = f"trial {where} has" if where else "there are"
                raise RecordingError(f"{begin} {len(values)} values of {name} for {count} frames; give one a frame")
            if values is not None and name in LABEL_BOUNDS:
                require_possible(values, name=name, where=where)

    @property
    def labelled(self) -> Bool[np.ndarray, " frames"]:
        """Frames that have a safety margin, and one that can be trusted."""
        present = np.isfinite(self.safety_margin)
        return present if self.valid is None else present & self.valid

    def count(self) -> dict[str, int]:
        """Count frames by the reason why they have no valid label; those with one as 'valid'."""
        reasons = self.reason or [""] * len(self.safety_margin)
        pairs = zip(self.labelled.tolist(), reasons, strict=True)
        return dict(Counter("valid" if valid else reason or "no label" for valid, reason in pairs))


OPTIONAL_LABELS = ("safety_margin_sigma", "valid", "reason", "force_time_s")  #: Fields of `Labels` that may be None.


def labels_of_margins(safety_margin: Float[np.ndarray, " frames"]) -> Labels:
    """Make labels without forces, from margins in [0, 1] or NaN where unknown.

    Full slip is where the margin is 0, contact where it is 1; the stick ratio is that of a sphere, as everywhere.

    Examples
    --------
    >>> labels = labels_of_margins(np.array([1.0, 0.4, 0.0, np.nan]))
    >>> [str(state) for state in labels.contact_state]
    ['contact', 'incipient slip', 'full slip', 'unknown']
    """
    unknown = np.full(len(safety_margin), np.nan)
    return Labels(
        normal_force_n=unknown,
        tangential_force_n=unknown,
        friction_coefficient=unknown,
        safety_margin=safety_margin,
        stick_ratio=stick_ratio(safety_margin),
        contact_state=contact_states(safety_margin, without=ContactState.UNKNOWN),
        reason=tuple("" if finite else "not labelled" for finite in np.isfinite(safety_margin)),
    )


def label_by_friction(labels: Labels, friction: float) -> Labels:
    """Add the margins that follow from the forces and a given coefficient of static friction.

    Raises
    ------
    RecordingError
        If F_t / F_n of a frame exceeds that friction, or no force is known.
    """
    if np.isnan(labels.normal_force_n).all():
        raise RecordingError("a friction gives no margin without forces; leave out --mu")
    pressed = labels.normal_force_n > 0
    ratio = np.where(pressed, labels.tangential_force_n, 0) / np.where(pressed, labels.normal_force_n, 1)
    if (most := ratio.max(initial=0)) > friction:
        raise RecordingError(f"F_t / F_n reaches {most:.2f}, above the given friction {friction:g}; give a larger --mu")
    margin = np.where(pressed, 1 - ratio / friction, np.nan)
    made = labels_of_margins(margin)
    contact = zip(labels.contact_state, made.contact_state, pressed.tolist(), strict=True)
    return replace(
        made,
        normal_force_n=labels.normal_force_n,
        tangential_force_n=labels.tangential_force_n,
        friction_coefficient=np.where(pressed, friction, np.nan),
        contact_state=tuple(new if presses else old for old, new, presses in contact),
    )


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """Ground truth of a simulated trial; pixel coordinates are (x, y), pixel centres at whole numbers.

    A stick zone larger than the contact is a `RecordingError`.
    """

    recipe: str  #: Hash of the recipe that made the trial.
    displacement: str
    """Model that moved the markers; the stick zone of `calibrated` is nominal, that of `half-space` exact."""
    marker_rest_px: Float32[np.ndarray, "_ 2"]  #: Markers of the untouched sensor.
    marker_px: Float32[np.ndarray, "_ _ 2"]  #: Markers in every frame, in the order of those at rest.
    static_friction: Float[np.ndarray, " _"]
    """mu_s, even in slip; `Recording.friction_coefficient` is the coefficient in force."""
    contact_radius_m: Float[np.ndarray, " _"]  #: 0 without contact.
    stick_radius_m: Float[np.ndarray, " _"]
    contact_map: UInt8[np.ndarray, "_ _ _"]
    """Contact of the skin as the camera sees it: 0 none, 1 slipping, 2 sticking."""

    def __post_init__(self) -> None:
        if np.any(sticking := self.stick_radius_m > self.contact_radius_m):
            at = int(np.argmax(sticking))
            raise RecordingError(f"frame {at} sticks beyond its contact; make the stick radius at most the contact's")


@dataclass(frozen=True, kw_only=True)
class Recording(TrialFacts, Labels, Result):
    """One trial in memory: its facts, its frames (uint8 RGB) at their times, and their labels."""

    reference: UInt8[np.ndarray, "_ _ 3"]  #: Image of the untouched sensor.
    frames: UInt8[np.ndarray, "_ _ _ 3"]
    time_s: Float[np.ndarray, " _"]  #: Times on the camera's clock, rising.
    truth: GroundTruth | None = None  #: Ground truth of a simulator; None for a real trial.

    def __post_init__(self) -> None:
        count = len(self.frames)
        if count == 0:
            raise RecordingError(f"trial {self.trial} has no frames; leave it out or record it again")
        if self.frames.shape[1:] != self.reference.shape:
            raise RecordingError(f"trial {self.trial} has a reference of another size than frames; record both alike")
        self._require_consistent(count, self.trial)
        require_rising(self.time_s, what=f"trial {self.trial}")

    def __len__(self) -> int:
        return len(self.frames)


CLOCK_S = (-1e6, 1e10)
"""Range of plausible times: seconds since the start of a recording or since 1970; others are in another unit."""
_STEPS_S = (1e-6, 86400.0)  # least median and largest step of time of a camera or a force sensor
MOST_FORCE_N = 1e4  #: Largest force on a fingertip, in newtons; a larger number is in another unit.
LABEL_BOUNDS = {
    **dict.fromkeys(("normal_force_n", "tangential_force_n"), (-MOST_FORCE_N, MOST_FORCE_N, "give it in newtons")),
    # after the slip it is F_t / F_n, which is large where hardly anything presses
    "friction_coefficient": (-MOST_FORCE_N, MOST_FORCE_N, "make the labels again"),
    **dict.fromkeys(("safety_margin", "stick_ratio"), (0.0, 1.0, "give it as a fraction, not in percent")),
    "safety_margin_sigma": (0.0, MOST_FORCE_N, "make the labels again"),
}
"""Range of each label, and the cure for values outside."""


def require_possible(values: Float[np.ndarray, " frames"], *, name: str, where: str) -> None:
    """Check that labels lie in their range; NaN (no label) passes."""
    low, high, cure = LABEL_BOUNDS[name]
    outside = (values < low) | (values > high)
    if outside.any():
        at, of = int(np.argmax(outside)), f"trial {where}: " if where else ""
        raise RecordingError(f"{of}{name} of frame {at} is {values[at]:.4g}, outside [{low:g}, {high:g}]; {cure}")


def require_rising(time_s: Float[np.ndarray, " samples"], *, what: str) -> None:
    """Check that times are numbers in seconds, and rise."""
    with np.errstate(invalid="ignore"):  # of infinite times, which the first law refuses
        steps = np.diff(time_s, prepend=time_s[:1] - 1)
    laws = (
        (np.isfinite(time_s), "the time of sample {at} is {time:g}, no number; correct its stamp"),
        (steps > 0, "time does not rise at sample {at} ({time:.6f} s); sort or correct the stamps"),
        ((time_s >= CLOCK_S[0]) & (time_s <= CLOCK_S[1]), "times reach {time:.4g} s, as none do; give seconds"),
        (steps <= _STEPS_S[1], "sample {at} comes more than a day late; correct or drop its stamp"),
    )
    for holds, message in laws:
        if not holds.all():
            at = int(np.argmin(holds))
            raise RecordingError(f"{what}: {message.format(at=at, time=time_s[at])}")
    if len(time_s) > 1 and (step_s := np.median(steps[1:])) < _STEPS_S[0]:
        raise RecordingError(f"{what}: samples are {step_s:.3g} s apart; declare the right unit of time")
