"""Trained networks: with their manifest, on disk, and those that come with the package."""

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from math import cos, erfc, radians, sin, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from msgspec import Meta
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from sliplens.codec import load_record, load_result
from sliplens.errors import CheckpointError, ImageError, InputError
from sliplens.extras import pick, require_device
from sliplens.files import (
    DIFFERENCE_NETWORK,
    MANIFEST_FILE,
    find_run,
    hash_file,
    require_folder,
    whole_file,
    write_json,
)
from sliplens.friction import LEARNT, Friction, FrictionLike, as_friction
from sliplens.images import channel_correlations, has_colour, require_rgb
from sliplens.models.backbones import (
    Answers,
    RunBatches,
    answer_names,
    bin_centres,
    bin_edges,
    build_model,
    ratio_edges,
)
from sliplens.models.calibration import Calibration, Traction, condition_on_friction, raw_interval, standard_deviation
from sliplens.models.encodings import ENCODINGS, Encoding
from sliplens.models.novelty import Novelty
from sliplens.progress import number_of
from sliplens.recordings.sensor import SensorProfile
from sliplens.results.evaluation import Training
from sliplens.shear import FULL_CIRCLE, Shear, ShearEstimator, range_words

if TYPE_CHECKING:
    from sliplens.models.engines import Engine

WEIGHTS_FILE = "model.safetensors"
MODULE = "module"
"""`Manifest.head` of a wrapped module."""
LARGEST_INPUT = 4096  # pixels along a side, several times what any backbone was made for


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """Facts of a checkpoint: how to encode its input, and where it comes from."""

    backbone: str
    input: str
    image_size: Annotated[int, Meta(ge=1, le=LARGEST_INPUT)]
    frame_size: tuple[int, int]
    sensor: str
    data_hash: str
    colour: bool | None = None
    """True if the frames it was trained on have colours; None if unknown."""
    channel_correlations: tuple[float, float] | None = None
    """Mean correlations of red with green and of green with blue in its training references; None if unknown."""
    head: str = "point"
    recipe: str = ""
    target: str = "safety_margin"
    unit: str = "margin"
    """Unit of the prediction; `margin` for a safety margin in [0, 1]."""
    weights_sha256: str = ""
    schema_version: int = 1
    metrics: dict[str, float] = field(default_factory=dict)
    calibration: Calibration | None = None
    traction: Traction | None = None
    """Calibration of the second output, F_t / F_n; None for a network that predicts the margin alone."""
    novelty: Novelty | None = None
    """Distribution of its training frames in its features; None if never fitted."""
    pull_direction_deg: tuple[float, float] | None = None
    """Directions in which its training trials were pulled, lowest and highest: 0 is right, 90 down the image, (0, 360)
    all. None if unknown."""
    versions: dict[str, str] = field(default_factory=dict)
    trained_on: tuple[str, ...] = ()
    """First 12 hex digits of the hash of every trial that trained or validated it, or what it started from."""
    started_from: str = ""
    """Hash of the weights it started from; empty for random ones."""


_BATCH = 64
_TURN_CURE = (
    "turn the sensor, or use a network of all directions: `chromatouch-turned-pair` for a ChromaTouch, or one trained "
    "with `sliplens train DATA -o RUN --augmentation all-directions`"
)
_CHANNELS_DIFFER = 0.15
"""Sum of the differences of two correlations of channels above which those in reverse order are tried."""
_DARKEST_FRAME, _BRIGHTEST_DIFFERENCE = 8.0, 64.0
"""Medians, in grey levels: no camera frame that shows something is darker, no difference image brighter."""


def sensor_kind(sensor: str) -> str:
    """Return the name of a sensor without the number of the piece."""
    return re.sub(r"-\d+$", "", sensor)


@dataclass(frozen=True, kw_only=True, repr=False)
class Network:
    """Trained network in evaluation mode, with its manifest and the record of its training."""

    model: nn.Module
    manifest: Manifest
    training: Training | None = None
    """Record of its training, with the learning curve; None if its folder has none."""

    def __repr__(self) -> str:
        """Describe the network in a few lines; the layers are in `model`."""
        manifest = self.manifest
        weights = sum(values.numel() for values in self.model.parameters())
        return (
            f"Network: {manifest.backbone} with a {manifest.head} head, {weights:,} weights, on {self.device}\n"
            f"  input: {manifest.input} images of {manifest.sensor}, frames of "
            f"{' x '.join(map(str, manifest.frame_size))} px at {manifest.image_size} px\n"
            f"  output: {manifest.target.replace('_', ' ')}, "
            f"{'calibrated' if manifest.calibration else 'no'} intervals\n"
            f"  trained on {number_of(len(manifest.trained_on), 'trial')}, recipe {manifest.recipe or 'unknown'}"
        )

    @property
    def device(self) -> torch.device:
        """Device of the network; inputs are moved there, predictions come back."""
        return next(self.model.parameters(), torch.empty(0)).device

    @property
    def wrapped(self) -> bool:
        """True for a module of others (`wrap`), which takes images of any size and has no intervals."""
        return self.manifest.head == MODULE

    @property
    def encoding(self) -> Encoding:
        """Encoding that the network was trained on."""
        return pick(ENCODINGS, self.manifest.input, noun="input")

    def encode(
        self, frames: Shaped[np.ndarray, "batch height width 3"], reference: Shaped[np.ndarray, "_ _ 3"] | None
    ) -> Float[Tensor, "batch colours size size"]:
        """Encode frames as the network was trained on them.

        `reference`: the sensor untouched; None for frames that were compared before, or that need not be.
        """
        require_rgb(frames)
        self.require_frame_size(frames.shape[1:3])
        return self.encoding.encode(frames, reference, image_size=self.manifest.image_size)

    def require_frame_size(self, size: tuple[int, ...], *, what: str = "frames") -> None:
        """Refuse frames of another sensor; a wrapped module takes any."""
        if not self.wrapped and tuple(size) != tuple(self.manifest.frame_size):
            raise ImageError(
                f"{what} are {size[0]} x {size[1]} pixels but the network was trained on "
                f"{' x '.join(map(str, self.manifest.frame_size))}; use frames of its sensor, or fit these to it with "
                "a profile (`sliplens sensor new --from VIDEO -o tip.toml`, --sensor tip.toml)"
            )

    def require_kind(self, frame: UInt8[np.ndarray, "height width 3"], *, what: str) -> None:
        """Refuse an image without a reference that is plainly not of the kind that the network was trained on.

        A difference image is black but where something moved, a camera's is not.
        """
        if self.wrapped:
            return
        level = float(np.median(frame))
        median = f"(median {level:.0f} of 255 grey levels)"
        if not self.encoding.empty_is_black and level < _DARKEST_FRAME and frame.any():
            raise ImageError(
                f"{what} is as dark as a difference image {median}, and this network takes camera frames; give those, "
                f"or a network on difference images such as {DIFFERENCE_NETWORK}"
            )
        if self.encoding.empty_is_black and level > _BRIGHTEST_DIFFERENCE:
            raise ImageError(
                f"{what} is as bright as a camera frame {median}, and without the untouched sensor this network takes "
                "it for a difference image; name it with --reference IMAGE or --reference-frame N"
            )

    def doubts(
        self,
        *,
        sensor: str = "",
        frame: UInt8[np.ndarray, "height width 3"] | None = None,
        friction: Friction | None = None,
        profile: SensorProfile | None = None,
    ) -> tuple[str, ...]:
        """Warn of whatever differs from the training: kind of sensor, colours, friction, direction of the pull.

        `friction`: doubted if most of it lies outside that of the training.
        """
        trained, doubts = self.manifest, []
        if sensor and trained.sensor and sensor_kind(sensor) != sensor_kind(trained.sensor):
            doubts.append(
                f"the network was trained on {trained.sensor} and the frames are of {sensor}: take margins for a trend "
                "until `sliplens evaluate` on trials with forces measures its intervals there"
            )
        if frame is not None and trained.colour and not has_colour(frame):
            doubts.append(
                "the frames are grey, and the network was trained on colours: its intervals were not measured on such "
                "frames; use a colour camera, or train it on frames of this one (`sliplens train`)"
            )
        elif frame is not None and trained.channel_correlations is not None:
            both = channel_correlations(frame), channel_correlations(frame[..., ::-1])
            off, off_swapped = (np.abs(np.subtract(pair, trained.channel_correlations)).sum() for pair in both)
            if off > _CHANNELS_DIFFER and off_swapped < off / 2:
                doubts.append(
                    "red and blue seem to be swapped, as in frames of OpenCV: the channels are correlated as those of "
                    "the training are in reverse order; give RGB, `frames[..., ::-1]`, of frames and reference"
                )
        if friction is not None and trained.traction is not None:
            low, high = trained.traction.friction[0], trained.traction.friction[-1]
            values, weights = friction.nodes
            if weights[(low <= values) & (values <= high)].sum() < 0.5:
                cure = "begin a new object" if friction.note == LEARNT else "check --friction"
                doubts.append(
                    f"the friction {friction.mean:.3g} lies outside that of the network's training, {low:.2g} to "
                    f"{high:.2g}: its intervals were not measured there, so {cure}, or take the margins for a trend"
                )
        if profile is not None and profile.pull_direction_deg is not None:
            pull = radians(profile.pull_direction_deg)
            if Shear(x_px=cos(pull), y_px=sin(pull), sigma_px=1.0).excess(self.directions):
                doubts.append(
                    f"the profile {profile.name} says that the sensor is pulled at {profile.pull_direction_deg:g} "
                    f"degrees, so margins will be withheld: {self.direction_reason}"
                )
        return tuple(doubts)

    @property
    def directions(self) -> tuple[float, float]:
        """Directions of the pull that it was trained on, in degrees; all where they are unknown."""
        return self.manifest.pull_direction_deg or FULL_CIRCLE

    @property
    def direction_reason(self) -> str:
        """Reason to withhold the margin of a frame pulled in another direction, with the cure."""
        return f"pulled outside the trained {range_words(self.directions)} (90 is down); {_TURN_CURE}"

    def shear_estimator(self, reference: UInt8[np.ndarray, "height width 3"]) -> ShearEstimator | None:
        """Make the estimator of the shear of frames; None for a network of all directions, or of unknown ones."""
        if self.directions == FULL_CIRCLE:
            return None
        return ShearEstimator(reference, sensor_kind(self.manifest.sensor))

    def answers(self, batches: Iterable[Tensor], run: RunBatches | None = None) -> tuple[Tensor, ...]:
        """Compute the outputs (`Answers`) for batches of encoded frames, on the network's device or by an engine."""
        parts = (run or Answers(self.model, self.feature_layer).run)(batches)
        return tuple(torch.cat(answers) for answers in zip(*parts, strict=True))

    def predict(self, inputs: Float[Tensor, "batch colours size size"]) -> Float[Tensor, " batch"]:
        """Predict the safety margin of encoded frames; not clipped to [0, 1]."""
        return self.answers(inputs.split(_BATCH))[0].cpu()

    def estimate(
        self,
        inputs: Float[Tensor, "batch colours size size"] | Iterable[Tensor],
        *,
        friction: FrictionLike | None = None,
        engine: "Engine | None" = None,
    ) -> "Estimate":
        """Predict the safety margin of encoded frames, or batches of them, with its uncertainty.

        `friction` as `predict` takes it; `engine`: of this network. A batch may be encoded while the one before is
        worked on.
        """
        size = _BATCH if engine is None else engine.batch_size
        batches = inputs.split(size) if isinstance(inputs, Tensor) else inputs
        return self.to_estimate(*self.answers(batches, engine and engine.answers), friction=friction)

    @property
    def feature_layer(self) -> str | None:
        """Layer whose features come with the outputs (`Answers`), for `novelty`."""
        return self.manifest.novelty and self.manifest.novelty.layer

    def to_estimate(self, *answers: Tensor, friction: FrictionLike | None = None) -> "Estimate":
        """Make an estimate of outputs of the network (`Answers`), and of a friction if it is known."""
        names = answer_names(self.model, self.feature_layer)
        values = {name: answer.cpu().double().numpy() for name, answer in zip(names, answers, strict=True)}
        of_ratio = ratio_edges(self.model)
        estimate = Estimate(
            margin=values["margin"],
            probabilities=values.get("probabilities"),
            edges=bin_edges(self.model),
            calibration=self.manifest.calibration,
            ratio=None if of_ratio is None else Ratio(probabilities=values["ratio_probabilities"], edges=of_ratio),
        )
        if self.manifest.novelty is not None:  # before friction narrows the answer
            estimate = replace(estimate, known=self.manifest.novelty.known(values["features"], estimate.sigma))
        if friction is None:
            return estimate
        return estimate.with_friction(as_friction(friction), self.require_ratio())

    def require_ratio(self) -> Traction:
        """Return the calibration of F_t / F_n, without which a friction cannot be used."""
        if self.manifest.traction is None:
            raise InputError(
                "this network predicts the margin alone and cannot use or learn a friction; leave it out, or teach "
                "the network F_t / F_n with `sliplens train DATA -o RUN --start-from NETWORK --recipe ratio`"
            )
        return self.manifest.traction


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """Predicted traction ratio F_t / F_n of some frames, with its uncertainty."""

    probabilities: Float[np.ndarray, "frames bins"]
    edges: Float[np.ndarray, " edges"]
    """Edges of the bins, as ratios."""

    @property
    def mean(self) -> Float[np.ndarray, " frames"]:
        """Expected F_t / F_n; not clipped."""
        return self.probabilities @ bin_centres(self.edges)

    @property
    def sigma(self) -> Float[np.ndarray, " frames"]:
        """Standard deviation of each distribution."""
        return standard_deviation(self.mean, self.probabilities, self.edges)


STRANGE = 0.01
"""Value of `Estimate.known` below which the margin of a frame is withheld."""
STRANGE_REASON = (
    f"strange to the network (known below {100 * STRANGE:g} %); use frames of the sensor it was trained on, or train "
    "it on frames of this one"
)


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Predicted safety margins of some frames, with their uncertainty."""

    margin: Float[np.ndarray, " frames"]
    calibration: Calibration | None
    probabilities: Float[np.ndarray, "frames bins"] | None = None
    """Distribution over the margin; None for a network with one number as its output."""
    edges: Float[np.ndarray, " edges"] | None = None
    """Edges of the bins, in margin units."""
    ratio: Ratio | None = None
    """Predicted F_t / F_n; None for a network without this output."""
    friction: Friction | None = None
    """Friction that the margins are conditioned on; None if unknown."""
    known: Float[np.ndarray, " frames"] | None = None
    """Share of the network's validation frames that were as strange or stranger, in its features or in the spread of
    its prediction, from 0 to 1 (`Novelty.known`). None for a network without a `Novelty`. It does not warn of an
    unknown friction."""

    @property
    def sigma(self) -> Float[np.ndarray, " frames"] | None:
        """Standard deviation of each distribution; None without a distribution."""
        if self.probabilities is None or self.edges is None:
            return None
        return standard_deviation(self.margin, self.probabilities, self.edges)

    def withheld(self, touches: Bool[np.ndarray, " frames"]) -> list[str | None]:
        """Return why the margin of each frame is not reliable, with the cure; None where it is.

        `touches`: True where something touches the sensor. An untouched sensor shows only noise, which may be strange.
        """
        strange = np.zeros(len(self.margin), bool) if self.known is None else touches & (self.known < STRANGE)
        return [STRANGE_REASON if each else None for each in strange]

    def beyond(self, error: float) -> Float[np.ndarray, " frames"]:
        """Return the predicted probability of an error above a number of margin units; not calibrated.

        For a network with one number as its output, that of a normal distribution with its validation error.
        """
        if self.probabilities is None or self.edges is None:
            mse = self.calibration.mse if self.calibration else 0.0
            return np.full(len(self.margin), erfc(error / sqrt(2 * mse)) if mse > 0 else 0.0)
        # bins beyond 0 and 1 mean the ends
        far = np.abs(np.clip(bin_centres(self.edges), 0, 1) - np.clip(self.margin, 0, 1)[:, None]) > error
        return (self.probabilities * far).sum(axis=1)

    def interval(self, level: float) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]] | None:
        """Return an interval for each margin at a level of confidence, within [0, 1]; None if not calibrated."""
        if self.calibration is None:
            return None
        offset = pick(self.calibration.offsets, str(level), noun="level")
        low, high = raw_interval(self.margin, self.probabilities, self.edges, level)
        # a label lies in [0, 1], so cutting there loses none
        return np.clip(low - offset, 0, 1), np.clip(high + offset, 0, 1)

    def with_friction(self, friction: Friction | Float[np.ndarray, " frames"], traction: Traction) -> "Estimate":
        """Condition the margins on a friction, or that of each frame (`condition_on_friction`), within [0, 1].

        `traction`: that of the network, whose intervals of such margins they get (`Traction.known_friction`).
        """
        assert self.probabilities is not None
        assert self.edges is not None
        assert self.ratio is not None
        common = isinstance(friction, Friction)
        parts = [(friction, slice(None))] if common else [(Friction(value), friction == value) for value in {*friction}]
        probabilities, margin = np.empty_like(self.probabilities), np.empty_like(self.margin)
        for value, rows in parts:
            probabilities[rows] = condition_on_friction(
                self.probabilities[rows],
                self.ratio.probabilities[rows],
                edges=self.edges,
                ratio_edges=self.ratio.edges,
                friction=value,
                trained_friction=np.array(traction.friction),
            )
            # bins beyond 0 and 1 mean the ends
            margin[rows] = probabilities[rows] @ np.clip(bin_centres(self.edges), 0, 1)
        return replace(
            self,
            margin=margin,
            probabilities=probabilities,
            calibration=traction.known_friction,
            friction=friction if common else None,
        )


def hash_weights(model: nn.Module) -> str:
    """Return the SHA-256 of all parameters and buffers of a network in memory."""
    digest = hashlib.sha256()
    for name, value in model.state_dict().items():
        digest.update(name.encode())
        if isinstance(value, Tensor):
            digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def save_checkpoint(folder: Path, model: nn.Module, manifest: Manifest) -> None:
    """Write weights and manifest into a folder; the manifest, which makes it a checkpoint, comes last."""
    values = save({name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()})
    with whole_file(folder / WEIGHTS_FILE) as part:
        part.write_bytes(values)
    write_json(folder / MANIFEST_FILE, replace(manifest, weights_sha256=hash_file(folder / WEIGHTS_FILE)))


def _load_weights(path: Path, model: nn.Module, *, what: str, sha256: str) -> None:
    """Fill a network with finite weights of the file that its manifest describes."""
    if not path.is_file():
        raise CheckpointError(f"{path} is missing; train the network again or copy the whole folder")
    if hash_file(path) != sha256:
        raise CheckpointError(f"{path} is not the file its manifest describes; copy the whole folder again")
    try:
        model.load_state_dict(load_file(path, device="cpu"))  # widens halves, as which the package stores networks
    except (SafetensorError, RuntimeError) as error:
        raise CheckpointError(f"{path} does not hold {what} ({str(error).splitlines()[0]})") from None
    for name, tensor in model.state_dict().items():
        if not tensor.isfinite().all():
            raise CheckpointError(f"{path} holds a value that is no finite number in {name}; train the network again")


def read_manifest(run: str | Path) -> Manifest:
    """Load the manifest of a network without its weights, by the name or folder that `load` takes."""
    return load_record(find_run(Path(run)) / MANIFEST_FILE, Manifest, command="sliplens train")


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
    CheckpointError
        If a file is missing or damaged.

    See Also
    --------
    train : Train a network.
    wrap : Make a network of a PyTorch module.

    Examples
    --------
    >>> import sliplens as sl
    >>> network = sl.load("chromatouch-pair")
    >>> network.manifest.input, network.manifest.image_size
    ('pair', 112)
    """
    require_device(device)
    folder = find_run(Path(run))
    require_folder(folder, what="the run")
    manifest = read_manifest(folder)
    colours = pick(ENCODINGS, manifest.input, noun="input").colours
    model = build_model(manifest.backbone, head=manifest.head, colours=colours)
    what = f"a {manifest.backbone} with a {manifest.head} head"
    _load_weights(folder / WEIGHTS_FILE, model, what=what, sha256=manifest.weights_sha256)
    # channels last: depthwise convolutions run up to half as fast again on a CPU
    model = model.to(device, memory_format=torch.channels_last).eval()  # pyright: ignore[reportCallIssue]
    # the networks of the package come without their learning curve
    has_curve = (folder / "curve.parquet").is_file()
    training = load_result(folder, Training, command="sliplens train") if has_curve else None
    return Network(model=model, manifest=manifest, training=training)
