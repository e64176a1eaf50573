"""Fit a network to a data set."""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import Logger
from torch import Tensor, nn

from sliplens.codec import save_result
from sliplens.errors import InputError, ModelError, RecordingError
from sliplens.files import output_folder, partial_folder, scratch_folder, versions
from sliplens.images import has_colour
from sliplens.models import Manifest, Network, build_model, load_checkpoint, save_checkpoint
from sliplens.models.backbones import (
    REFERENCE_SIGNS,
    HistogramRegressor,
    bin_edges,
    fill_head,
    last_layer,
    with_reference,
)
from sliplens.models.calibration import Calibration, Traction, calibrate_histogram, conformal_calibration
from sliplens.models.checkpoint import Estimate, Ratio, load, sensor_kind, tell_each
from sliplens.models.encodings import ENCODINGS, Encoding
from sliplens.models.novelty import Novelty, fit_novelty
from sliplens.progress import OnProgress, note, stage, wrote
from sliplens.recordings import Dataset, TrialInfo
from sliplens.recordings.dataset import load_dataset
from sliplens.recordings.trial import Recording
from sliplens.results.evaluation import Training
from sliplens.shear import FULL_CIRCLE, Shear, ShearEstimator, enclosing_range
from sliplens.training.config import TrainConfig, get_recipe, open_logger
from sliplens.training.data import (
    EpochShuffle,
    FrameSet,
    extract_features,
    get_augmentation,
    load_frames,
    make_loaders,
    tells_ratio,
)
from sliplens.training.module import (
    Clock,
    DivergedError,
    Patience,
    Regressor,
    make_trainer,
    run_trainer,
    share_of_batch,
)
from sliplens.training.sequence import fit_sequence

_ENOUGH_TRIALS, _FEW_TRIALS = 10, 30
"""Labelled trials with which adapting has about nine tenths of the R2 of a hundred, and of which a network that begins
with nothing learns less or, on the flat gel, no more; both on dry objects, of `benchmarks/adapt.py`."""
_KIND = {
    "all": ("backbone", "head"),
    "weights": ("backbone", "head", "image_size"),
    "ratio": ("backbone", "image_size"),
    "sequence": ("backbone", "head", "image_size"),
}
"""What a network to start from keeps, by what is learnt."""
_STAYS = {"ratio", "sequence"}
"""What is learnt beside a network that answers as before."""
_SEQUENCE_TAKES = {"epochs", "batch_size", "learning_rate", "weight_decay", "seed"}
"""What of a recipe shapes a head of several frames."""
_DIRECTION_TRIALS, _DIRECTION_FRAMES, _LEAST_DIRECTIONS = 40, 5, 3
"""Trials and frames of each from which the directions of the pulls are estimated, at most, and trials at least."""
_PULLED, _SURE, _DIRECTION_MARGIN_DEG = 0.6, 5.0, 10.0
"""Margin below which a frame is pulled enough; length of a shear, in standard deviations, whose direction is known to
11 degrees; and what a range is widened by at both ends, for that and for directions that no trial had."""
_NOVELTY_FRAMES = 2000
"""Frames from which the place of healthy inputs in the features is told, at most."""


def train(
    data: Dataset | Path | str,
    out: Path | str | None = None,
    *,
    input: str | None = None,
    recipe: str = "default",
    start_from: Network | Path | str | None = None,
    condition: str | None = None,
    accelerator: Literal["auto", "cpu", "gpu"] = "auto",
    devices: int = 1,
    num_nodes: int = 1,
    logger: str = "csv",
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **changes: Any,
) -> Network:
    """Train a network on the training trials of a data set, and keep the weights that read its validation trials best.

    Interrupted, it goes on after the last whole epoch when it is called again with the same `out`.

    Parameters
    ----------
    data
        Data set with labels, divided into training and validation trials, or its folder.
    out
        Folder to write: weights, manifest, learning curve; nothing is kept if None.
    input
        What the network sees, a row of `ENCODINGS`; `difference` if None, or what the network of `start_from` sees.
    recipe
        Row of `RECIPES`.
    start_from
        Network whose weights to start from, its folder, or the name of one that comes with sliplens: to teach it
        another sensor, or to go on at another image size. It keeps its input, backbone and head.
    condition
        Train and validate on the trials of one condition alone, such as dry.
    accelerator, devices, num_nodes
        As Lightning takes them: devices of each node, a process each. All processes but the first end here.
    logger
        Where the numbers go besides `metrics.csv`: `csv` for nowhere, or a row of `LOGGERS`.
    changes
        Fields of `TrainConfig` that are to differ from the recipe's, such as `epochs`, `image_size`, `batch_size`,
        `max_minutes` or `seed`; None leaves one as it is.

    Raises
    ------
    InputError
        If there is no such recipe, input or network to start from, a setting is out of range, or a device is missing.
    RecordingError
        If there is no labelled trial to train or to validate on, or all labels to train on are the same.
    ModelError
        If the network to start from is of another kind, or the loss is no longer finite.
    """
    start = load(start_from) if isinstance(start_from, str | Path) else start_from
    config = _configure(recipe, {name: value for name, value in changes.items() if value is not None}, start)
    input = input or ("difference" if start is None else start.manifest.input)
    trainer = make_trainer(config, accelerator=accelerator, devices=devices, num_nodes=num_nodes)
    share_of_batch(config.batch_size, trainer.world_size)
    if start is not None:
        require_same_kind(start, config, input)
    if config.learns == "sequence":
        _require_alone(trainer, logger)
    data = data if isinstance(data, Dataset) else load_dataset(data)
    encoding, trials = ENCODINGS.pick(input), _choose_trials(data, condition)
    _require_varied_labels(data, trials[0])
    config = config if start is None or changes.get("head") else _as_told(config, data, trials)
    for sentence in _advise(config, *trials, start=start) if trainer.is_global_zero else ():  # one process speaks
        note(on_progress, sentence)
    # what shapes the result besides the recipe
    origin = {"input": encoding.name, "condition": condition, "data_hash": data.hash}
    if start is not None:
        origin["started_from"] = start.manifest.weights_sha256

    def run(
        folder: Path, *, scratch: Path, logger: Logger | None = None, on_progress: OnProgress | None = None
    ) -> Training:
        """Read the frames and fit: what every process does alike."""
        if config.learns == "sequence":
            assert start is not None
            return replace(
                fit_sequence(config, start, data, trials, folder, on_progress=on_progress), condition=condition
            )
        read = partial(load_frames, data, encoding=encoding, image_size=config.image_size, scratch=scratch)
        frames = []
        for what, some, share in zip(("training", "validation"), trials, (config.untouched_share, 0.0), strict=True):
            with stage(on_progress, f"Reading {what} trials ({encoding.name})") as count:
                frames.append(read(some, untouched_share=share, on_progress=count))
        info = trials[0][0]
        training = fit(
            config,
            frames[0],
            frames[1],
            folder,
            frame_size=(info.height, info.width),
            sensor=info.sensor,
            colour=has_colour(data.read_labels(info).reference),
            pull_direction_deg=trained_directions(config, data, trials[0], start),
            data_hash=data.hash,
            trained_on=[trial.sha256[:12] for some in trials for trial in some],
            start=start,
            trainer=trainer,
            logger=logger,
            on_progress=on_progress,
        )
        return replace(training, condition=condition)

    if out is None:
        if trainer.world_size > 1:
            raise InputError("several processes need a folder that all can see; name one with out")
        with scratch_folder() as folder:
            training = run(folder, scratch=folder, on_progress=on_progress)
            return replace(load_checkpoint(folder), training=training)
    out = Path(out)
    if not trainer.is_global_zero:
        # the target appears when a training is over, which no process leaves before the others: all see the same here,
        # and where it is there the first process has nothing to do, or refuses
        if overwrite or not out.exists():
            # in silence, for the first one says what there is to say; the output folder is its to write, and on a
            # cluster this disk is nearer
            with suppress(KeyboardInterrupt, DivergedError):
                run(partial_folder(out), scratch=Path(tempfile.gettempdir()))
        raise SystemExit(0)  # what comes after a training is for one process
    with output_folder(out, stage="train", config={**origin, "training": config}, overwrite=overwrite) as output:
        if not output.complete:
            with open_logger(logger, output.folder, run_name=out.name, recipe={**asdict(config), **origin}) as opened:
                training = run(output.folder, scratch=output.folder, logger=opened, on_progress=on_progress)
            save_result(training, output.folder)
    trained = load_checkpoint(out)
    training = trained.training
    assert training is not None
    best = f"validation MSE {training.best_validation_mse:.4f}"
    done = f"{training.epochs:.1f} epochs in {training.minutes:.1f} min, {best}"
    wrote(on_progress, out, done, kept=output.complete)
    return trained


def _configure(recipe: str, changes: dict[str, Any], start: Network | None) -> TrainConfig:
    """Recipe with changes; a network to start from stays of its kind where nothing else is asked for."""
    config = replace(get_recipe(recipe), **changes)
    if start is None:
        if config.learns != "all":
            raise InputError(f"the recipe {recipe} teaches a network that is there; name it with --start-from")
        return config
    kept = {name: getattr(start.manifest, name) for name in _KIND[config.learns]}
    for name in sorted(changes) if config.learns in _STAYS else ():
        own = kept.get(name, changes[name])
        if changes[name] != own or (config.learns == "sequence" and name not in _SEQUENCE_TAKES | kept.keys()):
            why = f"whose {name} is {own}" if name in kept else "and takes no such thing"
            raise InputError(
                f"the recipe {recipe} leaves the network of --start-from as it is, {why}; leave out "
                f"--{name.replace('_', '-')}"
            )
    return replace(config, **kept | changes)


def _require_alone(trainer: lightning.Trainer, logger: str) -> None:
    """Refuse what is not done for a head of several frames, whose training takes a minute."""
    if trainer.world_size > 1:
        raise InputError("a head of several frames is trained by one process; leave out --devices and --num-nodes")
    if logger != "csv":
        raise InputError(f"a head of several frames tells its epochs in metrics.csv alone; leave out --logger {logger}")


def _choose_trials(data: Dataset, condition: str | None) -> tuple[tuple[TrialInfo, ...], tuple[TrialInfo, ...]]:
    try:
        train, validation = (data.select(split=split, condition=condition) for split in ("train", "validation"))
    except RecordingError as error:
        cure = "divide it" if condition is None else "name another --condition, or divide it"
        raise RecordingError(f"{error}; {cure} with `sliplens split`") from None
    sizes = sorted({(info.height, info.width) for info in (*train, *validation)})
    if len(sizes) > 1:
        shown = " and ".join(f"{height} x {width}" for height, width in sizes)
        raise RecordingError(f"{data.folder} mixes frames of {shown} pixels; train on one sensor at a time")
    return train, validation


def _as_told(config: TrainConfig, data: Dataset, trials: Sequence[Sequence[TrialInfo]]) -> TrainConfig:
    """The same without the second answer, where all that answers changes and the labels do not tell that one."""
    if config.head != "margin-and-ratio" or config.learns not in {"all", "weights"}:
        return config
    told = all(any(tells_ratio(data.read_labels(info)) for info in some) for some in trials)
    return config if told else replace(config, head="histogram")


def trained_directions(
    config: TrainConfig, data: Dataset, trials: Sequence[TrialInfo], start: Network | None
) -> tuple[float, float] | None:
    """Directions of the pulls that a network is trained on; those of `start` where it stays as it is.

    None where too few trials show them: no margin is then withheld for its direction.
    """
    if start is not None and config.learns in _STAYS:
        return start.manifest.pull_direction_deg
    augmentation = get_augmentation(config.augmentation)
    turned_deg = getattr(augmentation, "rotation_deg", 0.0)
    if turned_deg >= 180:
        return FULL_CIRCLE
    few = trials[:: max(1, -(-len(trials) // _DIRECTION_TRIALS))]
    directions = [pull_direction(data.load(info, truth=False)) for info in few]
    told = np.array([direction for direction in directions if direction is not None])
    if len(told) < _LEAST_DIRECTIONS:
        return None
    return enclosing_range(told, margin_deg=_DIRECTION_MARGIN_DEG + turned_deg)


def pull_direction(trial: Recording) -> float | None:
    """Direction in which a labelled trial is pulled, in degrees, estimated as for the frames that a network reads.

    It is that of the mean shear of the frames with the lowest margins; None where they show no shear.
    """
    pulled = np.flatnonzero(trial.labelled & (trial.safety_margin < _PULLED))
    lowest = pulled[np.argsort(trial.safety_margin[pulled], kind="stable")][:_DIRECTION_FRAMES]
    estimator = ShearEstimator(trial.reference, sensor_kind(trial.sensor))
    shears = [estimator.estimate(trial.frames[frame]) for frame in lowest]
    if not shears:
        return None
    x_px, y_px, sigma_px = (
        float(np.mean([getattr(one, name) for one in shears])) for name in ("x_px", "y_px", "sigma_px")
    )
    mean = Shear(x_px=x_px, y_px=y_px, sigma_px=sigma_px)
    return mean.direction_deg if np.hypot(x_px, y_px) > _SURE * sigma_px else None


def _advise(
    config: TrainConfig, train: Sequence[TrialInfo], validation: Sequence[TrialInfo], *, start: Network | None
) -> Iterator[str]:
    """Say how many trials to record, where there are few, and what is lost of the network to start from."""
    count = len(train) + len(validation)
    if config.learns == "weights":
        enough = f"record {_ENOUGH_TRIALS} or more" if count < _ENOUGH_TRIALS else "that is a good beginning"
        yield (
            f"{count} labelled trials, {len(validation)} of them held out; on simulated sensors {_ENOUGH_TRIALS} had "
            f"about nine tenths of the R2 of 100 on dry objects, so {enough}: on several days, to the slip, and on "
            "slippery objects if it is to hold those"
        )
    elif start is None and count < _FEW_TRIALS:
        yield (
            f"{count} labelled trials are few for a network that begins with nothing; begin with one that is there: "
            "--recipe adapt --start-from chromatouch-pair"
        )
    if start is not None and start.manifest.head == "margin-and-ratio" and config.head == "histogram":
        yield (
            "the labels do not tell forces and friction, so that it learns the margin alone: it takes neither "
            "--friction nor --sequence afterwards"
        )
    elif start is not None and start.sequence is not None and config.learns != "sequence":
        yield (
            "the network to start from reads several frames too, by a head that knows its answers as they are; teach "
            "the new one its own with --recipe sequence"
        )


def _require_varied_labels(data: Dataset, trials: Sequence[TrialInfo]) -> None:
    """Check that the safety margin to be learnt is not the same in every frame."""
    labels = [data.read_labels(info) for info in trials]
    margins = np.concatenate([one.safety_margin[one.labelled] for one in labels])
    # rounding of margins that were computed from constant forces
    if len(margins) and np.ptp(margins) < 1e-6:
        raise RecordingError(
            f"all {len(margins)} labels that {data.folder} has to train on are {100 * margins[0]:.0f} %, and of a "
            "constant there is nothing to learn; check that its forces hold the pull, and record trials until they slip"
        )


@torch.no_grad()
def calibrate(
    model: nn.Module,
    validation: FrameSet,
    *,
    batch_size: int,
    trained_friction: Float[np.ndarray, " _"] | None = None,
    kept: Calibration | None = None,
) -> tuple[Calibration, Traction | None]:
    """Fit the temperatures of the distributions, which are set in the model, and the offsets of the intervals.

    `trained_friction`: coefficients of friction of the training frames, for a network of two answers; the second of
    what is given is None for all others. `kept`: calibration of the margin that is to stay as it is.
    """
    was_training, device = model.training, next(model.parameters()).device
    model.eval()
    network = model.backbone if isinstance(model, HistogramRegressor) else model
    outputs = torch.cat([network(inputs.to(device)).float().cpu() for inputs in validation.batches(batch_size)])
    model.train(was_training)
    labels = validation.safety_margin
    if not isinstance(model, HistogramRegressor):
        margins = outputs.reshape(-1).double().numpy()
        return conformal_calibration(margins, None, None, labels, temperature=1.0), None
    logits, ratio_logits = outputs[:, : len(model.edges) - 1], outputs[:, len(model.edges) - 1 :]
    calibration, probabilities = calibrate_histogram(logits, model.edges, model.temperature, labels, kept=kept)
    if model.ratio_edges is None or model.ratio_temperature is None or trained_friction is None:
        return calibration, None
    known = torch.isfinite(validation.traction_ratio) & torch.from_numpy(np.isfinite(validation.friction))
    ratios = validation.traction_ratio[known]
    of_ratio, ratio_probabilities = calibrate_histogram(
        ratio_logits[known], model.ratio_edges, model.ratio_temperature, ratios
    )
    quantiles = np.quantile(trained_friction[np.isfinite(trained_friction)], np.linspace(0, 1, 11))
    edges = bin_edges(model)
    untold = Estimate(
        margin=probabilities[known.numpy()] @ model.centres.double().cpu().numpy(),
        probabilities=probabilities[known.numpy()],
        edges=edges,
        calibration=None,
        ratio=Ratio(probabilities=ratio_probabilities, edges=model.ratio_edges.double().cpu().numpy()),
    )
    told = tell_each(untold, validation.friction[known.numpy()], trained_friction=quantiles)
    told_calibration = conformal_calibration(
        told.margin, told.probabilities, edges, labels[known], temperature=calibration.temperature
    )
    return calibration, Traction(calibration=of_ratio, told=told_calibration, friction=tuple(quantiles.tolist()))


def _spread_batches(frames: FrameSet, *, batch_size: int) -> Iterator[Tensor]:
    """Encoded frames of all trials, some thousands at most."""
    rows = torch.linspace(0, len(frames) - 1, min(len(frames), _NOVELTY_FRAMES)).round().long()
    return (frames.__getitems__(some)[0] for some in rows.split(batch_size))


def fit(
    config: TrainConfig,
    train: FrameSet,
    validation: FrameSet,
    folder: Path,
    *,
    frame_size: tuple[int, int],
    sensor: str,
    data_hash: str,
    colour: bool | None = None,
    pull_direction_deg: tuple[float, float] | None = None,
    trained_on: Sequence[str] = (),
    start: Network | None = None,
    trainer: lightning.Trainer | None = None,
    logger: Logger | None = None,
    on_progress: OnProgress | None = None,
) -> Training:
    """Train a network and save the weights that were best on the validation frames.

    With several processes, each calls this with the same frames and takes its share of every batch; the first writes.
    Batch normalisation sees the share alone, so the weights differ from those of one process.

    Parameters
    ----------
    train, validation
        Encoded frames, of trials that do not overlap.
    folder
        Gets `model.safetensors`, `manifest.json` and `metrics.csv`; while training runs also checkpoints, from which a
        call with the same folder goes on. All processes must see it.
    frame_size, sensor, data_hash, colour, pull_direction_deg, trained_on
        Kept in the manifest: height and width of the sensor's frames, its name, hash of the data set, whether its
        frames have colours, the directions of its pulls, and hashes of the trials.
    start
        Network whose weights it starts from, instead of random ones; it is left as it is.
    trainer
        As `make_trainer` makes it, used once; one device, a GPU if there is one, if None.
    on_progress
        Called after every step in the first process; under a time limit the share of the time counts where it is
        further.

    Raises
    ------
    InputError
        If the training set is smaller than one batch, a trial is in both sets, the batch does not divide among the
        processes, or a checkpoint cannot be saved.
    ModelError
        If the network to start from has another input, backbone or head, the backbone is unknown, or the loss is no
        longer finite. The best network so far is saved before.
    """
    trainer = trainer or make_trainer(config)
    rank, processes, first = trainer.global_rank, trainer.world_size, trainer.is_global_zero
    share = share_of_batch(config.batch_size, processes)
    _check_frames(config, train, validation, processes)
    model = _begin(config, train.encoding, start)
    shuffle = EpochShuffle(len(train), seed=config.seed, drawn=config.epoch_frames, rank=rank, processes=processes)
    per_epoch = shuffle.drawn // config.batch_size
    clock = Clock(
        steps=config.epochs * per_epoch,
        max_minutes=config.max_minutes,
        metrics_file=folder / "metrics.csv" if first else None,
        on_progress=on_progress if first else None,
    )
    begun = Manifest(
        backbone=config.backbone,
        head=config.head,
        recipe=config.recipe,
        input=train.encoding.name,
        image_size=config.image_size,
        frame_size=frame_size,
        sensor=sensor,
        data_hash=data_hash,
        colour=colour,
        pull_direction_deg=pull_direction_deg,
        trained_on=(*trained_on, *(start.manifest.trained_on if start else ())),
        started_from=start.manifest.weights_sha256 if start else "",
        versions=versions(),
    )
    network: nn.Module = model
    if config.learns == "ratio":
        network, train, validation = _last_layer_alone(model, train, validation, config=config, report=on_progress)
    module = Regressor(
        network,
        config=config,
        augmentation=get_augmentation(config.augmentation, neutral=train.encoding.neutral),
        clock=clock,
        batch_rows=lambda epoch, batch: [train.name(row) for row in shuffle.batch(epoch, batch, size=share)],
    )
    best = ModelCheckpoint(dirpath=folder / "checkpoints", filename="best", monitor="validation_mse")
    # of every epoch: `save_last` writes one only where the best is written too
    last = ModelCheckpoint(dirpath=folder / "checkpoints", filename="last", enable_version_counter=False)
    # in this order: a checkpoint holds what the stopping has counted of the same epoch, and which was best so far
    early = Patience("validation_mse", patience=config.patience) if config.patience else None
    trainer.callbacks += [clock, *filter(None, [early]), best, last]  # pyright: ignore[reportAttributeAccessIssue]
    trainer.loggers = [logger] if logger is not None and first else []
    trainer.log_every_n_steps = min(50, per_epoch)  # pyright: ignore[reportAttributeAccessIssue]
    loaders = make_loaders(train, validation, shuffle=shuffle, batch_size=share)
    known: dict[str, Any] = {"begun": begun, "train": train, "validation": validation, "start": start}
    save_best = partial(_save_best, folder, model, module, best, **known)
    try:
        title = f"Training ({train.encoding.name})"
        with torch.random.fork_rng(devices=[]), stage(on_progress if first else None, title) as clock.on_progress:
            run_trainer(trainer, module, loaders, folder / "checkpoints" / "last.ckpt")
    except DivergedError as error:
        if not first or not best.best_model_path:
            raise
        raise ModelError(
            f"{error} (the best network so far, of validation MSE {save_best():.4g}, is in {folder})"
        ) from None
    training = Training(
        input=train.encoding.name,
        backbone=config.backbone,
        image_size=config.image_size,
        frame_size=frame_size,
        train_frames=len(train),
        validation_frames=len(validation),
        seed=config.seed,
        best_validation_mse=save_best() if first else float(best.best_model_score or np.nan),
        epochs=clock.rows[-1][0],
        minutes=clock.seconds / 60,
        stopped_by="no gain" if early is not None and early.stopped_epoch else clock.stopped_by,
        parameters=sum(value.numel() for value in model.parameters()),
        processes=processes,
        curve=clock.curve(),
    )
    if first:
        shutil.rmtree(folder / "checkpoints")
    return training


def _save_best(
    folder: Path,
    model: nn.Module,
    module: Regressor,
    best: ModelCheckpoint,
    *,
    begun: Manifest,
    train: FrameSet,
    validation: FrameSet,
    start: Network | None,
) -> float:
    """Calibrate and save the network of the best epoch; gives its validation error.

    `begun`: what its manifest says before anything is learnt; `module` holds the part of `model` that learnt.
    """
    # our own file of tensors and plain numbers, read back without unpickling anything else
    kept = torch.load(best.best_model_path, map_location="cpu", weights_only=True)
    module.load_state_dict(kept["state_dict"])
    config, network = module.config, module.model
    calibration, traction = calibrate(
        network,
        validation,
        batch_size=config.batch_size,
        trained_friction=train.friction,
        kept=start.manifest.calibration if start and config.learns == "ratio" else None,
    )
    _put_back(network, model)
    novelty = _find_novelty(model.eval(), config, train, validation, start=start)
    learnt = {"calibration": calibration, "traction": traction, "novelty": novelty}
    save_checkpoint(folder, model, replace(begun, metrics={"validation_mse": calibration.mse}, **learnt))
    # as the file itself has it: after a crash between two files the callback may remember an older one
    return float(kept["callbacks"][best.state_key]["current_score"])


def _begin(config: TrainConfig, encoding: Encoding, start: Network | None) -> nn.Module:
    """Network with random weights, or with those of the network that it starts from."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)  # forked, so that the caller's random state is untouched
        model = build_model(config.backbone, head=config.head, colours=encoding.colours)
    # channels last: depthwise convolutions run up to half as fast again on a CPU
    model = model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    if start is not None:
        require_same_kind(start, config, encoding.name)
        weights = start.model.state_dict()
        if encoding.colours > start.encoding.colours:
            weights = with_reference(weights, sign=REFERENCE_SIGNS[start.manifest.input])
        fill = model.load_state_dict if start.manifest.head == config.head else partial(fill_head, model)
        fill(weights)
    return model


def _last_layer_alone(
    model: nn.Module, *frames: FrameSet, config: TrainConfig, report: OnProgress | None
) -> tuple[HistogramRegressor, FrameSet, FrameSet]:
    """The last layer of a network of two answers as a network of its own, and training and validation frames for it."""
    alone, seen = HistogramRegressor(last_layer(model), ratio=True), []
    for name in ("temperature", "edges", "ratio_edges"):  # edges of a network of the package are rounded
        alone.get_buffer(name).copy_(model.get_buffer(name))
    for some, what in zip(frames, ("training", "validation"), strict=True):
        with stage(report, f"Passing {what} frames through the network") as count:
            seen.append(extract_features(model, some, batch_size=config.batch_size, on_progress=count))
    return alone, *seen


def _put_back(network: nn.Module, model: nn.Module) -> None:
    """Give a network the last layer and the temperatures that were fitted by themselves, if they were."""
    if network is not model:
        model.load_state_dict(network.state_dict(), strict=False)
        last_layer(model).load_state_dict(last_layer(network).state_dict())


def _find_novelty(
    model: nn.Module, config: TrainConfig, train: FrameSet, validation: FrameSet, *, start: Network | None
) -> Novelty | None:
    if start is not None and config.learns == "ratio":
        return start.manifest.novelty  # its early layers stay as they were
    return fit_novelty(model, *(_spread_batches(some, batch_size=config.batch_size) for some in (train, validation)))


def _check_frames(config: TrainConfig, train: FrameSet, validation: FrameSet, processes: int) -> None:
    if (config.epoch_frames or len(train)) < config.batch_size:
        raise InputError(f"{len(train)} training frames do not fill a batch of {config.batch_size}; lower batch_size")
    if config.head == "margin-and-ratio":
        for what, frames in (("training", train), ("validation", validation)):
            if not (torch.isfinite(frames.traction_ratio).numpy() & np.isfinite(frames.friction)).any():
                other = "" if config.learns == "ratio" else ", or choose another --head"
                raise InputError(
                    f"no {what} frame tells its forces and its friction, from which F_t / F_n is learnt; import them "
                    f"with the forces{other}"
                )
    if len(validation) < processes:
        raise InputError(f"{len(validation)} validation frames are too few for {processes} processes; lower --devices")
    shared = set(train.trial) & set(validation.trial)
    if shared:
        raise InputError(f"trial {min(shared)} is in both training and validation; split by trial")


def require_same_kind(start: Network, config: TrainConfig, encoding: str) -> None:
    """Refuse to start from a network whose weights would mean something else."""
    for name, value in (("input", encoding), ("backbone", config.backbone), ("head", config.head)):
        kept = getattr(start.manifest, name)
        # a second answer can be learnt beside the first or left out, and the reference be seen beside the frame; not
        # by a last layer alone: the first answer would stay as it was for other images
        paired = value == "pair" and kept in REFERENCE_SIGNS and config.learns not in _STAYS
        changed = {kept, value} == {"histogram", "margin-and-ratio"}
        if kept != value and not (paired or changed):
            raise ModelError(
                f"the network to start from has the {name} {kept}, and {value} is to be trained; "
                f"train {kept}, or start from another network"
            )
