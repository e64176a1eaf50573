"""Frames of a training, their augmentation and their order."""

import math
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from torch import Tensor
from torch.nn import functional
from torch.utils.data import Dataset as TorchDataset
from torch.utils.data import Sampler
from torchvision.transforms.v2 import functional as transforms

from sliplens.errors import RecordingError
from sliplens.extras import pick
from sliplens.models.encodings import Encoding
from sliplens.progress import report_each
from sliplens.recordings import Dataset, Labels, TrialInfo


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """Rotations, shifts, magnifications and mirrorings, colour, Gaussian noise and Gaussian blur, drawn for each image.

    Frame and reference are moved together. Polak, section 4 ("random image augmentations"), has slight rotations, noise
    and blur; the rest is ours.
    """

    rotation_deg: float = 5.0
    """Rotations are uniform within plus and minus this: the pull is never exactly along gravity."""
    shift: float = 0.015
    """Shifts along x and y are uniform within plus and minus this share of the image: a camera never sits twice alike,
    and a network must not know a day by its place."""
    zoom: float = 0.0
    """Magnifications are uniform within 1 plus and minus this."""
    mirror: bool = False
    """Mirror half of the images."""
    padding: str = "border"
    """Pixels beyond the border of an image, as `torch.nn.functional.grid_sample` takes it."""
    colour: float = 0.05
    """Each channel is scaled by 1 plus or minus up to this: white balance."""
    noise_sd: float = 0.03
    """Standard deviation of the noise is uniform in [0, noise_sd], in units of the image's maximum."""
    blur_probability: float = 0.25
    blur_sd_px: float = 0.8
    """Share of batches that are blurred, and the largest standard deviation of the blur in pixels."""
    neutral: float = 0.0
    """Level of the input that means no change; `colour` scales about it."""

    def __call__(
        self, images: Float[Tensor, "batch colours size size"], *, generator: torch.Generator
    ) -> Float[Tensor, "batch colours size size"]:
        """Augment a batch; the same generator state gives the same images."""
        batch, colours = images.shape[:2]
        device = images.device

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=device)

        angle = (2 * uniform(batch) - 1) * math.radians(self.rotation_deg)
        # the grid spans 2, from -1 to 1
        along, down = 2 * self.shift * (2 * uniform(2, batch) - 1)
        scale = 1 + self.zoom * (2 * uniform(batch) - 1) if self.zoom else torch.ones(batch, device=device)
        side = scale * (1 - 2 * (uniform(batch) < 0.5).float()) if self.mirror else scale
        cos, sin = angle.cos(), angle.sin()
        turn = torch.stack([side * cos, -scale * sin, along, side * sin, scale * cos, down], dim=1).view(-1, 2, 3)
        grid = functional.affine_grid(turn, list(images.shape), align_corners=False)
        images = functional.grid_sample(images, grid, padding_mode=self.padding, align_corners=False)
        # a blur of images that lie channels last takes a quarter of the time, and the network wants them so
        images = images.contiguous(memory_format=torch.channels_last)
        if float(uniform(1)) < self.blur_probability:
            images = transforms.gaussian_blur(images, [3, 3], [0.1 + (self.blur_sd_px - 0.1) * float(uniform(1))])
        # one camera saw the reference and the frame
        colour = 1 + self.colour * (2 * uniform(batch, 3, 1, 1) - 1).repeat(1, colours // 3, 1, 1)
        # in place: images of a batch are large, and the sampled ones are ours
        images.sub_(self.neutral).mul_(colour).add_(self.neutral)
        height, width = images.shape[-2:]
        noise = torch.randn((batch, height, width, colours), generator=generator, device=device).permute(0, 3, 1, 2)
        return images.add_(noise.mul_(uniform(batch, 1, 1, 1) * self.noise_sd)).clamp_(0, 1)


AUGMENTATIONS = {
    "none": None,
    "thesis": Augmentation(shift=0.0, colour=0.0),
    "noise": Augmentation(rotation_deg=0.0, shift=0.0, colour=0.0, blur_probability=0.0),
    "default": Augmentation(),
    # the corners of a turned square lie outside of it; mirrored skin is more like skin than its last pixel drawn out
    "all-directions": Augmentation(rotation_deg=180.0, zoom=0.03, mirror=True, padding="reflection"),
}
"""Augmentations by name. `thesis` has rotation, noise and blur, in amounts of ours; Polak gives none. `noise` has noise
alone. `all-directions` turns images by any angle, mirrors and magnifies them, for networks that may be pulled in any
direction."""


def get_augmentation(name: str, *, neutral: float = 0.0) -> Augmentation | None:
    """Look up an augmentation by name, for inputs with a neutral level."""
    augmentation = pick(AUGMENTATIONS, name, noun="augmentation")
    return None if augmentation is None else replace(augmentation, neutral=neutral)


UNTOUCHED = -1
"""Frame number of the reference frame, which is no frame of the trial."""


@dataclass(frozen=True, kw_only=True)
class FrameSet(TorchDataset):
    """Resized 8-bit inputs with their labels; a batch is indexed at once, not frame by frame."""

    encoding: Encoding
    images: UInt8[Tensor, "frames colours size size"] | Float32[Tensor, "frames features"]
    """Compared and resized frames, uint8, as `Encoding.resize` returns them; or inputs of the last layer."""
    safety_margin: Float32[Tensor, " frames"]
    """Labels in [0, 1]."""
    traction_ratio: Float32[Tensor, " frames"]
    """F_t / F_n; NaN where the forces are not known."""
    friction: Float64[np.ndarray, " frames"]
    """Coefficient of static friction of each frame's trial, see `trial_friction`; NaN where it is not known."""
    trial: tuple[str, ...]
    frame: tuple[int, ...]
    condition: tuple[str, ...]
    day: tuple[int, ...]
    time_s: Float[np.ndarray, " frames"]
    """Where each row comes from, for tables by trial, condition and day."""

    def __len__(self) -> int:
        return len(self.images)

    def __getitems__(self, indices: Sequence[int] | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return a batch of inputs, their margins and their ratios; torch's loader asks for it by this name."""
        rows = torch.as_tensor(indices)
        images = self.images[rows]
        inputs = images if images.is_floating_point() else self.encoding.normalise(images)
        return inputs, self.safety_margin[rows], self.traction_ratio[rows]

    def batches(self, size: int, *, report: bool = False) -> Iterator[Tensor]:
        """Iterate over the inputs of all frames, in their order; if `report`, report each batch as done."""
        batches = torch.arange(len(self)).split(size)
        for rows in report_each(batches, sizes=[len(rows) for rows in batches]) if report else batches:
            yield self.__getitems__(rows)[0]

    def sample(self, count: int, *, batch_size: int) -> Iterator[Tensor]:
        """Iterate over the inputs of a number of frames at most, spread over all trials."""
        rows = torch.linspace(0, len(self) - 1, min(len(self), count)).round().long()
        return (self.__getitems__(some)[0] for some in rows.split(batch_size))


def trial_friction(labels: Labels) -> float:
    """Return the static friction of a trial, the median over labelled frames that stick; NaN if unknown."""
    sticks = labels.labelled & (labels.safety_margin > 0)
    values = labels.friction_coefficient[sticks & np.isfinite(labels.friction_coefficient)]
    return float(np.median(values)) if len(values) else float("nan")


def _ratios(labels: Labels) -> Float[np.ndarray, " frames"]:
    """Return F_t / F_n of each frame; NaN where a force is unknown or nothing presses."""
    pressed = labels.normal_force_n > 0
    return np.where(pressed, labels.tangential_force_n / np.where(pressed, labels.normal_force_n, 1), np.nan)


def has_ratio(labels: Labels) -> bool:
    """Return True if F_t / F_n and the friction of any labelled frame are known."""
    return bool(np.isfinite(trial_friction(labels)) and np.isfinite(_ratios(labels)[labels.labelled]).any())


def require_one_size(data: Dataset, trials: Sequence[TrialInfo]) -> None:
    """Refuse trials of several sensors: a network takes frames of one size."""
    if len({(info.height, info.width) for info in trials}) > 1:
        raise RecordingError(f"{data.folder} mixes frames of several sizes; use one sensor at a time")


def load_frames(
    data: Dataset,
    trials: Sequence[TrialInfo],
    *,
    encoding: Encoding,
    image_size: int,
    untouched_share: float = 0.0,
    scratch: Path | None = None,
) -> FrameSet:
    """Load trials, encode them, and keep the frames that have a label; frames without contact have none.

    Frames that would take more than half of the free memory go into a file in the folder `scratch`, deleted with them.
    `untouched_share` adds the untouched sensor, with the label 1 (the limit of light touches), this often for each
    labelled frame and at least once a trial: a network trained on it gives explanations a meaningful reference.
    """
    require_one_size(data, trials)

    counts = np.array([data.read_labels(info).labelled.sum() for info in trials])
    if not counts.sum():
        raise RecordingError(f"{data.folder}: no frame of the {len(trials)} trials has a label; label them first")
    untouched = (np.maximum(1, np.round(untouched_share * counts)) * (untouched_share > 0)).astype(int)
    shape = int((counts + untouched).sum()), encoding.colours, image_size, image_size
    free_bytes = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else math.inf
    if scratch is None or math.prod(shape) <= free_bytes / 2:
        images = torch.empty(shape, dtype=torch.uint8)
    else:
        with tempfile.TemporaryFile(dir=scratch) as file:
            file.truncate(math.prod(shape))
            images = torch.from_numpy(np.memmap(file, dtype=np.uint8, mode="r+", shape=shape))
    labels, ratios, frictions, times, rows = [], [], [], [], []
    for info, copies in report_each(list(zip(trials, untouched.tolist(), strict=True))):
        recording = data.load(info, truth=False)
        labelled = np.flatnonzero(recording.labelled)
        end = len(rows) + len(labelled)
        compare = partial(encoding.compare_small, reference=recording.reference, image_size=image_size)
        images[len(rows) : end] = compare(recording.frames[labelled])
        if copies:
            images[end : end + copies] = compare(recording.reference[None])
        labels += recording.safety_margin[labelled], np.ones(copies)
        ratios += _ratios(recording)[labelled], np.zeros(copies)
        times += recording.time_s[labelled], np.full(copies, recording.time_s[0])
        frictions.append(np.full(len(labelled) + copies, trial_friction(recording)))
        numbers = [*labelled.tolist(), *[UNTOUCHED] * copies]
        rows += [(recording.trial, number, recording.condition, recording.day) for number in numbers]
    trial, frame, condition, day = zip(*rows, strict=True)
    return FrameSet(
        encoding=encoding,
        images=images,
        safety_margin=torch.from_numpy(np.concatenate(labels)).float(),
        traction_ratio=torch.from_numpy(np.concatenate(ratios)).float(),
        friction=np.concatenate(frictions),
        trial=trial,
        frame=frame,
        condition=condition,
        day=day,
        time_s=np.concatenate(times),
    )


class EpochShuffle(Sampler[int]):
    """Random order for each epoch that depends on the seed and the epoch alone, so that resuming repeats it."""

    def __init__(self, count: int, *, seed: int, drawn: int | None = None) -> None:
        self.count, self.drawn, self.seed, self.epoch = count, drawn or count, seed, 0

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch; Lightning calls this before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.drawn

    def __iter__(self) -> Iterator[int]:
        """Yield the indices: each frame once, or as many as are drawn, none again before all others."""
        rng = np.random.default_rng((self.seed, self.epoch))
        rounds = [rng.permutation(self.count) for _ in range(-(-self.drawn // self.count))]
        return iter(np.concatenate(rounds)[: self.drawn].tolist())
