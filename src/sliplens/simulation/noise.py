"""The camera's noise, drawn once as a bank of fields and mixed anew for every frame."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

_FIELDS = 32
_PLAY_PX = 64
"""How much larger than a frame the fields are: a frame's window lies anywhere in them."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Standard deviation of one frame's noise by channel, in grey levels, and its smoothness."""

    background: tuple[float, float, float]
    marker: tuple[float, float, float]
    edge: float
    """How far the noise of a marker's edge, where the video's compression rings, exceeds that inside: at a share s of
    marker in the pixel the noise has s (1 + edge (1 - s)) of the marker's excess over the background's."""
    smoothness: float
    """Weight w of the neighbour's noise in a pixel; the lag-1 correlation is w / (1 + w^2)."""
    red_in_green: float
    """Correlation of red and green, which the camera's debayering ties together."""
    grain: tuple[float, float, float]
    """Unevenness of the print, which moves with a marker, over its contrast."""
    ragged_px: tuple[float, float, float]
    """Unevenness of a marker's edge."""


@dataclass(frozen=True, kw_only=True)
class NoisePicks:
    """Which two fields of the bank each frame adds, and where their windows begin (row, column)."""

    field: Int[np.ndarray, "frames 2"]
    corner: Int[np.ndarray, "frames 2 2"]

    def at(self, frames: slice) -> "NoisePicks":
        """Picks of some of the frames."""
        return NoisePicks(field=self.field[frames], corner=self.corner[frames])


def pick_noise(frames: int, *, rng: np.random.Generator) -> NoisePicks:
    """Draw two different fields and their windows for each frame."""
    first = rng.integers(_FIELDS, size=frames)
    second = (first + rng.integers(1, _FIELDS, size=frames)) % _FIELDS
    return NoisePicks(field=np.stack([first, second], axis=-1), corner=rng.integers(_PLAY_PX + 1, size=(frames, 2, 2)))


def mix_noise(
    picks: NoisePicks, *, noise: Noise, image_size_px: int, device: str | torch.device
) -> Float[Tensor, "3 frames size size"]:
    """Noise of unit variance for each frame.

    The sum of two windows out of 32 fields repeats after some 10^10 frames, costs two reads and an addition, and is the
    same on every device.

    Parameters
    ----------
    picks
        From `pick_noise`.
    noise
        Its smoothness and the correlation of its channels.
    image_size_px
        Height and width of the frames.
    device
        Where to compute.
    """
    bank = _noise_bank(noise, image_size_px + _PLAY_PX, str(device))
    return sum(  # pyright: ignore[reportReturnType] - of two tensors, never of none
        torch.stack(
            [
                bank[:, field, row : row + image_size_px, column : column + image_size_px]
                for field, (row, column) in zip(picks.field[:, part], picks.corner[:, part], strict=True)
            ],
            dim=1,
        )
        for part in (0, 1)
    )


@lru_cache(maxsize=4)
def _noise_bank(noise: Noise, side: int, device: str) -> Float[Tensor, "3 fields side side"]:
    """Fields of variance 1/2, smooth over neighbours, red and green alike in part; always the same ones."""
    white = np.random.default_rng(0).standard_normal((3, _FIELDS, side + 1, side + 1), dtype=np.float32)
    rows = white[:, :, :-1] + noise.smoothness * white[:, :, 1:]
    smooth = rows[..., :-1] + noise.smoothness * rows[..., 1:]
    smooth /= (1 + noise.smoothness**2) * np.sqrt(2)
    smooth[1] = noise.red_in_green * smooth[0] + np.sqrt(1 - noise.red_in_green**2) * smooth[1]
    return torch.from_numpy(smooth).to(device)
