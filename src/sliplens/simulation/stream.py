"""Simulated frames as a torch data set: drawn when asked for, nothing stored."""

from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from sliplens.simulation.filming import Film
from sliplens.simulation.loading import Loading
from sliplens.simulation.plan import TrialPlan
from sliplens.simulation.trials import prepare_trial


class SimulatedFrame(NamedTuple):
    """A frame and its labels, as tensors that a loader can stack."""

    frame: Tensor
    """uint8, (height, width, 3)."""
    reference: Tensor
    """The untouched sensor, the same."""
    safety_margin: Tensor
    """float32; NaN without contact."""
    stick_ratio: Tensor
    normal_force_n: Tensor
    tangential_force_n: Tensor
    friction_coefficient: Tensor


class SimulatedFrames(Dataset[SimulatedFrame]):
    """Frames of planned trials, trial after trial, the same bytes as `simulate_dataset` stores.

    Parameters
    ----------
    plans
        Trials from `plan_trials`: those of one split, for instance.
    device
        Where to draw; frames and labels are there.
    kept_trials
        How many trials stay ready to be drawn (some 10 MB each). Frames in random order over more trials than that
        cost the preparation of a trial each.
    """

    def __init__(
        self, plans: Sequence[TrialPlan], *, device: str | torch.device = "cpu", kept_trials: int = 64
    ) -> None:
        self.plans = tuple(plans)
        self.device = device
        self.kept_trials = kept_trials
        self._ends = np.cumsum([plan.frames for plan in self.plans])
        self._ready: OrderedDict[int, tuple[Loading, Film, Tensor]] = OrderedDict()

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> SimulatedFrame:
        """Draw one frame; there is an `IndexError` if there are fewer."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        index %= len(self)
        trial = int(np.searchsorted(self._ends, index, side="right"))
        number = index - int(self._ends[trial]) + self.plans[trial].frames
        loading, film, reference = self._prepare(trial)
        # what follows the two images is named as in the loading
        labels = (
            torch.tensor(getattr(loading, name)[number], dtype=torch.float32, device=self.device)
            for name in SimulatedFrame._fields[2:]
        )
        return SimulatedFrame(film.draw(slice(number, number + 1), device=self.device)[0], reference, *labels)

    def _prepare(self, trial: int) -> tuple[Loading, Film, Tensor]:
        """Give a trial ready to be drawn; the one not used for longest makes room."""
        if trial not in self._ready:
            loading, film = prepare_trial(self.plans[trial])
            self._ready[trial] = (loading, film, film.draw_reference(device=self.device))
            while len(self._ready) > self.kept_trials:
                self._ready.popitem(last=False)
        self._ready.move_to_end(trial)
        return self._ready[trial]
