"""Training: fit a network to a data set."""

import shutil
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Unpack

import lightning
import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import Logger
from torch import Tensor, nn
from torch.utils.data import DataLoader

from sliplens.codec import save_result
from sliplens.errors import InputError, ModelError, RecordingError
from sliplens.extras import pick, require_keywords
from sliplens.files import output_folder, scratch_folder, versions
from sliplens.images import channel_correlations, has_colour
from sliplens.models import Manifest, Network, build_model, load, save_checkpoint
from sliplens.models.backbones import Answers, HistogramRegressor, bin_edges, fill_head, last_layer
from sliplens.models.calibration import Calibration, Traction, calibrate_histogram, conformal_calibration
from sliplens.models.checkpoint import Estimate, Ratio, sensor_kind
from sliplens.models.encodings import ENCODINGS, Encoding
from sliplens.models.novelty import fit_novelty
from sliplens.progress import OnProgress, add_note, open_stage, report_each, report_file, reporting
from sliplens.recordings import Dataset, TrialInfo
from sliplens.recordings.dataset import load_dataset
from sliplens.recordings.trial import Recording
from sliplens.results.evaluation import LearningCurve, Training
from sliplens.shear import FULL_CIRCLE, Shear, ShearEstimator, enclosing_range
from sliplens.training.config import RECIPES, TrainingChanges, TrainingConfig, make_logger
from sliplens.training.data import (
    EpochShuffle,
    FrameSet,
    get_augmentation,
    has_ratio,
    load_frames,
    require_one_size,
)
from sliplens.training.module import Patience, Regressor, make_trainer, run_trainer

_KIND = {
    "all": ("backbone", "head"),
    "weights": ("backbone", "head", "image_size"),
    "ratio": ("backbone", "image_size"),
}
"""Properties that a network keeps from the network it starts from, by `TrainingConfig.learns`."""
_DIRECTION_TRIALS, _DIRECTION_FRAMES, _LEAST_DIRECTIONS = 40, 5, 3
"""Trials and frames of each from which the directions of the pulls are estimated, at most, and trials at least."""
_PULLED, _SURE, _DIRECTION_MARGIN_DEG = 0.6, 5.0, 10.0
"""Margin below which a frame is pulled enough; length of a shear, in standard deviations, whose direction is known to
11 degrees; and what a range is widened by at both ends, for that and for directions that no trial had."""


def train(
    data: Dataset | Path | str,
    out: Path | str | None = None,
    *,
    input: str | None = None,
    recipe: str = "default",
    start_from: Network | Path | str | None = None,
    condition: str | None = None,
    logger: Logger | str = "csv",
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **options: Unpack[TrainingChanges],
) -> Network:
    """Train a network on a data set, and keep the weights that are best on its validation trials.

    Interrupted, it continues after the last whole epoch when it is called again with the same `out`.

    Parameters
    ----------
    data
        Data set with labels, divided into training and validation trials, or its folder.
    out
        Folder to write: weights, manifest, learning curve; nothing is kept if None.
    input
        Input of the network: `difference`, `raw`, `rgb`, `signed`, `amplitude` or `pair`; by default that of
        `start_from`, else `difference`.
    recipe
        `default`, `thesis`, `ratio` or `adapt`.
    start_from
        Network whose weights to start from, its folder, or the name of one that comes with sliplens: to adapt it to
        another sensor, or to go on at another image size. It keeps its input, backbone and head.
    condition
        Train and validate on the trials of one condition alone, such as dry.
    logger
        Logger besides `metrics.csv`: `csv` for none, `tensorboard`, or a logger of Lightning, such as `WandbLogger()`.
    overwrite
        If True, replace a folder `out` of other settings.
    on_progress
        Callback for progress.
    options
        `accelerator`, as Lightning takes it, and fields of `TrainingConfig` that differ from the recipe, such as
        `epochs`, `image_size`, `batch_size`, `max_minutes` or `seed`; None leaves a field as it is.

    Raises
    ------
    InputError
        If there is no such recipe, input or network to start from, a setting is out of range, or a device is missing.
    RecordingError
        If there is no labelled trial to train or to validate on, or all labels to train on are the same.
    ModelError
        If the network to start from is of another kind, or the loss is no longer finite.

    See Also
    --------
    evaluate : Measure the accuracy of the network.
    load : Load it from its folder.
    wrap : Use a network trained elsewhere.

    Examples
    --------
    >>> import sliplens as sl
    >>> network = sl.train("data", "run", recipe="adapt", start_from="chromatouch-pair")  # doctest: +SKIP
    >>> network.manifest.input  # doctest: +SKIP
    'pair'
    """
    require_keywords(train, options)
    accelerator = options.pop("accelerator", "auto")
    changes: TrainingChanges = {name: value for name, value in options.items() if value is not None}  # pyright: ignore[reportAssignmentType]
    start = load(start_from) if isinstance(start_from, str | Path) else start_from
    config = _configure(recipe, changes, start)
    input = input or ("difference" if start is None else start.manifest.input)
    trainer = make_trainer(config, accelerator=accelerator)
    if start is not None:
        require_same_kind(start, config, input)
    data = data if isinstance(data, Dataset) else load_dataset(data)
    encoding, trials = pick(ENCODINGS, input, noun="input"), _choose_trials(data, condition)
    grown = start is not None and config.head == "margin-and-ratio" and config.learns != "ratio"
    if grown and "head" not in changes:
        # the second output is left out where the labels do not show the ratio
        labelled = all(any(has_ratio(data.read_labels(info)) for info in some) for some in trials)
        config = config if labelled else replace(config, head="histogram")
    origin = {"input": encoding.name, "condition": condition, "data_hash": data.hash}
    origin |= {} if start is None else {"started_from": start.manifest.weights_sha256}

    def run(folder: Path, opened: Logger | None) -> Training:
        load_some = partial(load_frames, data, encoding=encoding, image_size=config.image_size, scratch=folder)
        with open_stage(f"Reading training trials ({encoding.name})"):
            train_frames = load_some(trials[0], untouched_share=config.untouched_share)
        with open_stage(f"Reading validation trials ({encoding.name})"):
            validation = load_some(trials[1])
        info = trials[0][0]
        spread = trials[0][:: -(-len(trials[0]) // _DIRECTION_TRIALS)]
        references = [data.read_labels(each).reference for each in spread]
        manifest = Manifest(
            backbone=config.backbone,
            head=config.head,
            recipe=config.recipe,
            input=encoding.name,
            image_size=config.image_size,
            frame_size=(info.height, info.width),
            sensor=info.sensor,
            data_hash=data.hash,
            colour=has_colour(references[0]),
            channel_correlations=tuple(np.mean([channel_correlations(each) for each in references], axis=0).tolist()),
            pull_direction_deg=trained_directions(config, data, spread, start),
            trained_on=tuple(trial.sha256[:12] for some in trials for trial in some),
        )
        training = fit(config, train_frames, validation, folder, manifest, start=start, trainer=trainer, logger=opened)
        return replace(training, condition=condition)

    with reporting(on_progress), ExitStack() as stack:
        if start is not None and start.manifest.head == "margin-and-ratio" and config.head == "histogram":
            add_note("the labels have no forces and friction, so the network learns the margin alone: no --friction")
        target = stack.enter_context(scratch_folder()) / "run" if out is None else Path(out)
        with output_folder(target, stage="train", config={**origin, "training": config}, overwrite=overwrite) as output:
            if not output.complete:
                opened = make_logger(logger, output.folder)
                if opened is not None:
                    opened.log_hyperparams({**asdict(config), **origin})
                save_result(run(output.folder, opened), output.folder)
        network = load(target)
        training = network.training
        assert training is not None
        best = f"validation MSE {training.best_validation_mse:.4f}"
        if out is not None:
            facts = f"{training.epochs:.1f} epochs in {training.minutes:.1f} min, {best}"
            report_file(target, facts, kept=output.complete)
        return network


def _configure(recipe: str, changes: TrainingChanges, start: Network | None) -> TrainingConfig:
    """Apply changes to a recipe; properties of a network to start from stay unless they are changed."""
    config = replace(pick(RECIPES, recipe, noun="recipe"), **changes)
    if start is None:
        if config.learns != "all":
            raise InputError(f"the recipe {recipe} teaches an existing network; name it with --start-from")
        return config
    fixed = {name: getattr(start.manifest, name) for name in _KIND[config.learns]}
    wrong = [name for name, value in changes.items() if value != fixed.get(name, value)]
    if wrong and config.learns == "ratio":
        options = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(wrong))
        raise InputError(f"the recipe {recipe} leaves the network of --start-from as it is; leave out {options}")
    return replace(config, **fixed | changes)


def _choose_trials(data: Dataset, condition: str | None) -> tuple[tuple[TrialInfo, ...], tuple[TrialInfo, ...]]:
    try:
        train, validation = (data.select(split=split, condition=condition) for split in ("train", "validation"))
    except RecordingError as error:
        cure = "divide it" if condition is None else "name another --condition, or divide it"
        raise RecordingError(f"{error}; {cure} with `sliplens split`") from None
    require_one_size(data, (*train, *validation))
    labels = [data.read_labels(info) for info in train]
    margins = np.concatenate([some.safety_margin[some.labelled] for some in labels])
    # rounding of margins that were computed from constant forces
    if len(margins) and np.ptp(margins) < 1e-6:
        raise RecordingError(
            f"all {len(margins)} labels that {data.folder} has to train on are {100 * margins[0]:.0f} %, and of a "
            "constant there is nothing to learn; check that its forces hold the pull, and record trials until they slip"
        )
    return train, validation


def trained_directions(
    config: TrainingConfig, data: Dataset, trials: Sequence[TrialInfo], start: Network | None
) -> tuple[float, float] | None:
    """Estimate the directions of the pulls in training trials; those of `start` where its predictions stay.

    None where too few trials show a direction: no margin is then withheld for its direction.
    """
    if start is not None and config.learns == "ratio":
        return start.manifest.pull_direction_deg
    turned_deg = getattr(get_augmentation(config.augmentation), "rotation_deg", 0.0)
    if turned_deg >= 180:
        return FULL_CIRCLE
    estimates = [pull_direction(data.load(info, truth=False)) for info in trials]
    directions = [direction for direction in estimates if direction is not None]
    if len(directions) < _LEAST_DIRECTIONS:
        return None
    return enclosing_range(np.array(directions), margin_deg=_DIRECTION_MARGIN_DEG + turned_deg)


def pull_direction(trial: Recording) -> float | None:
    """Estimate the direction of the mean shear at the lowest margins, in degrees; None without shear."""
    pulled = np.flatnonzero(trial.labelled & (trial.safety_margin < _PULLED))
    lowest = pulled[np.argsort(trial.safety_margin[pulled], kind="stable")][:_DIRECTION_FRAMES]
    estimator = ShearEstimator(trial.reference, sensor_kind(trial.sensor))
    shears = [vars(estimator.estimate(trial.frames[frame])) for frame in lowest]
    if not shears:
        return None
    mean = Shear(**{name: float(np.mean([shear[name] for shear in shears])) for name in shears[0]})
    return mean.direction_deg if np.hypot(mean.x_px, mean.y_px) > _SURE * mean.sigma_px else None


@torch.no_grad()
def calibrate(
    model: nn.Module,
    validation: FrameSet,
    *,
    batch_size: int,
    trained_friction: Float[np.ndarray, " _"] | None = None,
    margin_calibration: Calibration | None = None,
) -> tuple[Calibration, Traction | None]:
    """Fit the temperatures of the distributions, which are set in the model, and the offsets of the intervals.

    `trained_friction`: friction of the training frames, for a network of two outputs; without it the second result is
    None. `margin_calibration`: calibration of the margin, if it is to stay.
    """
    device = next(model.parameters()).device
    network = (model.backbone if isinstance(model, HistogramRegressor) else model).eval()
    outputs = torch.cat([network(inputs.to(device)).float().cpu() for inputs in validation.batches(batch_size)])
    labels = validation.safety_margin
    if not isinstance(model, HistogramRegressor):
        margins = outputs.reshape(-1).double().numpy()
        return conformal_calibration(margins, None, None, labels, temperature=1.0), None
    logits, ratio_logits = model.split(outputs)
    calibration, probabilities = calibrate_histogram(
        logits, model.edges, model.temperature, labels, calibration=margin_calibration
    )
    if model.ratio_edges is None or model.ratio_temperature is None or trained_friction is None:
        return calibration, None
    finite = torch.isfinite(validation.traction_ratio) & torch.from_numpy(np.isfinite(validation.friction))
    rows = finite.numpy()
    of_ratio, ratio_probabilities = calibrate_histogram(
        ratio_logits[finite], model.ratio_edges, model.ratio_temperature, validation.traction_ratio[finite]
    )
    quantiles = np.quantile(trained_friction[np.isfinite(trained_friction)], np.linspace(0, 1, 11))
    traction = Traction(calibration=of_ratio, known_friction=of_ratio, friction=tuple(quantiles.tolist()))
    edges = bin_edges(model)
    estimate = Estimate(
        margin=probabilities[rows] @ model.centres.cpu().double().numpy(),
        probabilities=probabilities[rows],
        edges=edges,
        calibration=None,
        ratio=Ratio(probabilities=ratio_probabilities, edges=model.ratio_edges.cpu().double().numpy()),
    )
    estimate = estimate.with_friction(validation.friction[rows], traction)
    with_friction = conformal_calibration(
        estimate.margin, estimate.probabilities, edges, labels[finite], temperature=calibration.temperature
    )
    return calibration, replace(traction, known_friction=with_friction)


def fit(
    config: TrainingConfig,
    train: FrameSet,
    validation: FrameSet,
    folder: Path,
    manifest: Manifest,
    *,
    start: Network | None = None,
    trainer: lightning.Trainer | None = None,
    logger: Logger | None = None,
) -> Training:
    """Train a network and save the weights that were best on the validation frames.

    Parameters
    ----------
    config
        Settings of the training.
    train, validation
        Encoded frames, of trials that do not overlap.
    folder
        Gets `model.safetensors`, `manifest.json` and `metrics.csv`; while training runs also checkpoints, from which a
        call with the same folder continues.
    manifest
        Facts of the data and the network, to be completed by calibration and origin.
    start
        Network whose weights it starts from, instead of random ones; it is left as it is.
    trainer, logger
        Trainer of `make_trainer`, used once, and Lightning's logger.
    """
    trainer = trainer or make_trainer(config)
    _check_frames(config, train, validation)
    network = model = _begin(config, train.encoding, start)
    frames, learnt = (train, validation), None
    if start is not None and config.learns == "ratio":
        learnt = start.manifest
        network, frames = _take_last_layer(model, frames, batch_size=config.batch_size)
    shuffle = EpochShuffle(len(train), seed=config.seed, drawn=config.epoch_frames)
    per_epoch, checkpoints = len(shuffle) // config.batch_size, folder / "checkpoints"
    module = Regressor(
        network,
        config=config,
        augmentation=get_augmentation(config.augmentation, neutral=train.encoding.neutral),
        steps=config.epochs * per_epoch,
        metrics_file=folder / "metrics.csv",
    )
    best = ModelCheckpoint(dirpath=checkpoints, filename="best", monitor="validation_mse")
    # of every epoch: `save_last` writes one only where the best is written too
    last = ModelCheckpoint(dirpath=checkpoints, filename="last", enable_version_counter=False)
    # in this order: a checkpoint holds what the stopping has counted of the same epoch, and which was best so far
    early = [Patience("validation_mse", patience=config.patience)] if config.patience else []
    trainer.callbacks += [module.timer, *early, best, last]  # pyright: ignore[reportAttributeAccessIssue]
    trainer.loggers = [] if logger is None else [logger]
    trainer.log_every_n_steps = min(50, per_epoch)  # pyright: ignore[reportAttributeAccessIssue]
    # a last small batch would make batch normalisation noisy; `FrameSet.__getitems__` makes batches
    loader = partial(DataLoader, batch_size=config.batch_size, collate_fn=lambda batch: batch)
    loaders = loader(frames[0], sampler=shuffle, drop_last=True), loader(frames[1])

    with torch.random.fork_rng(devices=[]), open_stage(f"Training ({train.encoding.name})"):
        run_trainer(trainer, module, loaders, checkpoints / "last.ckpt")
    # our own file of tensors and plain numbers, read back without unpickling anything else
    checkpoint = torch.load(best.best_model_path, map_location="cpu", weights_only=True)
    module.load_state_dict(checkpoint["state_dict"])
    calibration, traction = calibrate(
        network,
        frames[1],
        batch_size=config.batch_size,
        trained_friction=train.friction,
        margin_calibration=learnt and learnt.calibration,
    )
    if network is not model:  # the last layer and the temperatures were fitted by themselves
        model.load_state_dict(network.state_dict(), strict=False)
        last_layer(model).load_state_dict(last_layer(network).state_dict())
    model.eval()
    samples = (some.sample(2000, batch_size=config.batch_size) for some in (train, validation))
    complete = replace(
        manifest,
        trained_on=tuple(dict.fromkeys((*manifest.trained_on, *(start.manifest.trained_on if start else ())))),
        started_from=start.manifest.weights_sha256 if start else "",
        versions=versions(),
        metrics={"validation_mse": calibration.mse},
        calibration=calibration,
        traction=traction,
        # where the last layer alone was trained, the early layers stay as they were
        novelty=learnt.novelty if learnt else fit_novelty(model, *samples),
    )
    save_checkpoint(folder, model, complete)
    late = config.max_minutes is not None and module.global_step < module.steps
    epoch, train_mse, validation_mse, minutes = np.array(module.rows, dtype=np.float64).reshape(-1, 4).T
    training = Training(
        input=manifest.input,
        backbone=manifest.backbone,
        image_size=manifest.image_size,
        frame_size=manifest.frame_size,
        train_frames=len(train),
        validation_frames=len(validation),
        seed=config.seed,
        epochs=float(epoch[-1]),
        minutes=float(minutes[-1]),
        stopped_by="no gain" if early and early[0].stopped_epoch else "time limit" if late else "epochs",
        # as the file itself has it: after a crash between two files the callback may remember an older one
        best_validation_mse=float(checkpoint["callbacks"][best.state_key]["current_score"]),
        parameters=sum(values.numel() for values in model.parameters()),
        curve=LearningCurve(epoch=epoch, train_mse=train_mse, validation_mse=validation_mse, minutes=minutes),
    )
    shutil.rmtree(checkpoints)
    return training


def _take_last_layer(
    model: nn.Module, frames: tuple[FrameSet, FrameSet], *, batch_size: int
) -> tuple[HistogramRegressor, tuple[FrameSet, FrameSet]]:
    """Return the last layer of a network as a network of its own, and its inputs."""
    network = HistogramRegressor(last_layer(model), ratio=True)
    network.load_state_dict(  # edges of a network of the package are rounded
        {name: model.get_buffer(name) for name in ("temperature", "edges", "ratio_edges")}, strict=False
    )
    sets, features = [], list[Tensor]()
    hook = last_layer(model).register_forward_pre_hook(lambda _, inputs: features.append(inputs[0].float().cpu()))
    with open_stage("Passing frames through the network"), torch.no_grad():
        for some in report_each(frames):
            deque(Answers(model.eval()).run(some.batches(batch_size, report=True)), maxlen=0)
            sets.append(replace(some, images=torch.cat(features)))
            features.clear()
    hook.remove()
    model.train()
    return network, (sets[0], sets[1])


def _begin(config: TrainingConfig, encoding: Encoding, start: Network | None) -> nn.Module:
    """Build a network with random weights, or with those of the network that it starts from."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)  # forked, so that the caller's random state is untouched
        model = build_model(config.backbone, head=config.head, colours=encoding.colours)
    # channels last: depthwise convolutions run up to half as fast again on a CPU
    model = model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    if start is not None:
        require_same_kind(start, config, encoding.name)
        fill = model.load_state_dict if start.manifest.head == config.head else partial(fill_head, model)
        fill(start.model.state_dict())
    return model


def _check_frames(config: TrainingConfig, train: FrameSet, validation: FrameSet) -> None:
    if (config.epoch_frames or len(train)) < config.batch_size:
        raise InputError(f"{len(train)} training frames do not fill a batch of {config.batch_size}; lower batch_size")
    for name, frames in (("training", train), ("validation", validation)) if config.head == "margin-and-ratio" else ():
        if not (torch.isfinite(frames.traction_ratio).numpy() & np.isfinite(frames.friction)).any():
            raise InputError(
                f"no {name} frame has forces and friction, from which F_t / F_n is learnt; import the trials with "
                "their forces, or choose another --head"
            )
    if shared := set(train.trial) & set(validation.trial):
        raise InputError(f"trial {min(shared)} is in both training and validation; split by trial")


def require_same_kind(start: Network, config: TrainingConfig, encoding: str) -> None:
    """Refuse to start from a network whose weights would mean something else."""
    for name, value in (("input", encoding), ("backbone", config.backbone), ("head", config.head)):
        existing = getattr(start.manifest, name)
        # a second answer can be learnt beside the first or left out
        changed = {existing, value} == {"histogram", "margin-and-ratio"}
        if existing != value and not changed:
            raise ModelError(
                f"the network to start from has the {name} {existing}, and {value} is to be trained; "
                f"train {existing}, or start from another network"
            )
