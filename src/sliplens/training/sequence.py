"""Teach a network to read several frames: a head over its answers to whole trials, frame after frame."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from safetensors.numpy import load_file, save_file
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from sliplens.errors import InputError, RecordingError
from sliplens.files import versions, whole_file
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
from sliplens.progress import OnProgress, stage
from sliplens.recordings import Dataset, TrialInfo
from sliplens.results.evaluation import Training
from sliplens.training.config import TrainConfig
from sliplens.training.module import Clock

_ANSWERS = "answers"
_CLIP = 1.0
"""Largest norm of a gradient, as recurrent networks want it."""


@dataclass(frozen=True, kw_only=True)
class AnsweredTrial:
    """What a network answers to the labelled frames of a trial, in their order, and what is right."""

    margin: Float32[np.ndarray, "frames bins"]
    ratio: Float32[np.ndarray, "frames ratio_bins"]
    """Probabilities over the margin and over F_t / F_n."""
    label: Float[np.ndarray, " frames"]
    time_s: Float[np.ndarray, " frames"]

    def unbroken(self) -> "AnsweredTrial":
        """The frames before the first gap, those after which are read by themselves."""
        gaps = np.flatnonzero(np.diff(self.time_s) > GAP_S + ROUNDING_S)
        end = gaps[0] + 1 if len(gaps) else None
        return AnsweredTrial(**{name: values[:end] for name, values in vars(self).items()})

    def steps(self, step_s: float = STEP_S, *, late_s: float = 0.0) -> "AnsweredTrial":
        """The frames with which memory takes its steps; the first one `late_s` after the beginning.

        Where the frame after one would come when memory has ended, a step is taken before its time.
        """
        rows, next_s, ends_s = [], self.time_s[0] + late_s, np.inf
        times = self.time_s.tolist()
        for row, (now_s, then_s) in enumerate(zip(times, [*times[1:], -np.inf], strict=True)):
            if now_s >= next_s - ROUNDING_S or then_s > ends_s:
                rows.append(row)
                next_s, ends_s = now_s + step_s, now_s + GAP_S + ROUNDING_S
        return AnsweredTrial(**{name: values[rows] for name, values in vars(self).items()})

    def some(self, rng: np.random.Generator) -> "AnsweredTrial":
        """Steps of some rate, maybe from a later frame on: neither rate nor number of frames is to tell anything.

        In a data set whose trials have equally many frames the time between two tells how long the pull lasts.
        """
        step_s = STEP_S * 4 ** rng.random()
        half_s = float(self.time_s[-1] - self.time_s[0]) / 2
        late_s = rng.random() * min(half_s, LONGEST_S) if rng.random() < 0.5 else 0.0
        return self.steps(step_s, late_s=late_s)


def fit_sequence(
    config: TrainConfig,
    start: Network,
    data: Dataset,
    trials: tuple[Sequence[TrialInfo], Sequence[TrialInfo]],
    folder: Path,
    *,
    on_progress: OnProgress | None = None,
) -> Training:
    """Train the head of a network for several frames, whose answers to one frame stay, and save both.

    Trials are read once; what they were answered waits in the folder for whoever is interrupted.

    Parameters
    ----------
    start
        Network with two answers, margin and F_t / F_n.
    trials
        Training and validation trials of the data set.
    folder
        Gets what `save_checkpoint` writes and `metrics.csv`.
    """
    model = start.model
    if not isinstance(model, HistogramRegressor) or model.ratio_edges is None:
        raise InputError(
            "what reads several frames sees F_t / F_n too, and this network answers with the margin alone; teach it "
            "first with `sliplens train DATA -o RUN --start-from NETWORK --recipe ratio`"
        )
    train, answered = (
        _answer(start, data, some, folder / _ANSWERS, what=what, on_progress=on_progress)
        for what, some in zip(("training", "validation"), trials, strict=True)
    )
    validation = [one.steps() for one in answered]
    clock = Clock(steps=config.epochs, max_minutes=None, metrics_file=folder / "metrics.csv", on_progress=None)
    with torch.random.fork_rng(devices=[]), stage(on_progress, "Training (several frames)") as clock.on_progress:
        torch.manual_seed(config.seed)
        head = SequenceHead(model.edges.cpu(), model.ratio_edges.cpu())
        _fit(head, config, train, validation, clock=clock)
    labels, temperature = _labels(validation), torch.tensor(1.0)
    calibration, _ = calibrate_histogram(_logits(head, validation), head.edges, temperature, labels)
    alone = torch.from_numpy(np.concatenate([one.margin @ head.centres for one in validation]))
    kept = SequenceManifest(calibration=calibration, mse_one=float(((alone - labels) ** 2).mean()))
    manifest = replace(
        start.manifest,
        recipe=config.recipe,
        data_hash=data.hash,
        trained_on=(*(one.sha256[:12] for some in trials for one in some), *start.manifest.trained_on),
        started_from=start.manifest.weights_sha256,
        sequence=kept,
        versions=versions(),
    )
    save_checkpoint(folder, model, manifest, sequence=head)
    shutil.rmtree(folder / _ANSWERS)
    return Training(
        input=manifest.input,
        backbone=manifest.backbone,
        image_size=manifest.image_size,
        frame_size=manifest.frame_size,
        train_frames=sum(len(one.label) for one in train),
        validation_frames=len(labels),
        seed=config.seed,
        epochs=float(config.epochs),
        minutes=clock.seconds / 60,
        stopped_by=clock.stopped_by,
        best_validation_mse=min(row[2] for row in clock.rows),
        parameters=sum(values.numel() for values in head.parameters()),
        processes=1,
        curve=clock.curve(),
    )


def _answer(
    run: Network,
    data: Dataset,
    trials: Sequence[TrialInfo],
    folder: Path,
    *,
    what: str,
    on_progress: OnProgress | None,
) -> list[AnsweredTrial]:
    """Have every trial read, or take what was read before it was interrupted."""
    folder.mkdir(exist_ok=True)
    answered, engine = [], None
    with stage(on_progress, f"Reading {what} trials ({run.manifest.input})") as count:
        for done, info in enumerate(trials, start=1):
            path = folder / f"{info.sha256}.safetensors"
            if not path.is_file():
                engine = engine or make_engine("auto", run, frames=sum(one.frames for one in trials))
                recording = data.load(info, truth=False)
                rows = np.flatnonzero(recording.labelled)
                require_frequent(recording.time_s[rows], what=f"the trial {info.trial}")
                images = (
                    recording.frames[rows[at : at + engine.batch_size]] for at in range(0, len(rows), engine.batch_size)
                )
                estimate = engine.estimate(run, (run.encode(batch, recording.reference) for batch in images))
                assert estimate.probabilities is not None
                assert estimate.ratio is not None
                kept = {"margin": estimate.probabilities, "ratio": estimate.ratio.probabilities}
                kept = {name: values.astype(np.float32) for name, values in kept.items()}
                # whole, for a stamp may be seconds since 1970
                kept |= {"label": recording.safety_margin[rows], "time_s": recording.time_s[rows]}
                with whole_file(path) as part:
                    save_file(kept, part)
            answered.append(AnsweredTrial(**load_file(path)))
            count(done, len(trials))
    labelled = [one.unbroken() for one in answered if len(one.label)]
    if not labelled:
        raise RecordingError(f"{data.folder}: no frame of the {what} trials has a label; label them first")
    return labelled


def _fit(
    head: SequenceHead,
    config: TrainConfig,
    train: Sequence[AnsweredTrial],
    validation: Sequence[AnsweredTrial],
    *,
    clock: Clock,
) -> None:
    """Fit the head, and leave it with the weights that were best on the validation trials."""
    rng, batch = np.random.default_rng(config.seed), min(config.batch_size, len(train))
    steps = config.epochs * (len(train) // batch)
    optimizer = torch.optim.AdamW(head.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=config.learning_rate, total_steps=steps)
    labels, best, best_mse = _labels(validation), head.state_dict(), np.inf
    centres = bin_centres(head.edges)
    for epoch in range(1, config.epochs + 1):
        head.train()
        order, squares, frames = rng.permutation(len(train)), 0.0, 0
        for first in range(0, len(train) // batch * batch, batch):
            some = [train[row].some(rng) for row in order[first : first + batch]]
            told, margin, label = (
                pad_sequence(list(values), batch_first=True)
                for values in zip(*(_tensors(head, one) for one in some), strict=True)
            )
            known = pad_sequence([torch.ones(len(one.label), dtype=torch.bool) for one in some], batch_first=True)
            logits = head(told, margin)
            loss = functional.cross_entropy(logits[known], histogram_targets(label[known], head.edges))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(head.parameters(), _CLIP)
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                squares += float(((torch.softmax(logits[known], dim=-1) @ centres - label[known]) ** 2).sum())
            frames += int(known.sum())
        probabilities = torch.softmax(_logits(head, validation), dim=-1)
        mse = float(((probabilities @ centres - labels) ** 2).mean())
        clock.add_row(float(epoch), squares / frames, mse)
        if clock.on_progress is not None:
            clock.on_progress(epoch, config.epochs)
        if mse < best_mse:
            best, best_mse = {name: values.clone() for name, values in head.state_dict().items()}, mse
    head.load_state_dict(best)
    head.eval()


@torch.no_grad()
def _logits(head: SequenceHead, trials: Sequence[AnsweredTrial]) -> Float[Tensor, "frames bins"]:
    """Logits over the margin of all frames, trial by trial, each trial a contact."""
    head.eval()
    tensors = (_tensors(head, one) for one in trials)
    return torch.cat([head(told[None], margin[None])[0] for told, margin, _ in tensors])


def _tensors(head: SequenceHead, trial: AnsweredTrial) -> tuple[Tensor, ...]:
    """What the head is told of each frame, probabilities of its margin, and its label."""
    elapsed_s = np.diff(trial.time_s, prepend=trial.time_s[0] - LONGEST_S)
    told = head.tell(head.summarize(trial.margin, trial.ratio), elapsed_s)
    return tuple(torch.from_numpy(values) for values in (told, trial.margin, trial.label.astype(np.float32)))


def _labels(trials: Sequence[AnsweredTrial]) -> Float[Tensor, " frames"]:
    return torch.from_numpy(np.concatenate([one.label for one in trials]).astype(np.float32))
