"""Score saved explanations with the deletion score of the thesis."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, Int

from sliplens.errors import CheckpointError
from sliplens.faithfulness import (
    DeletionCurves,
    deletion_curves,
    deletion_score,
    get_fill,
    random_order,
    summarise_deletion,
)
from sliplens.faithfulness.alarms import fill_decides, flat_maps, follows_last_step, saturated
from sliplens.faithfulness.deletion import deletion_steps, saliency_orders
from sliplens.files import write_json
from sliplens.models import TrainedModel
from sliplens.study.explaining import RESULT_FILE, Explained
from sliplens.study.material import Material, make_fast

CURVES_FILE = "deletion.parquet"
CONTROL = "random"


@dataclass(frozen=True, kw_only=True)
class MethodScore:
    """Deletion score of one method over the frames: lower is more faithful."""

    mean: float
    sd: float
    last_step_mean: float
    frames: int


@dataclass(frozen=True, kw_only=True)
class ScoreResult:
    """Scores by method, the control among them, and what to be wary of."""

    methods: dict[str, MethodScore]
    alarms: tuple[str, ...]


def require_same_network(trained: TrainedModel, explained: Explained) -> None:
    """Refuse explanations of another network.

    Raises
    ------
    CheckpointError
        If the weights' hashes differ.
    """
    if explained.weights_sha256 != trained.manifest.weights_sha256:
        raise CheckpointError(
            "these explanations were made with another network; explain the frames again with this run"
        )


def score_explanations(
    trained: TrainedModel,
    explained: Explained,
    folder: Path,
    *,
    fill: str = "grey",
    steps: int | None = None,
    seed: int = 0,
    on_curve: Callable[[int, int], None] | None = None,
) -> ScoreResult:
    """Delete the most salient pixels step by step, for every method and for a random order.

    Parameters
    ----------
    trained
        The network that was explained.
    explained
        Saved explanations.
    folder
        Gets `deletion.parquet` (the curves) and `result.json` (the table); must exist.
    fill, steps
        What removed pixels become, and in how many steps (the image's height if None).
    seed
        Seeds the random control.
    on_curve
        Called with the number of curves done and the number of all.

    Raises
    ------
    CheckpointError
        If the explanations are of another network.
    """
    require_same_network(trained, explained)
    inputs = trained.encoding.normalise(explained.images).to(trained.device)
    shape = (inputs.shape[-2], inputs.shape[-1])
    rng = np.random.default_rng(seed)
    orders = {name: saliency_orders(maps, shape) for name, maps in explained.saliency.items()}
    orders[CONTROL] = np.stack([random_order(shape, rng=rng) for _ in explained.frames])
    count = len(inputs)
    passes = len(orders) * count * len(deletion_steps(shape, steps=steps))
    predict = make_fast(trained, inputs, passes=passes)
    curves: dict[str, DeletionCurves] = {}
    for number, (name, order) in enumerate(orders.items()):

        def report(done: int, _: int, before: int = number * count) -> None:
            if on_curve is not None:
                on_curve(before + done, len(orders) * count)

        curves[name] = deletion_curves(predict, inputs, order, fill=get_fill(fill), steps=steps, on_progress=report)
    names = [frame.id for frame in explained.frames]
    pq.write_table(
        pa.concat_tables([_table(method, curve, names) for method, curve in curves.items()]),
        folder / CURVES_FILE,
    )
    result = ScoreResult(
        methods={method: _method_score(curve) for method, curve in curves.items()},
        alarms=(*flat_maps(explained.saliency), *_alarms(curves, fill)),
    )
    some = curves[CONTROL]
    write_json(
        folder / RESULT_FILE,
        {
            "input": explained.input,
            "source": explained.source,
            "fill": fill,
            "steps": len(some.pixels_removed),
            "pixels_per_step": int(some.pixels_removed[0]),
            "methods": result.methods,
            "alarms": result.alarms,
        },
    )
    return result


def load_curves(folder: Path, explained: Explained) -> dict[str, DeletionCurves]:
    """Read the curves that `score_explanations` wrote of some explanations, by method, the control among them."""
    table = pq.read_table(folder / CURVES_FILE)
    method, shape = table["method"].to_numpy(), (len(explained.frames), -1)
    base = np.array([frame.prediction for frame in explained.frames])
    found = {}
    for name in dict.fromkeys(method.tolist()):
        mine = method == name
        found[name] = DeletionCurves(
            pixels_removed=table["pixels_removed"].to_numpy()[mine].reshape(shape)[0],
            base=base,
            predictions=table["prediction"].to_numpy()[mine].reshape(shape),
        )
    return found


def _method_score(curve: DeletionCurves) -> MethodScore:
    summary = summarise_deletion(curve.auc)
    return MethodScore(
        mean=summary.mean,
        sd=summary.sd,
        last_step_mean=float(curve.scores[:, -1].mean()),
        frames=summary.images,
    )


def _table(method: str, curve: DeletionCurves, names: list[str]) -> pa.Table:
    images, steps = curve.predictions.shape
    return pa.table(
        {
            "frame_id": np.repeat(names, steps),
            "method": [method] * (images * steps),
            "step": np.tile(np.arange(steps), images),
            "pixels_removed": np.tile(curve.pixels_removed, images),
            "prediction": curve.predictions.ravel(),
            "score": curve.scores.ravel(),
        }
    )


def _alarms(curves: dict[str, DeletionCurves], fill: str) -> list[str]:
    """Say where the score does not measure the explanation.

    References
    ----------
    Section 3 of the notes on faithfulness: the fill decides where the filled image is answered like the whole one; an
    explanation that does not beat a random order has shown nothing.
    """
    control = curves[CONTROL]
    alarms = [*fill_decides(control.base, control.predictions[:, -1], fill=fill), *saturated(control.base)]
    for method, curve in curves.items():
        if method == CONTROL:
            continue
        alarms += follows_last_step(curve.auc, curve.scores[:, -1], name=f"D of {method}")
        if curve.auc.mean() >= control.auc.mean():
            alarms.append(
                f"{method} does not beat a random order ({curve.auc.mean():.3f} against {control.auc.mean():.3f})"
            )
    return alarms


STEPS = 28
"""An eighth of the thesis's 224: the mean over the steps differs from that over all of them by less than a step."""
_STOP = 0.5
BACKGROUND = {"difference": "black", "raw": "white"}
"""What the thesis proposes as the background of its two inputs."""

Orders = Mapping[str, Int[np.ndarray, "frames pixels"]]


@dataclass(frozen=True, kw_only=True)
class _Curve:
    """D of one frame, step by step."""

    pixels_removed: Int[np.ndarray, " steps"]
    predictions: Float[np.ndarray, " steps"]
    scores: Float[np.ndarray, " steps"]


Curves = dict[str, list[_Curve]]
"""By method, for each frame; random orders among the methods."""


def score_remedies(
    material: Material,
    folder: Path,
    *,
    grey: Mapping[str, DeletionCurves],
    steps: int = STEPS,
    seed: int = 0,
    on_curve: Callable[[int, int], None] | None = None,
) -> None:
    """Score maps by deletion that stops at half of the saliency, by deletion to the background, and by insertion.

    Parameters
    ----------
    material
        The network, and the explanations of the frames that are scored.
    folder
        Gets `deletion.parquet` and `result.json`; must exist.
    grey
        The curves that the thesis scores, deletion to grey, by method with the random control (`load_curves`): stopping
        early needs no pass of its own.
    steps
        Steps of the others until every pixel is gone.
    seed
        Of the random control.
    on_curve
        Called with the number of curves done and the number of all.

    References
    ----------
    Polak, discussion of the faithfulness curves: stop once all pixels with saliency above 0.5 are gone; another fill.
    """
    explained, inputs = material.explained, material.inputs
    shape = (inputs.shape[-2], inputs.shape[-1])
    rng = np.random.default_rng(seed)
    orders = {name: saliency_orders(maps, shape) for name, maps in explained.saliency.items()}
    orders[CONTROL] = np.stack([random_order(shape, rng=rng) for _ in explained.frames])
    background = BACKGROUND.get(explained.input, "background")
    total, done = 2 * len(orders) * len(inputs), 0
    predict = material.fast(total * steps)

    def run(fill: str, one: Int[np.ndarray, "frames pixels"]) -> list[_Curve]:
        nonlocal done
        before = done

        def report(images: int, _: int) -> None:
            if on_curve is not None:
                on_curve(before + images, total)

        found = deletion_curves(predict, inputs, one, fill=get_fill(fill), steps=steps, on_progress=report)
        done = before + len(inputs)
        return _split(found)

    variants: dict[str, tuple[dict[str, Any], Curves]] = {
        "stop-at-half": (
            {
                "told": "Grey fill; ends once every pixel with a saliency above 0.5 is gone, so that frames and "
                "methods end at different areas. Random orders end at the median area of the methods.",
                "fill": "grey",
                "mode": "deletion",
                "stop": _STOP,
                "better": "lower",
            },
            _stopped({name: _split(found) for name, found in grey.items()}, explained),
        ),
        "background": (
            {
                "told": f"Removed pixels become {background}, and all of them go.",
                "fill": background,
                "mode": "deletion",
                "stop": None,
                "better": "lower",
            },
            {name: run(background, one) for name, one in orders.items()},
        ),
        "insertion": (
            {
                "told": "From an image of nothing but grey, the most salient pixels come first; D against the answer "
                "on the whole image, so that a faithful map rises early.",
                "fill": "grey",
                "mode": "insertion",
                "stop": None,
                "better": "higher",
            },
            # inserting k pixels of an order is deleting all the others
            {name: _inserted(run("grey", one[:, ::-1].copy()), explained) for name, one in orders.items()},
        ),
    }
    pq.write_table(
        pa.concat_tables(
            [table for name, (_, curves) in variants.items() for table in _tables(name, curves, explained)]
        ),
        folder / CURVES_FILE,
    )
    write_json(
        folder / RESULT_FILE,
        {
            "input": explained.input,
            "source": explained.source,
            "steps": steps,
            "variants": {
                name: {**about, "methods": {method: _score(one) for method, one in curves.items()}}
                for name, (about, curves) in variants.items()
            },
            "alarms": [
                alarm
                for name, (_, curves) in variants.items()
                if name != "insertion"
                for alarm in _remedy_alarms(name, curves)
            ],
        },
    )


def _split(curves: DeletionCurves) -> list[_Curve]:
    return [
        _Curve(pixels_removed=curves.pixels_removed, predictions=answers, scores=scores)
        for answers, scores in zip(curves.predictions, curves.scores, strict=True)
    ]


def _stopped(curves: Curves, explained: Explained) -> Curves:
    """Cut each curve after the step at which all pixels above the threshold are gone, the first step at least."""
    counts = {name: (maps > _STOP).sum(axis=(1, 2)) for name, maps in explained.saliency.items()}
    middle = np.median(np.stack(list(counts.values())), axis=0)
    return {
        name: [_cut(curve, int(count)) for curve, count in zip(ones, counts.get(name, middle), strict=True)]
        for name, ones in curves.items()
    }


def _cut(curve: _Curve, pixels: int) -> _Curve:
    end = int(np.searchsorted(curve.pixels_removed, pixels)) + 1
    return _Curve(
        pixels_removed=curve.pixels_removed[:end], predictions=curve.predictions[:end], scores=curve.scores[:end]
    )


def _inserted(curves: list[_Curve], explained: Explained) -> list[_Curve]:
    """Read deletion of the least salient pixels backwards, the whole image last."""
    turned = []
    for curve, frame in zip(curves, explained.frames, strict=True):
        removed = np.concatenate([[0], curve.pixels_removed[:-1]])[::-1]
        answers = np.concatenate([[frame.prediction], curve.predictions[:-1]])[::-1]
        scores = deletion_score(np.full(len(answers), frame.prediction), answers)
        turned.append(_Curve(pixels_removed=removed.copy(), predictions=answers.copy(), scores=scores))
    return turned


def _score(curves: list[_Curve]) -> dict[str, Any]:
    summary = summarise_deletion(np.array([curve.scores.mean() for curve in curves]))
    last = float(np.mean([curve.scores[-1] for curve in curves]))
    return {"mean": summary.mean, "sd": summary.sd, "last_step_mean": last, "frames": summary.images}


def _remedy_alarms(variant: str, curves: Curves) -> list[str]:
    told = []
    chance = float(np.mean([curve.scores.mean() for curve in curves[CONTROL]]))
    for name, ones in curves.items():
        if name == CONTROL:
            continue
        means, last = (
            np.array([read(one) for one in ones])
            for read in (lambda one: one.scores.mean(), lambda one: one.scores[-1])
        )
        if len({len(one.scores) for one in ones}) == 1:  # where curves stop early, the last step is the map's own doing
            told += follows_last_step(means, last, name=f"{variant}: D of {name}")
        if means.mean() >= chance:
            told.append(f"{variant}: {name} does not beat a random order ({means.mean():.3f} against {chance:.3f})")
    return told


def _tables(variant: str, curves: Curves, explained: Explained) -> Iterator[pa.Table]:
    for name, ones in curves.items():
        for frame, curve in zip(explained.frames, ones, strict=True):
            count = len(curve.scores)
            yield pa.table(
                {
                    "variant": [variant] * count,
                    "frame_id": [frame.id] * count,
                    "method": [name] * count,
                    "step": np.arange(count),
                    "pixels_removed": curve.pixels_removed,
                    "prediction": curve.predictions.astype(np.float64),
                    "score": curve.scores.astype(np.float64),
                }
            )
