"""What only a simulator knows of a frame: the contact, its stick zone, and where every marker is."""

from dataclasses import dataclass

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
