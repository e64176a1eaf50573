"""Several frames: what the frames before one tell of its margin, read one after another."""

from dataclasses import dataclass, replace
from math import erf, isnan, sqrt
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
"""Numbers that the head remembers of a contact."""
STEP_S, LONGEST_S = 0.1, 1.0
"""Time after which memory takes a step, and the longest that is told apart; a contact begins with the longest."""
GAP_S = 0.6
"""Longest time from a step of memory to a frame that is read by it. Training takes steps of 0.1 to 0.4 s, and the
frame that makes one may come a frame later, which for the shipped head is 0.17 s at most. Days of selection are read
better with steps of up to 0.6 s than frame by frame, or as well; wet ones worse with 1 to 1.5 s (R2 0.70 for 0.77)."""
_LEAST_PEAK = 0.02
"""Traction ratio below which nothing is pulled."""
_RATIO, _PEAK = 1, 5
"""Which numbers of `SequenceHead.tell` are the ratio and the largest so far."""
ROUNDING_S = 1e-6
"""By which times that are multiples of a step may miss it."""
_NEAR_ZERO = 0.1
"""Margins up to which a contact may slide already, in margin units."""
_LEAST = 1e-6
"""Probability below which a bin counts as empty."""


@dataclass(frozen=True, kw_only=True)
class SequenceManifest:
    """How sure the margins read from several frames are."""

    calibration: Calibration
    mse_one: float
    """Mean squared error of one frame alone on the same validation frames, beside that of `calibration`."""
    weights_sha256: str = ""


class SequenceHead(nn.Module):
    """Recurrent head over what a network answers frame by frame; it corrects the distribution over the margin.

    It is causal: an answer depends on the frames so far. It sees no image, only what `tell` gives. At first its
    correction is none, and the answer that of one frame. `Follower` takes its steps one at a time.

    Cho et al., *Learning Phrase Representations using RNN Encoder-Decoder* (2014), for the gated recurrent unit.

    Parameters
    ----------
    edges, ratio_edges
        Of the bins of both distributions, as the network has them.
    dropout
        Share of what is remembered that is hidden from the answer in training.
    """

    edges: Tensor

    def __init__(
        self, edges: Float[Tensor, " edges"], ratio_edges: Float[Tensor, " ratio_edges"], *, dropout: float = 0.1
    ) -> None:
        super().__init__()
        self.register_buffer("edges", edges.clone(), persistent=False)
        self.centres = bin_centres(edges).numpy()
        """Margins in the middle of the bins."""
        self._ratio_centres = bin_centres(ratio_edges).numpy()
        self._near_zero = (self.centres <= _NEAR_ZERO).astype(np.float32)
        self.seen = nn.Linear(8, WIDTH)
        self.memory = nn.GRU(WIDTH, WIDTH, batch_first=True)
        self.correction = nn.Linear(2 * WIDTH, len(edges) - 1)
        self.dropout = nn.Dropout(dropout)
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def summarize(
        self, margin: Float32[np.ndarray, "frames bins"], ratio: Float32[np.ndarray, "frames ratio_bins"]
    ) -> Float32[np.ndarray, "frames 5"]:
        """What each frame tells by itself, of its probabilities.

        Mean and spread of the margin and of F_t / F_n, and how likely the margin is near 0. So few numbers because
        whole distributions let the head learn its training trials by heart.
        """
        values, spread = _moments(margin, self.centres)
        pulled, pulled_spread = _moments(ratio, self._ratio_centres)
        near_zero = (margin * self._near_zero).sum(axis=-1)
        return np.stack([values, pulled, 4 * spread, 8 * pulled_spread, near_zero], axis=1)

    @staticmethod
    def tell(
        summary: Float32[np.ndarray, "frames 5"], elapsed_s: Float[np.ndarray, " frames"], *, peak: float = _LEAST_PEAK
    ) -> Float32[np.ndarray, "frames 8"]:
        """What the head is told of each frame, one after another.

        Beside what `summarize` gives: that ratio over the largest so far (friction falls as a contact begins to slide),
        the largest itself, and the time since memory took its last step.

        `elapsed_s`: that time; `peak`: largest F_t / F_n of the frames before these.
        """
        told = np.empty((len(summary), 8), dtype=np.float32)
        told[:, :4], told[:, 6] = summary[:, :4], summary[:, 4]
        np.maximum(np.maximum.accumulate(told[:, _RATIO]), peak, out=told[:, _PEAK])
        told[:, 4] = told[:, _RATIO] / told[:, _PEAK]
        told[:, 7] = np.log(np.minimum(np.maximum(elapsed_s, STEP_S), LONGEST_S))
        return told

    def forward(
        self, told: Float[Tensor, "batch frames 8"], margin: Float[Tensor, "batch frames bins"]
    ) -> Float[Tensor, "batch frames bins"]:
        """Logits over the margin in whole contacts, of what `tell` gives and the probabilities of each frame."""
        seen = functional.gelu(self.seen(told))
        remembered, _ = self.memory(self.dropout(seen))
        correction = self.correction(torch.cat([self.dropout(remembered), seen], dim=-1))
        return margin.clamp_min(_LEAST).log() + correction


def _moments(
    probabilities: Float[np.ndarray, "frames bins"], centres: Float[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
    """Mean and standard deviation of each distribution, the same to the bit however many there are.

    Hence no product of matrices, which adds in another order for many rows than for one.
    """
    mean = (probabilities * centres).sum(axis=-1)
    return mean, np.sqrt((probabilities * (centres - mean[:, None]) ** 2).sum(axis=-1))


def require_frequent(time_s: Float[np.ndarray, " frames"], *, what: str) -> None:
    """Refuse a recording whose frames mostly come too seldom to be read in order."""
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    if step_s > GAP_S + ROUNDING_S:
        raise InputError(
            f"{what} has a frame each {step_s:.2g} s, and --sequence follows a contact over {GAP_S:g} s at most; read "
            "such frames by themselves, without --sequence, or record 2 a second or more"
        )


class Follower:
    """Reads the frames of one sensor in order; each answer tells what the frames of this contact so far tell.

    Frames go through one by one, however many are given at once, so that a recording and a running camera have the
    same answers. Memory takes a step each `STEP_S`, at whatever rate they come; frames between are read by it and
    leave nothing.

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
        self._head, self._sequence = head, sequence
        self._weights = [values.numpy() for values in head.state_dict().values()]
        self._centres = head.centres.astype(np.float64)
        self.forget()

    def forget(self) -> None:
        """Begin anew with the next contact."""
        self._memory, self._peak = np.zeros(WIDTH, dtype=np.float32), _LEAST_PEAK
        self._time_s = np.nan
        self.lost = False
        """Whether there was a gap in this contact, so that its frames are read by themselves."""

    def update(
        self,
        estimate: "Estimate",
        time_s: Float[np.ndarray, " frames"],
        touches: Bool[np.ndarray, " frames"],
        *,
        believed: Bool[np.ndarray, " frames"] | None = None,
    ) -> "Estimate":
        """The next frames as they are read after those before.

        `estimate`: of each frame by itself, told no friction; `time_s`: when it was taken; `touches`: whether anything
        touches. A frame that nothing touches keeps its answer, and what was before it is forgotten; so is what was
        before a clock that runs back. After a gap (`GAP_S`) the rest of the contact keeps its answers too: nobody knows
        what happened meanwhile, and to a head that does not know the largest pull, what slides seems to hold.
        `believed`: False for frames whose margin is withheld; they keep their answer and leave nothing in memory.
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
            [told] = self._head.tell(summary[row : row + 1], np.array([elapsed_s]), peak=self._peak)
            correction[row], memory = self._step(told)
            followed[row] = True
            if elapsed_s >= STEP_S - ROUNDING_S:
                self._memory, self._peak, self._time_s = memory, float(told[_PEAK]), now_s
        calibration = self._sequence.calibration
        logits = (np.log(np.maximum(margin, _LEAST)) + correction) / calibration.temperature
        likely = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
        likely /= likely.sum(axis=1, keepdims=True)
        read = np.where(followed, (likely * self._centres).sum(axis=1), estimate.margin)
        probabilities = np.where(followed[:, None], likely, estimate.probabilities)
        alone = None if followed.all() else (~followed, estimate.calibration)
        return replace(estimate, margin=read, probabilities=probabilities, calibration=calibration, alone=alone)

    def _step(
        self, told: Float32[np.ndarray, " 8"]
    ) -> tuple[Float32[np.ndarray, " bins"], Float32[np.ndarray, " width"]]:
        """Correction of a frame, and what is remembered then, as `SequenceHead.forward` has them.

        In numpy: to torch each call costs more than what it computes here.
        """
        seen_by, seen_bias, by_seen, by_memory, bias, memory_bias, correct_by, correct_bias = self._weights
        seen = seen_by @ told + seen_bias
        # the Gaussian error linear unit
        seen *= np.array([(1 + erf(value / sqrt(2))) / 2 for value in seen.tolist()], dtype=np.float32)
        added, kept = by_seen @ seen + bias, by_memory @ self._memory + memory_bias
        gates = (1 + np.tanh((added + kept)[: 2 * WIDTH] / 2)) / 2  # the logistic function
        reset, held = gates[:WIDTH], gates[WIDTH:]
        fresh = np.tanh(added[2 * WIDTH :] + reset * kept[2 * WIDTH :])
        memory = fresh + held * (self._memory - fresh)
        return correct_by @ np.concatenate([memory, seen]) + correct_bias, memory
