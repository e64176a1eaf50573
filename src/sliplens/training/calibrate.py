"""Find out on validation frames how sure a network may be."""

import numpy as np
import torch
from torch import nn

from sliplens.datasets import FrameSet
from sliplens.models.calibration import LEVELS, Calibration, conformal_offset, fit_temperature, quantiles
from sliplens.models.heads import HistogramRegressor, histogram_targets


@torch.no_grad()
def calibrate(model: nn.Module, validation: FrameSet, *, batch_size: int) -> Calibration:
    """Fit the temperature of a distribution, which is set in the model, and the offsets of its intervals.

    Parameters
    ----------
    model
        Trained.
    validation
        Labelled frames of trials that did not train it.
    batch_size
        Images at a time.
    """
    was_training, device = model.training, next(model.parameters()).device
    model.eval()
    network = model.backbone if isinstance(model, HistogramRegressor) else model
    answers = []
    for start in range(0, len(validation), batch_size):
        rows = range(start, min(start + batch_size, len(validation)))
        answers.append(network(validation.__getitems__(rows)[0].to(device)).float().cpu())
    model.train(was_training)
    outputs, labels = torch.cat(answers), validation.safety_margin
    margins = labels.double().numpy()
    if not isinstance(model, HistogramRegressor):
        told = outputs.reshape(-1).double().numpy()
        offsets = {str(level): conformal_offset(told, told, margins, level=level) for level in LEVELS}
        mse = float(np.mean((told - margins) ** 2))
        return Calibration(temperature=1.0, offsets=offsets, frames=len(margins), mse=mse)
    edges = model.edges.cpu()
    temperature = fit_temperature(outputs, histogram_targets(labels, edges))
    model.temperature.fill_(temperature)
    probabilities = torch.softmax(outputs / temperature, dim=-1).double().numpy()
    offsets = {}
    for level in LEVELS:
        low, high = (
            quantiles(probabilities, edges.double().numpy(), share) for share in ((1 - level) / 2, (1 + level) / 2)
        )
        offsets[str(level)] = conformal_offset(np.asarray(low), np.asarray(high), margins, level=level)
    told = probabilities @ model.centres.double().cpu().numpy()
    mse = float(np.mean((told - margins) ** 2))
    return Calibration(temperature=temperature, offsets=offsets, frames=len(margins), mse=mse)
