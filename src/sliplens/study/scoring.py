"""Scores of a study: methods and controls under several fills and units; the deletion score and its remedies."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import combinations
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, Shaped
from scipy.stats import kendalltau
from torch import Tensor

from sliplens.errors import CheckpointError, InputError
from sliplens.faithfulness.controls import control_maps, lead_over_controls
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import RANDOM_ORDERS, Faithfulness, Predict, Units, answer_whole, score_maps
from sliplens.faithfulness.scoring import (
    controls_win,
    deletion_curves,
    deletion_score,
    deletion_steps,
    fill_decides,
    flat_maps,
    follows_last_step,
    prepare_passes,
    random_order,
    rankings_disagree,
    saliency_orders,
    saturated,
)
from sliplens.intervals import mean_interval, paired_difference
from sliplens.models import Network
from sliplens.progress import OnProgress, continued
from sliplens.results.explanation import ExplainedFrame, Explanation
from sliplens.results.faithfulness import (
    CHANCE,
    Agreement,
    Comparison,
    DeletionScores,
    DeletionTable,
    MethodScore,
    Remedies,
    RemovalScore,
    RemovalScores,
    RemovalTable,
    Variant,
    VariantTable,
    is_control,
)
from sliplens.results.study import SETTINGS, Setting
from sliplens.runner import Part
from sliplens.study.choice import Material, MaterialStage, trial_seed
from sliplens.study.explaining import network_inputs
from sliplens.study.stages import Find, Stage, join_trials, trial_shards

STEPS = 28
"""An eighth of the thesis's 224: the mean over the steps differs from that over all of them by less than a step."""
BACKGROUND = {"difference": "black", "raw": "white"}
"""What the thesis proposes as the background of its two inputs."""
_STOP = 0.5


_Curves = Mapping[str, Sequence[DeletionTable]]
"""Curve of each frame, by method; random orders among the methods."""


def require_same_network(trained: Network, explained: Explanation) -> None:
    """Refuse explanations of another network."""
    if explained.weights_sha256 != trained.manifest.weights_sha256:
        raise CheckpointError(
            "these explanations were made with another network; explain the frames again with this run"
        )


@dataclass(frozen=True, kw_only=True)
class _Answers:
    """Answers on the frames of a trial while pixels go, by the order in which they go; the first with all of them."""

    answers: dict[str, Float64[np.ndarray, "frames answers"]]


@dataclass(frozen=True, kw_only=True)
class Deletion(Stage[DeletionScores]):
    """Deletion of the most salient pixels by every method and in a random order, a trial a shard."""

    piece = _Answers
    title = "Deleting pixels, as the thesis did"

    trained: Network
    explained: Explanation
    fill: str = "grey"
    steps: int | None = None
    """The image's height if None."""
    seed: int = 0

    def shards(self) -> Iterator[Part]:
        """Trials, whose maps are counted with a random one."""
        return trial_shards(self.explained, maps=len(self.explained.saliency) + 1)

    @property
    def _removed(self) -> Int[np.ndarray, " steps"]:
        size = self.explained.image_size
        return deletion_steps((size, size), steps=self.steps)

    def prepare(self) -> Find:
        """Delete the pixels of the frames of a trial."""
        inputs, orders = network_inputs(self.trained, self.explained), _orders(self.explained, seed=self.seed)
        predict = prepare_passes(self.trained, inputs, len(orders) * len(inputs) * len(self._removed))

        def find(item: tuple[str], on_progress: OnProgress) -> _Answers:
            rows = self.explained.trials[item[-1]]
            delete = partial(_delete, predict, inputs[rows], fill=self.fill, steps=self.steps)
            return _Answers(answers=_each(delete, {name: own[rows] for name, own in orders.items()}, on_progress))

        return find

    def join(self, pieces: Sequence[_Answers]) -> DeletionScores:
        """Scores of all curves."""
        explained, removed = self.explained, self._removed
        answers = join_trials(explained, [one.answers for one in pieces])
        curves = {name: _split(name, removed, own, explained) for name, own in answers.items()}
        control = answers[CHANCE]
        return DeletionScores(
            input=explained.input,
            source=explained.source,
            fill=self.fill,
            steps=len(removed),
            pixels_per_step=int(removed[0]),
            methods={name: _score(own) for name, own in curves.items()},
            alarms=(
                *flat_maps(explained.saliency),
                # the fill decides where the filled image is answered like the whole one
                *fill_decides(control[:, 0], control[:, -1], fill=self.fill),
                *saturated(control[:, 0]),
                *_method_alarms(curves),
            ),
            table=DeletionTable.joined([curve for own in curves.values() for curve in own]),
        )


def _delete(
    predict: Predict,
    inputs: Float[Tensor, "frames colours size size"],
    order: Int[np.ndarray, "frames pixels"],
    *,
    fill: str,
    steps: int | None,
    on_progress: OnProgress | None = None,
) -> Float64[np.ndarray, "frames answers"]:
    """Answers on the whole frames, and then while the pixels of an order go."""
    deleted = deletion_curves(predict, inputs, order, fill=get_fill(fill), steps=steps, on_progress=on_progress)
    return np.column_stack([deleted.base, deleted.predictions])


def _each(
    delete: Callable[..., Float64[np.ndarray, "frames answers"]],
    orders: Mapping[str, Int[np.ndarray, "frames pixels"]],
    on_progress: OnProgress,
    *,
    before: int = 0,
) -> dict[str, Float64[np.ndarray, "frames answers"]]:
    """Answers of each order; each frame of each counts."""
    answers = {}
    for name, order in orders.items():
        answers[name] = delete(order, on_progress=continued(on_progress, before=before, total=0))
        before += len(order)
    return answers


@dataclass(frozen=True, kw_only=True)
class _Remedied:
    """Answers on the frames of a trial while pixels become the background, and while the least salient become grey."""

    background: dict[str, Float64[np.ndarray, "frames answers"]]
    insertion: dict[str, Float64[np.ndarray, "frames answers"]]


@dataclass(frozen=True, kw_only=True)
class RemedialDeletion(MaterialStage[Remedies]):
    """Deletion that stops at half of the saliency, deletion to the background, and insertion, a trial a shard.

    Stopping early needs no pass of its own: the same frames, scored by deletion to `grey`, are given.

    Polak, discussion of the faithfulness curves: stop once all pixels with saliency above 0.5 are gone; another fill.
    """

    piece = _Remedied
    title = "Trying the thesis's remedies"

    grey: DeletionScores
    steps: int = STEPS
    seed: int = 0

    def shards(self) -> Iterator[Part]:
        """Trials, whose maps are counted twice, and with a random one."""
        explained = self.material.explained
        return trial_shards(explained, maps=2 * (len(explained.saliency) + 1))

    @property
    def _background(self) -> str:
        return BACKGROUND.get(self.material.explained.input, "background")

    def prepare(self) -> Find:
        """Delete the pixels of the frames of a trial both ways."""
        material, inputs = self.material, self.material.inputs
        orders = _orders(material.explained, seed=self.seed)
        predict = prepare_passes(material.trained, inputs, 2 * len(orders) * len(inputs) * self.steps)

        def find(item: tuple[str], on_progress: OnProgress) -> _Remedied:
            rows = material.explained.trials[item[-1]]
            own = {name: order[rows] for name, order in orders.items()}
            # inserting k pixels of an order is deleting all the others
            turned = {name: order[:, ::-1].copy() for name, order in own.items()}
            delete = partial(_delete, predict, inputs[rows], steps=self.steps)
            return _Remedied(
                background=_each(partial(delete, fill=self._background), own, on_progress),
                insertion=_each(partial(delete, fill="grey"), turned, on_progress, before=len(own) * len(rows)),
            )

        return find

    def join(self, pieces: Sequence[_Remedied]) -> Remedies:
        """Scores of all remedies."""
        explained, grey, background = self.material.explained, self.grey, self._background
        removed = deletion_steps((explained.image_size, explained.image_size), steps=self.steps)
        deleted, inserted = (
            {name: _split(name, removed, own, explained) for name, own in join_trials(explained, answers).items()}
            for answers in ([one.background for one in pieces], [one.insertion for one in pieces])
        )
        curves: dict[str, _Curves] = {
            "stop-at-half": _stopped(grey, explained),
            "background": deleted,
            "insertion": {name: _inserted(own, explained) for name, own in inserted.items()},
        }
        deletion: dict[str, Any] = {"fill": "grey", "mode": "deletion", "stop": None, "better": "lower"}
        about = {
            "stop-at-half": deletion | {"stop": _STOP},
            "background": deletion | {"fill": background},
            "insertion": deletion | {"mode": "insertion", "better": "higher"},
        }
        summaries = {
            "stop-at-half": "Grey fill; ends once every pixel with a saliency above 0.5 is gone, so that frames and "
            "methods end at different areas. Random orders end at the median area of the methods.",
            "background": f"Removed pixels become {background}, and all of them go.",
            "insertion": "From an image of nothing but grey, the most salient pixels come first; D against the answer "
            "on the whole image, so that a faithful map rises early.",
        }
        each = [(name, curve) for name, by_method in curves.items() for own in by_method.values() for curve in own]
        tables = [VariantTable(variant=np.repeat(name, len(curve)), **vars(curve)) for name, curve in each]
        return Remedies(
            input=explained.input,
            source=explained.source,
            steps=self.steps,
            variants={
                name: Variant(
                    **about[name], summary=summaries[name], methods={method: _score(one) for method, one in own.items()}
                )
                for name, own in curves.items()
            },
            alarms=tuple(
                f"{name}: {alarm}" for name in ("stop-at-half", "background") for alarm in _method_alarms(curves[name])
            ),
            table=VariantTable.joined(tables),
        )


def _orders(explained: Explanation, *, seed: int) -> dict[str, Int[np.ndarray, "frames pixels"]]:
    """Pixels of each frame by method, most salient first, and a random order."""
    rng, shape = np.random.default_rng(seed), (explained.image_size, explained.image_size)
    orders = {name: saliency_orders(maps, shape) for name, maps in explained.saliency.items()}
    return orders | {CHANCE: np.stack([random_order(shape, rng=rng) for _ in explained.frames])}


def _curve(method: str, frame: ExplainedFrame, removed: np.ndarray, answers: np.ndarray, base: float) -> DeletionTable:
    told = {"method": method, "frame_id": frame.id, "day": frame.day, "trial": frame.trial}
    columns = {name: np.repeat(value, len(answers)) for name, value in told.items()}
    step, score = np.arange(len(answers)), deletion_score(np.full(len(answers), base), answers)
    return DeletionTable(**columns, step=step, pixels_removed=removed, prediction=answers, score=score)


def _split(
    method: str,
    removed: Int[np.ndarray, " steps"],
    answers: Float64[np.ndarray, "frames answers"],
    explained: Explanation,
) -> list[DeletionTable]:
    rows = zip(explained.frames, answers, strict=True)
    return [_curve(method, frame, removed, own[1:], own[0]) for frame, own in rows]


def _score(curves: Sequence[DeletionTable]) -> MethodScore:
    auc, last = np.array([(curve.score.mean(), curve.score[-1]) for curve in curves]).T
    return MethodScore(
        mean=float(auc.mean()), sd=float(auc.std()), last_step_mean=float(last.mean()), frames=len(curves)
    )


def _stopped(grey: DeletionScores, explained: Explanation) -> _Curves:
    """Cut each curve after the step at which all pixels above the threshold are gone, the first step at least."""
    counts = {name: (maps > _STOP).sum(axis=(1, 2)) for name, maps in explained.saliency.items()}
    median = np.median(np.stack(list(counts.values())), axis=0)
    stopped = {}
    for name, curve in grey.curves.items():
        stopped[name] = []
        for frame, pixels in zip(explained.frames, counts.get(name, median), strict=True):
            answers = curve.predictions[curve.frame_ids.index(frame.id)]
            end = int(np.searchsorted(curve.pixels_removed, int(pixels))) + 1
            stopped[name].append(_curve(name, frame, curve.pixels_removed[:end], answers[:end], frame.prediction))
    return stopped


def _inserted(curves: Sequence[DeletionTable], explained: Explanation) -> list[DeletionTable]:
    """Read deletion of the least salient pixels backwards, the whole image last."""
    turned = []
    for curve, frame in zip(curves, explained.frames, strict=True):
        removed = np.concatenate([[0], curve.pixels_removed[:-1]])[::-1]
        answers = np.concatenate([[frame.prediction], curve.prediction[:-1]])[::-1]
        turned.append(_curve(str(curve.method[0]), frame, removed.copy(), answers.copy(), frame.prediction))
    return turned


def _method_alarms(curves: _Curves) -> Iterator[str]:
    """Say where the score does not measure the map: one that does not beat a random order has shown nothing."""
    chance = float(np.mean([curve.score.mean() for curve in curves[CHANCE]]))
    for name, own in curves.items():
        if name == CHANCE:
            continue
        means, last = (np.array(values) for values in zip(*((c.score.mean(), c.score[-1]) for c in own), strict=True))
        if len({len(curve) for curve in own}) == 1:  # where curves stop early, the last step is the map's doing
            yield from follows_last_step(means, last, name=f"D of {name}")
        if means.mean() >= chance:
            yield f"{name} does not beat a random order ({means.mean():.3f} against {chance:.3f})"


EQUAL_AREAS = (0.01, 0.02, 0.05, 0.1, 0.2)
STUDY_AREAS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Fewer than `removal.AREAS`, so that many settings can be scored: the equal areas, and enough for trapezoids."""


Curves = Mapping[Setting, Mapping[str, Faithfulness]]
"""Curves by setting and method, controls included."""
Influence = Mapping[str, Float[np.ndarray, "images height width"]]
"""Maps to rank parts by, of each method and control."""
Scoring = Callable[[Material, Influence, int, OnProgress], Mapping[str, Faithfulness]]
"""Finds the curves of some frames with their maps and a seed."""


def influences(material: Material) -> dict[str, Float[np.ndarray, "frames size size"]]:
    """Maps to rank parts by, of each method (`Material.influence`) and of the controls."""
    maps = {name: material.influence(name) for name in material.explained.relevance}
    return maps | control_maps(material.trained.model, material.inputs, material.references)


@dataclass(frozen=True, kw_only=True)
class _SettingCurves:
    """Curves of every map of a trial's frames under one setting (`Faithfulness.curves`)."""

    areas: Float64[np.ndarray, " areas"]
    curves: dict[str, Float64[np.ndarray, "3 frames areas"]]
    whole: Float64[np.ndarray, " frames"]
    """Answers on all of each frame."""
    blank: Float64[np.ndarray, " frames"]
    """Answers where all of it is gone; NaN where the setting has no fill."""


@dataclass(frozen=True, kw_only=True)
class Removal(MaterialStage[RemovalScores]):
    """Removal of parts in the order of every map (`influences`), under each setting whose unit is known of every frame.

    Each trial and setting is a shard. Curves that are found in another way, such as by drawing the scene anew
    (`further`), are judged with the others.
    """

    piece = _SettingCurves
    title = "Removing parts under every fill"

    maps: Influence
    settings: Sequence[Setting] = SETTINGS
    random_orders: int = RANDOM_ORDERS
    further: Mapping[Setting, Scoring] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        for setting in self.settings:
            get_fill(setting.fill)

    @cached_property
    def _units(self) -> dict[str, list[Units]]:
        return self.material.units()

    @property
    def _known(self) -> list[Setting]:
        return [setting for setting in self.settings if setting.unit in self._units]

    def shards(self) -> Iterator[Part]:
        """All trials under the first setting, then under the next."""
        for setting in (*self._known, *self.further):
            yield from trial_shards(self.material.explained, setting.fill, setting.unit)

    def prepare(self) -> Find:
        """Find the curves of a trial under one setting."""
        inputs, orders = self.material.inputs, 2 * len(self.maps) + self.random_orders
        passes = len(self._known) * len(inputs) * orders * (len(STUDY_AREAS) - 2)
        predict, numbers = prepare_passes(self.material.trained, inputs, passes), list(self.material.explained.trials)

        def find(item: tuple[str, str, str], on_progress: OnProgress) -> _SettingCurves:
            fill, unit, trial = item
            setting, rows = Setting(fill=fill, unit=unit), self.material.explained.trials[trial]
            part, maps = self.material.take(rows), {name: values[rows] for name, values in self.maps.items()}
            seed = trial_seed(self.seed, numbers.index(trial))
            if setting in self.further:
                scored, blank = self.further[setting](part, maps, seed, on_progress), np.full(len(rows), np.nan)
            else:
                blank = _answer_blank(predict, part, fill, seed)
                scored = score_maps(
                    predict,
                    part.inputs,
                    maps,
                    [self._units[unit][row] for row in rows],
                    fill=get_fill(fill),
                    references=part.references,
                    towards=part.explained.towards,
                    # the same random orders under every fill
                    rng=np.random.default_rng(seed),
                    random_orders=self.random_orders,
                    areas=STUDY_AREAS,
                    seed=seed,
                    on_progress=on_progress,
                )
            return _SettingCurves(
                areas=next(iter(scored.values())).areas,
                curves={name: own.curves for name, own in scored.items()},
                whole=answer_whole(predict, part.inputs, batch_size=64),
                blank=blank,
            )

        return find

    def join(self, pieces: Sequence[_SettingCurves]) -> RemovalScores:
        """Scores of all curves."""
        explained, count = self.material.explained, len(self.material.explained.trials)
        curves: dict[Setting, dict[str, Faithfulness]] = {}
        answers: dict[Setting, dict[str, np.ndarray]] = {}
        for at, setting in enumerate((*self._known, *self.further)):
            own = pieces[at * count : (at + 1) * count]
            joined = join_trials(explained, [one.curves for one in own], axis=1)
            curves[setting] = {name: Faithfulness(areas=own[0].areas, curves=curve) for name, curve in joined.items()}
            answers[setting] = join_trials(explained, [{"whole": one.whole, "blank": one.blank} for one in own])
        whole = next(iter(answers.values()))["whole"]
        blank = {setting.fill: answers[setting]["blank"] for setting in self._known}
        scores, comparisons = judge_curves(curves, clusters=explained.clusters, seed=self.seed)
        return RemovalScores(
            input=explained.input,
            source=explained.source,
            frames=len(explained.frames),
            trials=count,
            random_orders=self.random_orders,
            fills=tuple(dict.fromkeys(setting.fill for setting in curves)),
            units=tuple(dict.fromkeys(setting.unit for setting in curves)),
            areas=STUDY_AREAS,
            scores=scores,
            comparisons=comparisons,
            agreement=compare_fills(curves),
            alarms=(
                *saturated(whole),
                *flat_maps({name: self.maps[name] for name in explained.relevance}),
                *(alarm for fill, gone in blank.items() for alarm in fill_decides(whole, gone, fill=fill)),
                *ranking_alarms(curves),
            ),
            table=_table(curves, explained),
        )


def _answer_blank(predict: Predict, material: Material, fill: str, seed: int) -> Float64[np.ndarray, " frames"]:
    """Answers on images of which everything is gone."""
    inputs = material.inputs
    paint = get_fill(fill)(inputs, material.references, seed)
    gone = torch.ones((len(inputs), *inputs.shape[-2:]), dtype=torch.bool, device=inputs.device)
    batches = torch.arange(len(inputs), device=inputs.device).split(16)
    return answer_whole(predict, torch.cat([paint(rows, gone[rows]) for rows in batches]), batch_size=64)


def judge_curves(
    curves: Curves, *, clusters: Shaped[np.ndarray, "2 frames"], seed: int
) -> tuple[tuple[RemovalScore, ...], tuple[Comparison, ...]]:
    """Scores with intervals and leads over the controls, and methods compared with each other.

    The curves are those of controls too; days and trials are resampled.
    """
    rng = np.random.default_rng(seed)
    scores, comparisons = [], []
    for setting, own in curves.items():
        gains = {name: curve.symmetric_gain for name, curve in own.items()}
        controls = {name: gain for name, gain in gains.items() if is_control(name)}
        for name, curve in own.items():
            mean = partial(mean_interval, clusters=clusters, rng=rng)
            lead = partial(lead_over_controls, gains[name], controls, clusters=clusters, rng=rng)
            orders: dict[str, Any] = {
                order: float(getattr(curve, order).mean()) for order in ("most_first", "least_first", "random")
            }
            score = RemovalScore(
                **vars(setting),
                method=name,
                control=is_control(name),
                srg=mean(gains[name]),
                gain_over_random=mean(curve.gain_over_random),
                lead_over_controls=None if is_control(name) else lead(),
                **orders,
                at={area: float(curve.at(area)[0].mean()) for area in EQUAL_AREAS if area in curve.areas},
            )
            scores.append(score)
        for first, second in combinations([name for name in own if not is_control(name)], 2):
            gap = paired_difference(gains[first], gains[second], clusters=clusters, rng=rng)
            comparisons.append(Comparison(**vars(setting), first=first, second=second, gap=gap))
    return tuple(scores), tuple(comparisons)


def compare_fills(curves: Curves) -> tuple[Agreement, ...]:
    """How far the rankings of the methods agree between fills of the same unit."""
    agreement = []
    for first, second in combinations(curves, 2):
        if first.unit != second.unit:
            continue
        names = [name for name in curves[first] if not is_control(name)]
        ranks = [[float(curves[setting][name].symmetric_gain.mean()) for name in names] for setting in (first, second)]
        tau = float(np.asarray(kendalltau(*ranks))[0]) if len(names) > 1 else float("nan")
        known = tau if np.isfinite(tau) else None
        agreement.append(Agreement(unit=first.unit, first=first.fill, second=second.fill, tau=known))
    return tuple(agreement)


def ranking_alarms(curves: Curves) -> list[str]:
    """Say where a control wins, and which fills rank the methods differently."""
    by_fill: dict[str, dict[str, float]] = {}
    alarms = []
    for setting, own in curves.items():
        methods = {name: curve for name, curve in own.items() if not is_control(name)}
        controls = {name: curve for name, curve in own.items() if is_control(name)}
        where = f"under {setting.fill}, {setting.unit} by {setting.unit}"
        alarms += [f"{where}: {alarm}" for alarm in controls_win(methods, controls)]
        if setting.unit == "pixel":
            by_fill[setting.fill] = {name: float(curve.symmetric_gain.mean()) for name, curve in methods.items()}
    return [*rankings_disagree(by_fill), *alarms]


def _table(curves: Curves, explained: Explanation) -> RemovalTable:
    frames, tables = explained.frames, []
    of_frames: dict[str, Any] = {"frame_id": [frame.id for frame in frames], "day": [frame.day for frame in frames]}
    of_frames |= {"trial": [frame.trial for frame in frames]}
    of_frames["safety_margin"] = [np.nan if frame.safety_margin is None else frame.safety_margin for frame in frames]
    for setting, own in curves.items():
        for name, curve in own.items():
            count, steps = curve.curves.shape[1:]
            if count != len(frames):
                raise InputError(f"{count} curves of {name} for {len(frames)} frames; make the study again")
            most_first, least_first, random = curve.curves.reshape(3, -1)
            known = {"fill": setting.fill, "unit": setting.unit, "method": name}
            columns = {key: np.repeat(value, count * steps) for key, value in known.items()}
            columns |= {key: np.repeat(values, steps) for key, values in of_frames.items()}
            columns |= {"area": np.tile(curve.areas, count), "most_first": most_first, "least_first": least_first}
            tables.append(RemovalTable(**columns, random=random))
    return RemovalTable.joined(tables)
