"""Scores of explanations: removal under several fills, the deletion score of the thesis, and alarms."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, Shaped, UInt8
from scipy.stats import kendalltau
from torch import Tensor

from sliplens.errors import CheckpointError, InputError, SaliencyError
from sliplens.explainers.attribution import CLOSE
from sliplens.explainers.explain import join_maps, network_inputs, network_references
from sliplens.explainers.frames import frames_from_arrays
from sliplens.faithfulness.controls import control_maps, lead_over_controls
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import Predict, Units, answer_whole, removal_curves, score_maps
from sliplens.intervals import mean_interval, paired_difference
from sliplens.models import Network
from sliplens.models.engines import Engine, prepare
from sliplens.results.explanation import ExplainedFrame, Explanation, MethodNotes, require_saliency
from sliplens.results.faithfulness import (
    CHANCE,
    Agreement,
    Comparison,
    Deletion,
    DeletionScores,
    DeletionTable,
    Faithfulness,
    MethodScore,
    RemovalCurve,
    RemovalScore,
    RemovalTable,
    is_control,
)
from sliplens.results.study import Setting

Frames = UInt8[np.ndarray, "images height width 3"]
Maps = Float[np.ndarray, "images height width"]
_CHECKED_IMAGES = 4


def explanation_of_maps(
    network: Network,
    frames: Frames,
    maps: Float[np.ndarray, "maps rows columns"],
    reference: UInt8[np.ndarray, "_ _ 3"] | None,
    *,
    signed: bool,
) -> Explanation:
    """Make the record of maps that another tool computed; see `sliplens.score` for `signed`.

    Raises
    ------
    SaliencyError
        If there is not a map a frame, or one has another size than the network's input, or holds NaN; or if a signed
        array has no number below zero for a frame whose prediction fell.
    """
    explanation = join_maps(network, frames_from_arrays(network, frames, reference), {})
    if len(maps) != len(frames):
        raise SaliencyError(f"there are {len(maps)} maps of {len(frames)} frames; explain the frames that are scored")
    for index, values in enumerate(maps):
        require_saliency(values, explanation.images.shape[-2:], where=f"map {index}")
    positive = (maps.min(axis=(1, 2)) >= 0) & (maps.max(axis=(1, 2)) > 0)
    for index in np.flatnonzero((explanation.towards < 0) & positive) if signed else ():
        raise SaliencyError(
            f"map {index} has no number below 0, but the prediction of its frame is lower than that of the untouched "
            "sensor, which a signed map must explain by pixels that lower it; if its numbers say how much a pixel "
            "matters whichever way, give signed=False"
        )
    notes = MethodNotes(seconds_per_frame=0.0, warnings=(), raises_only=not signed)
    return replace(explanation, methods={"maps": notes}, relevance={"maps": maps.astype(np.float32)})


def require_same_network(network: Network, explanation: Explanation) -> None:
    """Raise an error for explanations of another network."""
    if explanation.weights_sha256 != network.manifest.weights_sha256:
        raise CheckpointError(
            "these explanations were made with another network; explain the frames again with this run"
        )


def prepare_passes(network: Network, inputs: Float[Tensor, "images colours size size"], passes: int) -> Engine:
    """Prepare an engine for a number of passes of a network, checked on a few of its inputs, on its device."""
    some = inputs[:_CHECKED_IMAGES].to(network.device)
    return prepare(network.model, some, network.predict(some).to(network.device), passes=passes)


def influences(network: Network, explanation: Explanation) -> dict[str, Maps]:
    """Compute the maps that rank parts of frames, of each method (`Explanation.influence`) and of the controls."""
    maps = {name: explanation.influence(name) for name in explanation.relevance}
    inputs, references = network_inputs(network, explanation), network_references(network, explanation)
    return maps | control_maps(network.model, inputs, references)


@dataclass(frozen=True, kw_only=True)
class SettingCurves:
    """Curves of every map of some frames under one setting: most first, least first, random."""

    areas: Float64[np.ndarray, " areas"]
    curves: dict[str, Float64[np.ndarray, "3 frames areas"]]
    whole: Float64[np.ndarray, " frames"]
    """Predictions of the whole frames."""
    blank: Float64[np.ndarray, " frames"]
    """Predictions where all of the frame is removed; NaN where the setting has no fill."""


def stack_curves(curves: Mapping[str, RemovalCurve]) -> dict[str, Float64[np.ndarray, "3 frames areas"]]:
    """Stack the curves of each method: most influential first, least first, random."""
    return {name: np.stack([curve.most_first, curve.least_first, curve.random]) for name, curve in curves.items()}


def curves_of_frames(
    predict: Predict,
    network: Network,
    explanation: Explanation,
    maps: Mapping[str, Maps],
    units: Sequence[Units],
    *,
    fill: str,
    areas: Sequence[float],
    random_orders: int,
    seed: int,
) -> SettingCurves:
    """Remove parts of explained frames in the order of every map, and in random orders."""
    inputs, references = network_inputs(network, explanation), network_references(network, explanation)
    paint = get_fill(fill)(inputs, references, seed)
    gone = torch.ones((len(inputs), *inputs.shape[-2:]), dtype=torch.bool, device=inputs.device)
    batches = torch.arange(len(inputs), device=inputs.device).split(16)
    blank = answer_whole(predict, torch.cat([paint(rows, gone[rows]) for rows in batches]))
    curves = score_maps(
        predict,
        inputs,
        maps,
        units,
        fill=get_fill(fill),
        references=references,
        towards=explanation.towards,
        # the same random orders under every fill
        rng=np.random.default_rng(seed),
        random_orders=random_orders,
        areas=areas,
        seed=seed,
    )
    return SettingCurves(
        areas=np.asarray(areas, dtype=np.float64),
        curves=stack_curves(curves),
        whole=answer_whole(predict, inputs),
        blank=blank,
    )


def score_curves(
    explanation: Explanation,
    curves: Mapping[Setting, SettingCurves],
    *,
    random_orders: int,
    seed: int,
) -> Faithfulness:
    """Make the scores of the curves of all frames, by setting, with intervals over days and trials."""
    by_method = {
        setting: {
            name: RemovalCurve(areas=part.areas, most_first=most, least_first=least, random=random)
            for name, (most, least, random) in part.curves.items()
        }
        for setting, part in curves.items()
    }
    whole = next(iter(curves.values())).whole
    scores, comparisons = judge_curves(by_method, clusters=explanation.clusters, seed=seed)
    change = np.array([frame.prediction - frame.reference_prediction for frame in explanation.frames])
    blank = {setting.fill: part.blank for setting, part in curves.items() if np.isfinite(part.blank).all()}
    return Faithfulness(
        input=explanation.input,
        source=explanation.source,
        frames=len(explanation.frames),
        trials=len(explanation.trials),
        random_orders=random_orders,
        fills=tuple(dict.fromkeys(setting.fill for setting in curves)),
        units=tuple(dict.fromkeys(setting.unit for setting in curves)),
        areas=tuple(next(iter(curves.values())).areas.tolist()),
        scores=scores,
        comparisons=comparisons,
        agreement=compare_fills(by_method),
        alarms=(
            *little_to_explain(change),
            *saturated(whole),
            *flat_maps({name: explanation.influence(name) for name in explanation.relevance}),
            *(alarm for fill, gone in blank.items() for alarm in fill_decides(whole, gone, fill=fill)),
            *ranking_alarms(by_method),
        ),
        table=_table(by_method, explanation),
    )


EQUAL_AREAS = (0.01, 0.02, 0.05, 0.1, 0.2)
"""Shares of the image at which methods are compared."""


def judge_curves(
    curves: Mapping[Setting, Mapping[str, RemovalCurve]], *, clusters: Shaped[np.ndarray, "2 frames"], seed: int
) -> tuple[tuple[RemovalScore, ...], tuple[Comparison, ...]]:
    """Score methods and controls with intervals over days and trials, and compare the methods with each other."""
    rng = np.random.default_rng(seed)
    scores, comparisons = [], []
    for setting, by_method in curves.items():
        gains = {name: curve.symmetric_gain for name, curve in by_method.items()}
        controls = {name: gain for name, gain in gains.items() if is_control(name)}
        for name, curve in by_method.items():
            mean = partial(mean_interval, clusters=clusters, rng=rng)
            area = partial(np.trapezoid, x=curve.areas, axis=-1)
            steps = {share: np.flatnonzero(np.isclose(curve.areas, share)) for share in EQUAL_AREAS}
            score = RemovalScore(
                fill=setting.fill,
                unit=setting.unit,
                method=name,
                control=is_control(name),
                srg=mean(gains[name]),
                gain_over_random=mean(curve.gain_over_random),
                lead_over_controls=None
                if is_control(name)
                else lead_over_controls(gains[name], controls, clusters=clusters, rng=rng),
                most_first=float(area(curve.most_first).mean()),
                least_first=float(area(curve.least_first).mean()),
                random=float(area(curve.random).mean()),
                at={share: float(curve.most_first[:, at[0]].mean()) for share, at in steps.items() if len(at)},
            )
            scores.append(score)
        for first, second in combinations([name for name in by_method if not is_control(name)], 2):
            gap = paired_difference(gains[first], gains[second], clusters=clusters, rng=rng)
            comparisons.append(Comparison(fill=setting.fill, unit=setting.unit, first=first, second=second, gap=gap))
    return tuple(scores), tuple(comparisons)


def compare_fills(curves: Mapping[Setting, Mapping[str, RemovalCurve]]) -> tuple[Agreement, ...]:
    """Compute how far the rankings of the methods agree between fills of the same unit."""
    agreement = []
    for first, second in combinations(curves, 2):
        if first.unit != second.unit:
            continue
        names = [name for name in curves[first] if not is_control(name)]
        ranks = [[float(curves[setting][name].symmetric_gain.mean()) for name in names] for setting in (first, second)]
        tau = float(np.asarray(kendalltau(*ranks))[0]) if len(names) > 1 else float("nan")
        defined = tau if np.isfinite(tau) else None
        agreement.append(Agreement(unit=first.unit, first=first.fill, second=second.fill, tau=defined))
    return tuple(agreement)


def ranking_alarms(curves: Mapping[Setting, Mapping[str, RemovalCurve]]) -> list[str]:
    """Warn where a control wins, and of fills that rank the methods differently."""
    by_fill: dict[str, dict[str, float]] = {}
    alarms = []
    for setting, of_setting in curves.items():
        gains = {name: float(curve.symmetric_gain.mean()) for name, curve in of_setting.items()}
        methods = {name: gain for name, gain in gains.items() if not is_control(name)}
        best = max(gains.keys() - methods.keys(), key=lambda name: gains[name], default=None)
        where = f"under {setting.fill}, {setting.unit} by {setting.unit}"
        for name, gain in methods.items():
            if gain <= 0:
                alarms.append(f"{where}: {name} does not beat a random order: its symmetric gain is {gain:.3f}")
            elif best is not None and gain <= gains[best]:
                alarms.append(f"{where}: {name} gains {gain:.3f}, no more than the control {best} ({gains[best]:.3f})")
        if setting.unit == "pixel":
            by_fill[setting.fill] = methods
    return [*rankings_disagree(by_fill), *alarms]


def _table(curves: Mapping[Setting, Mapping[str, RemovalCurve]], explanation: Explanation) -> RemovalTable:
    frames, tables = explanation.frames, []
    for setting, by_method in curves.items():
        for name, curve in by_method.items():
            count, steps = curve.most_first.shape
            if count != len(frames):
                raise InputError(f"{count} curves of {name} for {len(frames)} frames; make the study again")
            labels = [np.nan if frame.safety_margin is None else frame.safety_margin for frame in frames]
            table = RemovalTable(
                fill=np.repeat(setting.fill, count * steps),
                unit=np.repeat(setting.unit, count * steps),
                method=np.repeat(name, count * steps),
                frame_id=np.repeat([frame.id for frame in frames], steps),
                day=np.repeat([frame.day for frame in frames], steps),
                trial=np.repeat([frame.trial for frame in frames], steps),
                safety_margin=np.repeat(labels, steps),
                area=np.tile(curve.areas, count),
                most_first=curve.most_first.ravel(),
                least_first=curve.least_first.ravel(),
                random=curve.random.ravel(),
            )
            tables.append(table)
    return RemovalTable.joined(tables)


def deletion_score(
    base: Float[np.ndarray, "*shape"], masked: Float[np.ndarray, "*shape2"]
) -> Float[np.ndarray, "*shape3"]:
    """Deletion score D = (1 - |y_base - y_mask|)^2 of answers in margin units; lower means more was destroyed.

    References
    ----------
    Polak, eq. 2 (there in percent, hence divided by 100).

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.faithfulness.scoring import deletion_score
    >>> deletion_score(np.array(0.9), np.array([0.9, 0.4])).round(2)  # nothing destroyed; half of the range
    array([1.  , 0.25])
    """
    return (1 - np.abs(base - masked)) ** 2


def deletion_order(saliency: Float[np.ndarray, "height width"]) -> Int[np.ndarray, " pixels"]:
    """Return flat pixel indices from most to least salient; of ties the later pixel first, as in the thesis's masks.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.faithfulness.scoring import deletion_order
    >>> deletion_order(np.array([[0.1, 0.9], [0.5, 0.1]]))
    array([1, 2, 3, 0])
    """
    return np.argsort(saliency.ravel(), kind="stable")[::-1].copy()


def random_order(shape: tuple[int, int], *, rng: np.random.Generator) -> Int[np.ndarray, " pixels"]:
    """Return flat pixel indices in random order: the control that every explanation has to beat."""
    return rng.permutation(shape[0] * shape[1])


def deletion_steps(shape: tuple[int, int], *, steps: int | None = None) -> Int[np.ndarray, " steps"]:
    """Return the pixels removed at each step: by default as many steps as the image is high; the last removes all.

    Polak, section 4 (n_masks = 224 for a 224 x 224 image: 224 steps of 224 pixels).
    """
    pixels = shape[0] * shape[1]
    count = steps or shape[0]
    if not 1 <= count <= pixels:
        raise InputError(f"deletion in {count} steps is impossible with {pixels} pixels; choose 1 to {pixels}")
    return np.round(np.linspace(0, pixels, count + 1)[1:]).astype(np.int64)


def delete_pixels(
    predict: Predict,
    images: Float[Tensor, "images colours height width"],
    orders: Int[np.ndarray, "images pixels"],
    *,
    fill: str,
    steps: int | None = None,
    references: Float[Tensor, "images colours height width"] | None = None,
    seed: int = 0,
    batch_size: int = 128,
) -> Float64[np.ndarray, "images answers"]:
    """Predict whole images, and then after each step while pixels are removed in an order (`deletion_order`).

    Examples
    --------
    A network that computes the mean brightness: bright pixels on black, removed one by one.

    >>> import torch
    >>> from sliplens.faithfulness.scoring import delete_pixels, deletion_order
    >>> image = torch.zeros(1, 3, 2, 2)
    >>> image[0, :, 0] = 1.0
    >>> order = deletion_order(image[0, 0].numpy())[None]
    >>> delete_pixels(lambda inputs: inputs.mean(dim=(1, 2, 3)), image, order, fill="black", steps=4)
    array([[0.5 , 0.25, 0.  , 0.  , 0.  ]])
    """
    removed = deletion_steps((images.shape[-2], images.shape[-1]), steps=steps)
    curves = removal_curves(
        predict,
        images,
        orders[None],
        fill=get_fill(fill),
        references=references,
        areas=[0.0, *removed / removed[-1]],
        seed=seed,
        batch_size=batch_size,
    )
    return curves.answers[0]


def deletion_orders(explanation: Explanation, *, seed: int) -> dict[str, Int[np.ndarray, "frames pixels"]]:
    """Compute the order of the pixels of each frame by method, most salient first, and a random one."""
    rng, shape = np.random.default_rng(seed), (explanation.image_size, explanation.image_size)
    orders = {
        name: np.stack([deletion_order(values) for values in maps]) for name, maps in explanation.saliency.items()
    }
    return orders | {CHANCE: np.stack([random_order(shape, rng=rng) for _ in explanation.frames])}


def score_deletion(
    explanation: Explanation, answers: Mapping[str, Float64[np.ndarray, "frames answers"]], *, fill: str
) -> DeletionScores:
    """Make the thesis's deletion scores of the predictions of all frames by method (`delete_pixels`)."""
    shape = (explanation.image_size, explanation.image_size)
    chance = answers[CHANCE]
    removed = deletion_steps(shape, steps=chance.shape[1] - 1)
    tables = {name: deletion_tables(name, removed, values, explanation) for name, values in answers.items()}
    return DeletionScores(
        input=explanation.input,
        source=explanation.source,
        fill=fill,
        steps=len(removed),
        pixels_per_step=int(removed[0]),
        methods={name: score_tables(curves) for name, curves in tables.items()},
        alarms=(
            *flat_maps(explanation.saliency),
            # the fill decides where the filled image is predicted like the whole one
            *fill_decides(chance[:, 0], chance[:, -1], fill=fill),
            *saturated(chance[:, 0]),
            *deletion_alarms(tables),
        ),
        table=DeletionTable.joined([curve for curves in tables.values() for curve in curves]),
    )


def deletion_table(
    method: str, frame: ExplainedFrame, removed: np.ndarray, answers: np.ndarray, base: float
) -> DeletionTable:
    """Make the rows of one frame and method."""
    rows = len(answers)
    return DeletionTable(
        method=np.repeat(method, rows),
        frame_id=np.repeat(frame.id, rows),
        day=np.repeat(frame.day, rows),
        trial=np.repeat(frame.trial, rows),
        step=np.arange(rows),
        pixels_removed=removed,
        prediction=answers,
        score=deletion_score(np.full(rows, base), answers),
    )


def deletion_tables(
    method: str,
    removed: Int[np.ndarray, " steps"],
    answers: Float64[np.ndarray, "frames answers"],
    explanation: Explanation,
) -> list[DeletionTable]:
    """Make the rows of a method, a table a frame."""
    rows = zip(explanation.frames, answers, strict=True)
    return [deletion_table(method, frame, removed, values[1:], values[0]) for frame, values in rows]


def score_tables(curves: Sequence[DeletionTable]) -> MethodScore:
    """Compute the score of a method from the rows of each frame."""
    auc, last = np.array([(curve.score.mean(), curve.score[-1]) for curve in curves]).T
    return MethodScore(
        mean=float(auc.mean()), sd=float(auc.std()), last_step_mean=float(last.mean()), frames=len(curves)
    )


def deletion_alarms(curves: Mapping[str, Sequence[DeletionTable]]) -> Iterator[str]:
    """Warn where the score does not measure the map: one that does not beat a random order shows nothing."""
    chance = float(np.mean([curve.score.mean() for curve in curves[CHANCE]]))
    for name, tables in curves.items():
        if name == CHANCE:
            continue
        means, last = (
            np.array(values) for values in zip(*((c.score.mean(), c.score[-1]) for c in tables), strict=True)
        )
        if len({len(curve) for curve in tables}) == 1:  # where curves stop early, the last step depends on the map
            yield from follows_last_step(means, last, name=f"D of {name}")
        if means.mean() >= chance:
            yield f"{name} does not beat a random order ({means.mean():.3f} against {chance:.3f})"


def with_deletion(faithfulness: Faithfulness, scores: DeletionScores | None = None) -> Faithfulness:
    """Add the thesis's deletion score to the record, if it was computed."""
    if scores is None:
        return faithfulness
    part = Deletion(
        fill=scores.fill,
        steps=scores.steps,
        pixels_per_step=scores.pixels_per_step,
        methods=scores.methods,
        alarms=scores.alarms,
    )
    return replace(faithfulness, deletion=part, deletion_table=scores.table)


FILL_DECIDES = 0.05
"""An image of nothing but fill that is answered this near to the whole image, in margin units."""
_TIED_TO_LAST = 0.8
_SATURATED = 0.01
_SAME_ORDER = 0.5
_FEWEST = 3


def fill_decides(whole: Float[np.ndarray, " images"], filled: Float[np.ndarray, " images"], *, fill: str) -> list[str]:
    """Warn of images whose fill alone is predicted like the whole image: there no map can change the prediction."""
    near = int(np.sum(np.abs(whole - filled) < FILL_DECIDES))
    sentence = (
        f"the fill decides in {near} of {len(whole)} frames: an image of nothing but {fill} is answered within "
        f"{FILL_DECIDES:.0%} of the whole frame"
    )
    return [sentence] if near else []


def follows_last_step(
    score: Float[np.ndarray, " images"], last: Float[np.ndarray, " images"], *, name: str
) -> list[str]:
    """Warn of a score that follows its last step, where all is filled and no map matters."""
    if len(score) < _FEWEST or np.std(score) == 0 or np.std(last) == 0:
        return []
    tied = float(np.corrcoef(score, last)[0, 1])
    if tied < _TIED_TO_LAST:
        return []
    return [f"{name} correlates with its last step by {tied:.2f}: it measures the fill rather than the map"]


def little_to_explain(change: Float[np.ndarray, " images"]) -> list[str]:
    """Warn of frames predicted nearly like the untouched sensor, whose direction is chance."""
    few = int(np.sum(np.abs(change) < CLOSE))
    sentence = (
        f"next to nothing to explain in {few} of {len(change)} frames: the answer lies within {CLOSE} of that on the "
        "untouched sensor, less than networks err by, and the direction that a gain counts along is chance; leave them "
        "out"
    )
    return [sentence] if few else []


def saturated(answers: Float[np.ndarray, " images"]) -> list[str]:
    """Warn of predictions at an end of [0, 1] or outside: they can move one way only."""
    ends = int(np.sum((answers < _SATURATED) | (answers > 1 - _SATURATED)))
    return [f"{ends} of {len(answers)} answers lie at an end of the margin: they can move one way only"] if ends else []


def flat_maps(maps: Mapping[str, Float[np.ndarray, "images height width"]]) -> list[str]:
    """Warn of constant maps and maps with NaN, which rank nothing."""
    alarms = []
    for method, values in maps.items():
        bad = int(np.sum(~np.isfinite(values).all(axis=(1, 2))))
        flat = int(np.sum(values.max(axis=(1, 2)) == values.min(axis=(1, 2))))
        alarms += [f"{method}: {bad} of {len(values)} maps hold NaN or infinity"] if bad else []
        alarms += [f"{method}: {flat} of {len(values)} maps are constant and rank nothing"] if flat else []
    return alarms


def rankings_disagree(scores: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Warn of fills that rank the methods differently, by Kendall's tau; scores by fill, then by method.

    Kendall, *A new measure of rank correlation* (1938).
    """
    alarms = []
    for first, second in combinations(scores, 2):
        methods = sorted(set(scores[first]) & set(scores[second]))
        if len(methods) < _FEWEST:
            continue
        ranked = ([scores[fill][method] for method in methods] for fill in (first, second))
        tau = float(np.asarray(kendalltau(*ranked))[0])
        if not tau >= _SAME_ORDER:
            alarms.append(
                f"{first} and {second} rank the methods differently (Kendall's tau {tau:.2f}): which is best depends "
                "on what removed pixels become"
            )
    return alarms
