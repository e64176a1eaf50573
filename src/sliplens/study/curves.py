"""The sound curves of a study: every method and control, under several fills and units, with intervals and alarms."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float

from sliplens.errors import InputError
from sliplens.faithfulness import get_fill
from sliplens.faithfulness.alarms import fill_decides, flat_maps, saturated
from sliplens.faithfulness.answering import Predict, answer_whole
from sliplens.faithfulness.controls import CONTROLS
from sliplens.faithfulness.removal import RANDOM_ORDERS, Faithfulness, faithfulness
from sliplens.provenance import write_json
from sliplens.study.judging import Setting, judge_curves, ranking_alarms
from sliplens.study.material import Material
from sliplens.study.saved import RESULT_FILE, Explained

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
            on_image=report,
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
