"""The verdict: sentences made from the numbers, which claim no more than these carry."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sliplens.intervals import FEWEST_UNITS
from sliplens.plots.style import (
    CONTROL,
    conditions_in_order,
    decimals,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    percent,
    source_name,
)
from sliplens.report.tables import against_control, agreement, compare_errors
from sliplens.report.thesis import NETWORK_PIXELS
from sliplens.report.workspace import Results
from sliplens.results.explanation import Explained
from sliplens.results.faithfulness import DeletionScores

Tone = Literal["good", "plain", "caution"]


@dataclass(frozen=True, kw_only=True)
class Statement:
    """One finding: its topic, what is said, and whether it carries, is plain, or warns."""

    topic: str
    text: str
    tone: Tone = "plain"


def judge_accuracy(results: Results, *, rng: np.random.Generator) -> list[Statement]:
    """State how well each network reads the margin, and which input does better."""
    return _accuracy(results) + _winners(results, rng=rng)


def judge(results: Results, *, rng: np.random.Generator) -> tuple[Statement, ...]:
    """State what the results show, from accuracy to real touch; what was not run is left out."""
    statements = judge_accuracy(results, rng=rng)
    statements += [
        _faithfulness(results.scores[key], rng=rng)
        for key in sorted(results.scores, key=lambda key: (key[1] == "real", key[0] != "raw", key))
    ]
    if results.scores:
        statements.append(_what_deletion_measures(results))
    real = {name: one for (name, source), one in results.explanations.items() if source == "real"}
    statements += [_real_touch(real[name]) for name in inputs_in_order(real)]
    statements += tell_scale(results)
    return tuple(statements)


def _accuracy(results: Results) -> list[Statement]:
    if not results.evaluations:
        return []
    sentences, useless = [], False
    for name in inputs_in_order(results.evaluations):
        scores = results.evaluations[name].conditions
        conditions = conditions_in_order(scores)
        r2 = [f"{decimals(scores[condition].r2, 2)} on {condition}" for condition in conditions]
        mae = [decimals(100 * scores[condition].mae, 1) for condition in conditions]
        sentences.append(
            f"From {input_name(name).lower()} the network reads the safety margin with R² {listed(r2)} objects; on "
            f"average it is off by {listed(mae)} percentage points."
        )
        poor = [condition for condition in conditions if (scores[condition].r2 or 0.0) <= 0]
        if poor:
            sentences.append(f"On {listed(poor)} objects that is no better than always answering the mean label.")
        useless = useless or bool(poor)
    return [
        Statement(topic="Accuracy on test trials", text=" ".join(sentences), tone="caution" if useless else "plain")
    ]


def _winners(results: Results, *, rng: np.random.Generator) -> list[Statement]:
    evaluations = results.evaluations
    if not {"raw", "difference"} <= set(evaluations):
        return []
    statements = []
    first, second = evaluations["difference"], evaluations["raw"]
    for condition in conditions_in_order(set(first.conditions) & set(second.conditions)):
        mse = {"difference": first.conditions[condition].mse, "raw": second.conditions[condition].mse}
        better, worse = sorted(mse, key=lambda name: mse[name])
        less = 1 - mse[better] / mse[worse] if mse[worse] > 0 else 0.0
        text = (
            f"On {condition} objects {input_name(better).lower()} have the lower error: MSE {mse[better]:.4f} against "
            f"{mse[worse]:.4f}, {percent(less)} less."
        )
        shown = [one.predictions.where(one.predictions.condition == condition) for one in (first, second)]
        gap = compare_errors(shown[0], shown[1], rng=rng)
        sure = gap is not None and gap.sure
        if gap is None:
            text += " The two networks did not answer the same frames, so whether that is chance was not tested."
        elif gap.units < FEWEST_UNITS:
            text += f" With {gap.units} test trials, that can be chance."
        elif sure:
            text += f" That holds when the {gap.units} test trials are resampled."
        else:
            text += f" Resampling the {gap.units} test trials does not rule out chance."
        statements.append(
            Statement(topic=f"Raw or difference, {condition}", text=text, tone="good" if sure else "caution")
        )
    if statements:
        seeds = "Each input stands for one trained network: another seed may change the order."
        statements[-1] = Statement(
            topic=statements[-1].topic, text=f"{statements[-1].text} {seeds}", tone=statements[-1].tone
        )
    return statements


def _faithfulness(scored: DeletionScores, *, rng: np.random.Generator) -> Statement:
    topic = f"Faithfulness, {input_name(scored.input).lower()}"
    if scored.source != "simulated":
        topic += f", {source_name(scored.source)}"
    methods = {name: score for name, score in scored.methods.items() if name != CONTROL}
    if not methods:
        return Statement(topic=topic, text="No method was scored.", tone="caution")
    best = min(methods, key=lambda name: methods[name].mean)
    text = f"{method_name(best)} has the lowest deletion score, {methods[best].mean:.3f} ± {methods[best].sd:.3f}"
    control = scored.methods.get(CONTROL)
    if control is None:
        text += "; no random control was scored, so whether that is better than chance is not known."
        return Statement(topic=topic, text=text, tone="caution")
    text += f"; removing pixels in random order gives {control.mean:.3f} ± {control.sd:.3f}."
    gaps = {name: against_control(scored, name, rng=rng) for name in methods}
    beating = [name for name, gap in gaps.items() if gap is not None and gap.sure and gap.estimate < 0]
    failing = [method_name(name) for name in methods if name not in beating]
    if best not in beating:
        if methods[best].mean < control.mean:
            text += " That is lower than chance, but not by enough to rule chance out."
        else:
            text += " It does not beat the control: by this score no map tells more than chance."
    elif failing:
        text += f" It beats the control; {listed(failing)} {'does' if len(failing) == 1 else 'do'} not."
    else:
        text += " It beats the control, as does every other method." if len(methods) > 1 else " It beats the control."
    return Statement(topic=topic, text=text, tone="good" if best in beating else "caution")


def _what_deletion_measures(results: Results) -> Statement:
    last = [
        f"{decimals(value, 2)} ({input_name(name).lower()}, {source_name(source)}, {scored.fill})"
        for (name, source), scored in sorted(results.scores.items(), key=lambda item: (item[0][1] == "real", item[0]))
        for value in [_last_step(scored)]
        if value is not None
    ]
    text = (
        "The deletion score depends on what a removed pixel becomes. It says how far the answer moves, not that the "
        "map shows what slip is, and its sign is lost."
    )
    if last:
        text += (
            f" With every pixel filled, where no map has a part, D is {listed(last)}: a score near "
            "that tells of the fill."
        )
    return Statement(topic="How far to trust D", text=text, tone="caution")


def _last_step(scored: DeletionScores) -> float | None:
    values = [one.last_step_mean for one in scored.methods.values() if one.last_step_mean is not None]
    return float(np.mean(values)) if values else None


def _real_touch(explained: Explained) -> Statement:
    topic = f"Real touch, {input_name(explained.input).lower()}"
    labelled = [
        (frame.safety_margin, frame.prediction) for frame in explained.frames if frame.safety_margin is not None
    ]
    if not labelled:
        text = f"The {len(explained.frames)} real frames have no label, so nothing can be said of the answers on them."
        return Statement(topic=topic, text=text, tone="caution")
    labels, answers = np.array(labelled, dtype=np.float64).T
    found = agreement(labels, answers)
    useful = found.mae < found.constant_mae
    text = (
        f"On {found.frames} frames of real touch the network is off by {100 * found.mae:.0f} percentage points "
        f"on average; the best constant answer would be off by {100 * found.constant_mae:.0f}."
    )
    if found.pairs:
        text += (
            f" It puts {found.ordered_pairs} of {found.pairs} pairs of frames in the right order "
            f"({'all of them' if found.ordered_pairs == found.pairs else 'chance gives half'})."
        )
    if not useful:
        text += " So its values do not carry over to real touch."
    return Statement(topic=topic, text=text, tone="plain" if useful else "caution")


def tell_scale(results: Results) -> list[Statement]:
    """State how little or much the networks were trained on."""
    if not results.trainings:
        return []
    one = results.trainings[inputs_in_order(results.trainings)[-1]]
    parts = [
        f"Each network was trained on {one.train_frames} frames" if one.train_frames else "Each network was trained"
    ]
    if one.minutes is not None:
        parts.append(f"for {decimals(one.minutes, 1)} minutes")
    text = " ".join(parts) + f", on images of {one.image_size} px"
    if one.frame_size and max(one.frame_size) > one.image_size:
        text += f", shrunk from the camera's {' x '.join(map(str, one.frame_size))}"
    if one.image_size != NETWORK_PIXELS:
        text += f" (the thesis: {NETWORK_PIXELS} px)"
    text += (
        ". The thesis measured a real sensor, so its figures beside these show the scale of such errors, not a contest."
    )
    return [Statement(topic="What this run is", text=text)]
