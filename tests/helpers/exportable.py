"""Trials with all that an export must hold: doubted labels, samples of forces, times before zero and since 1970."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from labelled import LABELLING

from sliplens.recordings import ContactState, Dataset, Recording
from sliplens.recordings.capture import Forces
from sliplens.recordings.dataset import load_dataset, trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import forces_path, save_forces, save_recording
from sliplens.recordings.trial import LABEL_SIGNALS

SIZE, LENGTHS, SAMPLES = (12, 16), {"full": 40, "since-1970": 17, "bare": 5}, 1200


def make_trial(name: str, rng: np.random.Generator, *, start_s: float = 0.0, count: int = 9) -> Recording:
    """A trial with margins of every kind, and times that single precision does not hold."""
    margin = rng.uniform(size=count)
    margin[0], margin[1:3] = np.nan, (1, 0)[: count - 1]
    states = list(ContactState)
    signals: dict[str, Any] = {name: rng.normal(size=count) for name in LABEL_SIGNALS[:3]}
    return Recording(
        trial=name,
        sensor="dome",
        day=3,
        condition="wet",
        reference=rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8),
        frames=rng.integers(0, 256, (count, *SIZE, 3), dtype=np.uint8),
        time_s=start_s + np.cumsum(1 / 30 + rng.uniform(-2e-4, 2e-4, count)),
        **signals,
        safety_margin=margin,
        stick_ratio=margin**2,
        contact_state=tuple(states[index % len(states)] for index in range(count)),
    )


def save_exportable(folder: Path) -> Dataset:
    """Write a trial from before zero on, one of times since 1970, and one without a force, at zero, that tests."""
    rng = np.random.default_rng(20261121)
    rows = []
    for (name, count), start_s in zip(LENGTHS.items(), (-2.7, 1_742_563_762.69, 0.0), strict=True):
        trial = make_trial(name, rng, start_s=start_s, count=count)
        if name == "bare":
            unknown = np.full(count, np.nan)
            trial = replace(trial, normal_force_n=unknown, tangential_force_n=unknown)
        else:
            sigma, valid = rng.exponential(size=count), rng.uniform(size=count) < 0.5
            reason = tuple(("no contact", "")[index % 2] for index in range(count))
            trial = replace(trial, safety_margin_sigma=sigma, valid=valid, reason=reason, labelling=LABELLING)
            trial = replace(trial, object="cup")
            time_s = start_s - 0.01 + np.cumsum(rng.uniform(1e-6, 1e-3, SAMPLES)) / 3
            samples = Forces(time_s=time_s, force_n=rng.normal(size=(SAMPLES, 3)), source="/wrench of bag")
            save_forces(samples, forces_path(folder, name))
        save_recording(trial, trial_path(folder, name))
        rows.append(trial_info(trial_path(folder, name), split={"bare": "test"}.get(name, "train")))
    write_dataset_table(folder, rows)
    return load_dataset(folder)
