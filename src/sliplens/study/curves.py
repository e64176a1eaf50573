"""The sound curves of a study: every method and control, under several fills and units, with intervals and alarms."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float
from scipy.stats import kendalltau

from sliplens.errors import InputError
from sliplens.faithfulness import get_fill
from sliplens.faithfulness.alarms import controls_win, fill_decides, flat_maps, rankings_disagree, saturated
from sliplens.faithfulness.controls import CONTROLS
from sliplens.faithfulness.removal import RANDOM_ORDERS, Faithfulness, Predict, answer_whole, faithfulness
from sliplens.files import write_json
from sliplens.intervals import Difference, paired_difference
from sliplens.study.explaining import RESULT_FILE, Explained
from sliplens.study.material import Material

RANDOMISED = "randomised"
"""The control that explains a network whose weights were drawn anew."""
EQUAL_AREAS = (0.01, 0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One way to remove parts: what is removed at once, and what takes its place."""

    fill: str
    unit: str


Found = Mapping[Setting, Mapping[str, Faithfulness]]
"""Curves by setting and method, controls included."""


def judge_curves(found: Found, *, trials: np.ndarray, seed: int) -> dict[str, Any]:
    """Scores with intervals, comparisons, and how far the fills agree; whole trials are resampled.

    Parameters
    ----------
    found
        Curves by setting and method, controls included.
    trials
        Trial of each frame.
    seed
        Of the resampling.
    """
    rng = np.random.default_rng(seed)
    scores, comparisons = [], []
    for setting, curves in found.items():
        where = {"fill": setting.fill, "unit": setting.unit}
        for name, curve in curves.items():
            none = np.zeros_like(curve.symmetric_gain)
            scores.append(
                {
                    **where,
                    "method": name,
                    "control": is_control(name),
                    "srg": _interval(paired_difference(curve.symmetric_gain, none, trials=trials, rng=rng)),
                    "gain_over_random": _interval(
                        paired_difference(curve.gain_over_random, none, trials=trials, rng=rng)
                    ),
                    "most_first": float(curve.most_first.mean()),
                    "least_first": float(curve.least_first.mean()),
                    "random": float(curve.random.mean()),
                    "at": {str(area): float(curve.at(area)[0].mean()) for area in EQUAL_AREAS if area in curve.areas},
                }
            )
        methods = [name for name in curves if not is_control(name)]
        controls = [name for name in curves if is_control(name)]
        best = max(controls, key=lambda name: float(curves[name].symmetric_gain.mean()), default=None)
        pairs = [*combinations(methods, 2), *((name, best) for name in methods if best is not None)]
        for first, second in pairs:
            gains = (curves[first].symmetric_gain, curves[second].symmetric_gain)
            gap = paired_difference(*gains, trials=trials, rng=rng)
            comparisons.append({**where, "first": first, "second": second, "measure": "srg", **_interval(gap)})
    return {"scores": scores, "comparisons": comparisons, "agreement": _agreement(found)}


def is_control(name: str) -> bool:
    """Whether a row stands for a map that knows nothing of what the network learned."""
    return name in CONTROLS or name == RANDOMISED


def _interval(gap: Difference) -> dict[str, Any]:
    return {"estimate": gap.estimate, "low": gap.low, "high": gap.high, "units": gap.units, "sure": gap.sure}


def _agreement(found: Found) -> list[dict[str, Any]]:
    told = []
    for first, second in combinations(found, 2):
        if first.unit != second.unit:
            continue
        names = [name for name in found[first] if not is_control(name)]
        ranks = [[float(found[one][name].symmetric_gain.mean()) for name in names] for one in (first, second)]
        tau = float(np.asarray(kendalltau(*ranks))[0]) if len(names) > 1 else float("nan")
        told.append(
            {"unit": first.unit, "first": first.fill, "second": second.fill, "tau": tau if np.isfinite(tau) else None}
        )
    return told


def ranking_alarms(found: Found) -> list[str]:
    """Say where a control wins, and which fills rank the methods differently."""
    by_fill: dict[str, dict[str, float]] = {}
    told = []
    for setting, curves in found.items():
        methods = {name: curve for name, curve in curves.items() if not is_control(name)}
        controls = {name: curve for name, curve in curves.items() if is_control(name)}
        where = f"under {setting.fill}, {setting.unit} by {setting.unit}"
        told += [f"{where}: {alarm}" for alarm in controls_win(methods, controls)]
        if setting.unit == "pixel":
            by_fill[setting.fill] = {name: float(curve.symmetric_gain.mean()) for name, curve in methods.items()}
    return [*rankings_disagree(by_fill), *told]


CURVES_FILE = "curves.parquet"
STUDY_AREAS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Fewer than `removal.AREAS`, so that many settings can be scored: the equal areas, and enough for trapezoids."""

Influence = Mapping[str, Float[np.ndarray, "images height width"]]
Report = Callable[[int, int], None]
"""Takes the frames done, and their number."""
Scoring = Callable[[Report], Mapping[str, Faithfulness]]
"""Finds the curves of every map, and reports the frames done."""


SETTINGS = (
    Setting(fill="reference", unit="pixel"),
    Setting(fill="grey", unit="pixel"),
    Setting(fill="blur", unit="pixel"),
    Setting(fill="noisy-linear", unit="pixel"),
    Setting(fill="reference", unit="tile"),
    Setting(fill="reference", unit="marker"),
)


def influences(material: Material) -> dict[str, Float[np.ndarray, "frames size size"]]:
    """Maps to rank parts by: of each method the part of its relevance that works towards the target, and the controls.

    Parameters
    ----------
    material
        The explanations and what was explained.
    """
    maps = {name: material.towards_target(name) for name in material.explained.relevance}
    return maps | {name: control(material.inputs).double().cpu().numpy() for name, control in CONTROLS.items()}


def score_curves(
    material: Material,
    folder: Path,
    *,
    maps: Influence,
    settings: Sequence[Setting] = SETTINGS,
    random_orders: int = RANDOM_ORDERS,
    further: Mapping[Setting, Scoring] | None = None,
    seed: int = 0,
    on_frame: Callable[[int, int], None] | None = None,
) -> None:
    """Remove parts in the order of every map, under every setting, and write what it tells.

    Each setting is written under `parts` as soon as it is done; a second call with the same folder goes on after the
    last.

    Parameters
    ----------
    material
        The network, and the explanations of the frames that are scored.
    folder
        Gets `curves.parquet` and `result.json`; must exist.
    maps
        Influence by method, controls included (`influences`).
    settings
        What to remove, and what to put there; those whose unit is not known of every frame are left out.
    random_orders
        How many random orders.
    further
        What finds curves in another way, such as by drawing the scene anew; they are written and judged with the
        others.
    seed
        Of the random orders and the noise.
    on_frame
        Called with the frames done, over all settings, and their number.

    Raises
    ------
    InputError
        If a fill is unknown.
    """
    inputs, references, explained = material.inputs, material.references, material.explained
    for setting in settings:
        get_fill(setting.fill)
    units = material.units()
    known = [setting for setting in settings if setting.unit in units]
    orders = 2 * len(maps) + random_orders
    predict = material.fast(len(known) * len(inputs) * orders * (len(STUDY_AREAS) - 2))

    def remove(setting: Setting, report: Report) -> Mapping[str, Faithfulness]:
        return faithfulness(
            predict,
            inputs,
            dict(maps),
            units[setting.unit],
            fill=get_fill(setting.fill),
            references=references,
            towards=material.towards,
            # the same random orders under every fill
            rng=np.random.default_rng(seed),
            random_orders=random_orders,
            areas=STUDY_AREAS,
            seed=seed,
            on_progress=report,
        )

    works: dict[Setting, Scoring] = {setting: partial(remove, setting) for setting in known} | dict(further or {})
    parts = folder / "parts"
    parts.mkdir(exist_ok=True)
    found: dict[Setting, dict[str, Faithfulness]] = {}
    for number, (setting, work) in enumerate(works.items()):
        part = parts / f"{setting.fill}-{setting.unit}.npz"
        if not part.is_file():

            def report(done: int, _: int, before: int = number * len(inputs)) -> None:
                if on_frame is not None:
                    on_frame(before + done, len(works) * len(inputs))

            _save(part, work(report))
        found[setting] = _load(part)
    pq.write_table(_table(found, explained), folder / CURVES_FILE)
    whole = answer_whole(predict, inputs, batch_size=64)
    blank = {setting.fill: _answer_blank(predict, material, setting.fill, seed) for setting in known}
    write_json(
        folder / RESULT_FILE,
        {
            "input": explained.input,
            "source": explained.source,
            "frames": len(inputs),
            "trials": len(set(material.trials.tolist())),
            "random_orders": random_orders,
            "fills": list(dict.fromkeys(setting.fill for setting in found)),
            "units": list(dict.fromkeys(setting.unit for setting in found)),
            "areas": list(STUDY_AREAS),
            **judge_curves(found, trials=material.trials, seed=seed),
            "alarms": [
                *saturated(whole),
                *flat_maps({name: maps[name] for name in explained.relevance}),
                *(alarm for fill, answers in blank.items() for alarm in fill_decides(whole, answers, fill=fill)),
                *ranking_alarms(found),
            ],
        },
    )
    shutil.rmtree(parts)


def _answer_blank(predict: Predict, material: Material, fill: str, seed: int) -> Float[np.ndarray, " frames"]:
    """Answers on images of which everything is gone."""
    inputs = material.inputs
    paint = get_fill(fill)(inputs, material.references, seed)
    gone = torch.ones((len(inputs), *inputs.shape[-2:]), dtype=torch.bool, device=inputs.device)
    some = torch.arange(len(inputs), device=inputs.device).split(16)
    return answer_whole(predict, torch.cat([paint(rows, gone[rows]) for rows in some]), batch_size=64)


def _save(path: Path, found: Mapping[str, Faithfulness]) -> None:
    hidden = path.with_suffix(".part.npz")
    np.savez(
        hidden,
        allow_pickle=False,
        areas=next(iter(found.values())).areas,
        **{name: one.curves for name, one in found.items()},
    )
    hidden.replace(path)


def _load(path: Path) -> dict[str, Faithfulness]:
    with np.load(path, allow_pickle=False) as archive:
        areas = archive["areas"]
        return {name: Faithfulness(areas=areas, curves=archive[name]) for name in archive.files if name != "areas"}


def _table(found: Mapping[Setting, Mapping[str, Faithfulness]], explained: Explained) -> pa.Table:
    tables = []
    for setting, curves in found.items():
        for name, curve in curves.items():
            frames, steps = curve.curves.shape[1:]
            if frames != len(explained.frames):
                raise InputError(f"{frames} curves of {name} for {len(explained.frames)} frames; make the study again")
            tables.append(
                pa.table(
                    {
                        **{
                            column: [value] * (frames * steps)
                            for column, value in (("fill", setting.fill), ("unit", setting.unit), ("method", name))
                        },
                        "frame_id": np.repeat([frame.id for frame in explained.frames], steps),
                        "trial": np.repeat([frame.trial for frame in explained.frames], steps),
                        "safety_margin": np.repeat(
                            np.array(
                                [np.nan if one.safety_margin is None else one.safety_margin for one in explained.frames]
                            ),
                            steps,
                        ),
                        "area": np.tile(curve.areas, frames),
                        **{
                            column: curve.curves[number].ravel()
                            for number, column in enumerate(("most_first", "least_first", "random"))
                        },
                    }
                )
            )
    return pa.concat_tables(tables)
