"""Results of the commands on the terminal."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sliplens.cli.console import Terminal, print_file, print_table, say
from sliplens.progress import number_of

if TYPE_CHECKING:
    from sliplens.grip.records import Grip
    from sliplens.models.predictions import Predictions
    from sliplens.recordings import Dataset, TrialInfo
    from sliplens.report.page import Written
    from sliplens.results.evaluation import Evaluation
    from sliplens.results.faithfulness import Faithfulness

_MOST_ROWS = 24  # number of frames or trials that are listed one by one
_MOST_TRIALS = 40  # number of trials with a line each
_MOST_NAMES = 6  # number of names in a cell


def show_predictions(predictions: "Predictions") -> None:
    """Print each frame if they are few, else the lowest margin of each trial."""
    from sliplens.models.predictions import lowest_frame

    table = predictions.to_arrow()
    rows = []
    for row in table.to_pylist() if predictions.frames <= _MOST_ROWS else ():
        frame = row.get("file") or f"{row['trial']} {row['frame']}"
        rows.append(
            {
                "frame": frame,
                "safety margin": _percent(row["prediction"]) or "withheld",
                "90 % interval": _interval(row["low_90"], row["high_90"]),
                "true": _percent(row.get("safety_margin")),
                "known": _percent(row.get("known")),
            }
        )
    if rows:
        print_table("Safety margins", rows)
        return
    column = table["trial"].to_numpy()
    names = list(dict.fromkeys(column))
    for name in names[:_MOST_TRIALS]:
        trial = table.filter(column == name)
        lowest = lowest_frame(trial)
        row = {} if lowest is None else trial.slice(lowest, 1).to_pylist()[0]
        time_s = row.get("time_s")
        touches = int(trial["touches"].to_numpy().sum()) if "touches" in trial.column_names else None
        at = lowest and f"frame {lowest}" if time_s is None else f"{time_s:.2f} s"
        rows.append(
            {"trial": name, "lowest": _percent(row.get("prediction")) or "none"}
            | {"90 % interval": _interval(row.get("low_90"), row.get("high_90")), "at": at, "frames": len(trial)}
            | {"touch": touches, "withheld": len(trial) - trial["withheld"].null_count or None}
        )
    print_table("Safety margins", rows)
    if len(names) > _MOST_TRIALS:
        say(f"and {number_of(len(names) - _MOST_TRIALS, 'more trial')}; -o margins.csv writes every frame")


def _percent(value: float | None) -> str | None:
    return None if value is None else f"{100 * value:.0f} %"


def _interval(low: float | None, high: float | None) -> str | None:
    return None if low is None or high is None else f"{100 * low:.0f} to {100 * high:.0f} %"


def show_labelled(data: "Dataset", *, audit: bool) -> None:
    """Draw the audit pages that are missing, and print what labels rest on and which frames have none."""
    from sliplens.plots.sheets import describe_labels, write_audits

    if audit and write_audits(data, data.folder / "audit", on_progress=Terminal()):
        print_file(data.folder / "audit", "a page for each trial: look at them before you train")
    whole = len(data.trials) <= _MOST_NAMES
    for info in data.trials[:_MOST_ROWS]:
        labels = data.read_labels(info)
        facts = ["its labels came with it"]
        if labels.labelling is not None:
            facts = describe_labels(labels, labels.labelling)
        say(f"  {info.trial}: {'; '.join(facts if whole else facts[:1])}")
    if (rest := len(data.trials) - _MOST_ROWS) > 0:
        say(f"  and {number_of(rest, 'more trial')}; `sliplens check` names those in doubt")


def show_splits(trials: "Sequence[TrialInfo]") -> None:
    """Print the content of each split."""
    groups, usual = defaultdict(list), ("train", "validation", "test")
    for info in trials:
        groups[info.split].append(info)
    rows = [
        {
            "split": name,
            "trials": len(infos),
            "frames": sum(info.frames for info in infos),
            "days": _names({str(info.day) for info in infos}),
            "objects": _names({info.object for info in infos} - {""}),
            "conditions": _names({info.condition for info in infos}),
        }
        for name, infos in sorted(groups.items(), key=lambda group: (*(group[0] != each for each in usual), group[0]))
    ]
    print_table("Splits", rows)


def show_moves(trials: "Sequence[TrialInfo]", splits: Sequence[str]) -> None:
    """Print the trials that change their split."""
    moves = defaultdict(list)
    for info, split in zip(trials, splits, strict=True):
        if info.split != split:
            moves[info.split, split].append(info.trial)
    rows = [
        {"from": old, "to": new, "trials": len(names), "which": _names(names)}
        for (old, new), names in sorted(moves.items())
    ]
    print_table("Moves", rows) if rows else say("every trial is in its split already")


def _names(names: Iterable[str]) -> str:
    from sliplens.images import natural_key

    ordered = sorted(names, key=natural_key)
    rest = len(ordered) - _MOST_NAMES
    return ", ".join(ordered if rest < 2 else [*ordered[:_MOST_NAMES], f"{rest} more"]) or "-"


def print_scores(evaluation: "Evaluation") -> None:
    """Print the scores of a network by condition."""
    trials = len(evaluation.trials)
    if count := evaluation.known_trials:
        say(
            f"  note: {count} of the {trials} trials trained or validated this network, which makes its scores too good"
        )
    rows = [
        {"condition": name, "frames": scores.frames, "MSE": scores.mse, "R2": scores.r2, "MAE": scores.mae}
        | {"90 %": _percent(evaluation.coverage[name].get("0.9")), "warned": f"{lead.warned}/{lead.trials}"}
        | {"ms": lead.median_ms, "false": lead.false_per_minute}
        for name, scores in evaluation.conditions.items()
        for lead in [evaluation.lead_times[name]]
    ]
    about = "90 %: labels within this interval; false: warnings a minute"
    print_table(f"{evaluation.input} images, {evaluation.split} trials; {about}", rows)
    if evaluation.friction:
        say(f"friction: {evaluation.friction}")
    if evaluation.ratio_r2:
        scores = (f"{name} {'none' if r2 is None else f'{r2:.3f}'}" for name, r2 in evaluation.ratio_r2.items())
        say(f"F_t / F_n is predicted with R2 {', '.join(scores)}")
    if evaluation.risk is not None:
        say(str(evaluation.risk))


def print_faithfulness(faithfulness: "Faithfulness") -> None:
    """Print the scores of each method, the deletion score of the thesis, and the alarms."""
    deletion, where = faithfulness.deletion, f"{faithfulness.input} images ({faithfulness.source})"
    rows = [
        {"method": scores.method, "gain": scores.srg.estimate, "95 % from": scores.srg.low, "to": scores.srg.high}
        | {"less the best control": lead and lead.gap.estimate}
        for scores in faithfulness.scores
        for lead in [scores.lead_over_controls]
    ]
    print_table(f"symmetric gain, {where}: higher is more faithful", rows)
    if deletion is not None:
        rows = [
            {"method": name, "D_AUC": scores.mean, "+-": scores.sd, "last step": scores.last_step_mean}
            for name, scores in deletion.methods.items()
        ]
        print_table(f"deletion score of the thesis, {where}, fill grey: lower is more faithful", rows)
    for alarm in dict.fromkeys(faithfulness.alarms + (() if deletion is None else deletion.alarms)):
        say(f"  alarm: {alarm}")


def print_grip(result: "Grip") -> None:
    """Print what became of the episodes."""
    from scipy.stats import binomtest

    table, fell, setup = result.episodes, int(result.episodes.dropped.sum()), result.setup
    low, high = binomtest(fell, len(table)).proportion_ci(method="wilson")
    facts = {
        "dropped": f"{fell} of {len(table)} ({100 * low:.0f} to {100 * high:.0f} %, 95 % interval)",
        "crushed": int(table.crushed.sum()),
        "slip, median": f"{1e3 * float(sorted(table.slip_m)[len(table) // 2]):.1f} mm",
        "mean force": f"{table.mean_force_n.mean():.2f} N",
        "over the least force that holds": f"{100 * table.force_excess.mean():.0f} %",
        "time with a margin under 20 %": f"{table.under_20_s.mean():.2f} s",
    }
    rows = [{"": name, " ": fact} for name, fact in facts.items()]
    print_table(f"{setup.controller} on a {setup.object}, {setup.condition}", rows)


def print_sources() -> None:
    """Print the cameras and the other live sources."""
    from sliplens.live import SOURCES, list_cameras

    cameras = [{"device": device, "name": name} for device, name in list_cameras().items()]
    print_table("Cameras", cameras) if cameras else say("no camera was found")
    for words in ("simulated gripper that holds (grip, or grip:egg)", *(kind.words for kind in SOURCES.values())):
        say(f"  {words}")


def draw_report(workspace: Path) -> None:
    """Draw the page of a workspace."""
    from sliplens.report import write_report

    print_written(write_report(workspace))


def print_written(written: "Written") -> None:
    """Print the page and the figures of a report."""
    if written.figures:
        count = number_of(len(written.figures) // 2, "figure")
        print_file(written.figures[0].parent, f"{count} as PDF, their numbers as CSV")
    print_file(written.page, "open it in a browser")
