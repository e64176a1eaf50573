"""Public call that scores explanations, and its two stages: removal, and the thesis's deletion."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal, TypeAlias, Unpack

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import nn

from sliplens.codec import load_result
from sliplens.errors import InputError, SaliencyError
from sliplens.explainers.explain import network_inputs, network_references
from sliplens.explainers.occlusion import tile_regions
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import AREAS, RANDOM_ORDERS, Units, answer_whole, score_maps
from sliplens.faithfulness.scoring import (
    SettingCurves,
    delete_pixels,
    deletion_orders,
    deletion_steps,
    explanation_of_maps,
    influences,
    prepare_passes,
    require_same_network,
    score_curves,
    score_deletion,
)
from sliplens.models import Network
from sliplens.models.wrapping import open_run
from sliplens.progress import open_stage, report_each, reporting
from sliplens.results.explanation import Explanation, load_explanation
from sliplens.results.faithfulness import Deletion, DeletionScores, Faithfulness, RemovalCurve
from sliplens.results.study import SETTINGS, Setting
from sliplens.runner import Part
from sliplens.study.choice import trial_seed
from sliplens.study.explaining import Running
from sliplens.study.stages import MakeRecord, Stage, TrialArrays, join_trials, keep_record, trial_parts

STEPS = 28
"""An eighth of the thesis's 224: the mean over the steps differs from that over all of them by less than a step."""
STUDY_AREAS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Fewer shares than `AREAS`, so that many settings can be scored: enough for trapezoids."""
_TILES_ACROSS = 14
Influence: TypeAlias = Mapping[str, Float[np.ndarray, "images height width"]]
"""Maps that rank parts, of each method and control."""
Scoring: TypeAlias = Callable[[Explanation, Influence, int], Mapping[str, RemovalCurve]]
"""Function from explained frames, their maps and a seed to their curves."""


def score(
    run: Network | nn.Module | Path | str,
    frames: UInt8[np.ndarray, "images height width 3"] | Explanation | Path | str,
    maps: Explanation | Float[np.ndarray, "maps rows columns"] | None = None,
    *,
    reference: UInt8[np.ndarray, "height width 3"] | None = None,
    signed: bool = True,
    fill: str = "reference",
    unit: Literal["pixel", "tile"] = "pixel",
    random_orders: int = RANDOM_ORDERS,
    steps: int = STEPS,
    seed: int = 0,
    out: Path | str | None = None,
    **running: Unpack[Running],
) -> Faithfulness:
    """Score maps by removing what they call influential first, and last, against random orders and controls.

    The score is the symmetric gain, in margin units: how much further the prediction moves towards that of the
    baseline with the most influential parts removed first rather than the least. Maps that gain no more than
    the controls, which use nothing the network learned, show nothing. Every frame counts; an alarm names how many are
    predicted nearly like the baseline, which a study leaves out (`worth_scoring`). The record also holds the
    deletion score of the thesis, under its grey fill, to compare with published figures (docs/deletion.md).

    Parameters
    ----------
    run
        The network that was explained, its folder, the name of one that comes with sliplens, or the PyTorch module.
    frames, reference
        Explanation, or the folder of one, which holds its frames; or the frames and the reference of `explain`.
    maps
        Explanation of the frames; or an array (frames, size, size) of one number a pixel of the network's input, by
        another tool. None where `frames` is an explanation.
    signed
        Meaning of an array. If True, above zero where a pixel raises the prediction, as `Explanation.relevance` and the
        attributions of Captum, summed over the colours. Pixels then rank by sign(f(x) - f(reference)) times the map,
        as those of an `Explanation` do. If False, larger where a pixel matters more, whichever way the prediction went,
        as a saliency in [0, 1].
    fill
        Content of removed pixels, a row of `FILLS`; `reference`, the baseline of the explanation, is one that networks
        know.
    unit
        What is removed at once: pixels, or square tiles of a fourteenth of the image.
    random_orders
        Number of random orders.
    steps
        Steps of the deletion score until every pixel is removed; 224 as in the thesis, 0 to leave it out.
    seed
        Seed of the random orders.
    out
        Folder to write; nothing is written if None. An interrupted call continues after the last trial.
    running
        Options of `Running`.

    Raises
    ------
    InputError
        If there is no such fill, the network needs a reference, or the folder to write holds something else.
    CheckpointError
        If the explanation is of another network.
    SaliencyError
        If there is not a map a frame, or one has another size than the network's input, or holds NaN; or if a signed
        array has no number below zero for a frame whose prediction fell.
    PartError
        If some of several trials failed three times, when all others are done.

    See Also
    --------
    explain : Make maps.
    run_study : Compare methods on a data set.

    Examples
    --------
    >>> import sliplens as sl
    >>> maps = sl.explain("chromatouch-pair", frames, reference=untouched)  # doctest: +SKIP
    >>> score = sl.score("chromatouch-pair", maps).scores[0]  # doctest: +SKIP
    >>> score.method, round(score.srg.estimate, 2), score.lead_over_controls.control  # doctest: +SKIP
    ('shapley-marker', 0.81, 'change')
    """
    get_fill(fill)
    if random_orders < 1:
        raise InputError(f"{random_orders} random orders are too few; --random-orders must be at least 1")
    network = open_run(run, device=running.get("device", "cpu"), preprocess=running.get("preprocess"))
    explanation = _to_score(network, frames, maps, reference, signed=signed)
    require_same_network(network, explanation)
    shape = (explanation.image_size, explanation.image_size)
    units = tile_regions(shape, tile_px=1 if unit == "pixel" else max(1, shape[0] // _TILES_ACROSS)).numpy()
    removal = Removal(
        trained=network,
        explained=explanation,
        maps=influences(network, explanation),
        units={unit: [units] * len(explanation.frames)},
        settings=(Setting(fill=fill, unit=unit),),
        areas=AREAS,
        random_orders=random_orders,
        seed=seed,
    )
    stages: list[Stage] = [removal]
    if steps:
        stages.append(PixelDeletion(trained=network, explained=explanation, steps=steps, seed=seed))

    def make(folder: Path | None) -> Faithfulness:
        results = []
        for stage in stages:
            with open_stage(stage.title):
                parts = folder and folder / type(stage).__name__
                results.append(stage.make(parts, on=running.get("on", "serial")))
        faithfulness, *deletions = results
        for scores in deletions:
            deletion = Deletion(**{field.name: getattr(scores, field.name) for field in fields(Deletion)})
            faithfulness = replace(faithfulness, deletion=deletion, deletion_table=scores.table)
        return faithfulness

    with reporting(running.get("on_progress")):
        if out is None:
            return make(None)
        hashes = hashlib.sha256()
        for values in explanation.relevance.values():
            hashes.update(values.tobytes())
        config = {"weights_sha256": network.manifest.weights_sha256, "maps_sha256": hashes.hexdigest()}
        config |= {"input": explanation.input, "source": explanation.source, "seed": seed, "steps": steps}
        config |= {"fill": fill, "unit": unit, "random_orders": random_orders}
        overwrite = running.get("overwrite", False)
        what = "curves and scores"
        keep_record(Path(out), make, stage="faithfulness", config=config, what=what, overwrite=overwrite)
    return load_result(Path(out), Faithfulness, command="sliplens score")


def _to_score(
    network: Network,
    frames: np.ndarray | Explanation | Path | str,
    maps: Explanation | np.ndarray | None,
    reference: np.ndarray | None,
    *,
    signed: bool,
) -> Explanation:
    if isinstance(frames, Explanation):
        return frames
    if isinstance(frames, str | Path):
        return load_explanation(Path(frames))
    if maps is None:
        raise InputError("the frames have no maps to score; give an explanation of them, or an array of maps")
    if isinstance(maps, np.ndarray):
        return explanation_of_maps(network, frames, maps, reference, signed=signed)
    if len(maps.frames) != len(frames):
        raise SaliencyError(
            f"there are {len(maps.frames)} maps of {len(frames)} frames; explain the frames that are scored"
        )
    return maps


@dataclass(frozen=True, kw_only=True)
class Removal(Stage[Faithfulness]):
    """Removal of parts in the order of every map, under each setting; a part is a setting and a trial.

    Curves that are computed in another way, such as by drawing the scene anew (`further`), are scored with the others.
    """

    record = SettingCurves
    title = "Removing parts"

    trained: Network
    explained: Explanation
    maps: Influence
    """Maps of the methods and controls (`influences`)."""
    units: Mapping[str, Sequence[Units]]
    """Units of each frame by name; settings of others are left out."""
    settings: Sequence[Setting] = SETTINGS
    areas: Sequence[float] = STUDY_AREAS
    random_orders: int = RANDOM_ORDERS
    further: Mapping[Setting, Scoring] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        for setting in self.settings:
            get_fill(setting.fill)

    @property
    def _all_settings(self) -> list[Setting]:
        return [*(setting for setting in self.settings if setting.unit in self.units), *self.further]

    def parts(self) -> Iterator[Part]:
        """Yield all trials under the first setting, then under the next."""
        for setting in self._all_settings:
            yield from trial_parts(self.explained, setting.fill, setting.unit)

    def prepare(self) -> MakeRecord:
        """Return the function that computes the curves of a trial under one setting."""
        inputs, orders = network_inputs(self.trained, self.explained), 2 * len(self.maps) + self.random_orders
        references = network_references(self.trained, self.explained)
        passes = (len(self._all_settings) - len(self.further)) * len(inputs) * orders * (len(self.areas) - 2)
        predict, trials = prepare_passes(self.trained, inputs, passes), list(self.explained.trials)

        def remove_parts(item: tuple[str, str, str]) -> SettingCurves:
            fill, unit, trial = item
            setting, rows = Setting(fill=fill, unit=unit), self.explained.trials[trial]
            part, maps = self.explained.take(rows), {name: values[rows] for name, values in self.maps.items()}
            images, empty, seed = inputs[rows], references[rows], trial_seed(self.seed, trials.index(trial))
            if setting in self.further:
                curves, blank = self.further[setting](part, maps, seed), np.full(len(rows), np.nan)
            else:
                paint = get_fill(fill)(images, empty, seed)
                gone = torch.ones((len(images), *images.shape[-2:]), dtype=torch.bool, device=images.device)
                batches = torch.arange(len(images), device=images.device).split(16)
                blank = answer_whole(predict, torch.cat([paint(batch, gone[batch]) for batch in batches]))
                curves = score_maps(
                    predict,
                    images,
                    maps,
                    [self.units[unit][row] for row in rows],
                    fill=get_fill(fill),
                    references=empty,
                    towards=part.towards,
                    # the same random orders under every fill
                    rng=np.random.default_rng(seed),
                    random_orders=self.random_orders,
                    areas=self.areas,
                    seed=seed,
                )
            return SettingCurves(
                areas=next(iter(curves.values())).areas,
                curves={
                    name: np.stack([curve.most_first, curve.least_first, curve.random])
                    for name, curve in curves.items()
                },
                whole=answer_whole(predict, images),
                blank=blank,
            )

        return remove_parts

    def join(self, records: Sequence[SettingCurves]) -> Faithfulness:
        """Score all curves."""
        count = len(self.explained.trials)
        curves = {}
        for at, setting in enumerate(self._all_settings):
            parts = records[at * count : (at + 1) * count]
            answers = [{"whole": part.whole, "blank": part.blank} for part in parts]
            curves[setting] = SettingCurves(
                areas=parts[0].areas,
                curves=join_trials(self.explained, [part.curves for part in parts], axis=1),
                **join_trials(self.explained, answers),
            )
        return score_curves(self.explained, curves, random_orders=self.random_orders, seed=self.seed)


@dataclass(frozen=True, kw_only=True)
class PixelDeletion(Stage[DeletionScores]):
    """Deletion of the most salient pixels by every method and in a random order; a part is a trial."""

    record = TrialArrays
    title = "Deleting pixels, as the thesis did"

    trained: Network
    explained: Explanation
    fill: str = "grey"
    steps: int | None = None
    """The image's height if None."""
    seed: int = 0

    def parts(self) -> Iterator[Part]:
        """Yield the trials, whose maps are counted with a random one."""
        return trial_parts(self.explained, maps=len(self.explained.relevance) + 1)

    def prepare(self) -> MakeRecord:
        """Return the function that deletes the pixels of the frames of a trial."""
        inputs, orders = network_inputs(self.trained, self.explained), deletion_orders(self.explained, seed=self.seed)
        removed = deletion_steps((self.explained.image_size, self.explained.image_size), steps=self.steps)
        predict = prepare_passes(self.trained, inputs, len(orders) * len(inputs) * len(removed))

        def delete(item: tuple[str]) -> TrialArrays:
            rows = self.explained.trials[item[-1]]
            answers = {
                name: delete_pixels(predict, inputs[rows], orders[name][rows], fill=self.fill, steps=self.steps)
                for name in report_each(list(orders), sizes=[len(rows)] * len(orders))
            }
            return TrialArrays(arrays=answers)

        return delete

    def join(self, records: Sequence[TrialArrays]) -> DeletionScores:
        """Score all curves."""
        answers = join_trials(self.explained, [record.arrays for record in records])
        return score_deletion(self.explained, answers, fill=self.fill)
