"""A small recording, and a network that nobody trained: enough to test everything around them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import nn

from sliplens.models import Manifest, Network, build_model, save_checkpoint
from sliplens.models.calibration import Calibration, Traction
from sliplens.models.encodings import ENCODINGS
from sliplens.recordings import ContactState, Recording

FRAME_SIZE = 48
IMAGE_SIZE = 32
CALIBRATION = Calibration(temperature=1.0, offsets={"0.68": 0.02, "0.9": 0.05}, frames=100, mse=0.01)
TRACTION = Traction(
    calibration=CALIBRATION, known_friction=CALIBRATION, friction=tuple(0.15 + 0.105 * part for part in range(11))
)


class Returning(nn.Module):
    """Module that returns something made of the outputs of another, or of the images themselves."""

    def __init__(self, make: Callable[[torch.Tensor], object], inner: nn.Module | None = None) -> None:
        super().__init__()
        self.make, self.inner = make, inner or nn.Identity()

    def forward(self, images: torch.Tensor) -> object:
        return self.make(self.inner(images))


def network_of(model: nn.Module, *, input: str, image_size: int, frame_size: int | None = None) -> Network:
    """A module as a network in memory; its frames are square, of the size of its images unless said otherwise."""
    size = frame_size or image_size
    manifest = Manifest(
        backbone="none", input=input, image_size=image_size, frame_size=(size, size), sensor="", data_hash=""
    )
    return Network(model=model.eval(), manifest=manifest)


def make_recording(trial: str, *, condition: str = "dry", day: int = 1, frames: int = 12, seed: int = 0) -> Recording:
    """A square that wanders over a noisy background as the safety margin falls: enough for a network to learn."""
    rng = np.random.default_rng(seed)
    margin = np.linspace(1, 0, frames)
    margin[0] = np.nan  # the first frame has no contact
    reference = rng.integers(0, 20, (FRAME_SIZE, FRAME_SIZE, 3), dtype=np.uint8)
    images = np.repeat(reference[None], frames, axis=0)
    for index in range(1, frames):
        row = 4 + round(24 * (1 - margin[index]))
        images[index, row : row + 12, 16:32] += 120
    state = [ContactState.NO_CONTACT] + [ContactState.INCIPIENT_SLIP] * (frames - 1)
    force = np.full(frames, 1.0)
    return Recording(
        trial=trial,
        sensor="test-sensor",
        day=day,
        condition=condition,
        reference=reference,
        frames=images,
        time_s=np.arange(frames) / 30,
        normal_force_n=force,
        tangential_force_n=np.nan_to_num(0.5 * (1 - margin)),
        friction_coefficient=0.5 * force,
        safety_margin=margin,
        stick_ratio=np.clip(margin ** (2 / 3), 0, 1),
        contact_state=tuple(state),
    )


def save_untrained(
    folder: Path,
    *,
    head: str = "point",
    kind: str = "difference",
    seed: int = 0,
    frame_size: int = FRAME_SIZE,
    image_size: int = IMAGE_SIZE,
    calibration: Calibration | None = None,
    traction: Traction | None = None,
    prepare: Callable[[nn.Module], None] = lambda _: None,
) -> Path:
    """A checkpoint with random weights: enough to test everything around a network; what prepares them comes last."""
    head = head if traction is None else "margin-and-ratio"
    folder.mkdir(parents=True, exist_ok=True)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = build_model(head=head, colours=ENCODINGS[kind].colours)
    prepare(model)
    manifest = Manifest(
        backbone="shufflenet_v2_x1_0",
        input=kind,
        image_size=image_size,
        frame_size=(frame_size, frame_size),
        sensor="test-sensor",
        data_hash="none",
        head=head,
        calibration=calibration if traction is None else traction.calibration,
        traction=traction,
    )
    save_checkpoint(folder, model.eval(), manifest)
    return folder
