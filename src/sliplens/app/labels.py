"""Page on which a person repairs the labels of a data set."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.app.server import Page
from sliplens.errors import RecordingError, SliplensError
from sliplens.images import encode_png
from sliplens.recordings.capture import Forces
from sliplens.recordings.dataset import Dataset, load_dataset, trial_path
from sliplens.recordings.edits import apply_edits, edits_in_force, keep_edit, login_name, make_edit, read_edits
from sliplens.recordings.formats.stored import read_stored_trial
from sliplens.recordings.importing import relabel_trial
from sliplens.recordings.labelling import Edit, EditKind, ForceAxes, FrictionEstimate
from sliplens.recordings.labels import measure_motion, soften
from sliplens.recordings.options import LabelSettings
from sliplens.recordings.store import read_frames
from sliplens.recordings.trial import ContactState

_MOST_SAMPLES = 3000  # of the forces in a chart: a span of more is drawn by its least and its largest
_DIGITS = 5
_TOUCHING = {ContactState.CONTACT, ContactState.INCIPIENT_SLIP, ContactState.FULL_SLIP}

Numbers: TypeAlias = tuple[float | None, ...]
"""A value a frame, or a sample; None where there is none."""


@dataclass(frozen=True, kw_only=True)
class ForceCurves:
    """Samples of the force sensor as recorded, few enough to be drawn."""

    time_s: Numbers
    """On the camera's clock."""
    axes_n: tuple[Numbers, Numbers, Numbers]
    """x, y, z."""


@dataclass(frozen=True, kw_only=True)
class TrialView:
    """What the page shows of a trial: its labels as they are made anew with the edits that are in force."""

    trial: str
    time_s: Numbers
    """Of the frames, on the camera's clock."""
    shift_s: float
    """Camera's clock less that of the forces, where that is applied."""
    samples: ForceCurves | None
    normal_n: Numbers
    tangential_n: Numbers
    margin: Numbers
    low: Numbers
    """Margin less its standard uncertainty, not below 0."""
    high: Numbers
    valid: tuple[bool, ...]
    words: tuple[str, ...]
    """Why a frame has no valid label, or its contact state."""
    reference: int | None
    """Number of the untouched frame; None where it was recorded apart."""
    contact_s: float | None
    """Begin of the contact, on the clock of the forces; None where nothing touches."""
    slip_s: float | None
    axes: ForceAxes | None
    friction: FrictionEstimate | None
    bad_frames: tuple[tuple[int, int], ...]
    flags: tuple[str, ...]
    """What puts the labels in doubt, a sentence each."""
    trouble: str
    """Why it cannot be labelled so, and the labels of the data set are shown; empty where it can."""
    edits: tuple[Edit, ...]
    """In force, the last one last."""


class LabelPage(Page):
    """Page on this machine on which a person repairs the labels of a data set, trial by trial.

    Frames and forces are scrubbed together; reference, contact, slip, tare, sign, friction and bad spans are set, and
    the margin with its band follows at once. Every edit is kept beside the data set (`sliplens.recordings.edits`), and
    `label_dataset` follows them; the labels on disk stay until then. A context manager that serves the page while it
    is entered.

    Parameters
    ----------
    data
        Data set that keeps its force samples, or its folder.
    labelling
        What is known of the forces and friction of all trials, as for `label_dataset`.
    by
        Who edits; who is logged in if None.
    port
        Port to listen on, 0 for any; 8090, or any where that is taken, if None.

    Raises
    ------
    InputError
        If the packages of the extra `live` are missing, the port is taken, or there is no such data set.
    """

    def __init__(
        self,
        data: Dataset | Path | str,
        *,
        labelling: LabelSettings | None = None,
        by: str | None = None,
        port: int | None = None,
    ) -> None:
        super().__init__(port=port)
        self.data = data if isinstance(data, Dataset) else load_dataset(data)
        self.labelling, self.by = labelling or LabelSettings(), by or login_name()
        self._motion: dict[str, Float[np.ndarray, " frames"]] = {}
        self._lock = Lock()
        read_edits(self.data.folder)  # what is damaged is told before a browser is opened

    def build(self) -> None:
        """Make the page of one viewer."""
        # an extra, and a second to import
        from sliplens.app.label_view import build_labels  # noqa: PLC0415

        build_labels(self)

    @property
    def edit_counts(self) -> dict[str, int]:
        """Number of edits in force of each trial."""
        edits = read_edits(self.data.folder)
        return {info.trial: len(edits_in_force(edits, info.trial)) for info in self.data.trials}

    def edit(self, trial: str, kind: EditKind | str, value: float | Sequence[float] | None = None) -> None:
        """Keep an edit; a `RecordingError` tells why it cannot be.

        `tare_span` makes the mean of the samples between two times, in seconds on the forces' clock, the tare.
        """
        if kind == "tare_span":
            assert isinstance(value, Sequence)
            kind, value = EditKind.TARE, self._mean_force(trial, *value)
        with self._lock:
            keep_edit(self.data, make_edit(trial, kind, value, by=self.by))

    def _mean_force(self, trial: str, begin_s: float, end_s: float) -> tuple[float, ...]:
        """Mean of the whole samples of a span: the page has but the extremes of a long recording."""
        forces = read_stored_trial(self.data, self.data.find(trial)).forces
        within = None if forces is None else forces.force_n[(begin_s <= forces.time_s) & (forces.time_s <= end_s)]
        if within is None or not len(within := within[np.isfinite(within).all(axis=1)]):
            raise RecordingError(f"there is no force sample from {begin_s:.2f} to {end_s:.2f} s; choose a longer span")
        return tuple(within.mean(axis=0).tolist())

    def look(self, trial: str) -> TrialView:
        """Label a trial anew, in memory."""
        stored = read_stored_trial(self.data, self.data.find(trial))
        edits = edits_in_force(read_edits(self.data.folder), trial)
        labels, trouble = stored.labels, ""
        assert labels is not None  # a trial of a data set has some, if only that none is known
        try:
            with self._lock:
                if trial not in self._motion:
                    self._motion[trial] = measure_motion(map(soften, stored.read_frames()))
            motion = self._motion[trial]
            labels = relabel_trial(self.data, trial, labelling=self.labelling, edits=edits, image_motion=motion)
        except SliplensError as error:
            trouble = str(error)
        basis = labels.labelling.basis if labels.labelling else None
        said = apply_edits(self.labelling, edits)
        shift_s = basis.lag.lag_s if basis and basis.lag and basis.lag_applied else 0.0
        time_s, margin = stored.frame_time_s, labels.safety_margin
        sigma = np.full(len(margin), np.nan) if labels.safety_margin_sigma is None else labels.safety_margin_sigma
        touches = np.flatnonzero([state in _TOUCHING for state in labels.contact_state])
        touch_s = float(time_s[touches[0]]) - shift_s if len(touches) else None
        states = zip(labels.reason or [""] * len(margin), labels.contact_state, strict=True)
        return TrialView(
            trial=trial,
            time_s=_numbers(time_s),
            shift_s=shift_s,
            samples=_curves(stored.forces, shift_s),
            normal_n=_numbers(labels.normal_force_n),
            tangential_n=_numbers(labels.tangential_force_n),
            margin=_numbers(margin),
            low=_numbers(np.clip(margin - sigma, 0, 1)),
            high=_numbers(np.clip(margin + sigma, 0, 1)),
            valid=tuple(labels.labelled.tolist()),
            words=tuple(reason or str(state) for reason, state in states),
            reference=labels.labelling.reference.index if labels.labelling else None,
            contact_s=touch_s if said.contact_s is None else said.contact_s,
            slip_s=basis.slip_s if basis else None,
            axes=basis.axes if basis else None,
            friction=basis.friction if basis else None,
            bad_frames=said.bad_frames,
            flags=basis.flags if basis else (),
            trouble=trouble,
            edits=edits,
        )

    def read_image(self, trial: str, number: int) -> bytes | None:
        """Frame of a trial as PNG; None where there is none."""
        frames = {info.trial: info.frames for info in self.data.trials}
        if not 0 <= number < frames.get(trial, 0):
            return None
        return encode_png(read_frames(trial_path(self.data.folder, trial), [number])[0])


def _numbers(values: Float[np.ndarray, " values"]) -> Numbers:
    return tuple(None if np.isnan(value) else round(value, _DIGITS) for value in values.tolist())


def _curves(forces: Forces | None, shift_s: float) -> ForceCurves | None:
    if forces is None:
        return None
    time_s, force_n = forces.time_s, forces.force_n
    if len(time_s) > _MOST_SAMPLES:
        # the least and the largest of each stretch: a spike is seen however many samples there are
        parts = np.array_split(np.arange(len(time_s)), _MOST_SAMPLES // 2)
        ends = [(np.nanmin(force_n[part], axis=0), np.nanmax(force_n[part], axis=0)) for part in parts]
        time_s, force_n = np.repeat([time_s[part[0]] for part in parts], 2), np.concatenate(ends)
    x, y, z = (_numbers(column) for column in force_n.T)
    return ForceCurves(time_s=_numbers(time_s + shift_s), axes_n=(x, y, z))
