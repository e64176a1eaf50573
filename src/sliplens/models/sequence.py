"""Sequence head: correct the margin of a frame by the frames of its contact before it."""

from dataclasses import dataclass, replace
from math import isnan
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from sliplens.errors import InputError
from sliplens.models.backbones import bin_centres
from sliplens.models.calibration import Calibration

if TYPE_CHECKING:
    from sliplens.models.checkpoint import Estimate

WIDTH = 32
"""Size of the memory of the head."""
STEP_S, LONGEST_S = 0.1, 1.0
"""Time after which memory takes a step, and the upper limit of the time input; a contact begins with the limit."""
GAP_S = 0.6
"""Longest time from a step of memory to a frame that it corrects. Training takes steps of 0.1 to 0.4 s, and the frame
that makes one may come a frame later, which for the shipped head is 0.17 s at most. On days of selection, steps of up
to 0.6 s are as good as single frames or better; on wet days, 1 to 1.5 s are worse (R2 0.70 for 0.77)."""
_LEAST_PEAK = 0.02
"""Traction ratio below which nothing is pulled."""
_RATIO, _PEAK = 1, 5
"""Columns of `SequenceHead.make_inputs`: the ratio, and the largest ratio so far."""
ROUNDING_S = 1e-6
"""Tolerance of times that are multiples of a step."""
_NEAR_ZERO = 0.1
"""Margins up to which a contact may slide already, in margin units."""
_LEAST = 1e-6
"""Probability below which a bin counts as empty."""


@dataclass(frozen=True, kw_only=True)
class SequenceManifest:
    """Calibration of the margins predicted from several frames."""

    calibration: Calibration
    mse_one: float
    """Mean squared error of one frame alone on the same validation frames, beside that of `calibration`."""
    weights_sha256: str = ""


class SequenceHead(nn.Module):
    """Recurrent head over the outputs of a network for each frame; it corrects the distribution over the margin.

    It is causal: a prediction depends on the frames so far. Its input is that of `make_inputs`, not the image. An
    untrained head corrects nothing. `Follower` takes its steps one at a time.

    Cho et al., *Learning Phrase Representations using RNN Encoder-Decoder* (2014), for the gated recurrent unit.
    """

    edges: Tensor

    def __init__(self, edges: Float[Tensor, " edges"], ratio_edges: Float[Tensor, " ratio_edges"]) -> None:
        super().__init__()
        self.register_buffer("edges", edges.clone(), persistent=False)
        self.centres = bin_centres(edges).numpy()
        """Margins in the middle of the bins."""
        self._ratio_centres = bin_centres(ratio_edges).numpy()
        self._near_zero = (self.centres <= _NEAR_ZERO).astype(np.float32)
        self.seen = nn.Linear(8, WIDTH)
        self.memory = nn.GRU(WIDTH, WIDTH, batch_first=True)
        self.correction = nn.Linear(2 * WIDTH, len(edges) - 1)
        self.dropout = nn.Dropout(0.1)
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def summarize(
        self, margin: Float32[np.ndarray, "frames bins"], ratio: Float32[np.ndarray, "frames ratio_bins"]
    ) -> Float32[np.ndarray, "frames 5"]:
        """Compute mean and spread of the margin and of F_t / F_n, and the probability of a margin near 0.

        So few numbers because with whole distributions the head overfits its training trials.
        """
        values, spread = _moments(margin, self.centres)
        pulled, pulled_spread = _moments(ratio, self._ratio_centres)
        near_zero = (margin * self._near_zero).sum(axis=-1)
        return np.stack([values, pulled, 4 * spread, 8 * pulled_spread, near_zero], axis=1)

    @staticmethod
    def make_inputs(
        summary: Float32[np.ndarray, "frames 5"], elapsed_s: Float[np.ndarray, " frames"], *, peak: float = _LEAST_PEAK
    ) -> Float32[np.ndarray, "frames 8"]:
        """Make the inputs of the head for consecutive frames, `peak` being the largest F_t / F_n before them.

        They are the numbers of `summarize`, that ratio over the largest so far (friction falls as a contact begins to
        slide), the largest ratio, and the time since the last step of memory.
        """
        inputs = np.empty((len(summary), 8), dtype=np.float32)
        inputs[:, :4], inputs[:, 6] = summary[:, :4], summary[:, 4]
        np.maximum(np.maximum.accumulate(inputs[:, _RATIO]), peak, out=inputs[:, _PEAK])
        inputs[:, 4] = inputs[:, _RATIO] / inputs[:, _PEAK]
        inputs[:, 7] = np.log(np.minimum(np.maximum(elapsed_s, STEP_S), LONGEST_S))
        return inputs

    def forward(
        self, inputs: Float[Tensor, "*batch frames 8"], memory: Float[Tensor, "1 width"] | None = None
    ) -> tuple[Float[Tensor, "*batch frames bins"], Tensor]:
        """Compute the corrections of the logits of frames of a contact, from `make_inputs`, and the memory after them.

        `memory`: that after the frames before them; None at the beginning of a contact.
        """
        hidden = functional.gelu(self.seen(inputs))
        states, after = self.memory(self.dropout(hidden), memory)
        return self.correction(torch.cat([self.dropout(states), hidden], dim=-1)), after

    @staticmethod
    def logits(margin: Float[Tensor, "*batch bins"]) -> Float[Tensor, "*batch bins"]:
        """Return the logits of the probabilities of a network, which the head corrects."""
        return margin.clamp_min(_LEAST).log()


def _moments(
    probabilities: Float[np.ndarray, "frames bins"], centres: Float[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
    """Compute mean and standard deviation of each distribution, to the same bits for any number of rows.

    Hence no product of matrices, which adds in another order for many rows than for a single row.
    """
    mean = (probabilities * centres).sum(axis=-1)
    return mean, np.sqrt((probabilities * (centres - mean[:, None]) ** 2).sum(axis=-1))


def require_frequent(time_s: Float[np.ndarray, " frames"] | None, *, what: str) -> None:
    """Refuse a recording whose frames have no times, or are mostly too far apart to be predicted in order."""
    if time_s is None:
        raise InputError(
            f"--sequence needs the times of the frames, and those of {what} are unknown; leave it out, or name a "
            "recording with times"
        )
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    if step_s > GAP_S + ROUNDING_S:
        raise InputError(
            f"{what} has a frame each {step_s:.2g} s, and --sequence follows a contact over {GAP_S:g} s at most; leave "
            "out --sequence, or record 2 frames a second or more"
        )


class Follower:
    """Correct the predictions for the frames of a sensor, in order, by the frames of the same contact before them.

    Frames go through one by one, also in a batch, so that a recording and a running camera have the same predictions.
    Memory takes a step each `STEP_S`, at any frame rate; frames between two steps are corrected and not remembered.

    Examples
    --------
    >>> import numpy as np
    >>> import sliplens as sl
    >>> network = sl.load("chromatouch-pair")
    >>> follower = network.follow()
    >>> frames = np.full((2, 224, 224, 3), 128, dtype=np.uint8)  # as the untouched sensor: nothing has moved
    >>> one_by_one = network.estimate(network.encode(frames, frames[0]))
    >>> follower.update(one_by_one, np.array([0.0, 0.1]), np.array([True, True])).margin.shape
    (2,)
    """

    def __init__(self, head: SequenceHead, sequence: SequenceManifest) -> None:
        self._head, self._calibration = head, sequence.calibration
        self.forget()

    def forget(self) -> None:
        """Clear the memory, for the next contact."""
        self._memory, self._peak = torch.zeros(1, WIDTH), _LEAST_PEAK
        self._time_s = np.nan
        self.lost = False
        """True after a gap in this contact: its frames keep the predictions of single frames."""

    def update(
        self,
        estimate: "Estimate",
        time_s: Float[np.ndarray, " frames"],
        touches: Bool[np.ndarray, " frames"],
        *,
        believed: Bool[np.ndarray, " frames"] | None = None,
    ) -> "Estimate":
        """Correct the predictions for the next frames.

        A frame without contact keeps its prediction and clears the memory, and so does a clock that runs back. After a
        gap (`GAP_S`) the rest of the contact keeps its predictions too: what happened meanwhile is unknown, and without
        the largest pull a sliding contact looks like a held one.

        `believed`: False for frames whose margin is withheld: they keep their prediction and are not remembered.
        """
        assert estimate.probabilities is not None
        assert estimate.ratio is not None
        margin, ratio = (values.astype(np.float32) for values in (estimate.probabilities, estimate.ratio.probabilities))
        summary = self._head.summarize(margin, ratio)
        correction, followed = np.zeros_like(margin), np.zeros(len(margin), dtype=bool)
        counts = touches if believed is None else touches & believed
        for row, (now_s, touched) in enumerate(zip(time_s.tolist(), touches.tolist(), strict=True)):
            if not touched or now_s < self._time_s:
                self.forget()
            self.lost |= now_s - self._time_s > GAP_S + ROUNDING_S
            if not counts[row] or self.lost:
                continue
            elapsed_s = LONGEST_S if isnan(self._time_s) else now_s - self._time_s
            inputs = self._head.make_inputs(summary[row : row + 1], np.array([elapsed_s]), peak=self._peak)
            with torch.no_grad():
                step, memory = self._head(torch.from_numpy(inputs), self._memory)
            correction[row], followed[row] = step[0], True
            if elapsed_s >= STEP_S - ROUNDING_S:
                self._memory, self._peak, self._time_s = memory, float(inputs[0, _PEAK]), now_s
        logits = self._head.logits(torch.from_numpy(margin)) + torch.from_numpy(correction)
        likely = torch.softmax(logits.double() / self._calibration.temperature, dim=1).numpy()
        read = np.where(followed, (likely * self._head.centres).sum(axis=1), estimate.margin)
        probabilities = np.where(followed[:, None], likely, estimate.probabilities)
        alone = None if followed.all() else (~followed, estimate.calibration)
        return replace(estimate, margin=read, probabilities=probabilities, calibration=self._calibration, alone=alone)
