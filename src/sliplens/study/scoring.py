"""Score saved explanations with the deletion score of the thesis."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sliplens.errors import CheckpointError
from sliplens.faithfulness import (
    DeletionCurves,
    deletion_curves,
    get_fill,
    random_order,
    summarise_deletion,
)
from sliplens.faithfulness.alarms import fill_decides, flat_maps, follows_last_step, saturated
from sliplens.faithfulness.deletion import deletion_steps, saliency_orders
from sliplens.models import TrainedModel
from sliplens.provenance import write_json
from sliplens.study.material import make_fast
from sliplens.study.saved import RESULT_FILE, Explained

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

        curves[name] = deletion_curves(predict, inputs, order, fill=get_fill(fill), steps=steps, on_image=report)
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
