"""What a network says of a grip's frames: measured once for many fingertips, then looked up."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Float32, Int

from sliplens.codec import load_result
from sliplens.errors import InputError
from sliplens.files import find_run, shipped_names
from sliplens.grip.fingertip import Fingertip, draw_film, place_in_grid
from sliplens.models import Network, make_engine
from sliplens.models.predictions import LEVEL
from sliplens.progress import OnProgress
from sliplens.results.evaluation import ANSWER, MARGIN

FRICTIONS = (0.1, 0.18, 0.3, 0.5, 0.8, 1.3)
"""Coefficients of friction at which readings are measured; between them they are interpolated in the logarithm."""
FORCES_N = (0.3, 0.7, 1.5, 2.5, 3.0, 3.25, 3.5, 3.75, 4.0)
"""Normal forces, the same; the networks were trained from 0.5 to 2 N, and far above they read nonsense, which changes
within a quarter of a newton."""
MARGINS = (0.0, 0.04, 0.12, 0.3, 0.55, 0.8, 1.0)
"""Margins, interpolated as they are."""


@dataclass(frozen=True, kw_only=True)
class ReadingTable:
    """Error model of a network: what it read of many fingertips at each friction, force and margin.

    Fingertips are the first axis: each has its own sensor and touch, and its errors stay with it as long as it holds,
    as they do in the rendered loop; noise comes anew with each frame. Fingertips 0 and 1, 2 and 3, ... are those of
    one gripper and share a day.
    """

    network: str
    """Hash of the weights that were measured."""
    seed: int
    """Seed of the first fingertip; the others follow."""
    margin: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], ANSWER]
    low: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], MARGIN]
    """Lower end of the 90 % interval."""
    high: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], MARGIN]
    noise: float
    """Standard deviation of the margin read anew of the same state, in margin units."""
    ratio: dict[str, Float32[np.ndarray, "fingertips frictions forces margins"]] = field(default_factory=dict)
    """`mean` and `sigma` of F_t / F_n as it was read; empty for a network that answers with the margin alone."""
    ratio_noise: float = 0.0
    """Standard deviation of the ratio read anew of the same state."""

    def __len__(self) -> int:
        return len(self.margin)

    def of(self, fingertips: slice) -> "ReadingTable":
        """Table of some of the fingertips."""
        parts = {name: getattr(self, name)[fingertips] for name in ("margin", "low", "high")}
        ratio = {name: values[fingertips] for name, values in self.ratio.items()}
        return replace(self, seed=self.seed + (fingertips.start or 0), ratio=ratio, **parts)

    def read(
        self,
        fingertips: Int[np.ndarray, "*contacts"],
        normal_force_n: Float[np.ndarray, "*contacts"],
        *,
        friction: Float[np.ndarray, "*contacts"],
        margins: Float[np.ndarray, "*contacts"],
    ) -> tuple[Float[np.ndarray, "*contacts"], ...]:
        """Margin and both ends of its interval, of contacts in these states, without noise.

        Mean and sigma of F_t / F_n follow, of a network that tells it. Forces and frictions beyond the measured ones
        are read as the outermost.
        """
        places = [
            place_in_grid(np.log(FRICTIONS), np.log(np.maximum(friction, 1e-6))),
            place_in_grid(np.log(FORCES_N), np.log(np.maximum(normal_force_n, 1e-6))),
            place_in_grid(np.asarray(MARGINS), margins),
        ]
        stacked = self._stacked
        total = np.zeros((*np.shape(fingertips), stacked.shape[-1]))
        for corner in range(8):
            weight, index = 1.0, [fingertips]
            for axis, (at, part) in enumerate(places):
                upper = corner >> axis & 1
                weight = weight * (part if upper else 1 - part)
                index.append(at + upper)
            total += np.asarray(weight)[..., None] * stacked[tuple(index)]
        return tuple(np.asarray(values) for values in np.moveaxis(total, -1, 0))

    @property
    def _stacked(self) -> Float32[np.ndarray, "fingertips frictions forces margins values"]:
        cached = self.__dict__.get("_cache")
        if cached is None:
            ratio = [self.ratio[name] for name in ("mean", "sigma") if self.ratio]
            cached = np.stack([self.margin, self.low, self.high, *ratio], axis=-1)
            object.__setattr__(self, "_cache", cached)
        return cached


def require_calibration(run: Network) -> None:
    """Refuse a network that tells no interval to grip by."""
    if run.manifest.calibration is None:
        raise InputError("the network was never calibrated and tells no interval to grip by; train it with validation")


def measure_readings(
    run: Network, *, fingertips: int = 96, seed: int = 0, engine: str = "auto", on_progress: OnProgress | None = None
) -> ReadingTable:
    """Measure what a network says of fingertips at every friction, force and margin of the table.

    Some 2 s a fingertip on one core. The noise is that of 12 states of each fingertip, filmed twice.

    Parameters
    ----------
    run
        Network with a calibration, which gives its intervals.
    fingertips
        How many, an even number; each has a seed of its own, counted from `seed`.
    engine
        `auto`, `torch` or `openvino`.

    Raises
    ------
    InputError
        If the network was never calibrated, and so cannot say how sure it is.
    """
    require_calibration(run)
    mu, force, gamma = np.meshgrid(FRICTIONS, FORCES_N, MARGINS, indexing="ij")
    # full stick shows no friction: one of them is enough
    shown = (gamma < 1) | (mu == FRICTIONS[0])
    states: dict[str, Any] = {"friction": mu[shown], "margins": gamma[shown]}
    again = np.random.default_rng(seed).choice(shown.sum(), 12, replace=False)
    ready = make_engine(engine, run, frames=fingertips * int(shown.sum()))
    found: list[np.ndarray] = []
    repeats: list[np.ndarray] = []
    tip = None
    for number in range(fingertips):
        tip = Fingertip(seed=seed + number, day=tip.day if tip is not None and number % 2 else None)
        film = tip.film(force[shown], held_s=np.ones(int(shown.sum())), **states)
        frames = draw_film(film)
        twice = draw_film(
            tip.film(force[shown][again], held_s=np.ones(12), **{name: part[again] for name, part in states.items()})
        )
        estimate = ready.estimate(run, run.encode(np.concatenate([frames, twice]), tip.reference))
        ends = estimate.interval(LEVEL)
        assert ends is not None  # it is calibrated
        ratio = [] if estimate.ratio is None else [estimate.ratio.mean, estimate.ratio.sigma]
        count = len(frames)
        rows = [estimate.margin[:count], *(end[:count] for end in ends), *(one[:count] for one in ratio)]
        table = np.empty((len(rows), *mu.shape), dtype=np.float32)
        for row, values in zip(table, rows, strict=True):
            row[shown] = values
            row[1:, :, -1] = row[0, :, -1]
        found.append(table)
        repeats.append(np.stack([one[count:] - one[:count][again] for one in (estimate.margin, *ratio[:1])]))
        if on_progress is not None:
            on_progress(number + 1, fingertips)
    margin, low, high, *ratios = np.stack(found, axis=1)
    noise, *ratio_noise = (np.std(np.concatenate(repeats, axis=1), axis=1) / np.sqrt(2)).tolist()
    return ReadingTable(
        network=run.manifest.weights_sha256,
        seed=seed,
        margin=margin,
        low=low,
        high=high,
        noise=noise,
        ratio=dict(zip(("mean", "sigma"), ratios, strict=False)),
        ratio_noise=sum(ratio_noise),
    )


_FOLDER = "readings"
"""Folder beside a network's weights with the table that was measured of it."""


def load_readings(run: Network) -> ReadingTable | None:
    """Table that comes with a network of the package; None where there is none of these weights."""
    for name in shipped_names():
        folder = find_run(Path(name)) / _FOLDER
        if folder.is_dir():
            table = load_result(folder, ReadingTable, command="make weights")
            if table.network == run.manifest.weights_sha256:
                return table
    return None
