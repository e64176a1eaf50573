"""Several frames: what the frames before one tell of its margin, read one after another."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float
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


State: TypeAlias = tuple[Tensor, Tensor]
"""What is remembered of each contact: (1, batch, WIDTH), and the largest ratio F_t / F_n so far, (batch, 1)."""


class SequenceHead(nn.Module):
    """Recurrent head over what a network answers frame by frame; it corrects the distribution over the margin.

    It is causal: an answer depends on the frames so far. It sees no image but, of each frame, eight numbers: mean and
    spread of the margin and of F_t / F_n, that ratio over the largest so far (friction falls as a contact begins to
    slide) and the largest itself, how likely the margin is near 0, and the time since memory took its last step. Eight
    because whole distributions let it learn its training trials by heart. At first its correction is none, and the
    answer that of one frame.

    Cho et al., *Learning Phrase Representations using RNN Encoder-Decoder* (2014), for the gated recurrent unit.

    Parameters
    ----------
    edges, ratio_edges
        Of the bins of both distributions, as the network has them.
    dropout
        Share of what is remembered that is hidden from the answer in training.
    """

    edges: Tensor
    centres: Tensor
    """Margins in the middle of the bins."""
    ratio_centres: Tensor
    near_zero: Tensor
    """1 for each bin of the margin that lies near 0, else 0."""

    def __init__(
        self, edges: Float[Tensor, " edges"], ratio_edges: Float[Tensor, " ratio_edges"], *, dropout: float = 0.1
    ) -> None:
        super().__init__()
        self.register_buffer("edges", edges.clone(), persistent=False)
        # once, for a step is made of so little that each of these costs a twentieth of it
        self.register_buffer("centres", bin_centres(edges), persistent=False)
        self.register_buffer("ratio_centres", bin_centres(ratio_edges), persistent=False)
        self.register_buffer("near_zero", (self.centres <= _NEAR_ZERO).float(), persistent=False)
        self.seen = nn.Linear(8, WIDTH)
        self.memory = nn.GRU(WIDTH, WIDTH, batch_first=True)
        self.correction = nn.Linear(2 * WIDTH, len(edges) - 1)
        self.dropout = nn.Dropout(dropout)
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def forward(
        self,
        margin: Float[Tensor, "batch frames bins"],
        ratio: Float[Tensor, "batch frames ratio_bins"],
        elapsed_s: Float[Tensor, "batch frames"],
        state: State | None = None,
    ) -> tuple[Float[Tensor, "batch frames bins"], State]:
        """Logits over the margin, and what is remembered after the last frame.

        `margin`, `ratio`: probabilities of each frame; `elapsed_s`: since memory took its last step; `state`: of the
        frames before these, None at the first of a contact.
        """
        values, spread = _moments(margin, self.centres)
        pulled, pulled_spread = _moments(ratio, self.ratio_centres)
        peak = pulled.cummax(dim=1).values.clamp_min(_LEAST_PEAK)
        if state is not None:
            peak = torch.maximum(peak, state[1])
        near_zero = margin @ self.near_zero
        log_s = elapsed_s.clamp(STEP_S, LONGEST_S).log()
        told = (values, pulled, 4 * spread, 8 * pulled_spread, pulled / peak, peak, near_zero, log_s)
        seen = functional.gelu(self.seen(torch.stack(told, dim=-1)))
        remembered, last = self.memory(self.dropout(seen), None if state is None else state[0])
        correction = self.correction(torch.cat([self.dropout(remembered), seen], dim=-1))
        return margin.clamp_min(_LEAST).log() + correction, (last, peak[:, -1:])


def _moments(probabilities: Float[Tensor, "*frames bins"], centres: Float[Tensor, " bins"]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each distribution."""
    mean = probabilities @ centres
    return mean, (probabilities * (centres - mean[..., None]) ** 2).sum(dim=-1).sqrt()


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
    >>> touch = np.zeros((2, 224, 224, 3), dtype=np.uint8)  # difference images: nothing has moved
    >>> one_by_one = network.estimate(network.encode(touch, None))
    >>> follower.update(one_by_one, np.array([0.0, 0.1]), np.array([True, True])).margin.shape
    (2,)
    """

    def __init__(self, head: SequenceHead, sequence: SequenceManifest) -> None:
        self._head, self._sequence = head, sequence
        self.forget()

    def forget(self) -> None:
        """Begin anew with the next contact."""
        self._state: State | None = None
        self._time_s = np.nan
        self.lost = False
        """Whether there was a gap in this contact, so that its frames are read by themselves."""

    @torch.inference_mode()
    def update(
        self, estimate: "Estimate", time_s: Float[np.ndarray, " frames"], touches: Bool[np.ndarray, " frames"]
    ) -> "Estimate":
        """The next frames as they are read after those before.

        `estimate`: of each frame by itself, told no friction; `time_s`: when it was taken; `touches`: whether anything
        touches. A frame that nothing touches keeps its answer, and what was before it is forgotten; so is what was
        before a clock that runs back. After a gap (`GAP_S`) the rest of the contact keeps its answers too: nobody knows
        what happened meanwhile, and to a head that does not know the largest pull, what slides seems to hold.
        """
        assert estimate.probabilities is not None
        assert estimate.ratio is not None
        device = self._head.edges.device
        margin, ratio = (
            torch.from_numpy(values).float().to(device)[:, None, None]
            for values in (estimate.probabilities, estimate.ratio.probabilities)
        )
        read, probabilities = estimate.margin.copy(), estimate.probabilities.copy()
        centres, temperature = self._head.centres.double().cpu().numpy(), self._sequence.calibration.temperature
        for row, (now_s, touched) in enumerate(zip(time_s.tolist(), touches.tolist(), strict=True)):
            if not touched or now_s < self._time_s:
                self.forget()
            self.lost |= now_s - self._time_s > GAP_S + ROUNDING_S
            if not touched or self.lost:
                continue
            elapsed_s = LONGEST_S if self._state is None else now_s - self._time_s
            since = torch.tensor([[elapsed_s]], device=device)
            logits, state = self._head(margin[row], ratio[row], since, self._state)
            if elapsed_s >= STEP_S - ROUNDING_S:
                self._state, self._time_s = state, now_s
            probabilities[row] = torch.softmax(logits[0, 0].double() / temperature, dim=-1).cpu().numpy()
            read[row] = probabilities[row] @ centres  # each by itself: sums of many rows are added in another order
        return replace(estimate, margin=read, probabilities=probabilities, calibration=self._sequence.calibration)
