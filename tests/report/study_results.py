"""A made-up study: the files that its stages write, with numbers that tests choose and nothing measured."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from made_up import SIZE, explained, frames_named, picture_and_maps, write_evaluation, write_run

from sliplens.faithfulness.scoring import frame_columns, score_curves, score_deletion
from sliplens.intervals import Difference
from sliplens.results import study as records
from sliplens.results.explanation import ExplainedFrame, Explanation, MethodNotes
from sliplens.results.faithfulness import Lead, MethodGap, RemovalCurve

INPUTS = ("difference", "raw")
METHODS = ("grad-cam", "integrated-gradients", "poly-cam")
CONTROLS = ("edges", "centre")
FILLS = (("reference", "pixel"), ("grey", "pixel"), ("blur", "pixel"), ("reference", "marker"), ("true", "marker"))
LEVELS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
SCORED = (0.4, 0.2, 0.0)
GRID = SIZE * np.stack([axis.ravel() for axis in np.meshgrid(*[np.linspace(0.14, 0.86, 6)] * 2)])
"""Markers, x and y."""
GAINS = {"grad-cam": -0.05, "integrated-gradients": 0.06, "poly-cam": 0.16, "edges": 0.02, "centre": 0.01}
SPEARMAN = {"grad-cam": 0.3, "integrated-gradients": 0.4, "poly-cam": 0.7, "poly-cam-thesis": 0.2}
MAP_MEASURES = {
    "grad-cam": {"resolution": 0.05, "total_variation": 0.01, "infidelity": 0.2, "max_sensitivity": 0.1},
    "integrated-gradients": {"resolution": 0.7, "total_variation": 0.2, "infidelity": 0.1, "max_sensitivity": 0.4},
    "poly-cam": {"resolution": 0.6, "total_variation": 0.05, "infidelity": 0.15, "max_sensitivity": 0.2},
}


@dataclass(frozen=True, kw_only=True)
class Made:
    """What the made-up results say."""

    trials: int = 6
    inputs: tuple[str, ...] = INPUTS
    methods: tuple[str, ...] = METHODS
    """With sound scores."""
    gains: Mapping[str, float] = field(default_factory=lambda: GAINS)
    """Symmetric relevance gain of each method on difference images; raw images get half of it, plus `raw_more`."""
    raw_more: float = 0.0
    looks: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: MAP_MEASURES)
    top_share: float = 0.8
    """Of the network's effects that two markers hold."""
    edge_mass: float = 0.3
    spearman: Mapping[str, float] = field(default_factory=lambda: SPEARMAN)
    """Of each method's map with the markers' Shapley values; every interval reaches 0.05 either way."""
    sound: bool = True
    """Whether every trial that was taken qualifies."""
    as_run: str = ""
    """Ends the names of the methods in maps, deletion scores and map quality."""


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    value = json.loads(path.read_text(encoding="utf-8"))
    change(value)
    path.write_text(json.dumps(value), encoding="utf-8")


def frames_of(made: Made) -> list[records.ChosenFrame]:
    rows = []
    for trial in range(made.trials):
        for level in LEVELS:
            if trial and level not in SCORED:
                continue
            frame = round(40 * (1 - level))
            rows.append(
                records.ChosenFrame(
                    id=f"t{trial:02d}-f{frame:04d}",
                    trial=f"t{trial:02d}",
                    frame=frame,
                    level=level,
                    safety_margin=min(1.0, max(0.0, level + 0.002)),
                    scored=level in SCORED,
                    pictured=trial == 0,
                )
            )
    return rows


def scored_frames(made: Made) -> list[records.ChosenFrame]:
    return [frame for frame in frames_of(made) if frame.scored]


def write_study(workspace: Path, made: Made | None = None) -> Path:
    """Every stage of a study."""
    made = made or Made()
    rng = np.random.default_rng(7)
    write_choice(workspace, made)
    write_states(workspace, made)
    for name in made.inputs:
        write_evaluation(workspace, name, trials=6, rng=rng)
        write_maps(workspace, name, made, rng=rng)
        write_thesis_scores(workspace, name, made, rng=rng)
        write_faithfulness(workspace, name, made, rng=rng)
        write_quality(workspace, name, made)
        write_truth(workspace, name, made, rng=rng)
    return workspace


def write_choice(workspace: Path, made: Made) -> Path:
    trials = tuple(
        records.ChosenTrial(
            trial=f"t{index:02d}",
            qualified=made.sound or index != 1,
            worst_error=dict.fromkeys(made.inputs, 0.01 + 0.005 * index),
        )
        for index in range(made.trials)
    )
    return write_run(
        workspace / "choice",
        "choice",
        {"trials": made.trials},
        records.Choice(
            trials_wanted=made.trials,
            tolerance=0.03,
            considered=60,
            qualified=made.trials - (not made.sound),
            mean_error={name: 0.07 if name == "difference" else 0.13 for name in made.inputs},
            source="simulated",
            condition="dry",
            trials=trials,
            frames=tuple(frames_of(made)),
        ),
    )


def write_states(workspace: Path, made: Made) -> Path:
    shown = [frame for frame in frames_of(made) if frame.pictured]
    x, y = np.tile(GRID, len(shown))
    shift = 0.08 * (1 - np.repeat([frame.safety_margin for frame in shown], len(GRID[0])))
    marker = np.tile(np.arange(len(GRID[0])), len(shown))
    lost = marker == 0  # one marker was not followed
    table = records.MarkerTable(
        frame_id=np.repeat([frame.id for frame in shown], len(GRID[0])),
        marker=marker,
        rest_x_px=x,
        rest_y_px=y,
        x_px=np.where(lost, np.nan, x),
        y_px=np.where(lost, np.nan, y + SIZE * shift * np.exp(-8 * ((y / SIZE - 0.55) ** 2 + (x / SIZE - 0.5) ** 2))),
    )
    return write_run(workspace / "states", "states", {}, records.States(untracked=(), table=table))


def frames_explained(rows: Sequence[records.ChosenFrame]) -> tuple[ExplainedFrame, ...]:
    margins = [row.safety_margin for row in rows]
    return frames_named([row.id for row in rows], margins, [margin + 0.01 for margin in margins])


def without_maps(name: str, rows: Sequence[records.ChosenFrame]) -> Explanation:
    return explained(name, frames_explained(rows), {}, np.zeros((len(rows), SIZE, SIZE, 3), np.uint8), {})


def write_maps(workspace: Path, name: str, made: Made, *, rng: np.random.Generator) -> None:
    rows = frames_of(made)
    drawn = [picture_and_maps(row.safety_margin, name, rng) for row in rows]
    stacked = {
        method + made.as_run: np.stack([maps[method] for _, maps in drawn]).astype(np.float32) for method in METHODS
    }
    notes: dict[str, MethodNotes] = dict.fromkeys(stacked, MethodNotes(seconds_per_frame=0.1, warnings=()))
    pictures = np.stack([picture for picture, _ in drawn])
    found = explained(name, frames_explained(rows), notes, pictures, stacked)
    write_run(workspace / f"explain-{name}", "explain", {"input": name}, found)


def write_thesis_scores(workspace: Path, name: str, made: Made, *, rng: np.random.Generator) -> Path:
    """Predictions that fall by up to 0.5, the earlier the more the method gains."""
    rows, share = frames_of(made), np.arange(SIZE + 1) / SIZE
    falls = {method + made.as_run: share ** np.exp(-8 * gain_of(made, name, method)) for method in METHODS}
    answers = {
        method: 0.6 - rng.uniform(0.4, 0.6, (len(rows), 1)) * fall - 0.005 * rng.random((len(rows), len(share)))
        for method, fall in (falls | {"random": share}).items()
    }
    scores = score_deletion(without_maps(name, rows), answers, fill="grey")
    scores = replace(scores, alarms=("the fill decides in 2 of 18 frames",))
    return write_run(workspace / f"score-{name}", "score", {"fill": "grey"}, scores)


def gain_of(made: Made, name: str, method: str) -> float:
    gain = made.gains.get(method, 0.0)
    return gain if name == "difference" else gain / 2 + made.raw_more


def write_faithfulness(workspace: Path, name: str, made: Made, *, rng: np.random.Generator) -> Path:
    """Curves whose symmetric gain is the method's own, plus what the trial adds: 6 a (1 - a) has area 1."""
    areas = np.linspace(0, 1, 21)
    bump = 6 * areas * (1 - areas)
    bump /= np.trapezoid(bump, areas)
    rows, chance, curves = scored_frames(made), 0.4 * areas, {}
    for fill, unit in FILLS:
        of_setting = {}
        for method in [*made.methods, *CONTROLS]:
            of_trial = rng.normal(0, 0.01, made.trials)
            gains = np.array([gain_of(made, name, method) + of_trial[int(row.trial[1:])] for row in rows])
            half = gains[:, None] / 2 * bump
            most, least, random = chance + half, chance - half, chance + 0 * half
            of_setting[method] = RemovalCurve(areas=areas, most_first=most, least_first=least, random=random)
        curves[records.Setting(fill=fill, unit=unit)] = of_setting
    scores = score_curves(without_maps(name, rows), curves, random_orders=20, seed=0)
    scores = replace(scores, alarms=("grad-cam does not beat a random order: its symmetric gain is -0.050",))
    return write_run(workspace / f"faithfulness-{name}", "faithfulness", {}, scores)


def write_quality(workspace: Path, name: str, made: Made) -> Path:
    looks = {method + made.as_run: records.MapMeasures(**values) for method, values in made.looks.items()}
    rougher = []
    for (first, one), (second, other) in combinations(looks.items(), 2):
        gap = interval((one.total_variation or 0) - (other.total_variation or 0), made.trials, half=0.001)
        rougher.append(MethodGap(first=first, second=second, gap=gap))
    facts = {"input": name, "source": "simulated", "frames": 42}
    quality = records.MapQuality(**facts, methods=looks, comparisons=tuple(rougher))
    return write_run(workspace / f"map-quality-{name}", "map-quality", {}, quality)


def write_truth(workspace: Path, name: str, made: Made, *, rng: np.random.Generator) -> Path:
    rows, count = scored_frames(made), len(GRID[0])
    x, y = np.tile(GRID, len(rows))
    share = np.full(count, (1 - made.top_share) / (count - 2))
    share[[14, 20]] = made.top_share / 2
    # a little of its own in each trial, so that an interval has a width
    network = (0.3 * share * (1 + 0.02 * rng.random((len(rows), count)))).ravel()
    effects = records.MarkerEffects(
        **frame_columns(without_maps(name, rows), count),
        safety_margin=np.repeat([row.safety_margin for row in rows], count),
        marker=np.tile(np.arange(count), len(rows)),
        x_px=x,
        y_px=y,
        shapley=network,
        shapley_error=0.1 * network,
        stick=network,
        state=np.ones(len(x), dtype=np.int64),
    )
    known = {"edges": 0.1, "oracle": 1.0, "degraded-oracle": 0.8}
    spearman = {**made.spearman, **known}
    test = records.MetaTest(fill="true", oracle=0.3, degraded=0.2, changed=0.1, gap=interval(0.1, made.trials))
    return write_run(
        workspace / f"truth-{name}",
        "truth",
        {},
        records.Truth(
            input=name,
            source="simulated",
            frames=len(rows),
            methods={
                method: records.Localisation(
                    **dict.fromkeys(("neutral", "stick", "shapley"), interval(value, made.trials)),
                    lead_over_controls=None
                    if method in known
                    else Lead(control="edges", gap=interval(value - known["edges"], made.trials)),
                    edges=interval(made.edge_mass - 0.07, made.trials, half=0.01),
                )
                for method, value in spearman.items()
            },
            pairs=400,
            meta=(test,),
            effects=effects,
            neutral=records.NeutralScores(
                **{
                    column: np.tile(values, len(spearman))
                    for column, values in frame_columns(without_maps(name, rows), 1).items()
                },
                method=np.repeat(list(spearman), len(rows)),
                correlation=np.repeat(list(spearman.values()), len(rows)),
            ),
        ),
    )


def interval(value: float, units: int, *, half: float = 0.05) -> Difference:
    return Difference(estimate=value, low=value - half, high=value + half, units=units)
