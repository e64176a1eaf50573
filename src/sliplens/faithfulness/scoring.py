"""Scores of explanations: removal under several fills, the deletion score of the thesis, and alarms."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from sliplens.errors import CheckpointError, InputError
from sliplens.explainers.explain import network_inputs, network_references
from sliplens.faithfulness.controls import Maps, control_maps, lead_over_controls
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import Predict, removal_curves
from sliplens.intervals import mean_interval, paired_difference
from sliplens.models import Network
from sliplens.models.engines import Engine, prepare
from sliplens.results import faithfulness as records
from sliplens.results.explanation import BASELINES, CLOSE, Explanation
from sliplens.results.faithfulness import CHANCE, RemovalCurve, is_control
from sliplens.results.study import REDRAWN, Setting


def require_same_network(network: Network, explanation: Explanation) -> None:
    """Raise an error for explanations of another network."""
    if explanation.weights_sha256 != network.manifest.weights_sha256:
        raise CheckpointError(
            "these explanations were made with another network; explain the frames again with this run"
        )


def prepare_passes(network: Network, inputs: Float[Tensor, "images colours size size"], passes: int) -> Engine:
    """Prepare an engine for a number of passes of a network, checked on a few of its inputs, on its device."""
    return prepare(network.model, inputs[:4].to(network.device), passes=passes)


def influences(network: Network, explanation: Explanation) -> dict[str, Maps]:
    """Compute the maps that rank parts of frames, of each method (`Explanation.influence`) and of the controls."""
    maps = {name: explanation.influence(name) for name in explanation.relevance}
    inputs, references = network_inputs(network, explanation), network_references(network, explanation)
    return maps | control_maps(network.model, inputs, references)


def frame_columns(explanation: Explanation, steps: int | Sequence[int]) -> dict[str, np.ndarray]:
    """Make the columns that name the frame of each row, for so many rows a frame, or for each frame its own number."""
    return {
        column: np.repeat([getattr(frame, name) for frame in explanation.frames], steps)
        for column, name in (("frame_id", "id"), ("day", "day"), ("trial", "trial"))
    }


def score_curves(
    explanation: Explanation, curves: Mapping[Setting, Mapping[str, RemovalCurve]], *, random_orders: int, seed: int
) -> records.Faithfulness:
    """Make the scores of the curves of all frames, by setting and map, with intervals over days and trials."""
    rng, clusters, frames = np.random.default_rng(seed), explanation.clusters, explanation.frames
    labels = [np.nan if frame.safety_margin is None else frame.safety_margin for frame in frames]
    scores, comparisons, tables, gains = [], [], [], {}
    for setting, of_setting in curves.items():
        where = {"fill": setting.fill, "unit": setting.unit}
        gain = gains[setting] = {name: curve.symmetric_gain for name, curve in of_setting.items()}
        controls = {name: values for name, values in gain.items() if is_control(name)}
        for name, values in gain.items():
            of_control, srg = name in controls, mean_interval(values, clusters=clusters, rng=rng)
            lead = None if of_control else lead_over_controls(values, controls, clusters=clusters, rng=rng)
            scores.append(
                records.RemovalScore(**where, method=name, control=of_control, srg=srg, lead_over_controls=lead)
            )
        for first, second in combinations([name for name in gain if name not in controls], 2):
            gap = paired_difference(gain[first], gain[second], clusters=clusters, rng=rng)
            comparisons.append(records.MethodGap(**where, first=first, second=second, gap=gap))
        for name, curve in of_setting.items():
            rows, steps = curve.random.size, len(curve.areas)
            tables.append(
                records.RemovalTable(
                    **{column: np.repeat(text, rows) for column, text in (where | {"method": name}).items()},
                    **frame_columns(explanation, steps),
                    safety_margin=np.repeat(labels, steps),
                    area=np.tile(curve.areas, len(frames)),
                    **{column: getattr(curve, column).ravel() for column in ("most_first", "least_first", "random")},
                )
            )
    whole, empty = np.array([(frame.prediction, frame.reference_prediction) for frame in frames]).T / explanation.scale
    # all parts are gone at the end of every curve; nothing is known of a frame without a direction
    towards = np.where(explanation.towards == 0, np.nan, explanation.towards)
    blank = {
        setting.fill: whole - towards * next(iter(of_setting.values())).random[:, -1] / explanation.scale
        for setting, of_setting in curves.items()
        if setting != REDRAWN
    }
    return records.Faithfulness(
        input=explanation.input,
        source=explanation.source,
        unit=explanation.unit,
        frames=len(frames),
        trials=len(explanation.trials),
        random_orders=random_orders,
        scores=tuple(scores),
        comparisons=tuple(comparisons),
        alarms=(
            *count_alarm(
                np.abs(whole - empty) < CLOSE,
                f"next to nothing to explain in {{}} of {{}} frames: the answer lies within {CLOSE} of that on "
                f"{BASELINES[explanation.baseline]}, less than networks err by, and the direction that a gain counts "
                "along is chance; leave them out",
            ),
            *(saturated(whole) if explanation.unit == "margin" else ()),
            *flat_maps({name: explanation.influence(name) for name in explanation.relevance}),
            *(alarm for fill, gone in blank.items() for alarm in fill_decides(whole, gone, fill=fill)),
            *ranking_alarms({setting: {n: float(g.mean()) for n, g in of.items()} for setting, of in gains.items()}),
        ),
        table=records.RemovalTable.joined(tables),
    )


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
    return (1 - np.minimum(np.abs(base - masked), 1)) ** 2


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


def deletion_steps(shape: tuple[int, int], *, steps: int | None = None) -> Int[np.ndarray, " steps"]:
    """Return the pixels removed at each step: by default as many steps as the image is high; the last removes all.

    Polak, section 4 (n_masks = 224 for a 224 x 224 image: 224 steps of 224 pixels).
    """
    pixels, count = shape[0] * shape[1], steps or shape[0]
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
    areas = [0.0, *removed / removed[-1]]
    return removal_curves(predict, images, orders[None], fill=get_fill(fill), areas=areas)[0]


def score_deletion(
    explanation: Explanation, answers: Mapping[str, Float64[np.ndarray, "frames answers"]], *, fill: str
) -> records.DeletionScores:
    """Make the thesis's deletion scores of the predictions of all frames by method (`delete_pixels`)."""
    answers = {name: values / explanation.scale for name, values in answers.items()}
    frames, chance = len(explanation.frames), answers[CHANCE]
    removed = deletion_steps((explanation.image_size, explanation.image_size), steps=chance.shape[1] - 1)
    steps, methods, tables = len(removed), {}, []
    alarms = [
        *flat_maps(explanation.saliency),
        # the fill decides where the filled image is predicted like the whole one
        *fill_decides(chance[:, 0], chance[:, -1], fill=fill),
        *(saturated(chance[:, 0]) if explanation.unit == "margin" else ()),
    ]
    scores = {name: deletion_score(values[:, :1], values[:, 1:]) for name, values in answers.items()}
    for name, values in scores.items():
        means, last = values.mean(axis=1), values[:, -1]
        methods[name] = records.MethodScore(
            mean=float(means.mean()), sd=float(means.std()), last_step_mean=float(last.mean()), frames=frames
        )
        if name != CHANCE:
            alarms += follows_last_step(means, last, name=f"D of {name}")
        tables.append(
            records.DeletionTable(
                method=np.repeat(name, frames * steps),
                **frame_columns(explanation, steps),
                step=np.tile(np.arange(steps), frames),
                pixels_removed=np.tile(removed, frames),
                prediction=explanation.scale * answers[name][:, 1:].ravel(),
                score=values.ravel(),
            )
        )
    alarms += [
        f"{name} does not beat a random order ({method.mean:.3f} against {methods[CHANCE].mean:.3f})"
        for name, method in methods.items()
        if name != CHANCE and method.mean >= methods[CHANCE].mean
    ]
    return records.DeletionScores(
        input=explanation.input,
        source=explanation.source,
        fill=fill,
        steps=steps,
        methods=methods,
        alarms=tuple(alarms),
        table=records.DeletionTable.joined(tables),
    )


FILL_DECIDES = 0.05
"""An image of nothing but fill that is answered this near to the whole image, in margin units."""
_TIED_TO_LAST = 0.8
_SATURATED = 0.01
_SAME_ORDER = 0.5
_FEWEST = 3


def count_alarm(frames: Bool[np.ndarray, " images"], sentence: str) -> list[str]:
    """Return the sentence with the number of these frames, and of all, for its two `{}`; none without any."""
    return [sentence.format(int(frames.sum()), len(frames))] if frames.any() else []


def fill_decides(whole: Float[np.ndarray, " images"], filled: Float[np.ndarray, " images"], *, fill: str) -> list[str]:
    """Warn of images whose fill alone is predicted like the whole image: there no map can change the prediction."""
    return count_alarm(
        np.abs(whole - filled) < FILL_DECIDES,
        f"the fill decides in {{}} of {{}} frames: an image of nothing but {fill} is answered within "
        f"{FILL_DECIDES:.0%} of the whole frame",
    )


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


def saturated(answers: Float[np.ndarray, " images"]) -> list[str]:
    """Warn of predictions at an end of [0, 1] or outside: they can move one way only."""
    return count_alarm(
        (answers < _SATURATED) | (answers > 1 - _SATURATED),
        "{} of {} answers lie at an end of the margin: they can move one way only",
    )


def flat_maps(maps: Mapping[str, Float[np.ndarray, "images height width"]]) -> list[str]:
    """Warn of constant maps, which rank nothing."""
    alarms = []
    for method, values in maps.items():
        flat = np.equal(values.max(axis=(1, 2)), values.min(axis=(1, 2)))
        alarms += count_alarm(flat, f"{method}: {{}} of {{}} maps are constant and rank nothing")
    return alarms


def ranking_alarms(gains: Mapping[Setting, Mapping[str, float]]) -> list[str]:
    """Warn where a control wins, and of fills that rank the methods differently; mean gains by setting and name.

    Kendall, *A new measure of rank correlation* (1938).
    """
    from scipy.stats import kendalltau  # noqa: PLC0415 (takes a second)

    by_fill, alarms, doubts = dict[str, dict[str, float]](), [], []
    for setting, of_setting in gains.items():
        methods = {name: gain for name, gain in of_setting.items() if not is_control(name)}
        best = max(of_setting.keys() - methods.keys(), key=lambda name: of_setting[name], default=None)
        where = f"under {setting.fill}, {setting.unit} by {setting.unit}"
        for name, gain in methods.items():
            if gain <= 0:
                alarms.append(f"{where}: {name} does not beat a random order: its symmetric gain is {gain:.3f}")
            elif best is not None and gain <= of_setting[best]:
                control = f"the control {best} ({of_setting[best]:.3f})"
                alarms.append(f"{where}: {name} gains {gain:.3f}, no more than {control}")
        if setting.unit == "pixel":
            by_fill[setting.fill] = methods
    for (first, gains_of_first), (second, gains_of_second) in combinations(by_fill.items(), 2):
        common = [(gain, gains_of_second[name]) for name, gain in gains_of_first.items() if name in gains_of_second]
        tau = float(np.asarray(kendalltau(*np.transpose(common)))[0]) if len(common) >= _FEWEST else 1.0
        if not tau >= _SAME_ORDER:
            doubts.append(
                f"{first} and {second} rank the methods differently (Kendall's tau {tau:.2f}): which is best depends "
                "on what removed pixels become"
            )
    return [*doubts, *alarms]
