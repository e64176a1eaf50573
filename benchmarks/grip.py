"""Hold objects by every controller on the same draws, and set the margin law beside the fixed forces that match it.

Fingertips and seeds are others than those by which the controllers' constants were chosen (the table's first 64
fingertips, seeds from 1000). `excess_ratio`: force excess of a controller over that of the least fixed force that drops
as few. `drop_ratio`: its drops over those of the fixed force of the same mean. Intervals (95 %) are over episodes,
drawn again 400 times, the same for all controllers. With `--json` the last line is one JSON object.
"""

import argparse
import itertools
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

# as the command line does; must be set before torch is imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np

from sliplens.files import DEFAULT_NETWORK
from sliplens.friction import GRASP_SPREAD, Friction, SlipLearner
from sliplens.grip.controllers import make_controller
from sliplens.grip.episodes import GripLoop, Tick, run_episodes, run_scripts
from sliplens.grip.fingertip import ReadingTable, RenderedSensor, TableSensor, load_readings
from sliplens.grip.plant import CONDITIONS, OBJECTS, Plant, Scripts, draw_scripts
from sliplens.grip.records import EpisodeTable
from sliplens.models import load

SEED = 500_000
CHOSEN = 64
"""Fingertips by which constants were chosen: no episode here has one of them."""
FORCES_N = (0.5, 0.8, 1.1, 1.4, 1.8, 2.2, 2.6, 3.0, 3.5, 4.0)
CONTROLLERS = ("margin", "assumed-friction", "reflex", "oracle")
LATENCIES_S = (0.0, 0.025, 0.05, 0.075, 0.1, 0.15)
SCALES = (0.0, 0.5, 1.0, 1.5, 2.0)
TARGETS = (0.05, 0.15, 0.25, 0.35, 0.45)
TOLD = ("exactly", "within 10 %", "from one slip")
_DRAWS = 400


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Episodes of one controller, condition after condition."""

    dropped: np.ndarray
    excess: np.ndarray
    force_n: np.ndarray
    slip_m: np.ndarray


def draw(conditions: Sequence[str], episodes: int) -> tuple[Scripts, np.ndarray]:
    """Episodes of each condition, and its name for each."""
    tips = len(READINGS) // 2
    drawn = [
        draw_scripts("cup", name, episodes=episodes, seed=SEED + list(CONDITIONS).index(name), fingertips=tips)
        for name in conditions
    ]
    return Scripts.joined(drawn), np.repeat(list(conditions), episodes)


def hold(
    controller: str,
    settings: dict[str, float],
    scripts: Scripts,
    *,
    latency_s: float = 0.02,
    error_scale: float = 1.0,
    friction: list[Friction] | None = None,
) -> Outcome:
    """Run a controller over all episodes at once."""
    rng = np.random.default_rng(SEED)
    learners = [SlipLearner(mu) for mu in friction or ()]
    sensor = TableSensor(READINGS, fingertips=scripts.fingertips, rng=rng, error_scale=error_scale, learners=learners)
    plant, hand = (
        Plant(OBJECTS["cup"], episodes=len(scripts)),
        make_controller(controller, settings, friction_known=bool(friction)),
    )
    loop = GripLoop(plant, sensor if controller != "fixed" else None, hand, latency_s=latency_s)
    table = run_scripts(loop, scripts)
    return Outcome(
        dropped=table.dropped,
        excess=table.force_excess,
        force_n=table.mean_force_n,
        slip_m=table.slip_m,
    )


def compare(own: Outcome, fixed: Sequence[Outcome], rows: np.ndarray, rng: np.random.Generator) -> dict[str, object]:
    """Rates of a controller, and its ratios to the fixed forces that match it, with intervals."""
    drops, excess, forces = (
        np.stack([getattr(one, name)[rows] for one in fixed]) for name in ("dropped", "excess", "force_n")
    )
    grid = np.array(FORCES_N)

    def ratios(picks: np.ndarray) -> tuple[float, ...]:
        rate, over, mean = (values[:, picks].mean(axis=1) for values in (drops, excess, forces))
        mine, own_over = own.dropped[rows][picks].mean(), own.excess[rows][picks].mean()
        # the least force that drops as few; the strongest where none does
        matched = np.interp(-max(mine, rate[-1]), -rate, grid)
        beside = np.interp(own.force_n[rows][picks].mean(), mean, rate)
        return mine, own_over, own_over / np.interp(matched, grid, over), mine / beside if beside else np.nan

    count = int(rows.sum())
    estimates = ratios(np.arange(count))
    again = np.array([ratios(rng.integers(count, size=count)) for _ in range(_DRAWS)])
    low, high = np.nanquantile(again, (0.025, 0.975), axis=0)
    names = ("drop_rate", "force_excess", "excess_ratio", "drop_ratio")
    told: dict[str, object] = {
        name: {"estimate": _number(value), "low": _number(a), "high": _number(b)}
        for name, value, a, b in zip(names, estimates, low, high, strict=True)
    }
    return told | {
        "mean_force_n": round(float(own.force_n[rows].mean()), 3),
        "median_slip_mm": round(1e3 * float(np.median(own.slip_m[rows])), 3),
    }


def tell(how: str, scripts: Scripts, rng: np.random.Generator) -> list[Friction]:
    """What is told of the friction with which each episode begins."""
    true = scripts.friction.tolist()
    if how == "exactly":
        return [Friction(one) for one in true]
    if how == "within 10 %":
        return [Friction.between(0.9 * one, 1.1 * one) for one in true]
    # another grasp of the same object slipped, at a friction of its own that was read with an error
    slipped = [one * (1 + GRASP_SPREAD * rng.standard_normal()) + 0.05 * rng.standard_normal() for one in true]
    return [Friction.from_slips([max(ratio, 0.05)]) for ratio in slipped]


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def accuracy(table: ReadingTable, scale: float, *, rng: np.random.Generator) -> float:
    """R2 of readings with scaled errors, over margins from 0 to 1, forces as trained and all frictions."""
    count = 20_000
    margins, tips = rng.uniform(0, 1, count), rng.integers(len(table), size=count)
    friction, force = np.exp(rng.uniform(np.log(0.15), np.log(1.2), count)), rng.uniform(0.5, 2, count)
    read, *_ = table.read(tips, force, friction=friction, margins=margins)
    error = scale * (read + table.noise * rng.standard_normal(count) - margins)
    return 1 - float((error**2).mean() / margins.var())


def rendered_rate(ticks: int = 120) -> float:
    """Ticks a second of plant, both fingertips drawn, read and followed."""
    scripts, sensor = draw_scripts("cup", "dry", episodes=1, seed=SEED), RenderedSensor(RUN, seed=SEED)
    loop = GripLoop(Plant(OBJECTS["cup"]), sensor, make_controller("margin"))
    for _ in range(20):
        loop.tick(scripts.world(loop.plant.state.time_s))
    begin = time.perf_counter()
    for _ in range(ticks):
        loop.tick(scripts.world(loop.plant.state.time_s))
    return ticks / (time.perf_counter() - begin)


def validate(count: int, conditions: Sequence[str], rng: np.random.Generator) -> dict[str, object]:
    """Run episodes through pixels with fingertips of the table, and again with what the table has of the same ones.

    Differences are pixels less table: of the margins read at every state that the loop through pixels went through
    after the lift, and of what became of the episodes. Intervals (95 %) are over fingertips and over episodes.
    """
    gaps: list[np.ndarray] = []
    pairs: list[tuple[EpisodeTable, EpisodeTable]] = []
    for pair in range(count):
        scripts = draw_scripts("cup", conditions[pair % len(conditions)], episodes=1, seed=SEED + pair)
        scripts = replace(scripts, fingertips=np.array([float(pair)]))
        ticks: list[Tick] = []
        seen = GripLoop(
            Plant(OBJECTS["cup"]), RenderedSensor(RUN, seed=READINGS.seed + 2 * pair), make_controller("margin")
        )
        looked_up = GripLoop(
            Plant(OBJECTS["cup"]),
            TableSensor(READINGS, fingertips=scripts.fingertips, rng=np.random.default_rng(pair)),
            make_controller("margin"),
        )
        pairs.append((run_scripts(seen, scripts, on_tick=ticks.append), run_scripts(looked_up, scripts)))
        held = [
            (before.state, now.reading.margin[0])
            for before, now in itertools.pairwise(ticks)
            if before.state.time_s > 0.6 and not before.state.dropped[0]
        ]
        force = np.array([np.full(2, state.force_n[0]) for state, _ in held])
        friction, margins = (
            np.array([getattr(state, name)[0] for state, _ in held]) for name in ("holding_friction", "margin")
        )
        tips = np.broadcast_to(2 * pair + np.arange(2), force.shape)
        read, *_ = READINGS.read(tips, force, friction=friction, margins=margins)
        gaps.append(np.array([margin for _, margin in held]) - read)
    return {
        "episodes": count,
        "bias": _over(np.concatenate([gap.mean(axis=0) for gap in gaps]), rng),
        "rms": _over(np.concatenate([(gap**2).mean(axis=0) for gap in gaps]), rng, then=np.sqrt),
        "noise_of_the_table": round(READINGS.noise, 4),
        "mean_force_n": _over(np.array([float((a.mean_force_n - b.mean_force_n)[0]) for a, b in pairs]), rng),
        "slip_mm": _over(np.array([1e3 * float((a.slip_m - b.slip_m)[0]) for a, b in pairs]), rng),
        "dropped": {
            "pixels": sum(int(a.dropped[0]) for a, _ in pairs), "table": sum(int(b.dropped[0]) for _, b in pairs)
        },
    }  # fmt: skip


def _over(
    values: np.ndarray, rng: np.random.Generator, then: Callable[[np.ndarray], np.ndarray] = np.asarray
) -> dict[str, float | None]:
    """Mean of independent values with its interval, both turned into another unit at the end."""
    means = values[rng.integers(len(values), size=(_DRAWS, len(values)))].mean(axis=1)
    low, high = then(np.quantile(means, (0.025, 0.975)))
    return {"estimate": _number(float(then(values.mean()))), "low": _number(low), "high": _number(high)}


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=250, help="of each condition")
    parser.add_argument("--sweeps", action="store_true", help="also sweep latency, error and target")
    parser.add_argument("--rendered", type=int, default=0, help="episodes through pixels, compared with the table")
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    options = parser.parse_args()
    found = compare_all(options, np.random.default_rng(0))
    print(json.dumps(found, indent=None if options.json else 2))


def compare_all(options: argparse.Namespace, rng: np.random.Generator) -> dict[str, object]:
    """Every controller on the same draws."""
    conditions, episodes = list(CONDITIONS), options.episodes
    scripts, labels = draw(conditions, episodes)
    found: dict[str, object] = {"episodes": episodes, "hz_rendered": round(rendered_rate(), 1)}
    busy = time.process_time()
    run_episodes("cup", "margin", episodes=500, seed=SEED, network=RUN)
    found["episodes_per_core_s"] = round(500 / (time.process_time() - busy), 1)
    fixed = [hold("fixed", {"force_n": force}, scripts) for force in FORCES_N]
    found["fixed"] = {
        f"{force:g}": {
            "drop_rate": round(float(one.dropped.mean()), 4), "force_excess": round(float(one.excess.mean()), 3)
        }
        for force, one in zip(FORCES_N, fixed, strict=True)
    }  # fmt: skip
    by_name = {}
    for controller in CONTROLLERS:
        own = hold(controller, {}, scripts)
        groups = {"all": np.ones(len(labels), dtype=bool), **{name: labels == name for name in conditions}}
        by_name[controller] = {name: compare(own, fixed, rows, rng) for name, rows in groups.items()}
    found["controllers"] = by_name
    found |= {name: by_name["margin"]["all"][name] for name in ("excess_ratio", "drop_ratio")}
    if options.sweeps:
        some = np.flatnonzero(np.arange(len(labels)) % 4 == 0)
        fewer, rows = scripts.where(some), np.ones(len(some), dtype=bool)
        beside = [hold("fixed", {"force_n": force}, fewer) for force in FORCES_N]

        def swept(values: Sequence[float], run: Callable[[float], Outcome]) -> dict[str, object]:
            return {f"{value:g}": compare(run(value), beside, rows, rng) for value in values}

        found["latency_s"] = swept(LATENCIES_S, lambda value: hold("margin", {}, fewer, latency_s=value))
        found["error_scale"] = swept(SCALES, lambda value: hold("margin", {}, fewer, error_scale=value))
        found["r2"] = {f"{scale:g}": round(accuracy(READINGS, scale, rng=rng), 3) for scale in SCALES}
        found["target"] = swept(TARGETS, lambda value: hold("margin", {"target": value}, fewer))
        groups = {"all": rows, **{name: labels[some] == name for name in conditions}}
        found["known_friction"] = {}
        for how in TOLD:
            own = hold("margin", {}, fewer, friction=tell(how, fewer, rng))
            found["known_friction"][how] = {name: compare(own, beside, one, rng) for name, one in groups.items()}
    if options.rendered:
        found["validation"] = validate(options.rendered, conditions, rng)
    return found


RUN = load(DEFAULT_NETWORK)
_TABLE = load_readings(RUN)
READINGS = replace(
    _TABLE,
    seed=_TABLE.seed + CHOSEN,
    ratio={name: values[CHOSEN:] for name, values in _TABLE.ratio.items()},
    **{name: getattr(_TABLE, name)[CHOSEN:] for name in ("margin", "low", "high")},
)
"""Seed of fingertips that no table has."""

if __name__ == "__main__":
    main()
