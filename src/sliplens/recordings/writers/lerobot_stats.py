"""Statistics that a LeRobot data set carries of each feature, for a network's inputs to be normalised with."""

from typing import Any

import numpy as np
from jaxtyping import Int64, Shaped, UInt8

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Stats = dict[str, Any]
"""min, max, mean, std, count and quantiles, as JSON holds them."""


class PixelCount:
    """How often each channel has each of the 256 levels, from which all statistics of pixels follow."""

    def __init__(self) -> None:
        self.levels: Int64[np.ndarray, "3 256"] = np.zeros((3, 256), dtype=np.int64)
        self.frames = 0

    def add(self, frame: UInt8[np.ndarray, "height width 3"]) -> None:
        """Count the pixels of a frame."""
        self.levels += [np.bincount(frame[..., channel].ravel(), minlength=256) for channel in range(3)]
        self.frames += 1

    def join(self, other: "PixelCount") -> None:
        """Count what another has counted."""
        self.levels += other.levels
        self.frames += other.frames

    def stats(self) -> Stats:
        """Statistics of each channel, in [0, 1]; a quantile is the lowest level that so many pixels do not exceed."""
        level = np.arange(256) / 255
        share = self.levels / self.levels.sum(axis=1, keepdims=True)
        mean = share @ level
        present = [level[counts > 0] for counts in self.levels]
        below = self.levels.cumsum(axis=1)
        found = {
            "min": [levels.min() for levels in present],
            "max": [levels.max() for levels in present],
            "mean": mean,
            "std": np.sqrt((share * (level - mean[:, None]) ** 2).sum(axis=1)),
            **{
                name: [level[np.searchsorted(counts, quantile * counts[-1])] for counts in below]
                for name, quantile in _QUANTILES.items()
            },
        }
        return {
            **{name: np.reshape(values, (3, 1, 1)).tolist() for name, values in found.items()},
            "count": [self.frames],
        }


def number_stats(values: Shaped[np.ndarray, "frames numbers"]) -> Stats:
    """Statistics of a feature over the frames of which all its numbers are known; zeros, counted 0, where none is.

    Parameters
    ----------
    values
        NaN where a number is not known.
    """
    known = values[np.isfinite(values).all(axis=1)]
    counted = known if len(known) else np.zeros_like(values[:1])
    exact = counted.astype(np.float64)
    found = {
        "min": counted.min(axis=0),
        "max": counted.max(axis=0),
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
        **dict(zip(_QUANTILES, np.quantile(exact, list(_QUANTILES.values()), axis=0), strict=True)),
    }
    return {**{name: value.tolist() for name, value in found.items()}, "count": [len(known)]}
