"""Results of the commands on the terminal."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sliplens.cli.console import Terminal, print_file, print_table, say
from sliplens.progress import fold_equal, number_of

if TYPE_CHECKING:
    import pyarrow as pa

    from sliplens.grip.records import Grip
    from sliplens.models.predictions import Predictions
    from sliplens.recordings import Dataset, TrialInfo
    from sliplens.recordings.labelling import Labelling
    from sliplens.report.page import Written
    from sliplens.results.evaluation import Evaluation, RegressionScores
    from sliplens.results.faithfulness import Faithfulness

_MOST_ROWS = 24
"""Number of frames or trials that are listed one by one."""
_MOST_TRIALS = 40
"""Number of trials with a line each."""
_MOST_NAMES = 6
"""Number of names in a cell."""


def show_predictions(predictions: "Predictions") -> None:
    """Print each frame if they are few, else the course of each trial."""
    if predictions.frames <= _MOST_ROWS:
        rows = predictions.to_arrow().to_pylist()
        columns = {"true": "safety_margin", "known": "known"}
        columns = {head: name for head, name in columns.items() if any(row.get(name) is not None for row in rows)}
        cells = [
            (
                row.get("file") or f"{row['trial']} {row['frame']}",
                _percent(row["prediction"]) if row["withheld"] is None else "withheld",
                _interval(row["low_90"], row["high_90"]),
                *(_percent(row[name]) for name in columns.values()),
            )
            for row in rows
        ]
        print_table("Safety margins", ("frame", "safety margin", "90 % interval", *columns), cells)
        return
    table = predictions.to_arrow()
    column = table["trial"].to_numpy()
    names = list(dict.fromkeys(column))
    for name in names[:_MOST_TRIALS]:
        say(_course(table.filter(column == name)))
    if len(names) > _MOST_TRIALS:
        say(f"and {number_of(len(names) - _MOST_TRIALS, 'more trial')}; -o margins.csv writes every frame")


def _course(rows: "pa.Table") -> str:
    """Describe the lowest margin of a trial."""
    from sliplens.models.predictions import lowest_frame

    words, lowest = "none", lowest_frame(rows)
    if lowest is not None:
        row = rows.slice(lowest, 1).to_pylist()[0]
        interval = "" if row["low_90"] is None else f" ({_interval(row['low_90'], row['high_90'])})"
        where = f"frame {lowest}" if row["time_s"] is None else f"{row['time_s']:.2f} s"
        words = f"{_percent(row['prediction'])}{interval} at {where}"
    words = f"{rows['trial'][0]}: lowest {words}, {number_of(len(rows), 'frame')}"
    if "touches" in rows.column_names:
        touching = int(rows["touches"].to_numpy().sum())
        words += f", {touching:,} touch" if touching else ", none touches"
    withheld = len(rows) - rows["withheld"].null_count
    return f"{words}, {withheld:,} withheld" if withheld else words


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _interval(low: float | None, high: float | None) -> str:
    return "-" if low is None or high is None else f"{100 * low:.0f} to {100 * high:.0f} %"


def draw_audits(data: "Dataset", folder: Path) -> None:
    """Draw the audit pages that are missing."""
    from sliplens.plots.sheets import write_audits

    if write_audits(data, folder, on_progress=Terminal()):
        print_file(folder, "a page for each trial: look at them before you train")


def show_labelled(title: str, data: "Dataset", *, audit: bool) -> None:
    """Draw the pages of a labelled data set, and print what its labels rest on."""
    if audit:
        draw_audits(data, data.folder / "audit")
    _show_labelling(title, data)


def _show_labelling(title: str, data: "Dataset") -> None:
    """Print what the labels of each trial rest on, what was assumed, and which frames have none."""
    rows, notes, invalid = [], [], {}
    for info in data.trials:
        labels = data.read_labels(info)
        counts = labels.count()
        rows.append((info.trial, f"{counts.get('valid', 0)} of {info.frames}", *_basis(labels.labelling, counts)))
        notes += labels.labelling.notes if labels.labelling is not None else ()
        invalid[info.trial] = Counter({reason: count for reason, count in counts.items() if reason != "valid"})
    print_table(title, ("trial", "valid", "mu", "lag, ms", "reference"), rows[:_MOST_ROWS])
    if len(rows) > _MOST_ROWS:
        say(f"  and {number_of(len(rows) - _MOST_ROWS, 'more trial')}; `sliplens check` names those in doubt")
        invalid = {f"all {len(rows)} trials": sum(invalid.values(), Counter())}
    for line in fold_equal(dict.fromkeys(notes)):
        say(f"  note: {line}")
    for trial, counts in invalid.items():
        reasons = ", ".join(f"{count:,} {reason}" for reason, count in counts.items())
        say(f"  {trial}: frames without a valid label: {reasons or 'none'}")


def _basis(labelling: "Labelling | None", counts: dict[str, int]) -> Sequence[str]:
    """Return friction, lag and reference in words."""
    friction, lag, reference = "came with it" if counts.get("valid") else "-", "-", "its own"
    if labelling is not None and labelling.basis is not None:
        basis = labelling.basis
        mu, low, high = basis.friction.mu, basis.friction.low, basis.friction.high
        friction = f"{mu:.3f} given" if low == high else f"{mu:.3f} [{low:.3f}, {high:.3f}]"
        if basis.lag is not None:
            estimate = f"{1e3 * basis.lag.lag_s:+.1f} +- {1e3 * basis.lag.sigma_s:.1f}"
            lag = ("unknown" if basis.lag.doubt else estimate) + (" (applied)" if basis.lag_applied else "")
    if labelling is not None and labelling.reference.index is not None:
        reference = f"frame {labelling.reference.index}"
    return friction, lag, reference


def show_splits(trials: "Sequence[TrialInfo]", splits: Sequence[str]) -> None:
    """Print the content of each split."""
    rows, usual = [], ("train", "validation", "test")
    for name in sorted(set(splits), key=lambda name: (usual.index(name) if name in usual else len(usual), name)):
        infos = [info for info, split in zip(trials, splits, strict=True) if split == name]
        rows.append(
            (
                name,
                str(len(infos)),
                f"{sum(info.frames for info in infos):,}",
                _names({str(info.day) for info in infos}),
                _names({info.object for info in infos} - {""}),
                _names({info.condition for info in infos}),
            )
        )
    print_table("Splits", ("split", "trials", "frames", "days", "objects", "conditions"), rows)


def show_moves(moves: "Sequence[tuple[TrialInfo, str]]") -> None:
    """Print the trials that change their split."""
    if not moves:
        say("every trial is in its split already")
        return
    names = defaultdict(list)
    for info, split in moves:
        names[info.split, split].append(info.trial)
    rows = [(old, new, str(len(those)), _names(those)) for (old, new), those in sorted(names.items())]
    print_table("Moves", ("from", "to", "trials", "which"), rows)


def _names(names: Iterable[str]) -> str:
    from sliplens.images import natural_key

    ordered = sorted(names, key=natural_key)
    rest = len(ordered) - _MOST_NAMES
    return ", ".join(ordered if rest < 2 else [*ordered[:_MOST_NAMES], f"{rest} more"]) or "-"


def print_known_trials(data: "Dataset", network: Path) -> None:
    """Print how many trials of each split trained a network."""
    from sliplens.models.checkpoint import load
    from sliplens.training.evaluation import find_training_trials

    trained = Counter(trial.split for trial in find_training_trials(data.trials, load(network)))
    for split, count in Counter(trial.split for trial in data.trials).items():
        say(f"{network} was trained on {trained[split]} of the {count} {split} trials of {data.folder}")


def print_scores(evaluation: "Evaluation") -> None:
    """Print the scores of a network by condition."""
    trials = len(evaluation.trials)
    if count := evaluation.known_trials:
        say(
            f"  note: {count} of the {trials} trials trained or validated this network, which makes its scores too good"
        )
    print_table(
        f"{evaluation.input} images, {evaluation.split} trials",
        # short enough for 80 columns
        ("condition", "frames", "MSE", "R2", "MAE", "in 90 %", "warns\nbefore", "false\n/min"),
        [_score_row(name, evaluation) for name in evaluation.conditions],
    )
    if evaluation.friction:
        say(f"friction: {evaluation.friction}")
    if evaluation.sequence:
        say("sequence: each margin is predicted from the frames of its contact so far")
    if evaluation.ratio_r2:
        scores = (f"{name} {'none' if r2 is None else f'{r2:.3f}'}" for name, r2 in evaluation.ratio_r2.items())
        say(f"F_t / F_n is predicted with R2 {', '.join(scores)}")
    if evaluation.risk is not None:
        say(str(evaluation.risk))


def _score_row(condition: str, evaluation: "Evaluation") -> tuple[str, ...]:
    scores, lead = evaluation.conditions[condition], evaluation.lead_times[condition]
    coverage = evaluation.coverage[condition].get("0.9")
    return (
        condition,
        f"{scores.frames:,}",
        *_errors(scores),
        "-" if coverage is None else f"{100 * coverage:.0f} %",
        "-" if lead.median_ms is None else f"{lead.median_ms:.0f} ms {lead.warned}/{lead.trials}",
        f"{lead.false_per_minute:.1f}",
    )


def _errors(scores: "RegressionScores") -> tuple[str, str, str]:
    return f"{scores.mse:.4f}", "none" if scores.r2 is None else f"{scores.r2:.3f}", f"{scores.mae:.3f}"


def print_faithfulness(faithfulness: "Faithfulness") -> None:
    """Print the scores of each method, the deletion score of the thesis, and the alarms."""
    rows = []
    for scores in faithfulness.scores:
        gain, lead = scores.srg, scores.lead_over_controls
        ends = "" if gain.low is None or gain.high is None else f"{gain.low:+.3f} to {gain.high:+.3f}"
        rows.append((scores.method, f"{gain.estimate:+.3f}", ends, "" if lead is None else f"{lead.gap.estimate:+.3f}"))
    where = f"{faithfulness.input} images ({faithfulness.source})"
    print_table(
        f"symmetric gain, {where}: higher is more faithful",
        ("method", "gain", "95 % interval", "less the best control"),
        rows,
    )
    deletion = faithfulness.deletion
    if deletion is not None:
        print_table(
            f"deletion score of the thesis, {where}, fill grey: lower is more faithful",
            ("method", "D_AUC", "+-", "last step", "frames"),
            [
                (name, f"{scores.mean:.3f}", f"{scores.sd:.3f}", f"{scores.last_step_mean:.3f}", str(scores.frames))
                for name, scores in deletion.methods.items()
            ],
        )
    for alarm in dict.fromkeys(faithfulness.alarms + (() if deletion is None else deletion.alarms)):
        say(f"  alarm: {alarm}")


def print_grip(result: "Grip") -> None:
    """Print what became of the episodes."""
    from scipy.stats import binomtest

    table, fell = result.episodes, int(result.episodes.dropped.sum())
    low, high = binomtest(fell, len(table)).proportion_ci(method="wilson")
    rows = [
        ("dropped", f"{fell} of {len(table)} ({100 * low:.0f} to {100 * high:.0f} %, 95 % interval)"),
        ("crushed", f"{int(table.crushed.sum())}"),
        ("slip, median", f"{1e3 * float(sorted(table.slip_m)[len(table) // 2]):.1f} mm"),
        ("mean force", f"{table.mean_force_n.mean():.2f} N"),
        ("over the least force that holds", f"{100 * table.force_excess.mean():.0f} %"),
        ("time with a margin under 20 %", f"{table.under_20_s.mean():.2f} s"),
    ]
    setup = result.setup
    print_table(f"{setup.controller} on a {setup.object}, {setup.condition}", ("", ""), rows)


def print_sources() -> None:
    """Print the cameras and the other live sources."""
    from sliplens.live import SOURCES, list_cameras

    cameras = list(list_cameras().items())
    print_table("Cameras", ("device", "name"), cameras) if cameras else say("no camera was found")
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
