"""From one frame to the next: a step where the pattern moved little, a search where it may have jumped."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sliplens.markers.matching import Pairing, likely_shifts, pair
from sliplens.markers.neighbours import Neighbours, predict_from_neighbours

_CALM_STEP = 0.2  # pitches: a larger step may be one the other way round a regular grid
_CALM_SPREAD = 2.5  # times the usual one
_LEAST_SPREAD_PX = 0.15
_LEAST_SUPPORT = 0.6
_CALM_SUPPORT = 0.85  # of the usual one
_RIVAL_SUPPORT, _RIVAL_SPREAD = 0.85, 1.6  # of the best: whoever comes so near cannot be ruled out
_LEAST_SHARE = 0.3  # of all markers
_CLEAN_PX = 0.3  # of spread: what jumps as a whole does not bend
_SMALL_STEP, _SMALL_SUPPORT = 0.25, 0.8


@dataclass(frozen=True, kw_only=True)
class Usual:
    """What steps of this trial look like."""

    spread_px: float = np.inf
    support: float = 1.0

    def after(self, pairing: Pairing) -> "Usual":
        """Remember one more step."""
        spread = max(pairing.spread_px, _LEAST_SPREAD_PX / _CALM_SPREAD)
        if not np.isfinite(self.spread_px):
            return Usual(spread_px=spread, support=pairing.support)
        return Usual(spread_px=0.8 * self.spread_px + 0.2 * spread, support=0.8 * self.support + 0.2 * pairing.support)


def link(
    origins: list[Float[np.ndarray, "markers 2"]],
    found_px: Float[np.ndarray, "spots 2"],
    *,
    neighbours: Neighbours,
    frame_size: tuple[int, int],
    usual: Usual,
    lost: bool,
) -> Pairing | None:
    """Tell which marker is which; None where it cannot be told.

    A small and smooth step is taken as it is. Otherwise all shifts that bring many markers onto spots are tried: on a
    regular grid a step of 0.6 pitches looks like one of 0.4 the other way. The right one keeps the small irregularities
    of the print, so that neighbours move alike. A step of less than a quarter pitch is believed unless another does
    clearly better; of larger ones, and after a jump, the best is believed only where no other does nearly as well.

    Parameters
    ----------
    origins
        Places from which the markers may have come, the likeliest first; no NaN.
    found_px
        Spots of the frame.
    neighbours
        Of the markers at rest.
    frame_size
        Height and width, in pixels.
    usual
        What steps have looked like.
    lost
        Whether nothing was said of the frame before: then no step counts as small.
    """
    step = _pair(origins[0], np.zeros(2), found_px, neighbours=neighbours, frame_size=frame_size)
    if not lost and _is_calm(step, neighbours, usual):
        return step
    pitch = float(np.median(neighbours.pitch_px))
    rivals: list[Pairing] = []
    for origin in origins:
        for shift in (np.zeros(2), *likely_shifts(origin, found_px, pitch_px=pitch)):
            pairing = _pair(origin, shift, found_px, neighbours=neighbours, frame_size=frame_size)
            if pairing.support >= _LEAST_SUPPORT and pairing.paired.sum() >= _LEAST_SHARE * len(origin):
                rivals.append(pairing)
    if not lost and _is_small(step, neighbours) and not any(_beats(other, step) for other in rivals):
        return step
    if not rivals:
        return None
    best = max(rivals, key=lambda one: one.paired.sum() * one.support / (one.spread_px + 0.1))
    return None if any(_rules_out(other, best) for other in rivals) else best


def _is_small(step: Pairing, neighbours: Neighbours) -> bool:
    """Whether a pattern moved so little, most of it seen, that it is believed unless something speaks against it."""
    moved = np.linalg.norm(step.step_px, axis=1) / neighbours.pitch_px
    return bool(step.paired.any()) and step.support >= _SMALL_SUPPORT and float(np.nanmedian(moved)) < _SMALL_STEP


def _beats(other: Pairing, small: Pairing) -> bool:
    """Whether a jump explains a frame clearly better: all moves alike, or a row more finds its place."""
    smoother = _RIVAL_SPREAD * other.spread_px + 0.02 < small.spread_px
    fuller = (
        other.paired.sum() > 1.04 * small.paired.sum()
        and other.support > small.support + 0.04
        and other.spread_px < min(1.2 * small.spread_px + 0.02, _CLEAN_PX)
    )
    return bool((smoother and other.paired.sum() >= _RIVAL_SUPPORT * small.paired.sum()) or fuller)


def _rules_out(other: Pairing, best: Pairing) -> bool:
    """Whether another pairing does nearly as well as the best, so that neither can be believed."""
    both = other.paired & best.paired
    different = not both.any() or np.mean(other.spot[both] != best.spot[both]) > 0.5
    strong = other.paired.sum() >= _RIVAL_SUPPORT * best.paired.sum()
    return bool(different and strong and other.spread_px < _RIVAL_SPREAD * best.spread_px + 0.02)


def _is_calm(step: Pairing, neighbours: Neighbours, usual: Usual) -> bool:
    moved = np.linalg.norm(step.step_px, axis=1) / neighbours.pitch_px
    if not step.paired.any() or np.nanmedian(moved) > _CALM_STEP:
        return False
    # the first step has nothing to be compared with
    spread = usual.spread_px if np.isfinite(usual.spread_px) else 0.02 * float(np.median(neighbours.pitch_px))
    return step.spread_px <= max(_CALM_SPREAD * spread, _LEAST_SPREAD_PX) and (
        step.support >= _CALM_SUPPORT * usual.support
    )


def _pair(
    origin_px: Float[np.ndarray, "markers 2"],
    shift_px: Float[np.ndarray, "2"],
    found_px: Float[np.ndarray, "spots 2"],
    *,
    neighbours: Neighbours,
    frame_size: tuple[int, int],
) -> Pairing:
    """Pair after a shift of all, then once more after the steps that neighbours made."""
    predicted = origin_px + shift_px
    pairing = pair(
        predicted, found_px, from_px=origin_px, neighbours=neighbours, expected=_in_view(predicted, frame_size)
    )
    told = predict_from_neighbours(neighbours, pairing.step_px, pairing.paired)
    refined = np.where(np.isfinite(told), origin_px + told, predicted)
    return pair(refined, found_px, from_px=origin_px, neighbours=neighbours, expected=_in_view(refined, frame_size))


def _in_view(place_px: Float[np.ndarray, "markers 2"], size: tuple[int, int]) -> Bool[np.ndarray, " markers"]:
    return np.all((place_px >= 0) & (place_px <= np.array([size[1] - 1, size[0] - 1])), axis=1)
