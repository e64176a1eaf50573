"""A made-up study: the files that its stages write, with numbers that tests choose and nothing measured."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from made_up import picture_and_maps, write_evaluation, write_run
from PIL import Image
from scipy.stats import kendalltau

from sliplens.intervals import Difference, paired_difference

INPUTS = ("difference", "raw")
METHODS = ("grad-cam", "integrated-gradients", "poly-cam")
CONTROLS = ("edges", "centre")
FILLS = (("reference", "pixel"), ("grey", "pixel"), ("blur", "pixel"), ("reference", "marker"), ("true", "marker"))
EQUAL_AREAS = (0.01, 0.02, 0.05, 0.1, 0.2)
LEVELS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
SCORED = (0.4, 0.2, 0.0)
GAINS = {"grad-cam": -0.05, "integrated-gradients": 0.06, "poly-cam": 0.16, "edges": 0.02, "centre": 0.01}
MAP_MEASURES = {
    "grad-cam": {"resolution": 0.05, "total_variation": 0.01, "gini": 0.4, "noise_stability": 0.98},
    "integrated-gradients": {"resolution": 0.7, "total_variation": 0.2, "gini": 0.7, "noise_stability": 0.6},
    "poly-cam": {"resolution": 0.6, "total_variation": 0.05, "gini": 0.6, "noise_stability": 0.95},
}


@dataclass(frozen=True, kw_only=True)
class Made:
    """What the made-up results say."""

    size: int = 24
    trials: int = 6
    areas: int = 21
    inputs: tuple[str, ...] = INPUTS
    methods: tuple[str, ...] = METHODS
    """With sound scores."""
    gains: Mapping[str, float] = field(default_factory=lambda: GAINS)
    """Symmetric relevance gain of each method on difference images; raw images get half of it, plus `raw_more`."""
    raw_more: float = 0.0
    spread: float = 0.01
    """Of the gains over trials."""
    looks: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: MAP_MEASURES)
    rougher_told: bool = True
    top_share: float = 0.8
    """Of the network's effects that two markers hold."""
    edge_mass: float = 0.3


def frames_of(made: Made) -> list[dict[str, Any]]:
    rows = []
    for trial in range(made.trials):
        for level in LEVELS:
            if trial and level not in SCORED:
                continue
            frame = round(40 * (1 - level))
            rows.append(
                {
                    "id": f"t{trial:02d}-f{frame:04d}",
                    "trial": f"t{trial:02d}",
                    "frame": frame,
                    "level": level,
                    "safety_margin": min(1.0, max(0.0, level + 0.002)),
                    "scored": level in SCORED,
                    "shown": trial == 0,
                }
            )
    return rows


def scored_frames(made: Made) -> list[dict[str, Any]]:
    return [row for row in frames_of(made) if row["scored"]]


def write_study(workspace: Path, made: Made | None = None, *, seed: int = 7) -> Path:
    """Every stage of a study."""
    made = made or Made()
    rng = np.random.default_rng(seed)
    write_choice(workspace, made)
    write_states(workspace, made)
    for name in made.inputs:
        write_evaluation(workspace, name, trials=6, rng=rng)
        maps = write_maps(workspace, name, made, rng=rng)
        write_thesis_scores(workspace, name, made, maps, rng=rng)
        write_remedies(workspace, name, made, maps, rng=rng)
        write_faithfulness(workspace, name, made, rng=rng)
        write_others(workspace, name, made)
        write_truth(workspace, name, made, rng=rng)
    return workspace


def write_choice(workspace: Path, made: Made) -> Path:
    trials = [
        {
            "trial": f"t{index:02d}",
            "qualified": index != 1,
            "worst_error": dict.fromkeys(made.inputs, 0.01 + 0.005 * index),
        }
        for index in range(made.trials)
    ]
    return write_run(
        workspace / "choice",
        "choice",
        {"trials": made.trials},
        {
            "trials_wanted": made.trials,
            "tolerance": 0.03,
            "considered": 60,
            "qualified": made.trials - 1,
            "told": f"{made.trials - 1} of 60 dry test trials lie within 3 %, so the nearest other was taken too.",
            "source": "simulated",
            "condition": "dry",
            "inputs": list(made.inputs),
            "levels": list(LEVELS),
            "scored_levels": list(SCORED),
            "trials": trials,
            "frames": frames_of(made),
        },
    )


def write_states(workspace: Path, made: Made) -> Path:
    rng = np.random.default_rng(1)
    size = made.size
    names = {1.0: "contact", 0.0: "full_slip"}
    shown = [row for row in frames_of(made) if row["shown"]]
    folder = write_run(
        workspace / "states",
        "states",
        {},
        {
            "trial": "t00",
            "markers_from": "simulation",
            "frame_size": [size, size],
            "frames": [
                {key: row[key] for key in ("id", "level", "safety_margin")}
                | {"contact_state": names.get(row["level"], "incipient_slip")}
                for row in shown
            ],
        },
    )
    (folder / "frames").mkdir()
    columns: dict[str, list] = {name: [] for name in ("frame_id", "marker", "rest_x_px", "rest_y_px", "x_px", "y_px")}
    for row in shown:
        for name in ("raw", "difference"):
            picture, _ = picture_and_maps(row["safety_margin"], name, size=size, rng=rng)
            Image.fromarray(picture).save(folder / "frames" / f"{row['id']}.{name}.png")
        x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0.14, 0.86, 6)] * 2))
        shift = 0.08 * (1 - row["safety_margin"]) * np.exp(-8 * ((y - 0.55) ** 2 + (x - 0.5) ** 2))
        columns["frame_id"] += [row["id"]] * len(x)
        columns["marker"] += list(range(len(x)))
        columns["rest_x_px"] += (size * x).tolist()
        columns["rest_y_px"] += (size * y).tolist()
        columns["x_px"] += [float("nan"), *(size * x[1:]).tolist()]
        columns["y_px"] += [float("nan"), *(size * (y + shift)[1:]).tolist()]
    pq.write_table(pa.table(columns), folder / "markers.parquet")
    return folder


def write_maps(workspace: Path, name: str, made: Made, *, rng: np.random.Generator) -> dict[str, np.ndarray]:
    rows = frames_of(made)
    folder = write_run(
        workspace / f"explain-{name}",
        "explain",
        {"input": name},
        {
            "input": name,
            "source": "simulated",
            "image_size": made.size,
            "frames": [
                {
                    "id": row["id"],
                    "condition": "dry",
                    "safety_margin": row["safety_margin"],
                    "prediction": row["safety_margin"] + 0.01,
                    "reference_prediction": 1.0,
                }
                for row in rows
            ],
            "methods": {method: {"seconds_per_frame": 0.1, "warnings": []} for method in METHODS},
        },
    )
    (folder / "frames").mkdir()
    found: dict[str, list[np.ndarray]] = {method: [] for method in METHODS}
    for row in rows:
        picture, maps = picture_and_maps(row["safety_margin"], name, size=made.size, rng=rng)
        Image.fromarray(picture).save(folder / "frames" / f"{row['id']}.png")
        for method in METHODS:
            found[method].append(maps[method])
    stacked = {method: np.stack(maps).astype(np.float32) for method, maps in found.items()}
    np.savez_compressed(
        folder / "maps.npz",
        allow_pickle=False,
        **stacked,
        **{f"{method}.saliency": maps for method, maps in stacked.items()},
    )
    return stacked


def thesis_curve(gain: float, size: int, *, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Answers that fall by up to 0.5, the earlier the more the method gains; and the score D of each."""
    share = np.arange(1, size + 1) / size
    change = rng.uniform(0.4, 0.6) * share ** np.exp(-8 * gain) + 0.005 * rng.random(size)
    return 0.6 - change, (1 - change) ** 2


def write_thesis_scores(
    workspace: Path, name: str, made: Made, maps: Mapping[str, np.ndarray], *, rng: np.random.Generator
) -> Path:
    columns = {key: [] for key in ("frame_id", "method", "step", "pixels_removed", "prediction", "score")}
    methods, size = {}, made.size
    for method in [*maps, "random"]:
        curves = []
        for row in frames_of(made):
            answer, score = thesis_curve(gain_of(made, name, method), size, rng=rng)
            curves.append(score)
            columns["frame_id"] += [row["id"]] * size
            columns["method"] += [method] * size
            columns["step"] += list(range(size))
            columns["pixels_removed"] += (size * np.arange(1, size + 1)).tolist()
            columns["prediction"] += answer.tolist()
            columns["score"] += score.tolist()
        auc = np.mean(curves, axis=1)
        last = float(np.mean([curve[-1] for curve in curves]))
        methods[method] = {
            "mean": float(auc.mean()),
            "sd": float(auc.std()),
            "last_step_mean": last,
            "frames": len(auc),
        }
    folder = write_run(
        workspace / f"score-{name}",
        "score",
        {"fill": "grey"},
        {
            "input": name,
            "source": "simulated",
            "fill": "grey",
            "methods": methods,
            "alarms": ["the fill decides in 2 of 18 frames"],
        },
    )
    pq.write_table(pa.table(columns), folder / "deletion.parquet")
    return folder


def write_remedies(
    workspace: Path, name: str, made: Made, maps: Mapping[str, np.ndarray], *, rng: np.random.Generator
) -> Path:
    columns: dict[str, list] = {
        key: [] for key in ("variant", "frame_id", "method", "step", "pixels_removed", "prediction", "score")
    }
    plan = {"stop-at-half": ("grey", "deletion", 0.5, "lower"), "insertion": ("grey", "insertion", None, "higher")}
    variants: dict[str, Any] = {}
    size, ids = made.size, [row["id"] for row in frames_of(made)]
    for variant, (fill, mode, stop, better) in plan.items():
        methods = {}
        for method, saliency in maps.items():
            means = []
            for row in scored_frames(made):
                answer, score = thesis_curve(gain_of(made, name, method), size, rng=rng)
                above = int((saliency[ids.index(row["id"])] > 0.5).sum())
                steps = size if stop is None else max(1, -(-above // size))
                removed = np.minimum(size * np.arange(1, steps + 1), size * size if stop is None else max(above, 1))
                means.append(score[:steps].mean())
                columns["variant"] += [variant] * steps
                columns["frame_id"] += [row["id"]] * steps
                columns["method"] += [method] * steps
                columns["step"] += list(range(steps))
                columns["pixels_removed"] += removed.tolist()
                columns["prediction"] += answer[:steps].tolist()
                columns["score"] += score[:steps].tolist()
            methods[method] = {
                "mean": float(np.mean(means)),
                "sd": float(np.std(means)),
                "last_step_mean": 0.3,
                "frames": len(means),
            }
        variants[variant] = {
            "told": f"{mode}, {fill}", "fill": fill, "mode": mode, "stop": stop, "better": better, "methods": methods,
        }  # fmt: skip
    folder = write_run(
        workspace / f"remedies-{name}",
        "remedies",
        {},
        {"input": name, "source": "simulated", "variants": variants, "alarms": []},
    )
    pq.write_table(pa.table(columns), folder / "deletion.parquet")
    return folder


def gain_of(made: Made, name: str, method: str) -> float:
    gain = made.gains.get(method, 0.0)
    return gain if name == "difference" else gain / 2 + made.raw_more


def write_faithfulness(workspace: Path, name: str, made: Made, *, rng: np.random.Generator) -> Path:
    """Curves whose symmetric gain is the method's own, plus what the trial adds: 6 a (1 - a) has area 1."""
    areas = np.linspace(0, 1, made.areas)
    bump = 6 * areas * (1 - areas)
    bump /= np.trapezoid(bump, areas)
    rows = scored_frames(made)
    trials = np.array([row["trial"] for row in rows])
    columns: dict[str, list] = {
        key: []
        for key in (
            "fill", "unit", "method", "frame_id", "trial", "safety_margin", "area", "most_first", "least_first",
            "random",
        )
    }  # fmt: skip
    scores, comparisons, ranks = [], [], {}
    chance = 0.4 * areas
    for fill, unit in FILLS:
        gains = {}
        for method in [*made.methods, *CONTROLS]:
            of_trial = rng.normal(0, made.spread, made.trials)
            gains[method] = np.array([gain_of(made, name, method) + of_trial[int(row["trial"][1:])] for row in rows])
            most = chance + gains[method][:, None] / 2 * bump
            least = chance - gains[method][:, None] / 2 * bump
            for row, one, other in zip(rows, most, least, strict=True):
                for key, value in (("fill", fill), ("unit", unit), ("method", method), ("frame_id", row["id"])):
                    columns[key] += [value] * len(areas)
                columns["trial"] += [row["trial"]] * len(areas)
                columns["safety_margin"] += [row["safety_margin"]] * len(areas)
                columns["area"] += areas.tolist()
                columns["most_first"] += one.tolist()
                columns["least_first"] += other.tolist()
                columns["random"] += chance.tolist()
            zero = np.zeros(len(rows))
            scores.append(
                {
                    "fill": fill,
                    "unit": unit,
                    "method": method,
                    "control": method in CONTROLS,
                    "srg": told(paired_difference(gains[method], zero, trials=trials, rng=rng)),
                    "gain_over_random": told(paired_difference(gains[method] / 2, zero, trials=trials, rng=rng)),
                    "most_first": float(np.trapezoid(most, areas).mean()),
                    "least_first": float(np.trapezoid(least, areas).mean()),
                    "random": 0.2,
                    "at": {
                        f"{area:g}": float(np.interp(area, areas, most.mean(axis=0)))
                        for area in (0.01, 0.02, 0.05, 0.1, 0.2)
                    },
                }
            )
        best = max(CONTROLS, key=lambda control, gains=gains: gains[control].mean())
        pairs = [*combinations(made.methods, 2), *((method, best) for method in made.methods)]
        comparisons += [
            {"fill": fill, "unit": unit, "first": first, "second": second, "measure": "srg"}
            | told(paired_difference(gains[first], gains[second], trials=trials, rng=rng))
            for first, second in pairs
        ]
        ranks[fill, unit] = [float(gains[method].mean()) for method in made.methods]
    agreement = [
        {
            "unit": "pixel",
            "first": one[0],
            "second": other[0],
            "tau": float(np.asarray(kendalltau(ranks[one], ranks[other]))[0]),
        }
        for one, other in combinations([key for key in FILLS if key[1] == "pixel"], 2)
    ]
    folder = write_run(
        workspace / f"faithfulness-{name}",
        "faithfulness",
        {},
        {
            "input": name,
            "source": "simulated",
            "frames": len(rows),
            "trials": made.trials,
            "random_orders": 20,
            "fills": list(dict.fromkeys(fill for fill, _ in FILLS)),
            "units": ["pixel", "marker"],
            "areas": areas.tolist(),
            "scores": scores,
            "comparisons": comparisons,
            "agreement": agreement,
            "alarms": ["grad-cam does not beat a random order: its symmetric gain is -0.050"],
        },
    )
    pq.write_table(pa.table(columns), folder / "curves.parquet")
    return folder


def told(gap: Difference) -> dict[str, Any]:
    return {"estimate": gap.estimate, "low": gap.low, "high": gap.high, "units": gap.units, "sure": gap.sure}


def write_others(workspace: Path, name: str, made: Made) -> None:
    origin = {"input": name, "source": "simulated"}
    layers = [1, 4, 8, 16]
    methods: dict[str, Any] = {
        method: {
            "layers": layers,
            "similarity": [0.9 / (1 + index * (0.1 if method == "grad-cam" else 1.0)) for index in range(len(layers))],
            "complexity_rise": 0.3,
            "smooth_complexity_rise": None,
        }
        for method in METHODS
    }
    write_run(
        workspace / f"randomisation-{name}",
        "randomisation",
        {},
        {**origin, "frames": 6, "methods": methods, "alarms": []},
    )
    looks = {method: {"frame_stability": 0.9, **values} for method, values in made.looks.items()}
    rougher = [
        {"measure": "total_variation", "first": first, "second": second, **interval(gap, made.trials, half=0.001)}
        for first, second in combinations(looks, 2)
        for gap in [looks[first]["total_variation"] - looks[second]["total_variation"]]
    ]
    told = {**origin, "frames": 42, "methods": looks, "comparisons": rougher if made.rougher_told else []}
    write_run(workspace / f"map-quality-{name}", "map-quality", {}, told)
    seconds = {"grad-cam": 0.02, "integrated-gradients": 0.4, "poly-cam": 3.0}
    timed = {
        method: {"seconds": one, "seconds_without_forward": one - 0.01, "low": one * 0.9, "high": one * 1.1}
        for method, one in seconds.items()
    }
    write_run(
        workspace / f"timing-{name}",
        "timing",
        {},
        {**origin, "device": "cpu", "threads": 2, "repeats": 5, "forward_seconds": 0.01, "methods": timed},
    )


def write_truth(workspace: Path, name: str, made: Made, *, rng: np.random.Generator) -> Path:
    rows, size = scored_frames(made), made.size
    x, y = (size * axis.ravel() for axis in np.meshgrid(*[np.linspace(0.14, 0.86, 6)] * 2))
    columns: dict[str, list] = {
        key: []
        for key in (
            "frame_id", "trial", "safety_margin", "marker", "x_px", "y_px", "network_effect", "margin_effect", "state",
        )
    }  # fmt: skip
    maps: dict[str, list[np.ndarray]] = {"network": [], "margin": []}
    grid_y, grid_x = np.mgrid[:size, :size]
    for row in rows:
        network = np.full(len(x), (1 - made.top_share) / (len(x) - 2))
        network[[14, 20]] = made.top_share / 2
        margin = 0.05 * np.exp(-((x - size / 2) ** 2 + (y - 0.6 * size) ** 2) / (0.1 * size**2))
        # a little of its own in each trial, so that an interval has a width
        network = 0.3 * network * (1 + 0.02 * rng.random(len(x)))
        for key in ("frame_id", "trial", "safety_margin"):
            columns[key] += [row["id" if key == "frame_id" else key]] * len(x)
        columns["marker"] += list(range(len(x)))
        columns["x_px"] += x.tolist()
        columns["y_px"] += y.tolist()
        columns["network_effect"] += network.tolist()
        columns["margin_effect"] += (-margin).tolist()
        columns["state"] += [1] * len(x)
        for key, effects in (("network", network), ("margin", -margin)):
            spots = np.exp(-((grid_x - x[:, None, None]) ** 2 + (grid_y - y[:, None, None]) ** 2) / (0.002 * size**2))
            maps[key].append((effects[:, None, None] * (spots > 0.4)).sum(axis=0).astype(np.float32))
    spearman = {
        "grad-cam": 0.3,
        "integrated-gradients": 0.4,
        "poly-cam": 0.7,
        "edges": 0.1,
        "oracle": 1.0,
        "degraded-oracle": 0.8,
    }
    mass = {"markers": 0.5, "slip_annulus": 0.4, "edges": made.edge_mass}
    folder = write_run(
        workspace / f"truth-{name}",
        "truth",
        {},
        {
            "input": name,
            "source": "simulated",
            "frames": len(rows),
            "areas": {"markers": 0.18, "slip_annulus": 0.2, "edges": 0.07},
            "methods": {
                method: {"mass": mass, "rank": mass, "spearman_network": value, "spearman_margin": value / 2}
                for method, value in spearman.items()
            },
            "intervals": {
                method: {
                    "spearman_network": interval(value, made.trials),
                    "spearman_margin": interval(value / 2, made.trials),
                    "edges_over_chance": interval(made.edge_mass - 0.07, made.trials, half=0.01),
                }
                for method, value in spearman.items()
            },
            "network_against_margin": interval(0.5, made.trials),
            "meta": [{"fill": "true", "holds": True, "oracle": 0.3, "degraded": 0.2, "random": 0.0}],
            "told": "Each marker was put back where it rested.",
        },
    )
    pq.write_table(pa.table(columns), folder / "effects.parquet")
    np.savez_compressed(
        folder / "maps.npz", allow_pickle=False, **{key: np.stack(found) for key, found in maps.items()}
    )
    return folder


def interval(value: float, units: int, *, half: float = 0.05) -> dict[str, Any]:
    sure = abs(value) > half and units >= 5
    return {"estimate": value, "low": value - half, "high": value + half, "units": units, "sure": sure}
