"""Commands that make, label and look at data sets, and the first one to try."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliplens.cli.app import command
from sliplens.cli.console import Terminal, print_file, print_table, say
from sliplens.errors import InputError, RecordingError
from sliplens.progress import fold_equal, number_of

if TYPE_CHECKING:
    from sliplens.recordings import Dataset, TrialInfo
    from sliplens.recordings.labelling import Labelling

_MOST_ROWS = 24  # number of trials that are listed one by one
_MOST_NAMES = 6  # number of names in a cell


@command("demo", "demo:run_demo", "sliplens demo runs/demo")
def call_demo(call: Any) -> None:
    """Print where the page is as soon as it exists; its notes are on the page."""
    pages, terminal = list[Path](), Terminal()

    def on_page(page: Path) -> None:
        if not pages:
            say(f"open {page.resolve()} now: it grows while the rest is made")
        pages.append(page)

    terminal.note = lambda _: None
    say(f"open {call(on_page=on_page, on_progress=terminal).resolve()}")


@command(
    "sensor new", "plots.figure:make_profile", "sliplens sensor new --from tip.mp4 -o tip.toml", ("source", "--from")
)
def call_sensor_new(call: Any) -> None:
    """Write the profile and its picture."""
    proposal, path = call(), Path(call.keywords["out"])
    for sentence in proposal.notes:
        say(f"  {sentence}")
    print_file(path, "correct it where the picture shows an error")
    print_file(path.with_suffix(".png"), "what the profile does to a frame")


@command(
    "simulate",
    "simulation.trials:simulate",
    "sliplens simulate runs/mine/data --preset small",
    writes="folder of the data set",
)
def call_simulate(call: Any) -> None:
    """Print the splits."""
    show_splits(call().trials)


@command(
    "import",
    "recordings.importing:import_recordings",
    "sliplens import cup.mp4 --forces cup.csv --sensor tip.toml -o runs/mine/data",
)
def call_import(call: Any, *, audit: bool = True) -> None:
    """Print what the labels rest on.

    Parameters
    ----------
    audit
        Draw a page for each trial, in `audit/` of the folder, from which to judge its labels.
    """
    data = call()
    show_labelled("Imported", data, audit=audit)
    if data.left_out:
        print_table("Left out", [{"trial": trial.trial, "why": trial.why} for trial in data.left_out])
        raise SystemExit(1)


@command("label", "recordings.corrections:label_dataset", "sliplens label runs/mine/data --draft corrections.csv")
def call_label(call: Any, *, draft: Path | None = None, audit: bool = True) -> None:
    """Print what the labels rest on.

    Parameters
    ----------
    draft
        Change no label: write a table of the present labels, to be edited and given to --corrections.
    audit
        Draw a page for each trial, in `audit/` of the folder, from which to judge its labels.
    """
    from sliplens.recordings.corrections import draft_corrections
    from sliplens.recordings.dataset import load_dataset

    arguments = call.keywords
    if draft is not None and arguments.keys() & {"out", "corrections"}:
        raise InputError("--draft changes no label; leave --out and --corrections out")
    folder = arguments["data"]
    data, out = load_dataset(folder), Path(arguments.get("out") or folder)
    if draft is not None:
        draft_corrections(data, draft)
        print_file(draft, f"edit it, then: sliplens label {folder} --corrections {draft}")
        return
    show_labelled("Labelled", call(data=data, out=out), audit=audit)


def show_labelled(title: str, data: "Dataset", *, audit: bool) -> None:
    """Draw the audit pages that are missing, and print what labels rest on and which frames have none."""
    from sliplens.plots.sheets import write_audits

    if audit and write_audits(data, data.folder / "audit", on_progress=Terminal()):
        print_file(data.folder / "audit", "a page for each trial: look at them before you train")
    rows, notes, invalid = [], [], Counter[str]()
    for info in data.trials:
        labels = data.read_labels(info)
        counts = Counter(labels.count())
        valid = counts.pop("valid", 0)
        rows.append({"trial": info.trial, "valid": f"{valid} of {info.frames}", **_basis(labels.labelling)})
        notes += labels.labelling.notes if labels.labelling is not None else ()
        invalid += counts
    print_table(title, rows[:_MOST_ROWS])
    if len(rows) > _MOST_ROWS:
        say(f"  and {number_of(len(rows) - _MOST_ROWS, 'more trial')}; `sliplens check` names those in doubt")
    for line in fold_equal(dict.fromkeys(notes)):
        say(f"  note: {line}")
    reasons = ", ".join(f"{count:,} {reason}" for reason, count in invalid.items())
    say(f"  frames without a valid label: {reasons or 'none'}")


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


@command("recover", "recordings.dataset:recover_dataset", "sliplens recover runs/mine/data")
def call_recover(call: Any) -> None:
    """Print what the data set holds."""
    data = call()
    say(f"{data.folder} holds {number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}")


@command("split", "recordings.splits:split_dataset", "sliplens split runs/mine/data --splits object --dry-run")
def call_split(call: Any) -> None:
    """Print the splits, and the trials that move."""
    from sliplens.recordings.dataset import load_dataset

    data, moves = load_dataset(call.keywords["data"]), defaultdict(list)
    result = call(data=data)
    for info, split in zip(data.trials, result.splits, strict=True):
        if info.split != split:
            moves[info.split, split].append(info.trial)
    show_splits([replace(info, split=split) for info, split in zip(data.trials, result.splits, strict=True)])
    rows = [
        {"from": old, "to": new, "trials": len(names), "which": _names(names)}
        for (old, new), names in sorted(moves.items())
    ]
    print_table("Moves", rows) if rows else say("every trial is in its split already")
    for note in result.notes:
        say(f"note: {note}")
    if call.keywords.get("dry_run"):
        say("nothing is written (--dry-run)")
        return
    print_file(data.folder, f"{sum(map(len, moves.values()))} of {len(data.trials)} trials moved")
    if moves:
        say("networks trained before had other splits: a trial of the test may have trained them; train again")


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


def _names(names: Iterable[str]) -> str:
    from sliplens.images import natural_key

    ordered = sorted(names, key=natural_key)
    rest = len(ordered) - _MOST_NAMES
    return ", ".join(ordered if rest < 2 else [*ordered[:_MOST_NAMES], f"{rest} more"]) or "-"


@command("check", "recordings.check:check_dataset", "sliplens check runs/mine/data")
def call_check(call: Any) -> None:
    """Print the findings; exit code 2 if there are any."""
    from sliplens.recordings.dataset import load_dataset

    data = load_dataset(call.keywords["data"])
    findings = call(data=data)
    if errors := [{"where": each.where, "what": each.what} for each in findings if not each.doubt]:
        print_table("Findings", errors)
        count = number_of(len(errors), "error")
        raise RecordingError(f"{data.folder} has {count}, listed above; correct or make these trials again")
    size = f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}"
    if doubtful := {finding.where for finding in findings}:
        about = f"the notes above put labels of {number_of(len(doubtful), 'trial')} in doubt"
        say(f"{data.folder} is whole: {size}, every hash and law holds, but {about}")
        return
    say(f"{data.folder} is sound: {size}, every hash and law holds")


@command(
    "view",
    "live.viewer:view",
    "sliplens view runs/mine/data --trial cup --predictions margins.parquet --maps runs/mine/explain",
)
def call_view(call: Any) -> None:
    """Print what is shown."""
    viewed = call()
    about = f"{viewed.trial}, {number_of(viewed.frames, 'frame')}"
    if (out := call.keywords.get("out")) is None:
        say(f"{about}, are in the Rerun viewer")
        say("the viewer reports its use to its makers, not what it shows: see `rerun analytics disable`")
    else:
        print_file(Path(out), f"{about}; open it with `rerun {out}`")


@command(
    "track",
    "markers.tracking:track",
    "sliplens track cup.mp4 --reference untouched.png -o markers.parquet",
    writes="table to write",
    suffixes=(".parquet",),
)
def call_track(call: Any) -> None:
    """Print how many markers were followed."""
    from sliplens.recordings.sensor import load_profile

    arguments = call.keywords
    if "markers" not in arguments and "sensor" in arguments:
        arguments["markers"] = load_profile(arguments["sensor"]).markers or "auto"
    tracking = call()
    for trial in tracking.trials:
        say(str(trial))
    print_file(tracking.path, f"{number_of(tracking.frames, 'frame')} of {number_of(len(tracking.trials), 'trial')}")
