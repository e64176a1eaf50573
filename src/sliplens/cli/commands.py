"""The commands: each calls a function of the library and prints its result."""

import time
from collections.abc import Iterable
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

import msgspec

from sliplens.cli import data  # noqa: F401 (its commands are listed first)
from sliplens.cli.app import command
from sliplens.cli.console import OUT, Terminal, print_file, print_table, say
from sliplens.errors import InputError, SliplensError
from sliplens.files import require_new_file, to_builtins
from sliplens.progress import number_of, open_stage, reporting

if TYPE_CHECKING:
    from sliplens.grip.controllers import HoldStep
    from sliplens.live import LiveReader
    from sliplens.models.predictions import Predictions
    from sliplens.report.page import Written

_MOST_FRAMES, _MOST_TRIALS = 24, 40  # numbers of frames and trials with a line each


class _Log:
    """Lines of a running work: one a second, and each warning once, aside from the results."""

    def __init__(self) -> None:
        self._printed_s, self._warnings = -1.0, set[str]()

    def due(self) -> bool:
        """Return True once a second."""
        due = time.monotonic() - self._printed_s >= 1
        self._printed_s = time.monotonic() if due else self._printed_s
        return due

    def warn(self, warnings: Iterable[str | None]) -> None:
        """Print warnings that are new."""
        for warning in dict.fromkeys(filter(None, warnings)):
            if warning not in self._warnings:
                self._warnings.add(warning)
                say(warning, aside=True)


def _say_friction(name: str, reader: "LiveReader") -> None:
    """Print the friction that slips taught, with the option for the next time."""
    if (friction := reader.learnt) is not None:
        say(f"{name}: the object slipped; to hold it again, set --friction {friction.text}", aside=True)


@command(
    "live",
    "live.loop:read_live",
    "sliplens live 0 --network chromatouch-pair --reference untouched.png",
    ("list_sources", "--list"),
    ("rate_hz", "--rate"),
)
def call_live(
    call: Any,
    *,
    list_sources: bool = False,
    sink: tuple[str, ...] = (),
    page: bool = True,
    host: str = "127.0.0.1",
    port: int | None = None,
    record: Path | None = None,
    object: str = "",
    condition: str = "dry",
    day: int = 1,
) -> None:
    """Show readings in a browser or on the terminal, send them elsewhere, and record frames.

    Parameters
    ----------
    list_sources
        List the cameras and the other sources, and end.
    sink
        Where readings go: json (lines on standard output), mcap:FILE (for Foxglove), rerun:FILE, zenoh:KEY
        (to ROS 2). Without one, a line a second is printed.
    page
        Serve a page with buttons to freeze, explain and record.
    host
        Address of the page; 0.0.0.0 for all machines, which then need the token that is printed.
    port
        Port of the page; 8090 if not given.
    record
        Data set to record every frame into; the button of the page records into `recorded` without it.
    object
        Name of the object, for the recording.
    condition
        dry or wet, for the recording.
    day
        Day of the recording.
    """
    from sliplens.grip.source import open_reader
    from sliplens.live import SOURCES, list_cameras
    from sliplens.recordings import TrialFacts
    from sliplens.recordings.sensor import is_profile, load_profile

    if list_sources:
        cameras = [{"device": device, "name": name} for device, name in list_cameras().items()]
        print_table("Cameras", cameras) if cameras else say("no camera was found")
        for words in ("simulated gripper that holds (grip, or grip:egg)", *(kind.words for kind in SOURCES.values())):
            say(f"  {words}")
        return
    sensor = call.keywords.get("sensor", "")
    settings = call.keywords | {"sensor": load_profile(sensor) if is_profile(sensor) else None}
    facts = TrialFacts(trial="live", sensor=sensor, object=object, condition=condition, day=day)
    with ExitStack() as stack:
        reader = stack.enter_context(closing(open_reader(**settings)))
        reader.send_to(*sink)
        if record is not None:
            reader.record(record, facts=facts)
        stack.callback(lambda: [say(str(outlet), aside=True) for outlet in reader.outputs])
        stack.callback(_say_friction, reader.source.name, reader)
        with suppress(KeyboardInterrupt), reader, ExitStack() as serving:
            if page:
                from sliplens.app import LivePage

                into = record or Path("recorded")
                served = serving.enter_context(LivePage(reader, facts=facts, host=host, port=port, record_into=into))
                say(f"open {served.address}", aside=True)
            log = _Log()
            for reading in filter(lambda _: log.due(), reader.readings()):
                for sender in () if page else reader.outputs:
                    if sender.error and sender is not reader.recorder:
                        raise sender.error
                log.warn((*reader.doubts, *reader.troubles))
                if not sink:
                    say(str(reading))
            if page and not sink and "seconds" not in settings:
                say(f"{reader.source.name} has ended; the page stays until Ctrl-C", aside=True)
                Event().wait()


@command("slip", "live.slip_clips:evaluate_slip", "sliplens slip lifts.csv --after 10")
def call_slip(call: Any) -> None:
    """Print the balanced accuracy of the slip detector and of trivial baselines."""
    with reporting(Terminal()), open_stage("Reading clips"):
        result = call()
    print_table(f"Slip of {number_of(len(result.fall), 'clip')}", result.scores.to_arrow().to_pylist())


@command(
    "train",
    "training.fitting:train",
    "sliplens train runs/mine/data -o runs/mine/train --start-from chromatouch-pair --epochs 5",
    writes="folder of the network",
)
def call_train(call: Any) -> None:
    """Draw the learning curve."""
    from sliplens.plots.figure import plot
    from sliplens.plots.style import save_page

    picture, network = Path(call.keywords["out"]) / "curves.png", call()
    if network.training is not None and not picture.is_file():
        save_page(plot(network), picture)


@command(
    "evaluate", "training.evaluation:evaluate", "sliplens evaluate runs/mine/train runs/mine/data -o runs/mine/evaluate"
)
def call_evaluate(call: Any, *, device: str = "cpu") -> None:
    """Print the scores and draw them.

    Parameters
    ----------
    device
        Device of the network: cpu, cuda or cuda:1.
    """
    from sliplens.models.checkpoint import load
    from sliplens.plots.figure import plot
    from sliplens.plots.style import save_page

    evaluation = call(run=load(call.keywords["run"], device=device))
    if (out := call.keywords.get("out")) is not None and not (picture := Path(out) / "evaluation.png").is_file():
        save_page(plot(evaluation), picture)
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


def show_predictions(predictions: "Predictions") -> None:
    """Print each frame if they are few, else the lowest margin of each trial."""
    from sliplens.models.predictions import lowest_frame

    table = predictions.to_arrow()
    rows = []
    for row in table.to_pylist() if predictions.frames <= _MOST_FRAMES else ():
        frame = row.get("file") or f"{row['trial']} {row['frame']}"
        rows.append(
            {"frame": frame, "safety margin": _percent(row["prediction"]) or "withheld"}
            | {"90 % interval": _interval(row["low_90"], row["high_90"])}
            | {"true": _percent(row.get("safety_margin")), "known": _percent(row.get("known"))}
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


@command(
    "predict",
    "models.predictions:predict",
    "sliplens predict cup.mp4 --sensor tip.toml --plot margin.png -o margins.csv",
    suffixes=(".parquet", ".csv"),
)
def call_predict(call: Any, *, plot: Path | None = None) -> None:
    """Print the margins.

    Parameters
    ----------
    plot
        Picture to draw: margin with its interval over time of the first trial, and label if it is known.
    """
    if plot is not None:
        from sliplens.plots.style import require_picture_path

        require_picture_path(plot, example="margins.png")
        require_new_file(plot, overwrite=call.keywords.get("overwrite", False))
    predictions = call()
    predictions = replace(predictions, rows=predictions.to_arrow())  # a file is loaded once
    show_predictions(predictions)
    for reason, frames in predictions.withheld.items():
        say(f"withheld in {number_of(frames, 'frame')}: {reason}")
    if plot is not None:
        from sliplens.plots.figure import plot as draw
        from sliplens.plots.style import save_page

        save_page(draw(predictions), plot)
        print_file(plot, "margin over time of the first trial")
    if predictions.path is not None:
        print_file(predictions.path, f"{number_of(predictions.frames, 'frame')}, by {predictions.engine}")


@command(
    "export onnx", "models.onnx:export_onnx", "sliplens export onnx runs/mine/train -o tip.onnx", suffixes=(".onnx",)
)
def call_export_onnx(call: Any) -> None:
    """Print what was written."""
    with OUT.status("Exporting; the file appears once ONNX Runtime predicts the same as the network"):
        path = call()
    print_file(path, "predicts as the network does")


command(
    "explain",
    "study.explaining:explain",
    "sliplens explain runs/mine/train runs/mine/data -o runs/mine/explain",
    ("source", "--frames"),
    writes="folder of the maps",
)(lambda call: call())


@command("score", "study.scoring:score", "sliplens score runs/mine/train runs/mine/explain -o runs/mine/score")
def call_score(call: Any) -> None:
    """Print the scores of each method, the deletion score of the thesis, and the alarms."""
    faithfulness = call()
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


@command(
    "study",
    "study.run:run_study",
    "sliplens study runs/mine/data --network runs/mine/train -o runs/mine/study --on processes=2",
    ("networks", "--network"),
    ("methods", "--method"),
    writes="folder of the study",
)
def call_study(call: Any) -> None:
    """Draw the page."""
    call()
    draw_report(Path(call.keywords["out"]))


@command(
    "grip",
    "grip.episodes:run_episodes",
    "sliplens grip -o runs/grip --object egg --rendered",
    ("settings", "--set"),
    writes="folder to make",
)
def call_grip(call: Any) -> None:
    """Print what became of the episodes, and draw the first."""
    from scipy.stats import binomtest

    from sliplens.plots.figure import plot
    from sliplens.plots.style import save_page

    out = Path(call.keywords["out"])
    grip = call(out=out / "grip")
    save_page(plot(grip), out / "grip.png")
    table, fell, setup = grip.episodes, int(grip.episodes.dropped.sum()), grip.setup
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


class HoldOptions(TypedDict, total=False):
    """Options of `sliplens hold` beside those of `hold_grip`."""

    network: str
    """Network for the sources; for `grip` that of the package if not given."""

    messages: str
    """Messages of a ROS 2 gripper: gripper-command (default) or controllers."""
    joint: str
    """Joint of a ROS 2 gripper that has width and force; the first if not given."""
    second: str
    """Source of a second fingertip."""
    reference: tuple[Path, ...]
    """Image of each untouched sensor; taken when the picture is still at first if not given."""
    friction: str
    """Coefficient of friction of the object, if it is known: 0.62, 0.5..0.8 or 0.58+-0.05."""
    same_object: bool
    """All grasps are of one object: friction measured in a slip holds for the next."""
    sensor: str
    """Profile of the sensors, a file or a name such as digit."""
    engine: Literal["auto", "torch", "openvino"]
    """Library that runs the network; auto (default) is the fastest."""
    device: str
    """Device of the network: cpu (default), cuda or cuda:1."""
    json: bool
    """Print a line of JSON for each command; else a line a second."""


@command(
    "hold",
    "grip.hold:hold_grip",
    "sliplens hold grip:cup --gripper simulated",
    ("settings", "--set"),
    ("ceiling_n", "--ceiling"),
)
def call_hold(call: Any, source: str, **options: Unpack[HoldOptions]) -> None:
    """Print the commands.

    Parameters
    ----------
    source
        Source of a fingertip as in `live`; `grip` for a simulated gripper, or `grip:egg`.
    """
    from sliplens.grip.controllers import make_controller
    from sliplens.grip.gripper import open_gripper
    from sliplens.grip.source import open_reader
    from sliplens.live.loop import ReaderSettings

    arguments = call.keywords
    gripper = arguments["gripper"]
    make_controller(arguments.get("controller", "margin"), arguments.get("settings"))  # refused before a network loads
    names = [name for name in (source, options.get("second")) if name is not None]
    reference = options.get("reference", ())
    if reference and len(reference) != len(names):
        raise InputError(f"--reference takes an image for each source, {len(names)}, got {len(reference)}")
    settings = {name: options[name] for name in options.keys() & ReaderSettings.__annotations__.keys() - {"reference"}}
    with ExitStack() as stack:
        if gripper not in {"simulated", "dry-run"}:
            messages = options.get("messages", "gripper-command")
            gripper = stack.enter_context(closing(open_gripper(gripper, messages=messages, joint=options.get("joint"))))
        readers = list["LiveReader"]()
        for name, image in zip(names, reference or [None] * len(names), strict=True):
            reader = open_reader(name, options.get("network"), reference=image, **settings)
            readers.append(stack.enter_context(reader))
        log = _Log()

        def on_step(step: "HoldStep") -> None:
            log.warn((step.trouble, *(doubt for reader in readers for doubt in reader.doubts)))
            if options.get("json"):
                print(msgspec.json.encode(to_builtins(step)).decode(), flush=True)
            elif log.due():
                say(str(step))

        result = call(readers=readers, gripper=gripper, on_step=on_step)
    say(result.why, aside=True)
    for name, reader in zip(names, readers, strict=True):
        _say_friction(name, reader)
    if "out" in arguments:
        print_file(Path(arguments["out"]), number_of(len(result.steps), "command"))
    if result.ended == "failed":
        raise SliplensError(result.why)


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


command("report", "report.page:write_report", "sliplens report runs/mine")(lambda call: print_written(call()))
