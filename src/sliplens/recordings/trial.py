"""One trial of a tactile sensor: frames, forces, labels, and who, when and what."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from sliplens.errors import RecordingError

OUTSIDE, SLIPS, STICKS = 0, 1, 2
"""Values of a contact map."""


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """The truth behind a simulated trial; pixel coordinates are (x, y), pixel centres at whole numbers.

    Raises
    ------
    RecordingError
        If lengths disagree, or the stick zone is larger than the contact.
    """

    recipe: str
    """Hash of the recipe that made the trial."""
    displacement: str
    """Which model moved the markers; the stick zone of `calibrated` is nominal, that of `half-space` exact."""
    # sizes that must agree are left open here and checked below, in the user's words
    marker_rest_px: Float32[np.ndarray, "_ 2"]
    """Markers of the untouched sensor."""
    marker_px: Float32[np.ndarray, "_ _ 2"]
    """The same markers in every frame."""
    static_friction: Float[np.ndarray, " _"]
    """mu_s, whether or not the contact slips; `Recording.friction_coefficient` is the one that holds."""
    contact_radius_m: Float[np.ndarray, " _"]
    """0 without contact."""
    stick_radius_m: Float[np.ndarray, " _"]
    contact_map: UInt8[np.ndarray, "_ _ _"]
    """Where the camera sees the skin touch the object: 0 nowhere, 1 slipping, 2 sticking."""

    def __post_init__(self) -> None:
        """Check that all speaks of the same frames and markers."""
        count = len(self.marker_px)
        for name in ("static_friction", "contact_radius_m", "stick_radius_m", "contact_map"):
            if len(getattr(self, name)) != count:
                raise RecordingError(
                    f"the truth has {count} frames of markers but {len(getattr(self, name))} of {name}; "
                    "give one a frame"
                )
        if self.marker_px.shape[1:] != self.marker_rest_px.shape:
            raise RecordingError(
                f"the truth has {len(self.marker_rest_px)} markers at rest but {self.marker_px.shape[1]} in "
                "its frames; give each marker a place in both"
            )
        if np.any(self.stick_radius_m > self.contact_radius_m):
            at = int(np.argmax(self.stick_radius_m > self.contact_radius_m))
            raise RecordingError(
                f"frame {at} sticks beyond its contact; the stick radius is at most the contact radius"
            )

    @property
    def contact_mask(self) -> Bool[np.ndarray, "frames height width"]:
        """Pixels that see the contact."""
        return self.contact_map != OUTSIDE

    @property
    def stick_mask(self) -> Bool[np.ndarray, "frames height width"]:
        """Pixels that see skin stick to the object."""
        return self.contact_map == STICKS


class ContactState(StrEnum):
    """Phase of a grasp, as in Fig. 4 of the thesis; unknown where nothing measured it."""

    NO_CONTACT = "no contact"
    CONTACT = "contact"
    INCIPIENT_SLIP = "incipient slip"
    FULL_SLIP = "full slip"
    UNKNOWN = "unknown"


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One trial.

    Forces are in newtons (normal force positive when pressing), times in seconds, images uint8 RGB. Labels are NaN
    where there is none: without contact the safety margin has no meaning.

    Raises
    ------
    RecordingError
        If the trial is empty, lengths or sizes disagree, times do not rise, or a label lies outside [0, 1].
    """

    trial: str
    sensor: str
    day: int
    condition: str
    # sizes that must agree are left open here and checked below, in the user's words
    reference: UInt8[np.ndarray, "_ _ 3"]
    frames: UInt8[np.ndarray, "_ _ _ 3"]
    time_s: Float[np.ndarray, " _"]
    normal_force_n: Float[np.ndarray, " _"]
    tangential_force_n: Float[np.ndarray, " _"]
    friction_coefficient: Float[np.ndarray, " _"]
    safety_margin: Float[np.ndarray, " _"]
    stick_ratio: Float[np.ndarray, " _"]
    contact_state: tuple[ContactState, ...]
    safety_margin_sigma: Float[np.ndarray, " _"] | None = None
    """Standard uncertainty of the safety margin; None where it is exact or was not estimated."""
    valid: Bool[np.ndarray, " _"] | None = None
    """Frames whose label can be trusted; None where all that have one can."""
    object: str = ""
    """What was held; empty where it is not told."""
    truth: GroundTruth | None = None
    """What a simulator knows beyond the labels; None for a real trial."""

    def __post_init__(self) -> None:
        """Check the laws that every trial obeys."""
        count = len(self.frames)
        if count == 0:
            raise RecordingError(f"trial {self.trial} has no frames; leave it out or record it again")
        if self.frames.shape[1:] != self.reference.shape:
            raise RecordingError(
                f"trial {self.trial} has frames of {self.frames.shape[1:3]} pixels but a reference of "
                f"{self.reference.shape[:2]}; record both with the same camera settings"
            )
        for name in (*SIGNALS, "contact_state"):
            if len(getattr(self, name)) != count:
                raise RecordingError(
                    f"trial {self.trial} has {count} frames but {len(getattr(self, name))} values of {name}; "
                    "give one value a frame"
                )
        for name in ("safety_margin_sigma", "valid"):
            values = getattr(self, name)
            if values is not None and len(values) != count:
                raise RecordingError(
                    f"trial {self.trial} has {count} frames but {len(values)} values of {name}; give one value a frame"
                )
        if self.truth is not None and len(self.truth.marker_px) != count:
            raise RecordingError(
                f"trial {self.trial} has {count} frames but the truth of {len(self.truth.marker_px)}; "
                "give the truth of every frame"
            )
        if not np.all(np.diff(self.time_s) > 0):
            at = int(np.argmax(~(np.diff(self.time_s) > 0))) + 1
            raise RecordingError(
                f"trial {self.trial}: time does not rise at frame {at} ({self.time_s[at - 1]:.6g} s, then "
                f"{self.time_s[at]:.6g} s); sort the frames or mend their stamps"
            )
        for name in ("safety_margin", "stick_ratio"):
            require_unit_interval(getattr(self, name), name=name, trial=self.trial)

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.frames)

    @property
    def labelled(self) -> Bool[np.ndarray, " frames"]:
        """Frames that have a safety margin, and one that can be trusted."""
        present = np.isfinite(self.safety_margin)
        return present if self.valid is None else present & self.valid


SIGNALS = (
    "time_s",
    "normal_force_n",
    "tangential_force_n",
    "friction_coefficient",
    "safety_margin",
    "stick_ratio",
)
"""The per-frame numbers of a `Recording`, in the order they are stored."""


def require_unit_interval(values: Float[np.ndarray, " frames"], *, name: str, trial: str) -> None:
    """Check that labels lie in [0, 1]; NaN (no label) passes.

    Raises
    ------
    RecordingError
        Naming the trial, the first offending frame and its value.
    """
    outside = (values < 0) | (values > 1)
    if outside.any():
        at = int(np.argmax(outside))
        raise RecordingError(
            f"trial {trial}: {name} of frame {at} is {values[at]:.4g}, outside [0, 1]; "
            "give it as a fraction, not in percent"
        )
