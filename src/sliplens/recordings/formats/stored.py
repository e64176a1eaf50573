"""Data sets of sliplens as recordings; and what trials say of themselves in the formats of others."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from sliplens.codec import from_builtins, to_builtins
from sliplens.errors import InputError, RecordingError
from sliplens.files import parse_json
from sliplens.images import encode_png
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.dataset import Dataset, TrialInfo, load_dataset, trial_path
from sliplens.recordings.formats.tables import trial_name
from sliplens.recordings.labelling import Labelling
from sliplens.recordings.store import forces_path, load_forces, load_recording, stream_frames
from sliplens.recordings.trial import LABEL_SIGNALS, ContactState, Labels, Recording, TrialFacts

STATES = {str(state): state for state in ContactState}
"""Contact states by their words."""


def read_stored(folder: Path) -> list[Capture]:
    """Read a data set, one capture a trial, with its labels, its reference frame, and all it says of itself.

    Forces are the samples that were kept on import, else, as for a simulated trial, those of the frames: the pull along
    x, pressing along z.
    """
    data = load_dataset(folder)
    return [read_stored_trial(data, info) for info in data.trials]


def read_stored_trial(data: Dataset, info: TrialInfo, *, samples: bool = True) -> Capture:
    """Read one trial of a data set as `read_stored` does, with the samples of its forces or without."""
    path = trial_path(data.folder, info.trial)
    stored = load_recording(path, pixels=False)
    return Capture(
        **{field.name: getattr(info, field.name) for field in fields(TrialFacts)},
        source=f"{info.trial} of {data.folder}",
        frame_time_s=stored.time_s,
        frame_size=(info.height, info.width),
        read_frames=partial(stream_frames, path),
        forces=_forces(data, info, stored) if samples else None,
        labels=stored,
        reference=stored.reference,
        split=info.split,
        simulated=data.simulated,
    )


def _forces(data: Dataset, info: TrialInfo, stored: Recording) -> Forces | None:
    if info.forces_sha256:
        return load_forces(forces_path(data.folder, info.trial))
    pull, press = stored.tangential_force_n, stored.normal_force_n
    known = np.isfinite(pull) & np.isfinite(press)
    if not known.any():
        return None
    samples = np.stack([pull, np.zeros_like(pull), press], axis=-1)[known]
    return Forces(time_s=stored.time_s[known], force_n=samples, source=f"the frames of {info.trial}")


FORMAT, VERSION = "sliplens trial", 2
"""What the text of an exported trial calls itself."""
EXPORTED_OPTIONAL = ("safety_margin_sigma", "valid", "reason")
"""Labels that a trial may lack, though the formats of others have room for them."""
_BATCH = 16  # frames that are encoded side by side
_LONGEST = 2**24  # characters of a text that is parsed; those of a trial are some thousands


def exported_labels(labels: Labels) -> dict[str, np.ndarray]:
    """A value a frame of each label; those that a trial lacks follow from what it has, or are not known."""
    known = np.isfinite(labels.safety_margin)
    missing = {"safety_margin_sigma": np.full(len(known), np.nan), "valid": known, "reason": ("",) * len(known)}
    found = {name: getattr(labels, name) for name in (*LABEL_SIGNALS, *EXPORTED_OPTIONAL)}
    states = [str(state) for state in labels.contact_state]
    found = {name: missing[name] if values is None else values for name, values in found.items()}
    return {name: np.asarray(values) for name, values in {**found, "contact_state": states}.items()}


def encode_batches(frames: Iterator[Frame]) -> Iterator[tuple[list[Frame], Iterator[bytes]]]:
    """Frames and their PNG, those of a batch encoded side by side."""
    with ThreadPoolExecutor() as pool:
        while batch := list(islice(frames, _BATCH)):
            yield batch, pool.map(encode_png, batch)


@dataclass(frozen=True, kw_only=True)
class ExportedTrial:
    """What a trial is, and how much of each kind belongs to it, beside its frames in a format of others."""

    format: str = FORMAT
    version: int = VERSION
    facts: TrialFacts
    split: str
    simulated: bool
    frames: int
    force_samples: int
    """0 where no force is known."""
    force_source: str
    optional: tuple[str, ...]
    """Those of `EXPORTED_OPTIONAL` that the labels have."""
    labelling: Labelling | None

    def __post_init__(self) -> None:
        if trial_name(self.facts.trial) != self.facts.trial:
            raise ValueError("no proper name of a trial")
        if self.frames <= 0 or self.force_samples < 0 or not set(self.optional) <= set(EXPORTED_OPTIONAL):
            raise ValueError("no proper counts of frames, force samples and labels")

    @classmethod
    def of(cls, capture: Capture) -> "ExportedTrial":
        """Text of a stored trial, which has labels."""
        labels, forces = capture.labels, capture.forces
        assert labels is not None
        return cls(
            facts=TrialFacts(**{field.name: getattr(capture, field.name) for field in fields(TrialFacts)}),
            split=capture.split,
            simulated=capture.simulated,
            frames=len(capture),
            force_samples=len(forces.time_s) if forces else 0,
            force_source=forces.source if forces else "",
            optional=tuple(name for name in EXPORTED_OPTIONAL if getattr(labels, name) is not None),
            labelling=labels.labelling,
        )

    def dump(self, **more: object) -> str:
        """JSON; `more` is for people and not read back."""
        return msgspec.json.encode({**to_builtins(self), **more}).decode()

    @classmethod
    def parse(cls, text: str, *, where: str) -> "ExportedTrial":
        """Read what `dump` wrote, believing nothing."""
        if len(text) > _LONGEST:
            raise RecordingError(f"{where} has {len(text)} characters, no description does; export the trial again")
        try:
            values = parse_json(text, where=where, cure="export the trial again")
        except InputError as error:
            raise RecordingError(str(error)) from None
        if not isinstance(values, dict) or values.get("format") != FORMAT:
            raise RecordingError(f"{where} does not describe a {FORMAT}; export the trial again")
        if values.get("version") != VERSION:
            raise RecordingError(
                f"{where} is of version {str(values.get('version'))[:20]}, this sliplens reads {VERSION}; update it"
            )
        try:
            return from_builtins(values, cls, where=where, command="sliplens export")
        except InputError as error:
            raise RecordingError(str(error)) from None

    def capture(
        self,
        numbers: dict[str, Float[np.ndarray, " frames"]],
        *,
        states: tuple[str, ...],
        valid: np.ndarray,
        reasons: tuple[str, ...],
        source: str,
        **recorded: Any,
    ) -> Capture:
        """Trial as it was exported, its times and labels from the columns of another format, checked."""
        time_s = numbers.pop("time_s")
        if not np.isfinite(time_s).all():
            raise RecordingError(f"{source} has a time that is not a number; export the trial again")
        unknown = set(states) - set(STATES)
        if unknown:
            raise RecordingError(
                f"{source} has the contact state {min(unknown)[:40]!r}, none of {', '.join(STATES)}; "
                "export the trial again"
            )
        optional = {"safety_margin_sigma": numbers.pop("safety_margin_sigma"), "valid": valid, "reason": reasons}
        labels = Labels(
            **numbers,
            contact_state=tuple(STATES[state] for state in states),
            **{name: values for name, values in optional.items() if name in self.optional},
            labelling=self.labelling,
        )
        told = {**vars(self.facts), "split": self.split, "simulated": self.simulated, "source": source}
        return Capture(**told, frame_time_s=time_s, labels=labels, **recorded)
