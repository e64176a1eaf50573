"""What a network answers, as tensors that every engine can give."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.models import TrainedModel
from sliplens.models.checkpoints import Estimate
from sliplens.models.heads import HistogramRegressor

INPUT = "image"
MARGIN, PROBABILITIES = "margin", "probabilities"


class Answers(nn.Module):
    """A network that returns its margins, and the probabilities behind them where it has a histogram.

    Parameters
    ----------
    model
        As in a `TrainedModel`.
    """

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, image: Float[Tensor, "batch 3 height width"]
    ) -> tuple[Float[Tensor, " batch"]] | tuple[Float[Tensor, " batch"], Float[Tensor, "batch bins"]]:
        """Margins, and probabilities if any."""
        if isinstance(self.model, HistogramRegressor):
            probabilities = self.model.probabilities(image)
            return probabilities @ self.model.centres, probabilities
        return (self.model(image)[:, 0],)


def answer_names(model: nn.Module) -> tuple[str, ...]:
    """Names of what `Answers` returns, in its order."""
    return (MARGIN, PROBABILITIES) if isinstance(model, HistogramRegressor) else (MARGIN,)


def bin_edges(model: nn.Module) -> Float[np.ndarray, " edges"] | None:
    """Edges of the bins of a histogram, in margin units; None for one number."""
    return model.edges.double().cpu().numpy() if isinstance(model, HistogramRegressor) else None


def to_estimate(trained: TrainedModel, answers: tuple[np.ndarray, ...]) -> Estimate:
    """Estimate of a network from what `Answers` returned."""
    margin, *rest = (np.asarray(answer, dtype=np.float64) for answer in answers)
    return Estimate(
        margin=margin,
        probabilities=rest[0] if rest else None,
        edges=bin_edges(trained.model),
        calibration=trained.calibration,
    )


@torch.inference_mode()
def run_network(network: nn.Module, inputs: Float[Tensor, "batch 3 height width"]) -> tuple[np.ndarray, ...]:
    """Answers of an `Answers` network that is where the inputs are."""
    return tuple(answer.cpu().numpy() for answer in network(inputs))
