"""Results of the commands on the terminal."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sliplens.cli.console import Terminal, print_file, print_table, say
from sliplens.progress import fold_equal, number_of

if TYPE_CHECKING:
    from sliplens.grip.records import Grip
    from sliplens.models.predictions import Predictions
    from sliplens.recordings import Dataset, TrialInfo
    from sliplens.recordings.labelling import Labelling
    from sliplens.report.page import Written
    from sliplens.results.evaluation import Evaluation
    from sliplens.results.faithfulness import Faithfulness

_MOST_ROWS = 24
"""Number of frames or trials that are listed one by one."""
_MOST_TRIALS = 40
"""Number of trials with a line each."""
_MOST_NAMES = 6
"""Number of names in a cell."""


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
        rows.append(
            {
                "trial": name,
                "lowest": _percent(row.get("prediction")) or "none",
                "90 % interval": _interval(row.get("low_90"), row.get("high_90")),
                "at": lowest and f"frame {lowest}" if time_s is None else f"{time_s:.2f} s",
                "frames": len(trial),
                "touch": int(trial["touches"].to_numpy().sum()) if "touches" in trial.column_names else None,
                "withheld": len(trial) - trial["withheld"].null_count or None,
            }
        )
    print_table("Safety margins", rows)
    if len(names) > _MOST_TRIALS:
        say(f"and {number_of(len(names) - _MOST_TRIALS, 'more trial')}; -o margins.csv writes every frame")


def _percent(value: float | None) -> str | None:
    return None if value is None else f"{100 * value:.0f} %"


def _interval(low: float | None, high: float | None) -> str | None:
    return None if low is None or high is None else f"{100 * low:.0f} to {100 * high:.0f} %"


def show_labelled(title: str, data: "Dataset", *, audit: bool) -> None:
    """Draw the audit pages that are missing, and print what labels rest on and which frames have none."""
    from sliplens.plots.sheets import write_audits

    if audit and write_audits(data, data.folder / "audit", on_progress=Terminal()):
        print_file(data.folder / "audit", "a page for each trial: look at them before you train")
    rows, notes, invalid = [], [], {}
    for info in data.trials:
        labels = data.read_labels(info)
        counts = Counter(labels.count())
        valid = counts.pop("valid", 0)
        rows.append({"trial": info.trial, "valid": f"{valid} of {info.frames}", **_basis(labels.labelling)})
        notes += labels.labelling.notes if labels.labelling is not None else ()
        invalid[info.trial] = counts
    print_table(title, rows[:_MOST_ROWS])
    if len(rows) > _MOST_ROWS:
        say(f"  and {number_of(len(rows) - _MOST_ROWS, 'more trial')}; `sliplens check` names those in doubt")
        invalid = {f"all {len(rows)} trials": sum(invalid.values(), Counter())}
    for line in fold_equal(dict.fromkeys(notes)):
        say(f"  note: {line}")
    for trial, counts in invalid.items():
        reasons = ", ".join(f"{count:,} {reason}" for reason, count in counts.items())
        say(f"  {trial}: frames without a valid label: {reasons or 'none'}")


def _basis(labelling: "Labelling | None") -> dict[str, str | None]:
    """Return the cells of friction, lag and reference."""
    friction, lag, reference = "came with it", None, "its own"
    if labelling is not None and (basis := labelling.basis) is not None:
        mu, low, high = basis.friction.mu, basis.friction.low, basis.friction.high
        friction = f"{mu:.3f} given" if low == high else f"{mu:.3f} [{low:.3f}, {high:.3f}]"
        if basis.lag is not None:
            lag = "unknown" if basis.lag.doubt else f"{1e3 * basis.lag.lag_s:+.1f} +- {1e3 * basis.lag.sigma_s:.1f}"
            lag += " (applied)" if basis.lag_applied else ""
    if labelling is not None and labelling.reference.index is not None:
        reference = f"frame {labelling.reference.index}"
    return {"mu": friction, "lag, ms": lag, "reference": reference}


def show_splits(trials: "Sequence[TrialInfo]", splits: Sequence[str]) -> None:
    """Print the content of each split, and the trials that change theirs."""
    groups, moves, usual = defaultdict(list), defaultdict(list), ("train", "validation", "test")
    for info, split in zip(trials, splits, strict=True):
        groups[split].append(info)
        if info.split != split:
            moves[info.split, split].append(info.trial)
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
    if moves:
        rows = [
            {"from": old, "to": new, "trials": len(names), "which": _names(names)}
            for (old, new), names in sorted(moves.items())
        ]
        print_table("Moves", rows)
    else:
        say("every trial is in its split already")


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
    rows = []
    for name, scores in evaluation.conditions.items():
        lead = evaluation.lead_times[name]
        rows.append(
            {
                "condition": name,
                "frames": scores.frames,
                "MSE": f"{scores.mse:.4f}",
                "R2": "none" if scores.r2 is None else f"{scores.r2:.3f}",
                "MAE": f"{scores.mae:.3f}",
                "90 %": _percent(evaluation.coverage[name].get("0.9")),
                "warns": lead.median_ms and f"{lead.median_ms / 1e3:.2f} s {lead.warned}/{lead.trials}",
                "false": f"{lead.false_per_minute:.1f}/min",
            }
        )
    print_table(f"{evaluation.input} images, {evaluation.split} trials; 90 %: labels within this interval", rows)
    if evaluation.friction:
        say(f"friction: {evaluation.friction}")
    if evaluation.ratio_r2:
        scores = (f"{name} {'none' if r2 is None else f'{r2:.3f}'}" for name, r2 in evaluation.ratio_r2.items())
        say(f"F_t / F_n is predicted with R2 {', '.join(scores)}")
    if evaluation.risk is not None:
        say(str(evaluation.risk))


def print_faithfulness(faithfulness: "Faithfulness") -> None:
    """Print the scores of each method, the deletion score of the thesis, and the alarms."""
    rows, deletion = [], faithfulness.deletion
    for scores in faithfulness.scores:
        gain, lead = scores.srg, scores.lead_over_controls
        ends = None if gain.low is None or gain.high is None else f"{gain.low:+.3f} to {gain.high:+.3f}"
        rows.append(
            {
                "method": scores.method,
                "gain": f"{gain.estimate:+.3f}",
                "95 % interval": ends,
                "less the best control": None if lead is None else f"{lead.gap.estimate:+.3f}",
            }
        )
    where = f"{faithfulness.input} images ({faithfulness.source})"
    print_table(f"symmetric gain, {where}: higher is more faithful", rows)
    if deletion is not None:
        rows = [
            {
                "method": name,
                "D_AUC": f"{scores.mean:.3f}",
                "+-": f"{scores.sd:.3f}",
                "last step": f"{scores.last_step_mean:.3f}",
                "frames": scores.frames,
            }
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
