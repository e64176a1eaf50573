"""Public call that scores explanations, and the study's stages: removal, the thesis's deletion score, its remedies."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, Unpack

import numpy as np
from jaxtyping import Float, Float64, UInt8

from sliplens.codec import load_result, save_result
from sliplens.errors import InputError, SaliencyError
from sliplens.explainers.explain import network_inputs
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import AREAS, RANDOM_ORDERS, Units, answer_whole, tile_units
from sliplens.faithfulness.scoring import (
    SettingCurves,
    curves_of_frames,
    delete_pixels,
    deletion_alarms,
    deletion_orders,
    deletion_steps,
    deletion_table,
    deletion_tables,
    explanation_of_maps,
    influences,
    prepare_passes,
    require_same_network,
    score_curves,
    score_deletion,
    score_tables,
    stack_curves,
    with_deletion,
)
from sliplens.files import output_folder, remove
from sliplens.models import Network
from sliplens.models.checkpoint import open_run
from sliplens.progress import OnProgress, ignore, open_stage, report_each, report_file, reporting
from sliplens.results.explanation import Explanation, load_explanation
from sliplens.results.faithfulness import (
    DeletionScores,
    DeletionTable,
    Faithfulness,
    Remedies,
    RemovalCurve,
    Variant,
    VariantTable,
)
from sliplens.results.study import SETTINGS, Setting
from sliplens.runner import Part
from sliplens.study.choice import trial_seed
from sliplens.study.explaining import Running
from sliplens.study.stages import Find, Stage, join_trials, trial_shards

STEPS = 28
"""An eighth of the thesis's 224: the mean over the steps differs from that over all of them by less than a step."""
STUDY_AREAS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Fewer shares than `AREAS`, so that many settings can be scored: the equal areas, and enough for trapezoids."""
_TILES_ACROSS = 14
Influence: TypeAlias = Mapping[str, Float[np.ndarray, "images height width"]]
"""Maps that rank parts, of each method and control."""
Scoring: TypeAlias = Callable[[Explanation, Influence, int], Mapping[str, RemovalCurve]]
"""Function from explained frames, their maps and a seed to their curves."""


def score(
    run: Network | Path | str,
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

    The score is the symmetric gain, in margin units: how much further the prediction moves towards that on the
    untouched sensor with the most influential parts removed first rather than the least. Maps that gain no more than
    the controls, which use nothing the network learned, show nothing. Every frame counts; an alarm names how many are
    predicted nearly like the untouched sensor, which a study leaves out (`worth_scoring`). The record also holds the
    deletion score of the thesis, under its grey fill, to compare with published figures (docs/deletion.md).

    Parameters
    ----------
    run
        The network that was explained, its folder, or the name of one that comes with sliplens.
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
        Content of removed pixels, a row of `FILLS`; `reference`, the untouched sensor, is one that networks know.
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
    """
    get_fill(fill)
    if random_orders < 1:
        raise InputError(f"{random_orders} random orders are too few; --random-orders must be at least 1")
    network = open_run(run, device=running.get("device", "cpu"))
    explanation = _to_score(network, frames, maps, reference, signed=signed)
    require_same_network(network, explanation)
    shape = (explanation.image_size, explanation.image_size)
    units = tile_units(shape, size=1 if unit == "pixel" else max(1, shape[0] // _TILES_ACROSS))
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
    works: dict[str, Stage] = {"removal": removal}
    if steps:
        works["deletion"] = Deletion(trained=network, explained=explanation, steps=steps, seed=seed)
    with reporting(running.get("on_progress")):
        if out is None:
            results = []
            for work in works.values():
                with open_stage(work.title):
                    results.append(compute(work))
            return with_deletion(*results)
        hashes = hashlib.sha256()
        for values in explanation.relevance.values():
            hashes.update(values.tobytes())
        config = {"weights_sha256": network.manifest.weights_sha256, "maps_sha256": hashes.hexdigest()}
        config |= {"input": explanation.input, "source": explanation.source, "seed": seed, "steps": steps}
        config |= {"fill": fill, "unit": unit, "random_orders": random_orders}
        overwrite = running.get("overwrite", False)
        with output_folder(Path(out), stage="faithfulness", config=config, overwrite=overwrite) as output:
            if not output.complete:
                results = []
                for name, work in works.items():
                    with open_stage(work.title):
                        result = work.make(
                            output.folder / "parts" / name,
                            on=running.get("on", "serial"),
                            retry_failed=running.get("retry_failed", False),
                        )
                    results.append(result)
                save_result(with_deletion(*results), output.folder)
                remove(output.folder / "parts")
        report_file(Path(out), "curves and scores", kept=output.complete)
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


def compute(stage: Stage) -> Any:
    """Compute the result of a stage in memory."""
    shards = list(stage.shards())
    find = stage.prepare()
    records = [find(shard.item, ignore) for shard in report_each(shards, sizes=[shard.frames for shard in shards])]
    return stage.join(records)


@dataclass(frozen=True, kw_only=True)
class Removal(Stage[Faithfulness]):
    """Removal of parts in the order of every map, under each setting; a part is a setting and a trial.

    Curves that are computed in another way, such as by drawing the scene anew (`further`), are scored with the others.
    """

    piece = SettingCurves
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
    def _available(self) -> list[Setting]:
        return [setting for setting in self.settings if setting.unit in self.units]

    def shards(self) -> Iterator[Part]:
        """Yield all trials under the first setting, then under the next."""
        for setting in (*self._available, *self.further):
            yield from trial_shards(self.explained, setting.fill, setting.unit)

    def prepare(self) -> Find:
        """Return the function that computes the curves of a trial under one setting."""
        inputs, orders = network_inputs(self.trained, self.explained), 2 * len(self.maps) + self.random_orders
        passes = len(self._available) * len(inputs) * orders * (len(self.areas) - 2)
        predict, trials = prepare_passes(self.trained, inputs, passes), list(self.explained.trials)

        def remove_parts(item: tuple[str, str, str], _: OnProgress) -> SettingCurves:
            fill, unit, trial = item
            setting, rows = Setting(fill=fill, unit=unit), self.explained.trials[trial]
            part, maps = self.explained.take(rows), {name: values[rows] for name, values in self.maps.items()}
            seed = trial_seed(self.seed, trials.index(trial))
            if setting not in self.further:
                return curves_of_frames(
                    predict,
                    self.trained,
                    part,
                    maps,
                    [self.units[unit][row] for row in rows],
                    fill=fill,
                    areas=self.areas,
                    random_orders=self.random_orders,
                    seed=seed,
                )
            curves = self.further[setting](part, maps, seed)
            return SettingCurves(
                areas=next(iter(curves.values())).areas,
                curves=stack_curves(curves),
                whole=answer_whole(predict, network_inputs(self.trained, part)),
                blank=np.full(len(rows), np.nan),
            )

        return remove_parts

    def join(self, pieces: Sequence[SettingCurves]) -> Faithfulness:
        """Score all curves."""
        count = len(self.explained.trials)
        curves = {}
        for at, setting in enumerate((*self._available, *self.further)):
            parts = pieces[at * count : (at + 1) * count]
            answers = [{"whole": part.whole, "blank": part.blank} for part in parts]
            curves[setting] = SettingCurves(
                areas=parts[0].areas,
                curves=join_trials(self.explained, [part.curves for part in parts], axis=1),
                **join_trials(self.explained, answers),
            )
        return score_curves(self.explained, curves, random_orders=self.random_orders, seed=self.seed)


Answers: TypeAlias = dict[str, Float64[np.ndarray, "frames answers"]]
"""Predictions of frames while pixels are removed, by the order of removal; the first of the whole frames."""


@dataclass(frozen=True, kw_only=True)
class TrialAnswers:
    """Predictions of the frames of a trial while pixels are removed."""

    answers: dict[str, Float64[np.ndarray, "frames answers"]]


@dataclass(frozen=True, kw_only=True)
class Deletion(Stage[DeletionScores]):
    """Deletion of the most salient pixels by every method and in a random order; a part is a trial."""

    piece = TrialAnswers
    title = "Deleting pixels, as the thesis did"

    trained: Network
    explained: Explanation
    fill: str = "grey"
    steps: int | None = None
    """The image's height if None."""
    seed: int = 0

    def shards(self) -> Iterator[Part]:
        """Yield the trials, whose maps are counted with a random one."""
        return trial_shards(self.explained, maps=len(self.explained.relevance) + 1)

    def prepare(self) -> Find:
        """Return the function that deletes the pixels of the frames of a trial."""
        inputs, orders = network_inputs(self.trained, self.explained), deletion_orders(self.explained, seed=self.seed)
        removed = deletion_steps((self.explained.image_size, self.explained.image_size), steps=self.steps)
        predict = prepare_passes(self.trained, inputs, len(orders) * len(inputs) * len(removed))

        def delete(item: tuple[str], _: OnProgress) -> TrialAnswers:
            rows = self.explained.trials[item[-1]]
            part = {name: order[rows] for name, order in orders.items()}
            answers = {
                name: delete_pixels(predict, inputs[rows], order, fill=self.fill, steps=self.steps)
                for name, order in report_each(list(part.items()), sizes=[len(rows)] * len(part))
            }
            return TrialAnswers(answers=answers)

        return delete

    def join(self, pieces: Sequence[TrialAnswers]) -> DeletionScores:
        """Score all curves."""
        answers = join_trials(self.explained, [piece.answers for piece in pieces])
        return score_deletion(self.explained, answers, fill=self.fill)


@dataclass(frozen=True, kw_only=True)
class RemedyAnswers:
    """Predictions of the frames of a trial while pixels become background, and while the least salient become grey."""

    background: dict[str, Float64[np.ndarray, "frames answers"]]
    insertion: dict[str, Float64[np.ndarray, "frames answers"]]


BACKGROUND = {"difference": "black", "raw": "white"}
"""Background that the thesis proposes for its two inputs."""
_STOP = 0.5


@dataclass(frozen=True, kw_only=True)
class RemedialDeletion(Stage[Remedies]):
    """Deletion that stops at half of the saliency, deletion to the background, and insertion; a part is a trial.

    Stopping early needs no pass: it reuses `grey`, the same frames scored by deletion to grey.

    Polak, discussion of the faithfulness curves: stop once all pixels with saliency above 0.5 are gone; another fill.
    """

    piece = RemedyAnswers
    title = "Trying the thesis's remedies"

    trained: Network
    explained: Explanation
    grey: DeletionScores
    steps: int = STEPS
    seed: int = 0

    def shards(self) -> Iterator[Part]:
        """Yield the trials, whose maps are counted twice, and with a random one."""
        return trial_shards(self.explained, maps=2 * (len(self.explained.relevance) + 1))

    @property
    def _background(self) -> str:
        return BACKGROUND.get(self.explained.input, "background")

    def prepare(self) -> Find:
        """Return the function that deletes the pixels of the frames of a trial both ways."""
        inputs, orders = network_inputs(self.trained, self.explained), deletion_orders(self.explained, seed=self.seed)
        predict = prepare_passes(self.trained, inputs, 2 * len(orders) * len(inputs) * self.steps)

        def delete(item: tuple[str], _: OnProgress) -> RemedyAnswers:
            rows = self.explained.trials[item[-1]]
            delete_rows = partial(delete_pixels, predict, inputs[rows], steps=self.steps)
            # inserting k pixels of an order is deleting all the others
            jobs = [(name, order[rows], self._background) for name, order in orders.items()]
            jobs += [(name, order[rows][:, ::-1].copy(), "grey") for name, order in orders.items()]
            tracked = report_each(jobs, sizes=[len(rows)] * len(jobs))
            answers = [(name, delete_rows(order, fill=fill)) for name, order, fill in tracked]
            return RemedyAnswers(background=dict(answers[: len(orders)]), insertion=dict(answers[len(orders) :]))

        return delete

    def join(self, pieces: Sequence[RemedyAnswers]) -> Remedies:
        """Score all remedies."""
        explained, background = self.explained, self._background
        removed = deletion_steps((explained.image_size, explained.image_size), steps=self.steps)
        deleted, inserted = (
            {name: deletion_tables(name, removed, values, explained) for name, values in joined.items()}
            for joined in (
                join_trials(explained, [piece.background for piece in pieces]),
                join_trials(explained, [piece.insertion for piece in pieces]),
            )
        )
        curves = {
            "stop-at-half": _stopped(self.grey, explained),
            "background": deleted,
            "insertion": {name: _inserted(tables, explained) for name, tables in inserted.items()},
        }
        scores = {
            name: {method: score_tables(tables) for method, tables in by_method.items()}
            for name, by_method in curves.items()
        }
        variants = {
            "stop-at-half": Variant(
                summary="Grey fill; ends once every pixel with a saliency above 0.5 is gone, so that frames and "
                "methods end at different areas. Random orders end at the median area of the methods.",
                fill="grey",
                mode="deletion",
                stop=_STOP,
                better="lower",
                methods=scores["stop-at-half"],
            ),
            "background": Variant(
                summary=f"Removed pixels become {background}, and all of them go.",
                fill=background,
                mode="deletion",
                stop=None,
                better="lower",
                methods=scores["background"],
            ),
            "insertion": Variant(
                summary="From an image of nothing but grey, the most salient pixels come first; D against the answer "
                "on the whole image, so that a faithful map rises early.",
                fill="grey",
                mode="insertion",
                stop=None,
                better="higher",
                methods=scores["insertion"],
            ),
        }
        tables = [
            VariantTable(variant=np.repeat(name, len(table)), **vars(table))
            for name, by_method in curves.items()
            for of_method in by_method.values()
            for table in of_method
        ]
        return Remedies(
            input=explained.input,
            source=explained.source,
            steps=self.steps,
            variants=variants,
            alarms=tuple(
                f"{name}: {alarm}" for name in ("stop-at-half", "background") for alarm in deletion_alarms(curves[name])
            ),
            table=VariantTable.joined(tables),
        )


def _stopped(grey: DeletionScores, explained: Explanation) -> dict[str, list[DeletionTable]]:
    """Cut each curve after the step at which all pixels above the threshold are gone, the first step at least."""
    counts = {name: (maps > _STOP).sum(axis=(1, 2)) for name, maps in explained.saliency.items()}
    median = np.median(np.stack(list(counts.values())), axis=0)
    stopped = {}
    for name, curve in grey.curves.items():
        stopped[name] = []
        for frame, pixels in zip(explained.frames, counts.get(name, median), strict=True):
            answers = curve.predictions[curve.frame_ids.index(frame.id)]
            end = int(np.searchsorted(curve.pixels_removed, int(pixels))) + 1
            removed = curve.pixels_removed[:end]
            stopped[name].append(deletion_table(name, frame, removed, answers[:end], frame.prediction))
    return stopped


def _inserted(curves: Sequence[DeletionTable], explained: Explanation) -> list[DeletionTable]:
    """Turn deletion of the least salient pixels into insertion, the whole image last."""
    turned = []
    for curve, frame in zip(curves, explained.frames, strict=True):
        removed = np.concatenate([[0], curve.pixels_removed[:-1]])[::-1]
        answers = np.concatenate([[frame.prediction], curve.prediction[:-1]])[::-1]
        method = str(curve.method[0])
        turned.append(deletion_table(method, frame, removed.copy(), answers.copy(), frame.prediction))
    return turned
