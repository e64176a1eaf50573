"""Explanations held against the truth that only a simulator knows: what each marker does when it is put back."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float
from scipy.stats import spearmanr
from torch import Tensor

from sliplens.faithfulness import get_fill
from sliplens.faithfulness.localisation import relevance_mass, relevance_rank
from sliplens.faithfulness.removal import (
    RANDOM_ORDERS,
    Faithfulness,
    Predict,
    RemovalCurves,
    answer_whole,
    removal_curves,
)
from sliplens.faithfulness.true_fill import SHARES, Redraw, influence_orders, marker_curves, marker_faithfulness
from sliplens.faithfulness.units import unit_means, unit_order
from sliplens.files import write_json
from sliplens.intervals import paired_difference
from sliplens.models import TrainedModel
from sliplens.recordings import Dataset
from sliplens.simulation import SimulationRecipe
from sliplens.simulation.intervention import marker_readings
from sliplens.study.explaining import MAPS_FILE, RESULT_FILE, Explained, mean_of_known
from sliplens.study.material import make_fast
from sliplens.study.scenes import Places, StagedFrame, find_places, redrawing, stage_frames
from sliplens.study.scoring import require_same_network

TRUE_FILL = "true"
EFFECTS_FILE = "effects.parquet"
EFFECTS = ("network", "margin")
"""What putting a marker back changes."""
ORACLE, DEGRADED = "oracle", "degraded-oracle"


@dataclass(frozen=True, kw_only=True)
class MarkerEffects:
    """What each marker of a frame does, in margin units: the value as it is less the value with the marker put back.

    Attributes
    ----------
    network
        Of the network's answer.
    margin
        Of the margin as the best reader of markers reads it (`simulation.best_reading`).
    shuffled
        The network's, those of half of the markers shuffled: an oracle that is half wrong.
    gains
        Symmetric gain, under each fill, of the map that has `network` and of the one that has `shuffled`: a row for
        changes by their size, as `Faithfulness` has them, and one for changes counted towards the target.
    """

    network: Float[np.ndarray, " markers"]
    margin: Float[np.ndarray, " markers"]
    shuffled: Float[np.ndarray, " markers"]
    gains: Mapping[str, Float[np.ndarray, "2 2"]]


def network_effects(predict: Predict, redraw: Redraw, image: int, *, markers: int) -> Float[np.ndarray, " markers"]:
    """What the network's answer loses when each marker alone is put back, in margin units.

    Parameters
    ----------
    predict, redraw
        The network, and what draws the image.
    image, markers
        Number of the image, and of the markers in it.
    """
    # the whole image first
    back = np.eye(markers + 1, markers, k=-1, dtype=bool)
    answers = answer_whole(predict, redraw(image, back), batch_size=64)
    return answers[0] - answers[1:]


def shuffle_half(values: Float[np.ndarray, " markers"], *, rng: np.random.Generator) -> Float[np.ndarray, " markers"]:
    """Shuffle the values of half of the markers among themselves."""
    chosen = rng.permutation(len(values))[: len(values) // 2]
    shuffled = values.copy()
    shuffled[chosen] = values[rng.permutation(chosen)]
    return shuffled


def find_effects(
    predict: Predict,
    redraw: Redraw,
    image: int,
    frame: StagedFrame,
    places: Places,
    *,
    inputs: Float[Tensor, "1 3 size size"],
    references: Float[Tensor, "1 3 size size"],
    towards: float,
    fills: Sequence[str],
    rng: np.random.Generator,
) -> MarkerEffects:
    """Put every marker of a frame back, and see which fills can tell a map that knows its effects from half of one.

    Parameters
    ----------
    predict, redraw
        The network, and what draws the image.
    image
        Number of the frame, as `redraw` takes it.
    frame, places
        The frame, and where its markers are.
    inputs, references
        The frame as the network gets it, and the untouched sensor.
    towards
        Sign of the answer's change from the untouched sensor: what works towards it goes first.
    fills
        Names of fills; the true one is always there.
    rng
        Source of the shuffling.
    """
    network = network_effects(predict, redraw, image, markers=len(frame.markers))
    shuffled = shuffle_half(network, rng=rng)
    known = [towards * network, towards * shuffled]
    orders = [
        unit_order(places.paint(one), places.units, least_first=least) for one in known for least in (False, True)
    ]
    curves = {
        name: removal_curves(
            predict,
            inputs,
            np.stack(orders)[:, None],
            fill=get_fill(name),
            references=references,
            areas=SHARES,
        )
        for name in fills
    }
    curves[TRUE_FILL] = marker_curves(
        predict, lambda _, back: redraw(image, back), np.concatenate([influence_orders(one[None]) for one in known])
    )
    return MarkerEffects(
        network=network,
        margin=marker_readings(frame.scene, frame.number)[1],
        shuffled=shuffled,
        gains={name: _gains(found, towards) for name, found in curves.items()},
    )


def _gains(curves: RemovalCurves, towards: float) -> Float[np.ndarray, "2 2"]:
    """Symmetric gains of two maps, each removed both ways, by the size of the changes and by their part `towards`."""
    means = np.empty((2, len(curves.answers)))
    means[0] = curves.mean_changes[:, 0]
    means[1] = np.trapezoid(towards * (curves.answers[:, 0, :1] - curves.answers[:, 0]), curves.areas, axis=-1)
    return means[:, ::2] - means[:, 1::2]


def save_effects(path: Path, effects: MarkerEffects) -> None:
    """Write the effects of a frame, beside the target first."""
    hidden = path.with_suffix(".part.npz")
    np.savez(
        hidden,
        allow_pickle=False,
        network=effects.network,
        margin=effects.margin,
        shuffled=effects.shuffled,
        fills=np.array(list(effects.gains), dtype=np.str_),
        gains=np.stack(list(effects.gains.values())),
    )
    hidden.replace(path)


def load_effects(path: Path) -> MarkerEffects:
    """Read what `save_effects` wrote."""
    with np.load(path, allow_pickle=False) as archive:
        return MarkerEffects(
            network=archive["network"],
            margin=archive["margin"],
            shuffled=archive["shuffled"],
            gains=dict(zip(archive["fills"].tolist(), archive["gains"], strict=True)),
        )


def write_effects(
    folder: Path, frames: Sequence[StagedFrame], places: Sequence[Places], effects: Sequence[MarkerEffects]
) -> None:
    """Write the effects of all frames as a table, and painted on the markers."""
    tables = [
        pa.table(
            {
                "frame_id": [frame.id] * len(frame.markers),
                "trial": [frame.trial] * len(frame.markers),
                "safety_margin": np.full(len(frame.markers), frame.safety_margin),
                "marker": frame.markers.astype(np.int64),
                "x_px": one.now_px[:, 0],
                "y_px": one.now_px[:, 1],
                "network_effect": found.network,
                "margin_effect": found.margin,
                "state": one.state,
            }
        )
        for frame, one, found in zip(frames, places, effects, strict=True)
    ]
    pq.write_table(pa.concat_tables(tables), folder / EFFECTS_FILE)
    maps = {
        effect: np.stack([one.paint(getattr(found, effect)) for one, found in zip(places, effects, strict=True)])
        for effect in EFFECTS
    }
    np.savez_compressed(
        folder / MAPS_FILE, allow_pickle=False, **{name: values.astype(np.float32) for name, values in maps.items()}
    )


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


RANDOM = "random"
"""A map of even noise."""
TRUTH_FILLS = ("reference", "grey", "background", "blur")
"""Fills that the oracle is tried under; the true one always is. The noisy-linear one takes longer than all of them."""


def judge_by_truth(
    trained: TrainedModel,
    explained: Explained,
    data: Dataset,
    folder: Path,
    *,
    maps: Mapping[str, Maps],
    fills: Sequence[str] = TRUTH_FILLS,
    recipe: SimulationRecipe | None = None,
    seed: int = 0,
    on_frame: Callable[[int, int], None] | None = None,
) -> None:
    """Put every marker of every frame back, and hold maps against what that does.

    What is found of a frame is written under `parts` as soon as it is there; a second call with the same folder goes on
    after the last.

    A map's mass and rank are those of its positive part, what works towards the answer: a share of a sum needs one
    sign. Marker by marker it is the size of a map's mean that is compared with the size of the effect: a marker that
    works against the answer matters as much as one that works for it, and maps that know no sign can be compared too.

    Parameters
    ----------
    trained, explained
        The network, and the explanations of the frames to judge.
    data
        The simulated data set that they are from.
    folder
        Gets `effects.parquet`, `maps.npz` and `result.json`; must exist.
    maps
        Influence by method, controls included: signed relevance times the sign of the answer's change from the
        untouched sensor.
    fills
        Names of the fills under which a map that knows the effects is held against one that knows half of them.
    recipe
        What simulated the data set; read from its folder if None.
    seed
        Of the random map, the shuffling and the resampling.
    on_frame
        Called with the number of frames done and the number of all.

    Raises
    ------
    CheckpointError
        If the explanations are of another network.
    InputError
        If the data are not simulated or not those that were explained, cannot be drawn as they are stored, or a fill is
        unknown.
    ContactError
        If a frame has no contact.
    """
    for fill in fills:
        get_fill(fill)
    frames, places = _stage(trained, explained, data, recipe=recipe)
    effects = _all_effects(
        trained, explained, frames, places, folder / "parts", fills=fills, seed=seed, on_frame=on_frame
    )
    towards, size = _towards(explained), trained.manifest.image_size
    judged = dict(maps) | {
        RANDOM: np.random.default_rng(seed).random((len(frames), size, size)),
        ORACLE: _paint(places, [sign * found.network for sign, found in zip(towards, effects, strict=True)]),
        DEGRADED: _paint(places, [sign * found.shuffled for sign, found in zip(towards, effects, strict=True)]),
    }
    trials = np.array([frame.trial for frame in frames])
    agreement = {name: agreements(values, places, effects) for name, values in judged.items()}
    own = np.array([rank_correlation(found.network, found.margin) for found in effects])
    meta, interval = meta_test(effects, trials, seed=seed), mean_interval(own, trials, seed=seed)
    write_effects(folder, frames, places, effects)
    write_json(
        folder / RESULT_FILE,
        {
            "input": explained.input,
            "source": explained.source,
            "frames": len(frames),
            "areas": covered_shares(places),
            "methods": {
                name: {
                    **localisation(values, places),
                    **{f"spearman_{effect}": mean_of_known(agreement[name][effect]) for effect in EFFECTS},
                }
                for name, values in judged.items()
            },
            "intervals": {
                name: {
                    **{f"spearman_{effect}": mean_interval(found[effect], trials, seed=seed) for effect in EFFECTS},
                    "edges_over_chance": mean_interval(edges_over_chance(judged[name], places), trials, seed=seed),
                }
                for name, found in agreement.items()
            },
            "network_against_margin": interval,
            "meta": meta,
            "told": tell(meta, interval),
        },
    )
    shutil.rmtree(folder / "parts")


def true_curves(
    trained: TrainedModel,
    explained: Explained,
    data: Dataset,
    *,
    maps: Mapping[str, Maps],
    recipe: SimulationRecipe | None = None,
    random_orders: int = RANDOM_ORDERS,
    seed: int = 0,
    on_frame: Callable[[int, int], None] | None = None,
) -> dict[str, Faithfulness]:
    """Removal curves under the true fill: markers put back, most or least influential first, or in random orders.

    Parameters
    ----------
    trained, explained, data, maps, recipe, on_frame
        As `judge_by_truth` takes them.
    random_orders, seed
        How many random orders, and what they are drawn from.

    Raises
    ------
    CheckpointError, InputError
        As `judge_by_truth`.
    """
    frames, places = _stage(trained, explained, data, recipe=recipe)
    inputs = trained.encoding.normalise(explained.images)
    passes = len(frames) * (2 * len(maps) + random_orders) * (len(SHARES) - 2)
    return marker_faithfulness(
        make_fast(trained, inputs, passes=passes),
        redrawing(trained, frames),
        {name: np.stack(marker_means(values, places)) for name, values in maps.items()},
        rng=np.random.default_rng(seed),
        towards=np.array(_towards(explained)),
        random_orders=random_orders,
        on_progress=on_frame,
    )


def _stage(
    trained: TrainedModel, explained: Explained, data: Dataset, *, recipe: SimulationRecipe | None
) -> tuple[tuple[StagedFrame, ...], list[Places]]:
    require_same_network(trained, explained)
    frames = stage_frames(trained, explained, data, recipe=recipe)
    return frames, [find_places(frame, image_size=trained.manifest.image_size) for frame in frames]


def _towards(explained: Explained) -> list[float]:
    return [float(np.sign(frame.prediction - frame.reference_prediction)) for frame in explained.frames]


def _paint(places: Sequence[Places], values: Sequence[Float[np.ndarray, " markers"]]) -> Maps:
    return np.stack([one.paint(some) for one, some in zip(places, values, strict=True)])


def _all_effects(
    trained: TrainedModel,
    explained: Explained,
    frames: Sequence[StagedFrame],
    places: Sequence[Places],
    parts: Path,
    *,
    fills: Sequence[str],
    seed: int,
    on_frame: Callable[[int, int], None] | None,
) -> list[MarkerEffects]:
    parts.mkdir(exist_ok=True)
    inputs, towards = trained.encoding.normalise(explained.images).to(trained.device), _towards(explained)
    files = [parts / f"{index:05d}.npz" for index in range(len(frames))]
    # each marker alone, and under each fill two maps both ways
    passes = sum(not file.is_file() for file in files) * (len(frames[0].markers) + 4 * len(SHARES) * (len(fills) + 1))
    predict = make_fast(trained, inputs, passes=passes)
    redraw = redrawing(trained, frames)
    for index, (file, frame) in enumerate(zip(files, frames, strict=True)):
        if not file.is_file():
            empty = trained.encoding.empty(frame.reference, image_size=trained.manifest.image_size)
            found = find_effects(
                predict,
                redraw,
                index,
                frame,
                places[index],
                inputs=inputs[index : index + 1],
                references=empty[None].to(trained.device),
                towards=towards[index],
                fills=fills,
                # a run that goes on draws the same
                rng=np.random.default_rng((seed, index)),
            )
            save_effects(file, found)
        if on_frame is not None:
            on_frame(index + 1, len(frames))
    return [load_effects(file) for file in files]
