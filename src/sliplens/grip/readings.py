"""Error model of a network on frames of a grip: measured once for many fingertips, then looked up."""

from dataclasses import dataclass, field, replace
from functools import cached_property
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
from sliplens.progress import track
from sliplens.results.evaluation import ANSWER, MARGIN

FRICTIONS = (0.1, 0.18, 0.3, 0.5, 0.8, 1.3)
"""Coefficients of friction of the table; predictions between them are interpolated in the logarithm."""
FORCES_N = (0.3, 0.7, 1.5, 2.5, 3.0, 3.25, 3.5, 3.75, 4.0)
"""Normal forces of the table, interpolated in the logarithm. The networks were trained from 0.5 to 2 N; far above,
their errors are large and change within a quarter of a newton."""
MARGINS = (0.0, 0.04, 0.12, 0.3, 0.55, 0.8, 1.0)
"""Margins of the table, interpolated linearly."""


@dataclass(frozen=True, kw_only=True)
class ReadingTable:
    """Predictions of a network for many fingertips at each friction, force and margin.

    Fingertips are the first axis: each has its own sensor and touch, and its errors stay with it as long as it holds,
    as they do in the rendered loop; noise is drawn for each frame. Fingertips 0 and 1, 2 and 3, ... are those of
    one gripper and share a day.
    """

    network: str
    """Hash of the measured weights."""
    seed: int
    """Seed of the first fingertip; the others follow."""
    margin: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], ANSWER]
    low: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], MARGIN]
    """Lower end of the 90 % interval."""
    high: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], MARGIN]
    noise: float
    """Standard deviation of predictions of the same state, in margin units."""
    ratio: dict[str, Float32[np.ndarray, "fingertips frictions forces margins"]] = field(default_factory=dict)
    """`mean` and `sigma` of the predicted F_t / F_n; empty for a network that predicts the margin alone."""
    ratio_noise: float = 0.0
    """Standard deviation of the predicted ratio of the same state."""

    def __len__(self) -> int:
        return len(self.margin)

    def of(self, fingertips: slice) -> "ReadingTable":
        """Select fingertips."""
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
        """Interpolate the margin and both ends of its interval of contacts, without noise.

        Mean and sigma of F_t / F_n follow, where the network predicts them. Forces and frictions outside the table
        count as the outermost.
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

    @cached_property
    def _stacked(self) -> Float32[np.ndarray, "fingertips frictions forces margins values"]:
        ratio = [self.ratio[name] for name in ("mean", "sigma") if self.ratio]
        return np.stack([self.margin, self.low, self.high, *ratio], axis=-1)


def require_calibration(run: Network) -> None:
    """Refuse a network without intervals."""
    if run.manifest.calibration is None:
        raise InputError("the network was never calibrated and has no interval to grip by; train it with validation")


def measure_readings(run: Network, *, fingertips: int = 96, seed: int = 0, engine: str = "auto") -> ReadingTable:
    """Measure the predictions of a network for fingertips at every friction, force and margin of the table.

    It takes some 2 s a fingertip on one core. The noise is that of 12 states of each fingertip, drawn twice.
    """
    require_calibration(run)
    mu, force, gamma = np.meshgrid(FRICTIONS, FORCES_N, MARGINS, indexing="ij")
    # a fully stuck contact does not show the friction: one value is enough
    drawn = (gamma < 1) | (mu == FRICTIONS[0])
    states: dict[str, Any] = {"friction": mu[drawn], "margins": gamma[drawn]}
    again = np.random.default_rng(seed).choice(drawn.sum(), 12, replace=False)
    ready = make_engine(engine, run, frames=fingertips * int(drawn.sum()))
    tables: list[np.ndarray] = []
    repeats: list[np.ndarray] = []
    tip = None
    for number in track(range(fingertips)):
        tip = Fingertip(seed=seed + number, day=tip.day if tip is not None and number % 2 else None)
        film = tip.film(force[drawn], held_s=np.ones(int(drawn.sum())), **states)
        frames = draw_film(film)
        twice = draw_film(
            tip.film(force[drawn][again], held_s=np.ones(12), **{name: part[again] for name, part in states.items()})
        )
        estimate = ready.estimate(run, run.encode(np.concatenate([frames, twice]), tip.reference))
        ends = estimate.interval(LEVEL)
        assert ends is not None  # it is calibrated
        ratio = [] if estimate.ratio is None else [estimate.ratio.mean, estimate.ratio.sigma]
        count = len(frames)
        rows = [estimate.margin[:count], *(end[:count] for end in ends), *(values[:count] for values in ratio)]
        table = np.empty((len(rows), *mu.shape), dtype=np.float32)
        for row, values in zip(table, rows, strict=True):
            row[drawn] = values
            row[1:, :, -1] = row[0, :, -1]
        tables.append(table)
        repeats.append(np.stack([values[count:] - values[:count][again] for values in (estimate.margin, *ratio[:1])]))
    margin, low, high, *ratios = np.stack(tables, axis=1)
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


_FOLDER = "readings"  # folder beside a network's weights with its table


def load_readings(run: Network) -> ReadingTable | None:
    """Load the table that comes with a network of the package; None for other weights."""
    for name in shipped_names():
        folder = find_run(Path(name)) / _FOLDER
        if folder.is_dir():
            table = load_result(folder, ReadingTable, command="make weights")
            if table.network == run.manifest.weights_sha256:
                return table
    return None
