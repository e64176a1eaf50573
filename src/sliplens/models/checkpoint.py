"""Trained networks: with their manifest, on disk, and those that come with the package."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from math import cos, erfc, radians, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from sliplens.codec import load_record, load_result, save_record
from sliplens.errors import CheckpointError, ImageError, InputError
from sliplens.extras import require_device
from sliplens.files import DIFFERENCE_NETWORK, MANIFEST_FILE, find_run, hash_file, require_folder, whole_file
from sliplens.friction import LEARNT, Friction, FrictionLike, as_friction
from sliplens.images import MOST_PIXELS, has_colour, require_rgb
from sliplens.models.backbones import (
    Answers,
    HistogramRegressor,
    answer_names,
    bin_centres,
    bin_edges,
    build_model,
    ratio_edges,
)
from sliplens.models.calibration import Calibration, Traction, condition_on_friction, raw_interval, spread
from sliplens.models.encodings import ENCODINGS, Encoding
from sliplens.models.novelty import Novelty
from sliplens.models.sequence import Follower, SequenceHead, SequenceManifest
from sliplens.progress import number_of
from sliplens.recordings.sensor import SensorProfile
from sliplens.results.evaluation import Training
from sliplens.shear import DIRECTION_LIMIT, FULL_CIRCLE, Shear, ShearEstimator, range_words

WEIGHTS_FILE, SEQUENCE_FILE = "model.safetensors", "sequence.safetensors"
SCHEMA_VERSION = 1
LARGEST_INPUT = 4096  # pixels along a side, several times what any backbone was made for


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a checkpoint is: enough to feed it right, and to tell where it comes from."""

    backbone: str
    input: str
    image_size: int
    frame_size: tuple[int, int]
    sensor: str
    data_hash: str
    colour: bool | None = None
    """Whether the frames it was trained on have colours; None where that is not told."""
    head: str = "point"
    recipe: str = ""
    target: str = "safety_margin"
    weights_sha256: str = ""
    schema_version: int = SCHEMA_VERSION
    metrics: dict[str, float] = field(default_factory=dict)
    calibration: Calibration | None = None
    traction: Traction | None = None
    """Of the second answer, F_t / F_n; None for a network that answers with the margin alone."""
    novelty: Novelty | None = None
    """Where its training frames lie in its features; None where that was never fitted."""
    sequence: SequenceManifest | None = None
    """Of the margins that it reads from several frames; None where it reads each frame by itself alone."""
    pull_direction_deg: tuple[float, float] | None = None
    """Directions in which its training trials were pulled, lowest and highest: 0 is right, 90 down the image, (0, 360)
    all. None where they are not known."""
    versions: dict[str, str] = field(default_factory=dict)
    trained_on: tuple[str, ...] = ()
    """First 12 hex digits of the hash of every trial that trained or validated it, or what it started from."""
    started_from: str = ""
    """Hash of the weights it started from; empty for random ones."""

    def __post_init__(self) -> None:
        height, width = self.frame_size
        if not 1 <= self.image_size <= LARGEST_INPUT or min(height, width) <= 0 or height * width > MOST_PIXELS:
            sizes = f"frames of {height} x {width} pixels at {self.image_size}"
            raise ValueError(f"no network reads {sizes}")
        low, high = self.pull_direction_deg or FULL_CIRCLE
        if not 0 <= low <= high <= low + 360 or low > 360:
            raise ValueError(f"pull_direction_deg is {[low, high]}; give a low from 0 to 360, then a high")


_TURN_CURE = (
    "turn the sensor, or train on this direction with `sliplens train DATA -o RUN --augmentation all-directions`"
)
_DARKEST_FRAME, _BRIGHTEST_DIFFERENCE = 8.0, 64.0
"""Medians, in grey levels: no camera frame that shows something is darker, no difference image brighter."""


def sensor_kind(sensor: str) -> str:
    """Name of a sensor without the number of the piece."""
    return re.sub(r"-\d+$", "", sensor)


@dataclass(frozen=True, kw_only=True, repr=False)
class Network:
    """A trained network, in evaluation mode, with what it is and how it was trained."""

    model: nn.Module
    manifest: Manifest
    training: Training | None = None
    """How it was trained, with its learning curve; None where its folder does not tell."""
    sequence: SequenceHead | None = None
    """What makes one margin of several frames, see `follow`; None where each frame is read by itself alone."""

    def __repr__(self) -> str:
        """What it is, in a few lines: the layers are in `model`."""
        kept = self.manifest
        weights = sum(values.numel() for values in self.model.parameters())
        intervals = "calibrated intervals" if kept.calibration else "no intervals"
        lines = (
            f"Network: {kept.backbone} with a {kept.head} head, {weights:,} weights, on {self.device}",
            f"  reads {kept.input} images of {kept.sensor}, frames of {' x '.join(map(str, kept.frame_size))} px "
            f"at {kept.image_size} px",
            f"  tells {kept.target.replace('_', ' ')}, {intervals}",
            f"  trained on {number_of(len(kept.trained_on), 'trial')}, recipe {kept.recipe or 'not told'}",
            *([f"  {', '.join(f'{name} {value:.3g}' for name, value in kept.metrics.items())}"] * bool(kept.metrics)),
        )
        return "\n".join(lines)

    @property
    def device(self) -> torch.device:
        """Where the network runs; inputs are brought there, answers come back."""
        return next(self.model.parameters(), torch.empty(0)).device

    @property
    def encoding(self) -> Encoding:
        """The input the network was trained on."""
        return ENCODINGS.pick(self.manifest.input)

    def encode(
        self, frames: Shaped[np.ndarray, "batch height width 3"], reference: Shaped[np.ndarray, "_ _ 3"] | None
    ) -> Float[Tensor, "batch colours size size"]:
        """Encode frames as the network was trained on them.

        `reference`: the sensor untouched; None for frames that were compared before, or that need not be. Frames of
        another size than the network's sensor has raise `ImageError`, and so do those that are no 8-bit images.
        """
        require_rgb(frames)
        self.require_frame_size(frames.shape[1:3])
        size = self.manifest.image_size
        if reference is None and self.encoding.beside:
            raise InputError(
                f"a network on {self.encoding.name} images sees the untouched sensor beside the frame; name its image "
                "with --reference IMAGE, or a frame of it with --reference-frame N"
            )
        if reference is None:
            return self.encoding.normalise(self.encoding.resize(frames, image_size=size))
        return self.encoding.encode(frames, reference, image_size=size)

    def require_frame_size(self, size: tuple[int, ...], *, what: str = "frames") -> None:
        """Refuse frames of another sensor."""
        if tuple(size) != tuple(self.manifest.frame_size):
            raise ImageError(
                f"{what} are {size[0]} x {size[1]} pixels but the network was trained on "
                f"{self.manifest.frame_size[0]} x {self.manifest.frame_size[1]}; use frames of "
                "its sensor, or fit these to it with a profile (`sliplens sensor new --from VIDEO -o tip.toml`, "
                "--sensor tip.toml)"
            )

    def require_kind(self, frame: UInt8[np.ndarray, "height width 3"], *, what: str) -> None:
        """Refuse an image without a reference that is plainly of the other kind than the network reads.

        A difference image is black but where something moved, a camera's is not.
        """
        level = float(np.median(frame))
        if not self.encoding.empty_is_black and level < _DARKEST_FRAME and frame.any():
            raise ImageError(
                f"{what} is as dark as a difference image (median {level:.0f} of 255 grey levels), and this network "
                f"reads camera frames; give those, or a network on difference images such as {DIFFERENCE_NETWORK}"
            )
        if self.encoding.empty_is_black and level > _BRIGHTEST_DIFFERENCE:
            raise ImageError(
                f"{what} is as bright as a camera frame (median {level:.0f} of 255 grey levels), and without the "
                "untouched sensor this network takes it for a difference image; name it with --reference IMAGE or "
                "--reference-frame N"
            )

    def doubt(self, sensor: str) -> str | None:
        """Say that frames are of another sensor than those it was trained on; None where they are not.

        Sensors are of one kind if their names differ in a number at the end, such as chromatouch-1 and chromatouch-2.
        """
        own = self.manifest.sensor
        if not sensor or not own or sensor_kind(sensor) == sensor_kind(own):
            return None
        return (
            f"the network was trained on {own} and reads frames of {sensor}: its intervals were not measured on that "
            "sensor, so take the margins for a trend until trials with forces say how far they can be trusted "
            "(`sliplens import`, then `sliplens evaluate`)"
        )

    def doubt_colour(self, frame: UInt8[np.ndarray, "height width 3"]) -> str | None:
        """Say that a frame is grey where the network was trained on colours; None where it is not, or nobody knows."""
        if not self.manifest.colour or has_colour(frame):
            return None
        return (
            "the frames are grey, and the network was trained on colours: its intervals were not measured on such "
            "frames, so read those of a colour camera, or train it on frames of this one (`sliplens train`)"
        )

    def doubt_friction(self, friction: Friction | None) -> str | None:
        """Say that friction is told which it was not trained on; None where most of what is held possible was."""
        if friction is None or self.manifest.traction is None:
            return None
        low, high = self.manifest.traction.friction[0], self.manifest.traction.friction[-1]
        values, weights = friction.nodes
        if weights[(low <= values) & (values <= high)].sum() >= 0.5:
            return None
        learnt = friction.note == LEARNT
        known, cure = ("learnt from slips", "begin a new object") if learnt else ("told", "check --friction")
        return (
            f"the friction {known} ({friction.mean:.3g}) lies outside that of the network's training, {low:.2g} to "
            f"{high:.2g}: its intervals were not measured there, so {cure}, or take the margins for a trend"
        )

    def doubt_direction(self, profile: SensorProfile) -> str | None:
        """Describe a sensor that is pulled in another direction than the training trials; None where it is not."""
        trained = self.manifest.pull_direction_deg
        if profile.pull_direction_deg is None or trained is None:
            return None
        pull = radians(profile.pull_direction_deg)
        if not Shear(x_px=cos(pull), y_px=sin(pull), sigma_px=1.0).excess(trained):
            return None
        return (
            f"the profile {profile.name} says that the sensor is pulled at {profile.pull_direction_deg:g} degrees in "
            f"the image, and the network was trained on {range_words(trained)} (90 is down): its margins will "
            f"be withheld, so {_TURN_CURE}"
        )

    def shear_estimator(self, reference: UInt8[np.ndarray, "height width 3"]) -> ShearEstimator | None:
        """Estimator of the shear of frames; None for a network whose directions are all, or not known."""
        if self.manifest.pull_direction_deg in {None, FULL_CIRCLE}:
            return None
        return ShearEstimator(reference, sensor_kind(self.manifest.sensor))

    def doubt_shear(self, shear: Shear) -> str | None:
        """Reason to withhold the margin of a frame that is pulled outside the trained directions; None inside."""
        trained = self.manifest.pull_direction_deg
        if trained is None or shear.excess(trained) <= DIRECTION_LIMIT:
            return None
        return f"pulled outside the trained {range_words(trained)} (90 is down); {_TURN_CURE}"

    @torch.no_grad()
    def answers(self, batches: Iterable[Tensor]) -> tuple[Tensor, ...]:
        """What the network answers (`Answers`) to batches of encoded frames, on its device."""
        network = Answers(self.model, self.feature_layer)
        parts = [network(batch.to(self.device)) for batch in batches]
        return tuple(torch.cat(answers) for answers in zip(*parts, strict=True))

    def predict(
        self, inputs: Float[Tensor, "batch colours size size"], *, batch_size: int = 64
    ) -> Float[Tensor, " batch"]:
        """Safety margin of encoded frames; not clipped, so that an answer outside [0, 1] shows as what it is."""
        return self.answers(inputs.split(batch_size))[0].cpu()

    def estimate(
        self,
        inputs: Float[Tensor, "batch colours size size"],
        *,
        friction: FrictionLike | None = None,
        batch_size: int = 64,
    ) -> "Estimate":
        """Safety margin of encoded frames, with how sure it is.

        `friction`: what is known of the coefficient of friction, as `predict` takes it.
        """
        return self.estimate_batches(inputs.split(batch_size), friction=friction)

    def estimate_batches(self, batches: Iterable[Tensor], *, friction: FrictionLike | None = None) -> "Estimate":
        """Safety margins as `estimate` tells them, of batches of encoded frames."""
        return self.to_estimate(*self.answers(batches), friction=friction)

    @property
    def novelty(self) -> Novelty | None:
        """What tells how far it knows a frame; None of a network that does not tell."""
        novelty = self.manifest.novelty
        return novelty if novelty is not None and novelty.strangeness else None

    @property
    def feature_layer(self) -> str | None:
        """Layer whose features are told beside the answers (`Answers`), for `novelty`."""
        return None if self.novelty is None else self.novelty.layer

    def to_estimate(self, *answers: Tensor, friction: FrictionLike | None = None) -> "Estimate":
        """Estimate from what the network answered (`Answers`), and from friction where it is told."""
        names = answer_names(self.model, self.feature_layer)
        values = {name: answer.double().cpu().numpy() for name, answer in zip(names, answers, strict=True)}
        traction, of_ratio = self.manifest.traction, ratio_edges(self.model)
        estimate = Estimate(
            margin=values["margin"],
            probabilities=values.get("probabilities"),
            edges=bin_edges(self.model),
            calibration=self.manifest.calibration,
            ratio=None
            if of_ratio is None
            else Ratio(
                probabilities=values["ratio_probabilities"],
                edges=of_ratio,
                calibration=None if traction is None else traction.calibration,
            ),
        )
        if self.novelty is not None:  # before friction narrows the answer
            estimate = replace(estimate, known=self.novelty.known(values["features"], estimate.sigma))
        if friction is None:
            return estimate
        traction = self.require_ratio()
        return estimate.told(
            as_friction(friction), trained_friction=np.array(traction.friction), calibration=traction.told
        )

    def follow(self, *, friction: object = None) -> Follower:
        """What reads the frames of a sensor in order.

        `InputError` for a network that was never taught to, and where `friction` is told, which is what it looks for.
        """
        kept = self.manifest.sequence
        if friction is not None:
            raise InputError(
                "--sequence finds out what friction may be, and --friction tells it; leave out one of them"
            )
        if self.sequence is None or kept is None:
            raise InputError(
                "this network reads each frame by itself; leave out --sequence, or teach it with `sliplens train DATA "
                "-o RUN --start-from NETWORK --recipe sequence`"
            )
        return Follower(self.sequence, kept)

    def require_ratio(self, *, learns: bool = False) -> Traction:
        """What the second answer is; `InputError` for a network that answers with the margin alone.

        `learns`: it is not told friction, but is to learn it from slips.
        """
        if self.manifest.traction is None:
            why = "--same-object learns friction from F_t / F_n" if learns else "friction was told"
            raise InputError(
                f"{why}, but this network answers with the margin alone and cannot use it; leave it out, or teach the "
                "network F_t / F_n with `sliplens train DATA -o RUN --start-from NETWORK --recipe ratio`"
            )
        return self.manifest.traction


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """Traction ratio F_t / F_n of some frames, and how sure it is."""

    probabilities: Float[np.ndarray, "frames bins"]
    edges: Float[np.ndarray, " edges"]
    """Of the bins, as ratios."""
    calibration: Calibration | None = None

    @property
    def mean(self) -> Float[np.ndarray, " frames"]:
        """Expected F_t / F_n; not clipped."""
        return self.probabilities @ bin_centres(self.edges)

    @property
    def sigma(self) -> Float[np.ndarray, " frames"]:
        """Standard deviation of each distribution."""
        return spread(self.mean, self.probabilities, self.edges)

    def interval(self, level: float) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]] | None:
        """Ratios between which each true one lies with a level of confidence, none negative; None if not calibrated."""
        if self.calibration is None:
            return None
        offset = self.calibration.offset(level)
        low, high = raw_interval(self.mean, self.probabilities, self.edges, level)
        return np.maximum(low - offset, 0), np.maximum(high + offset, 0)


STRANGE = 0.01
"""Share of the validation frames (`Estimate.known`) below which a frame is too unlike them for its margin to count."""
STRANGE_REASON = (
    f"strange to the network (known below {100 * STRANGE:g} %); use frames of the sensor it was trained on, or train "
    "it on frames of this one"
)


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Safety margins of some frames, and how sure they are."""

    margin: Float[np.ndarray, " frames"]
    calibration: Calibration | None
    probabilities: Float[np.ndarray, "frames bins"] | None = None
    """Over the margin; None for a network that answers with one number."""
    edges: Float[np.ndarray, " edges"] | None = None
    """Of the bins, in margin units."""
    ratio: Ratio | None = None
    """Second answer, F_t / F_n; None for a network without it."""
    friction: Friction | None = None
    """What was told of the friction; None where nothing was."""
    known: Float[np.ndarray, " frames"] | None = None
    """How far the network knows such frames, from 0 to 1: the share of its validation frames that were as strange or
    stranger, in its features or in the spread of its answer (`Novelty.known`). None of a network that does not tell.

    An unknown friction is nothing strange: a network that was trained on frictions from 0.15 to 1.2 takes wet for one
    more of them, and no value of this warns of it."""

    alone: tuple[Bool[np.ndarray, " frames"], Calibration | None] | None = None
    """Which of the frames that were read in order keep the answers of one frame, and the calibration of those; None
    where all have one calibration."""

    def at(self, rows: Int[np.ndarray, " rows"] | Bool[np.ndarray, " frames"]) -> "Estimate":
        """Some of the frames."""
        ratio = self.ratio and replace(self.ratio, probabilities=self.ratio.probabilities[rows])
        alone = self.alone and (self.alone[0][rows], self.alone[1])
        parts = {name: getattr(self, name) for name in ("probabilities", "known")}
        parts = {name: None if values is None else values[rows] for name, values in parts.items()}
        return replace(self, margin=self.margin[rows], ratio=ratio, alone=alone, **parts)

    @property
    def sigma(self) -> Float[np.ndarray, " frames"] | None:
        """Standard deviation of each distribution; None where there is none."""
        if self.probabilities is None or self.edges is None:
            return None
        return spread(self.margin, self.probabilities, self.edges)

    def withheld(self, touches: Bool[np.ndarray, " frames"]) -> list[str | None]:
        """Return why the margin of each frame is not to be believed, with the cure; None where it is.

        `touches`: whether anything touches the sensor. An untouched one shows nothing but noise, which may be strange.
        """
        strange = np.zeros(len(self.margin), bool) if self.known is None else touches & (self.known < STRANGE)
        return [STRANGE_REASON if each else None for each in strange]

    def beyond(self, error: float) -> Float[np.ndarray, " frames"]:
        """What the network gives for an error above a number of margin units, from 0 to 1; not calibrated.

        One that answers with one number gives every frame that of a normal distribution with its validation error.
        """
        if self.probabilities is None or self.edges is None:
            mse = self.calibration.mse if self.calibration else 0.0
            return np.full(len(self.margin), erfc(error / sqrt(2 * mse)) if mse > 0 else 0.0)
        # bins beyond 0 and 1 mean the ends
        centres = np.clip(bin_centres(self.edges), 0, 1)
        far = np.abs(centres - np.clip(self.margin, 0, 1)[:, None]) > error
        return (self.probabilities * far).sum(axis=1)

    def interval(self, level: float) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]] | None:
        """Margins between which each label lies with a level of confidence, within [0, 1]; None if not calibrated."""
        if self.calibration is None:
            return None
        offset: Any = self.calibration.offset(level)
        if self.alone is not None and self.alone[1] is not None:
            own = self.alone[1].offsets.get(str(level), offset)  # calibrations may have other levels
            offset = np.where(self.alone[0], own, offset)
        low, high = raw_interval(self.margin, self.probabilities, self.edges, level)
        # a label lies in [0, 1], so cutting there loses none
        return np.clip(low - offset, 0, 1), np.clip(high + offset, 0, 1)

    def told(
        self,
        friction: Friction,
        *,
        trained_friction: Float[np.ndarray, " quantiles"],
        calibration: Calibration | None = None,
    ) -> "Estimate":
        """The same frames once friction is told (`condition_on_friction`); margins then lie within [0, 1].

        `calibration`: of the intervals of such margins; there are none if None.
        """
        assert self.probabilities is not None
        assert self.edges is not None
        assert self.ratio is not None
        probabilities = condition_on_friction(
            self.probabilities,
            self.ratio.probabilities,
            edges=self.edges,
            ratio_edges=self.ratio.edges,
            friction=friction,
            trained_friction=trained_friction,
        )
        # bins beyond 0 and 1 mean the ends
        margin = probabilities @ np.clip(bin_centres(self.edges), 0, 1)
        told = {"calibration": calibration, "friction": friction, "alone": None}
        return replace(self, margin=margin, probabilities=probabilities, **told)


def tell_each(
    estimate: Estimate,
    friction: Float[np.ndarray, " frames"],
    *,
    trained_friction: Float[np.ndarray, " quantiles"],
    calibration: Calibration | None = None,
) -> Estimate:
    """Tell each frame the friction of its own trial, exactly."""
    assert estimate.probabilities is not None
    margin, probabilities = np.empty_like(estimate.margin), np.empty_like(estimate.probabilities)
    for value in np.unique(friction):
        rows = friction == value
        told = estimate.at(rows).told(Friction(float(value)), trained_friction=trained_friction)
        assert told.probabilities is not None
        margin[rows], probabilities[rows] = told.margin, told.probabilities
    return replace(estimate, margin=margin, probabilities=probabilities, calibration=calibration)


def save_checkpoint(
    folder: Path, model: nn.Module, manifest: Manifest, *, sequence: SequenceHead | None = None
) -> None:
    """Write weights and manifest into a folder; the manifest, which makes it a checkpoint, comes last.

    `sequence`: the head that reads several frames, of a manifest that tells of one.
    """
    if manifest.sequence is not None and sequence is not None:
        hashed = _save_weights(folder / SEQUENCE_FILE, sequence)
        manifest = replace(manifest, sequence=replace(manifest.sequence, weights_sha256=hashed))
    hashed = _save_weights(folder / WEIGHTS_FILE, model)
    save_record(replace(manifest, weights_sha256=hashed), folder / MANIFEST_FILE)


def _save_weights(path: Path, model: nn.Module) -> str:
    values = save({name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()})
    with whole_file(path) as part:
        part.write_bytes(values)
    return hash_file(path)


def load_checkpoint(folder: Path, *, device: str = "cpu") -> Network:
    """Load a checkpoint written by `save_checkpoint`.

    `InputError` if the folder or its manifest is missing; `CheckpointError` if the manifest is of another schema, the
    weights were changed or damaged, or they do not fit the backbone.
    """
    require_folder(folder, what="the run")
    manifest = read_manifest(folder)
    model = build_model(manifest.backbone, head=manifest.head, colours=ENCODINGS.pick(manifest.input).colours)
    what = f"a {manifest.backbone} with a {manifest.head} head"
    _load_weights(folder / WEIGHTS_FILE, model, what=what, sha256=manifest.weights_sha256)
    if manifest.novelty is not None and manifest.novelty.layer not in dict(model.named_modules()):
        raise CheckpointError(f"{folder / MANIFEST_FILE} names a layer that the network has not; copy the folder again")
    sequence = None
    if manifest.sequence is not None:
        if not isinstance(model, HistogramRegressor) or model.ratio_edges is None:
            raise CheckpointError(f"{folder / MANIFEST_FILE} tells of several frames, whose head reads F_t / F_n too")
        sequence = SequenceHead(model.edges, model.ratio_edges)
        hashed = manifest.sequence.weights_sha256
        _load_weights(folder / SEQUENCE_FILE, sequence, what="a head of several frames", sha256=hashed)
        sequence.eval()
    # channels last: depthwise convolutions run up to half as fast again on a CPU
    model = model.to(device, memory_format=torch.channels_last).eval()  # pyright: ignore[reportCallIssue]
    # the networks of the package come without their learning curve
    told = (folder / "curve.parquet").is_file()
    training = load_result(folder, Training, command="sliplens train") if told else None
    return Network(model=model, manifest=manifest, training=training, sequence=sequence)


def _load_weights(path: Path, model: nn.Module, *, what: str, sha256: str) -> None:
    """Fill a network with the weights of a file that is the one its manifest names, and holds numbers alone."""
    if not path.is_file():
        raise CheckpointError(f"{path} is missing; train the network again or copy the whole folder")
    if hash_file(path) != sha256:
        raise CheckpointError(f"{path} is not the file its manifest describes; copy the whole folder again")
    try:
        values, own = load_file(path, device="cpu"), model.state_dict()
        model.load_state_dict(values)
    except (SafetensorError, RuntimeError) as error:
        raise CheckpointError(f"{path} does not hold {what} ({str(error).splitlines()[0]})") from None
    # halves are widened: networks of the package are stored as such
    kept = {name: {tensor.dtype, torch.float16} for name, tensor in own.items()}
    strange = [name for name in own if values[name].dtype not in kept[name] or not values[name].isfinite().all()]
    if strange:
        raise CheckpointError(f"{path} holds what is no number in {strange[0]}; train the network again")


def read_manifest(run: str | Path) -> Manifest:
    """Read what a network is without its weights, by the name or folder that `load` takes."""
    path = find_run(Path(run)) / MANIFEST_FILE
    manifest = load_record(path, Manifest, command="sliplens train")
    if manifest.schema_version != SCHEMA_VERSION:
        raise CheckpointError(f"{path} is not a sliplens manifest of schema {SCHEMA_VERSION}; train the network again")
    return manifest


def load(run: str | Path, *, device: str = "cpu") -> Network:
    """Load a network: one that comes with the package by its name, or that of a run by its folder.

    Parameters
    ----------
    run
        One of `shipped_names`, such as `chromatouch-pair`, or a folder that training wrote.
    device
        Where to put it: cpu, cuda or cuda:1.

    Raises
    ------
    InputError
        If there is none, which lists the names there are, or the device is not known or not there.
    CheckpointError
        If the folder is damaged.

    Examples
    --------
    >>> import sliplens as sl
    >>> network = sl.load("chromatouch-pair")
    >>> network.manifest.input, network.manifest.image_size
    ('pair', 112)
    """
    require_device(device)
    return load_checkpoint(find_run(Path(run)), device=device)


def open_run(run: object, *, device: str = "cpu") -> Network:
    """Network that a caller named: itself, its folder, or the name of one that comes with sliplens."""
    if not isinstance(run, Network | Path | str):
        raise InputError(f"{type(run).__name__} is no network; give a network, its folder or its name first")
    return run if isinstance(run, Network) else load(run, device=device)
