"""Labels that came with a recording: made by a simulator, by an earlier import, or by hand."""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import RecordingError
from sliplens.mechanics import stick_ratio
from sliplens.recordings.recording import ContactState

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
