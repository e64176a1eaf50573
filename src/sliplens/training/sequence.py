"""Training of a head for several frames, on the outputs of a network for whole trials."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from sliplens.errors import InputError, RecordingError
from sliplens.files import versions
from sliplens.models import Network, make_engine, save_checkpoint
from sliplens.models.backbones import HistogramRegressor, bin_centres, histogram_targets
from sliplens.models.calibration import calibrate_histogram
from sliplens.models.sequence import (
    GAP_S,
    LONGEST_S,
    ROUNDING_S,
    STEP_S,
    SequenceHead,
    SequenceManifest,
    require_frequent,
)
from sliplens.progress import open_stage, report_each
from sliplens.recordings import Dataset, TrialInfo
from sliplens.results.evaluation import Training
from sliplens.training.config import TrainingConfig
from sliplens.training.module import add_row, describe_training

_MOST_GRADIENT = 1.0
"""Largest norm of a gradient, as recurrent networks want it."""


@dataclass(frozen=True, kw_only=True)
class TrialOutputs:
    """Outputs of a network for the labelled frames of a trial, in their order, and the labels."""

    margin: Float32[np.ndarray, "frames bins"]
    ratio: Float32[np.ndarray, "frames ratio_bins"]
    """Probabilities over the margin and over F_t / F_n."""
    label: Float[np.ndarray, " frames"]
    time_s: Float[np.ndarray, " frames"]

    def at(self, rows: slice | list[int]) -> "TrialOutputs":
        """Return some frames."""
        return TrialOutputs(**{name: values[rows] for name, values in vars(self).items()})

    def steps(self, step_s: float = STEP_S, *, late_s: float = 0.0) -> "TrialOutputs":
        """Return the frames at which memory takes its steps; the first step is `late_s` after the beginning.

        Where the frame after a step would come too late for memory, a step is taken before its time.
        """
        rows, next_s, ends_s = [], self.time_s[0] + late_s, np.inf
        times = self.time_s.tolist()
        for row, (now_s, then_s) in enumerate(zip(times, [*times[1:], -np.inf], strict=True)):
            if now_s >= next_s - ROUNDING_S or then_s > ends_s:
                rows.append(row)
                next_s, ends_s = now_s + step_s, now_s + GAP_S + ROUNDING_S
        return self.at(rows)

    def sample(self, rng: np.random.Generator) -> "TrialOutputs":
        """Draw steps of a random rate, half of them from a later frame on.

        In a data set whose trials have equally many frames the time between two frames shows how long the pull lasts;
        neither rate nor number of frames may give that away.
        """
        step_s = STEP_S * 4 ** rng.random()
        half_s = float(self.time_s[-1] - self.time_s[0]) / 2
        late_s = rng.random() * min(half_s, LONGEST_S) if rng.random() < 0.5 else 0.0
        return self.steps(step_s, late_s=late_s)


def fit_sequence(
    config: TrainingConfig,
    start: Network,
    data: Dataset,
    trials: tuple[Sequence[TrialInfo], Sequence[TrialInfo]],
    folder: Path,
) -> Training:
    """Train the head of a network for several frames on its outputs, and save both; predictions for one frame stay.

    `start`: network with two outputs, margin and F_t / F_n; `trials`: training and validation trials. The folder gets
    the files of `save_checkpoint` and `metrics.csv`.
    """
    model = start.model
    if not isinstance(model, HistogramRegressor) or model.ratio_edges is None:
        raise InputError(
            "a head for several frames needs F_t / F_n, and this network predicts the margin alone; teach it the ratio "
            "first with `sliplens train DATA -o RUN --start-from NETWORK --recipe ratio`"
        )
    train, whole = (
        _predict_trials(start, data, some, name=name)
        for name, some in zip(("training", "validation"), trials, strict=True)
    )
    validation = [trial.steps() for trial in whole]
    with torch.random.fork_rng(devices=[]), open_stage("Training (several frames)"):
        torch.manual_seed(config.seed)
        head = SequenceHead(model.edges.cpu(), model.ratio_edges.cpu())
        rows = _fit(head, config, train, validation, file=folder / "metrics.csv")
    labels, temperature = _labels(validation), torch.tensor(1.0)
    calibration, _ = calibrate_histogram(_logits(head, validation), head.edges, temperature, labels)
    single = torch.from_numpy(np.concatenate([trial.margin @ head.centres for trial in validation]))
    manifest = replace(
        start.manifest,
        recipe=config.recipe,
        data_hash=data.hash,
        trained_on=(*(info.sha256[:12] for some in trials for info in some), *start.manifest.trained_on),
        started_from=start.manifest.weights_sha256,
        sequence=SequenceManifest(calibration=calibration, mse_one=float(((single - labels) ** 2).mean())),
        versions=versions(),
    )
    save_checkpoint(folder, model, manifest, sequence=head)
    return describe_training(
        manifest,
        config,
        rows,
        frames=(sum(len(trial.label) for trial in train), len(labels)),
        trained=head,
    )


def _predict_trials(network: Network, data: Dataset, trials: Sequence[TrialInfo], *, name: str) -> list[TrialOutputs]:
    """Predict the labelled frames of every trial, up to the first gap."""
    engine, outputs = make_engine("auto", network, frames=sum(trial.frames for trial in trials)), []
    with open_stage(f"Reading {name} trials ({network.manifest.input})"):
        for info in report_each(trials):
            recording = data.load(info, truth=False)
            rows = np.flatnonzero(recording.labelled)
            if not len(rows):
                continue
            require_frequent(recording.time_s[rows], what=f"the trial {info.trial}")
            parts = np.split(rows, range(engine.batch_size, len(rows), engine.batch_size))
            images = (network.encode(recording.frames[part], recording.reference) for part in parts)
            estimate = network.estimate(images, engine=engine)
            assert estimate.probabilities is not None
            assert estimate.ratio is not None
            trial = TrialOutputs(
                margin=estimate.probabilities.astype(np.float32),
                ratio=estimate.ratio.probabilities.astype(np.float32),
                label=recording.safety_margin[rows],
                time_s=recording.time_s[rows],
            )
            # frames after the first gap keep the predictions of single frames
            gaps = np.flatnonzero(np.diff(trial.time_s) > GAP_S + ROUNDING_S)
            outputs.append(trial.at(slice(gaps[0] + 1 if len(gaps) else None)))
    if not outputs:
        raise RecordingError(f"{data.folder}: no frame of the {name} trials has a label; label them first")
    return outputs


def _fit(
    head: SequenceHead,
    config: TrainingConfig,
    train: Sequence[TrialOutputs],
    validation: Sequence[TrialOutputs],
    *,
    file: Path,
) -> list[list[float]]:
    """Fit the head, leave it with the weights that were best on validation, and return the learning curve."""
    began, rows = time.perf_counter(), []
    rng, batch = np.random.default_rng(config.seed), min(config.batch_size, len(train))
    steps = config.epochs * (len(train) // batch)
    optimizer = torch.optim.AdamW(head.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=config.learning_rate, total_steps=steps)
    labels, best, best_mse = _labels(validation), head.state_dict(), np.inf
    centres = bin_centres(head.edges)
    for epoch in report_each(range(1, config.epochs + 1)):
        head.train()
        order, squares, frames = rng.permutation(len(train)), 0.0, 0
        for first in range(0, len(train) // batch * batch, batch):
            some = [train[row].sample(rng) for row in order[first : first + batch]]
            inputs, margin, label = (
                pad_sequence(list(values), batch_first=True)
                for values in zip(*(_tensors(head, trial) for trial in some), strict=True)
            )
            real = pad_sequence([torch.ones(len(trial.label), dtype=torch.bool) for trial in some], batch_first=True)
            logits = head.logits(margin) + head(inputs)[0]
            loss = functional.cross_entropy(logits[real], histogram_targets(label[real], head.edges))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(head.parameters(), _MOST_GRADIENT)
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                squares += float(((torch.softmax(logits[real], dim=-1) @ centres - label[real]) ** 2).sum())
            frames += int(real.sum())
        probabilities = torch.softmax(_logits(head, validation), dim=-1)
        mse = float(((probabilities @ centres - labels) ** 2).mean())
        add_row(rows, [float(epoch), squares / frames, mse, (time.perf_counter() - began) / 60], file)
        if mse < best_mse:
            best, best_mse = {name: values.clone() for name, values in head.state_dict().items()}, mse
    head.load_state_dict(best)
    head.eval()
    return rows


@torch.no_grad()
def _logits(head: SequenceHead, trials: Sequence[TrialOutputs]) -> Float[Tensor, "frames bins"]:
    """Compute logits over the margin of all frames, trial by trial, each trial a contact."""
    head.eval()
    tensors = (_tensors(head, trial) for trial in trials)
    return torch.cat([head.logits(margin) + head(inputs)[0] for inputs, margin, _ in tensors])


def _tensors(head: SequenceHead, trial: TrialOutputs) -> tuple[Tensor, ...]:
    """Make inputs of the head, probabilities of the margin, and label of each frame."""
    elapsed_s = np.diff(trial.time_s, prepend=trial.time_s[0] - LONGEST_S)
    inputs = head.make_inputs(head.summarize(trial.margin, trial.ratio), elapsed_s)
    return tuple(torch.from_numpy(values) for values in (inputs, trial.margin, trial.label.astype(np.float32)))


def _labels(trials: Sequence[TrialOutputs]) -> Float[Tensor, " frames"]:
    return torch.from_numpy(np.concatenate([trial.label for trial in trials]).astype(np.float32))
