"""A made-up workspace: the files that the stages write, with plausible numbers and nothing measured."""

import json
from collections.abc import Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sliplens.codec import save_result
from sliplens.faithfulness.scoring import score_deletion
from sliplens.files import Provenance, machine, versions, write_json
from sliplens.recordings import TrialInfo
from sliplens.recordings.dataset import write_dataset_table
from sliplens.results.evaluation import Evaluation, LearningCurve, ScoredFrames, Training
from sliplens.results.explanation import ExplainedFrame, Explanation, MethodNotes
from sliplens.training.evaluation import lead_times, regression_scores, risk_coverage

SIZE = 24
METHODS = ("grad-cam", "integrated-gradients", "poly-cam")
MARGINS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
NOISE = {("raw", "dry"): 0.14, ("raw", "wet"): 0.24, ("difference", "dry"): 0.09, ("difference", "wet"): 0.17}
FALL = {"grad-cam": 0.25, "integrated-gradients": 0.15, "poly-cam": 0.08, "random": 0.45}


def write_run(folder: Path, stage: str, config: dict[str, Any], result: object, *, minute: int = 0) -> Path:
    """A stage's folder with `run.json` and its result, a record or what JSON holds of one."""
    folder.mkdir(parents=True)
    facts = {"versions": versions(), "machine": machine(), "finished": f"2026-11-21T04:{minute:02d}:00+00:00"}
    provenance = Provenance(stage=stage, config=config, config_hash=stage.encode().hex(), **facts)
    write_json(folder / "run.json", provenance)
    if is_dataclass(result):
        save_result(result, folder)
    else:
        (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")
    return folder


def write_simulation(workspace: Path) -> Path:
    facts = {"sensor": "chromatouch-1", "day": 1, "frames": 40, "height": 224, "width": 224, "sha256": "0" * 64}
    trials = [
        TrialInfo(trial=f"{split}-{number:03d}", condition=condition, split=split, **facts)
        for split, count, condition in (("train", 40, "dry"), ("validation", 8, "dry"), ("test", 16, "wet"))
        for number in range(count)
    ]
    folder = write_run(workspace / "data", "simulate", {"trials": 64, "seed": 0, "size": [224, 224]}, {})
    (folder / "result.json").unlink()
    write_dataset_table(folder, trials, simulated=True)
    return folder


def write_training(workspace: Path, name: str, *, rng: np.random.Generator) -> Path:
    epochs = np.arange(12.0)
    floor = 0.02 if name == "raw" else 0.011
    validation = floor + 0.08 * np.exp(-epochs / 2.5) * rng.uniform(0.9, 1.1, 12)
    result = Training(
        input=name,
        backbone="shufflenet_v2_x1_0",
        image_size=SIZE,
        frame_size=(224, 224),
        train_frames=1600,
        validation_frames=320,
        epochs=12.3,
        minutes=2.0,
        seed=0,
        best_validation_mse=float(validation.min()),
        parameters=1254629,
        stopped_by="time limit",
        curve=LearningCurve(epoch=epochs, train_mse=0.8 * validation, validation_mse=validation, minutes=epochs / 6),
    )
    config = {"input": name, "data": "data", "seed": 0, "minutes": 2.0}
    return write_run(workspace / f"network-{name}", "train", config, result, minute=5)


def write_evaluation(workspace: Path, name: str, *, trials: int, rng: np.random.Generator) -> Path:
    time = np.linspace(0, 2, 40)
    trial, condition, labels, answers = [], [], [], []
    for surface in ("dry", "wet"):
        for number in range(trials):
            # one law for both inputs: the labels of a test frame do not depend on the network
            label = np.clip(1.02 - time / (1.5 + 0.05 * number), 0, 1)
            noise = NOISE[name, surface] * (rng.normal() * 0.5 + rng.normal(size=40) * 0.8)
            trial += [f"day4-{surface}-{number:03d}"] * 40
            condition += [surface] * 40
            labels.append(label)
            answers.append(label + noise + 0.05 * (1 - label))
    predictions = ScoredFrames(
        trial=np.array(trial),
        condition=np.array(condition),
        day=np.full(len(trial), 4),
        frame=np.tile(np.arange(40), 2 * trials),
        time_s=np.tile(time, 2 * trials),
        safety_margin=np.concatenate(labels),
        prediction=np.concatenate(answers),
        **{column: np.full(len(trial), np.nan) for column in ("sigma", "low_90", "high_90")},
        withheld=np.full(len(trial), ""),
    )
    by_condition = {one: predictions.where(predictions.condition == one) for one in ("dry", "wet")}
    by_trial = {one: predictions.where(predictions.trial == one) for one in dict.fromkeys(trial)}
    result = Evaluation(
        input=name,
        split="test",
        known_trials=0,
        conditions={one: regression_scores(rows) for one, rows in by_condition.items()},
        trials={one: regression_scores(rows) for one, rows in by_trial.items()},
        coverage={one: {} for one in by_condition},
        lead_times={one: lead_times(rows) for one, rows in by_condition.items()},
        predictions=predictions,
        risk=risk_coverage(np.abs(predictions.prediction - predictions.safety_margin), {"spread": None}),
    )
    return write_run(workspace / f"test-{name}", "evaluate", {"input": name}, result, minute=9)


def picture_and_maps(margin: float, name: str, rng: np.random.Generator) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A dome of dark markers that move down as the margin falls, and a map of each kind on its lower markers."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    light = 0.75 - 0.6 * ((x - 0.5) ** 2 + (y - 0.5) ** 2)
    now, still, moved = np.zeros((3, SIZE, SIZE))
    for row in np.linspace(0.14, 0.86, 6):
        for column in np.linspace(0.14, 0.86, 6):
            reach = np.exp(-8 * ((row - 0.55) ** 2 + (column - 0.5) ** 2))
            shift = 0.08 * (1 - margin) * reach
            dot = np.exp(-((x - column) ** 2 + (y - row - shift) ** 2) / 0.0012)
            still += np.exp(-((x - column) ** 2 + (y - row) ** 2) / 0.0012)
            now += dot
            moved += reach**2 * dot
    tint = np.array([0.85, 0.75, 1.0])
    image = (light - 0.5 * now)[..., None] * tint if name == "raw" else 2.0 * np.abs(now - still)[..., None] * tint
    image = np.clip(image + rng.normal(0, 0.015, image.shape), 0, 1)
    blob = np.exp(-((x - 0.5) ** 2 + (y - 0.6) ** 2) / 0.06)
    maps = {
        "grad-cam": blob,
        "integrated-gradients": moved * rng.random((SIZE, SIZE)) + 0.15 * rng.random((SIZE, SIZE)),
        "poly-cam": moved,
    }
    return (255 * image).astype(np.uint8), {key: (one - one.min()) / np.ptp(one) for key, one in maps.items()}


def frames_named(
    ids: Sequence[str], margins: Sequence[float | None], predictions: Sequence[float]
) -> tuple[ExplainedFrame, ...]:
    return tuple(
        ExplainedFrame(
            id=frame_id,
            trial=frame_id.rpartition("-")[0] or frame_id,
            condition="dry",
            safety_margin=margin,
            prediction=prediction,
            reference_prediction=1.0,
        )
        for frame_id, margin, prediction in zip(ids, margins, predictions, strict=True)
    )


def write_explanation(workspace: Path, name: str, source: str, *, rng: np.random.Generator) -> Path:
    noise = 0.03 if source == "simulated" else 0.2
    margins = [margin for margin in MARGINS for _ in range(2 if source == "simulated" else 1)]
    ids = [
        f"{'day4' if source == 'simulated' else 'real'}-dry-{place:03d}-f{int(40 * (1 - m)):03d}"
        for place, m in enumerate(margins)
    ]
    predictions = [float(np.clip(margin + rng.normal(0, noise), 0, 1.05)) for margin in margins]
    frames = frames_named(ids, margins, predictions)
    seconds = {"grad-cam": 0.031, "integrated-gradients": 0.42, "poly-cam": 3.1}
    warned = {"integrated-gradients": ("completeness gap 1.8 % on 2 frames",) * (name == "raw" and source == "real")}
    drawn = [picture_and_maps(margin, name, rng) for margin in margins]
    saliency = {key: np.stack([maps[key] for _, maps in drawn]).astype(np.float32) for key in METHODS}
    return write_run(
        workspace / f"maps-{name}-{source}",
        "explain",
        {"input": name, "source": source, "methods": list(METHODS)},
        explained(
            name,
            frames,
            {key: MethodNotes(seconds_per_frame=seconds[key], warnings=warned.get(key, ())) for key in METHODS},
            np.stack([picture for picture, _ in drawn]),
            saliency,
            source=source,
        ),
        minute=12,
    )


def explained(
    name: str,
    frames: tuple[ExplainedFrame, ...],
    methods: dict[str, MethodNotes],
    pictures: np.ndarray,
    saliency: dict[str, np.ndarray],
    *,
    source: str = "simulated",
) -> Explanation:
    towards = np.array([np.sign(frame.prediction - frame.reference_prediction) for frame in frames], dtype=np.float32)
    towards = towards[:, None, None]
    return Explanation(
        input=name,
        source=source,
        weights_sha256="none",
        frames=frames,
        methods=methods,
        images=np.moveaxis(pictures, -1, 1),
        references=np.zeros_like(np.moveaxis(pictures, -1, 1)),
        pictures=pictures,
        relevance={key: np.float32(0.01) * towards * maps for key, maps in saliency.items()},
    )


def write_score(workspace: Path, name: str, *, rng: np.random.Generator) -> Path:
    frames = frames_named([f"f{number:03d}" for number in range(12)], [None] * 12, [0.0] * 12)
    last, removed = 0.25 if name == "difference" else 0.45, np.arange(1, SIZE + 1) / SIZE
    answers = {}
    for method, fall in FALL.items():
        answers[method] = np.zeros((len(frames), SIZE + 1))
        for row in answers[method]:
            rate = fall * rng.uniform(0.7, 1.3) * (1 if name == "difference" else 2)
            fallen = (1 - np.exp(-removed / rate)) / (1 - np.exp(-1 / rate))
            score = np.clip(1 - (1 - last) * fallen + 0.01 * rng.normal(size=SIZE) * (fallen < 1), 0, 1)
            row[1:] = 1 - np.sqrt(score)
    pictures = np.zeros((len(frames), SIZE, SIZE, 3), dtype=np.uint8)
    scores = score_deletion(explained(name, frames, {}, pictures, {}), answers, fill="grey")
    alarms = ("on 3 frames the filled image is answered like the frame itself",) if name == "raw" else ()
    config = {"input": name, "fill": "grey"}
    return write_run(workspace / f"score-{name}", "score", config, replace(scores, alarms=alarms), minute=20)


def write_workspace(workspace: Path, *, trials: int = 6) -> Path:
    """Every stage, for both inputs."""
    rng = np.random.default_rng(20261121)
    write_simulation(workspace)
    for name in ("raw", "difference"):
        write_training(workspace, name, rng=rng)
        write_evaluation(workspace, name, trials=trials, rng=rng)
        for source in ("simulated", "real"):
            write_explanation(workspace, name, source, rng=rng)
        write_score(workspace, name, rng=rng)
    return workspace
