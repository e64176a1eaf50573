"""Sound scores of a study: every method and control, under several fills and units, with intervals and alarms."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Shaped
from scipy.stats import kendalltau

from sliplens.codec import keep_part
from sliplens.errors import InputError
from sliplens.faithfulness import get_fill
from sliplens.faithfulness.alarms import controls_win, fill_decides, flat_maps, rankings_disagree, saturated
from sliplens.faithfulness.controls import control_maps, lead_over_controls
from sliplens.faithfulness.removal import RANDOM_ORDERS, Faithfulness, Predict, answer_whole, score_maps
from sliplens.faithfulness.scoring import prepare_passes
from sliplens.intervals import mean_interval, paired_difference
from sliplens.progress import OnProgress, continued
from sliplens.results.explanation import Explained
from sliplens.results.faithfulness import Agreement, Comparison, RemovalScore, RemovalScores, RemovalTable, is_control
from sliplens.study.material import Material

EQUAL_AREAS = (0.01, 0.02, 0.05, 0.1, 0.2)
STUDY_AREAS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Fewer than `removal.AREAS`, so that many settings can be scored: the equal areas, and enough for trapezoids."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """Way to remove parts: what is removed at once, and what takes its place."""

    fill: str
    unit: str


SETTINGS = (
    Setting(fill="reference", unit="pixel"),
    Setting(fill="grey", unit="pixel"),
    Setting(fill="blur", unit="pixel"),
    Setting(fill="noisy-linear", unit="pixel"),
    Setting(fill="reference", unit="tile"),
    Setting(fill="reference", unit="marker"),
)

Curves = Mapping[Setting, Mapping[str, Faithfulness]]
"""Curves by setting and method, controls included."""
Influence = Mapping[str, Float[np.ndarray, "images height width"]]
"""Maps to rank parts by, of each method and control."""
Scoring = Callable[..., Mapping[str, Faithfulness]]
"""Finds the curves of every map; takes `on_progress`."""


def influences(material: Material) -> dict[str, Float[np.ndarray, "frames size size"]]:
    """Maps to rank parts by: the part of each method's relevance that works towards the target, and the controls."""
    maps = {name: material.towards_target(name) for name in material.explained.relevance}
    return maps | control_maps(material.trained.model, material.inputs, material.references)


@dataclass(frozen=True, kw_only=True)
class _SettingCurves:
    """Curves of every map under one setting (`Faithfulness.curves`)."""

    areas: Float64[np.ndarray, " areas"]
    curves: dict[str, Float64[np.ndarray, "3 frames areas"]]


def score_removal(
    material: Material,
    *,
    maps: Influence,
    settings: Sequence[Setting] = SETTINGS,
    random_orders: int = RANDOM_ORDERS,
    further: Mapping[Setting, Scoring] = {},
    seed: int = 0,
    parts: Path | None = None,
    on_progress: OnProgress | None = None,
) -> RemovalScores:
    """Remove parts in the order of every map (`influences`), under every setting whose unit is known of every frame.

    Curves that are found in another way, such as by drawing the scene anew (`further`), are judged with the others.
    """
    inputs, explained = material.inputs, material.explained
    for setting in settings:
        get_fill(setting.fill)
    units = material.units()
    known = [setting for setting in settings if setting.unit in units]
    orders = 2 * len(maps) + random_orders
    predict = prepare_passes(material.trained, inputs, len(known) * len(inputs) * orders * (len(STUDY_AREAS) - 2))

    works: dict[Setting, Scoring] = {
        setting: partial(
            score_maps,
            predict,
            inputs,
            dict(maps),
            units[setting.unit],
            fill=get_fill(setting.fill),
            references=material.references,
            towards=explained.towards,
            # the same random orders under every fill
            rng=np.random.default_rng(seed),
            random_orders=random_orders,
            areas=STUDY_AREAS,
            seed=seed,
        )
        for setting in known
    }
    works |= further
    curves: dict[Setting, dict[str, Faithfulness]] = {}
    for number, (setting, work) in enumerate(works.items()):
        on_frames = continued(on_progress, before=number * len(inputs), total=len(works) * len(inputs))

        def find(work: Scoring = work, on_frames: OnProgress | None = on_frames) -> _SettingCurves:
            scored = work(on_progress=on_frames)
            areas = next(iter(scored.values())).areas
            return _SettingCurves(areas=areas, curves={name: own.curves for name, own in scored.items()})

        kept = keep_part(parts and parts / f"{setting.fill}-{setting.unit}", _SettingCurves, find)
        curves[setting] = {name: Faithfulness(areas=kept.areas, curves=own) for name, own in kept.curves.items()}
    whole = answer_whole(predict, inputs, batch_size=64)
    blank = {setting.fill: _answer_blank(predict, material, setting.fill, seed) for setting in known}
    scores, comparisons = judge_curves(curves, clusters=material.clusters, seed=seed)
    return RemovalScores(
        input=explained.input,
        source=explained.source,
        frames=len(inputs),
        trials=len(set(material.clusters[1].tolist())),
        random_orders=random_orders,
        fills=tuple(dict.fromkeys(setting.fill for setting in curves)),
        units=tuple(dict.fromkeys(setting.unit for setting in curves)),
        areas=STUDY_AREAS,
        scores=scores,
        comparisons=comparisons,
        agreement=compare_fills(curves),
        alarms=(
            *saturated(whole),
            *flat_maps({name: maps[name] for name in explained.relevance}),
            *(alarm for fill, answers in blank.items() for alarm in fill_decides(whole, answers, fill=fill)),
            *ranking_alarms(curves),
        ),
        table=_table(curves, explained),
    )


def _answer_blank(predict: Predict, material: Material, fill: str, seed: int) -> Float[np.ndarray, " frames"]:
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


def _table(curves: Curves, explained: Explained) -> RemovalTable:
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
