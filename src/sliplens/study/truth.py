"""Explanations held against the truth that only a simulator knows: what each marker does when it is put back."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sliplens.faithfulness import get_fill
from sliplens.faithfulness.removal import RANDOM_ORDERS, Faithfulness
from sliplens.faithfulness.true_fill import SHARES, marker_faithfulness
from sliplens.models import TrainedModel
from sliplens.provenance import write_json
from sliplens.recordings import Dataset
from sliplens.simulation import SimulationRecipe
from sliplens.study.material import make_fast
from sliplens.study.saved import RESULT_FILE, Explained, mean_of_known
from sliplens.study.scoring import require_same_network
from sliplens.study.truth_effects import (
    DEGRADED,
    EFFECTS,
    ORACLE,
    MarkerEffects,
    find_effects,
    load_effects,
    save_effects,
    write_effects,
)
from sliplens.study.truth_measures import (
    Maps,
    agreements,
    covered_shares,
    edges_over_chance,
    localisation,
    marker_means,
    mean_interval,
    meta_test,
    rank_correlation,
    tell,
)
from sliplens.study.truth_scenes import Places, StagedFrame, find_places, redrawing, stage_frames

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
        on_image=on_frame,
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
