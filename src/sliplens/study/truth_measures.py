"""How well maps agree with what each marker does, and what is told of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import spearmanr

from sliplens.faithfulness.localisation import relevance_mass, relevance_rank
from sliplens.faithfulness.units import unit_means
from sliplens.intervals import paired_difference
from sliplens.study.saved import mean_of_known
from sliplens.study.truth_effects import EFFECTS, MarkerEffects
from sliplens.study.truth_scenes import Places

AREAS = ("markers", "slip_annulus", "edges")
"""Where a map may lie."""
_MEASURES: dict[str, Callable[..., float]] = {"mass": relevance_mass, "rank": relevance_rank}

Maps = Float[np.ndarray, "frames size size"]


def marker_means(maps: Maps, places: Sequence[Places]) -> list[Float[np.ndarray, " markers"]]:
    """Mean of each frame's map over each of its markers, where it is and where it was."""
    return [
        unit_means(values.astype(np.float64), one.units)[: len(one.now_px)]
        for values, one in zip(maps, places, strict=True)
    ]


def covered_shares(places: Sequence[Places]) -> dict[str, float | None]:
    """Share of the image that each area covers, mean over the frames that have it: the mass of a map of chance."""
    shares = {area: np.array([getattr(one, area).mean() for one in places]) for area in AREAS}
    return {area: mean_of_known(values[values > 0]) for area, values in shares.items()}


def localisation(maps: Maps, places: Sequence[Places]) -> dict[str, dict[str, float | None]]:
    """Mass and rank of the positive part of maps in each area, mean over the frames that have the area."""
    positive = np.clip(maps.astype(np.float64), 0, None)
    found: dict[str, dict[str, float | None]] = {}
    for name, measure in _MEASURES.items():
        found[name] = {}
        for area in AREAS:
            truths = [getattr(one, area) for one in places]
            # where nothing slips there is nothing to find
            pairs = [(values, truth) for values, truth in zip(positive, truths, strict=True) if truth.any()]
            found[name][area] = mean_of_known(np.array([measure(values, truth) for values, truth in pairs]))
    return found


def edges_over_chance(maps: Maps, places: Sequence[Places]) -> Float[np.ndarray, " frames"]:
    """Mass of the positive part of each map on the edges of markers, less the share of the image that they cover."""
    positive = np.clip(maps.astype(np.float64), 0, None)
    return np.array(
        [relevance_mass(values, one.edges) - one.edges.mean() for values, one in zip(positive, places, strict=True)]
    )


def agreements(
    maps: Maps, places: Sequence[Places], effects: Sequence[MarkerEffects]
) -> dict[str, Float[np.ndarray, " frames"]]:
    """Rank correlation, by frame, between a map marker by marker and each of the effects."""
    means = marker_means(maps, places)
    return {
        effect: np.array(
            [rank_correlation(told, getattr(truth, effect)) for told, truth in zip(means, effects, strict=True)]
        )
        for effect in EFFECTS
    }


def rank_correlation(first: Float[np.ndarray, " markers"], second: Float[np.ndarray, " markers"]) -> float:
    """Spearman's rank correlation of the sizes; NaN where one of the two does not vary."""
    first, second = np.abs(first), np.abs(second)
    if len(first) < 2 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return float(np.asarray(spearmanr(first, second))[0])


def mean_interval(values: Float[np.ndarray, " frames"], trials: np.ndarray, *, seed: int) -> dict[str, Any] | None:
    """Mean over the frames in which it is defined, with a 95 % interval over resampled trials; None if in none."""
    known = np.isfinite(values)
    if not known.any():
        return None
    gap = paired_difference(
        values[known], np.zeros(int(known.sum())), trials=trials[known], rng=np.random.default_rng(seed)
    )
    return {**asdict(gap), "sure": gap.sure}


def meta_test(effects: Sequence[MarkerEffects], trials: np.ndarray, *, seed: int) -> list[dict[str, Any]]:
    """Whether each fill ranks the map that knows the effects above the one that knows half, and that above chance.

    A gain counts changes of the answer towards the target, as `faithfulness` does when it is told; `by_size` counts how
    large they are, where a marker that works against the answer moves it as far as one that works for it.
    """
    told = []
    for fill in effects[0].gains:
        gains = np.stack([found.gains[fill] for found in effects])
        by_size, signed = (_ranked(gains[:, row], trials, seed=seed) for row in (0, 1))
        told.append({"fill": fill, **signed, "by_size": by_size})
    return told


def _ranked(gains: Float[np.ndarray, "frames 2"], trials: np.ndarray, *, seed: int) -> dict[str, Any]:
    oracle, degraded = gains.mean(axis=0).tolist()
    return {
        "holds": oracle > degraded > 0,
        "oracle": oracle,
        "degraded": degraded,
        # a random order turned round is a random order: its symmetric gain is 0 on average
        "random": 0.0,
        "gap": mean_interval(gains[:, 0] - gains[:, 1], trials, seed=seed),
    }


def tell(meta: Sequence[Mapping[str, Any]], own: Mapping[str, Any] | None) -> str:
    """Say which fills can tell, and whether the network looks where the best reader would."""
    held = [str(row["fill"]) for row in meta if row["holds"]]
    by_size = [str(row["fill"]) for row in meta if row["by_size"]["holds"]]
    told = (
        "The map of the network's own marker effects ranks above one of which half is shuffled, and that above chance, "
        f"under {len(held)} of {len(meta)} fills ({', '.join(held) or 'none'}); counted by the size of the answer's "
        f"changes instead of along them, under {len(by_size)} ({', '.join(by_size) or 'none'})."
    )
    if own is not None:
        told += (
            f" Marker by marker the network's effects agree with those on the best reading of the margin by "
            f"{own['estimate']:.2f} (Spearman, 95 % interval {own['low']:.2f} to {own['high']:.2f})."
        )
    return told
