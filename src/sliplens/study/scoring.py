"""Deletion score of the thesis, and the remedies that the thesis proposes for it."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int

from sliplens.errors import CheckpointError
from sliplens.faithfulness import DeletionCurves, deletion_curves, deletion_score, get_fill, random_order
from sliplens.faithfulness.alarms import fill_decides, flat_maps, follows_last_step, saturated
from sliplens.faithfulness.deletion import deletion_steps, saliency_orders
from sliplens.faithfulness.scoring import prepare_passes
from sliplens.models import Run
from sliplens.progress import OnProgress, continued
from sliplens.results.explanation import Explained, ExplainedFrame
from sliplens.results.faithfulness import DeletionScores, DeletionTable, MethodScore, Remedies, Variant, VariantTable
from sliplens.study.explaining import network_inputs
from sliplens.study.material import Material

CONTROL = "random"
STEPS = 28
"""An eighth of the thesis's 224: the mean over the steps differs from that over all of them by less than a step."""
BACKGROUND = {"difference": "black", "raw": "white"}
"""What the thesis proposes as the background of its two inputs."""
_STOP = 0.5


_Curves = Mapping[str, Sequence[DeletionTable]]
"""Curve of each frame, by method; random orders among the methods."""


def require_same_network(trained: Run, explained: Explained) -> None:
    """Refuse explanations of another network."""
    if explained.weights_sha256 != trained.manifest.weights_sha256:
        raise CheckpointError(
            "these explanations were made with another network; explain the frames again with this run"
        )


def score_explanations(
    trained: Run,
    explained: Explained,
    *,
    fill: str = "grey",
    steps: int | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> DeletionScores:
    """Delete the most salient pixels for every method and a random order, in so many steps or the image's height.

    Raises
    ------
    CheckpointError
        If the explanations are of another network.
    """
    require_same_network(trained, explained)
    inputs = network_inputs(trained, explained)
    orders, shape = _orders(explained, seed=seed), (inputs.shape[-2], inputs.shape[-1])
    total = len(orders) * len(inputs)
    predict = prepare_passes(trained, inputs, total * len(deletion_steps(shape, steps=steps)))
    deleted = {
        name: deletion_curves(
            predict,
            inputs,
            order,
            fill=get_fill(fill),
            steps=steps,
            on_progress=continued(on_progress, before=number * len(inputs), total=total),
        )
        for number, (name, order) in enumerate(orders.items())
    }
    curves, control = {name: _split(name, own, explained) for name, own in deleted.items()}, deleted[CONTROL]
    return DeletionScores(
        input=explained.input,
        source=explained.source,
        fill=fill,
        steps=len(control.pixels_removed),
        pixels_per_step=int(control.pixels_removed[0]),
        methods={name: _score(own) for name, own in curves.items()},
        alarms=(
            *flat_maps(explained.saliency),
            # the fill decides where the filled image is answered like the whole one
            *fill_decides(control.base, control.predictions[:, -1], fill=fill),
            *saturated(control.base),
            *_method_alarms(curves),
        ),
        table=DeletionTable.joined([curve for own in curves.values() for curve in own]),
    )


def score_remedies(
    material: Material,
    *,
    grey: DeletionScores,
    steps: int = STEPS,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> Remedies:
    """Score maps by deletion that stops at half of the saliency, by deletion to the background, and by insertion.

    Stopping early needs no pass of its own: the same frames, scored by deletion to grey, are given.

    References
    ----------
    Polak, discussion of the faithfulness curves: stop once all pixels with saliency above 0.5 are gone; another fill.
    """
    explained, inputs = material.explained, material.inputs
    orders = _orders(explained, seed=seed)
    background = BACKGROUND.get(explained.input, "background")
    total, done = 2 * len(orders) * len(inputs), 0
    predict = prepare_passes(material.trained, inputs, total * steps)

    def delete(name: str, fill: str, order: Int[np.ndarray, "frames pixels"]) -> list[DeletionTable]:
        nonlocal done
        progress = continued(on_progress, before=done, total=total)
        done += len(inputs)
        deleted = deletion_curves(predict, inputs, order, fill=get_fill(fill), steps=steps, on_progress=progress)
        return _split(name, deleted, explained)

    curves: dict[str, _Curves] = {
        "stop-at-half": _stopped(grey, explained),
        "background": {name: delete(name, background, order) for name, order in orders.items()},
        # inserting k pixels of an order is deleting all the others
        "insertion": {
            name: _inserted(delete(name, "grey", order[:, ::-1].copy()), explained) for name, order in orders.items()
        },
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
        "insertion": "From an image of nothing but grey, the most salient pixels come first; D against the answer on "
        "the whole image, so that a faithful map rises early.",
    }
    each = [(name, curve) for name, by_method in curves.items() for own in by_method.values() for curve in own]
    tables = [VariantTable(variant=np.repeat(name, len(curve)), **vars(curve)) for name, curve in each]
    return Remedies(
        input=explained.input,
        source=explained.source,
        steps=steps,
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


def _orders(explained: Explained, *, seed: int) -> dict[str, Int[np.ndarray, "frames pixels"]]:
    """Pixels of each frame by method, most salient first, and a random order."""
    rng, shape = np.random.default_rng(seed), (explained.image_size, explained.image_size)
    orders = {name: saliency_orders(maps, shape) for name, maps in explained.saliency.items()}
    return orders | {CONTROL: np.stack([random_order(shape, rng=rng) for _ in explained.frames])}


def _curve(method: str, frame: ExplainedFrame, removed: np.ndarray, answers: np.ndarray, base: float) -> DeletionTable:
    told = {"method": method, "frame_id": frame.id, "day": frame.day, "trial": frame.trial}
    columns = {name: np.repeat(value, len(answers)) for name, value in told.items()}
    step, score = np.arange(len(answers)), deletion_score(np.full(len(answers), base), answers)
    return DeletionTable(**columns, step=step, pixels_removed=removed, prediction=answers, score=score)


def _split(method: str, curves: DeletionCurves, explained: Explained) -> list[DeletionTable]:
    rows = zip(explained.frames, curves.predictions, curves.base, strict=True)
    return [_curve(method, frame, curves.pixels_removed, answers, base) for frame, answers, base in rows]


def _score(curves: Sequence[DeletionTable]) -> MethodScore:
    auc, last = np.array([(curve.score.mean(), curve.score[-1]) for curve in curves]).T
    return MethodScore(
        mean=float(auc.mean()), sd=float(auc.std()), last_step_mean=float(last.mean()), frames=len(curves)
    )


def _stopped(grey: DeletionScores, explained: Explained) -> _Curves:
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


def _inserted(curves: Sequence[DeletionTable], explained: Explained) -> list[DeletionTable]:
    """Read deletion of the least salient pixels backwards, the whole image last."""
    turned = []
    for curve, frame in zip(curves, explained.frames, strict=True):
        removed = np.concatenate([[0], curve.pixels_removed[:-1]])[::-1]
        answers = np.concatenate([[frame.prediction], curve.prediction[:-1]])[::-1]
        turned.append(_curve(str(curve.method[0]), frame, removed.copy(), answers.copy(), frame.prediction))
    return turned


def _method_alarms(curves: _Curves) -> Iterator[str]:
    """Say where the score does not measure the map: one that does not beat a random order has shown nothing."""
    chance = float(np.mean([curve.score.mean() for curve in curves[CONTROL]]))
    for name, own in curves.items():
        if name == CONTROL:
            continue
        means, last = (np.array(values) for values in zip(*((c.score.mean(), c.score[-1]) for c in own), strict=True))
        if len({len(curve) for curve in own}) == 1:  # where curves stop early, the last step is the map's doing
            yield from follows_last_step(means, last, name=f"D of {name}")
        if means.mean() >= chance:
            yield f"{name} does not beat a random order ({means.mean():.3f} against {chance:.3f})"
