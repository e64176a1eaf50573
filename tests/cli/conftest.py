from dataclasses import replace

import pytest

from sliplens.recordings import Recording
from sliplens.simulation import PRESETS, plan_trials, simulate_trial


@pytest.fixture(scope="session")
def trial() -> Recording:
    """A simulated trial at 30 frames a second, of every other pixel: its motion is seen all the same."""
    whole = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=240))
    return replace(whole, frames=whole.frames[:, ::2, ::2].copy(), reference=whole.reference[::2, ::2].copy())
