"""The commands: each calls a function of the library and prints its result."""

import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

import msgspec

from sliplens.cli import output
from sliplens.cli.app import Command
from sliplens.cli.console import OUT, Terminal, print_file, print_table, say
from sliplens.errors import InputError, RecordingError, SliplensError
from sliplens.files import require_new_file, to_builtins
from sliplens.progress import number_of, open_stage, reporting

if TYPE_CHECKING:
    from sliplens.grip.controllers import HoldStep
    from sliplens.live import LiveReader

COMMANDS: dict[str, Command] = {}
"""Commands by name; `sensor new` and the like have two words."""
Run = Callable[..., None]


def command(
    name: str, function: str, example: str, *aliases: tuple[str, str], writes: str = ""
) -> Callable[[Run], Run]:
    """Register a function that calls a function of the library, given with its arguments, and prints the result."""

    def register(run: Run) -> Run:
        COMMANDS[name] = Command(f"sliplens.{function}", run, example, aliases, writes)
        return run

    return register


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
    from sliplens.grip.source import open_grip, usual_network
    from sliplens.live import LiveReader
    from sliplens.live.contract import LiveOptions
    from sliplens.recordings import TrialFacts
    from sliplens.recordings.sensor import is_profile, load_profile

    if list_sources:
        output.print_sources()
        return
    arguments = {"source": "simulated", "network": None, "options": LiveOptions(), "sensor": None} | call.keywords
    sensor = arguments["sensor"] or ""
    profile = arguments["sensor"] = load_profile(sensor) if is_profile(sensor) else None
    if profile is None:
        arguments["network"] = arguments["network"] or usual_network(arguments["source"])
    if (grip := open_grip(arguments["source"], arguments["options"])) is not None:
        arguments |= {"source": grip, "options": None}
    facts = TrialFacts(trial="live", sensor=sensor, object=object, condition=condition, day=day)
    with ExitStack() as stack:
        reader = stack.enter_context(closing(LiveReader(**arguments)))
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
            if page and not sink and "seconds" not in arguments:
                say(f"{reader.source.name} has ended; the page stays until Ctrl-C", aside=True)
                Event().wait()


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
    output.show_splits(call().trials)


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
    output.show_labelled(data, audit=audit)
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
    output.show_labelled(call(data=data, out=out), audit=audit)


@command("recover", "recordings.dataset:recover_dataset", "sliplens recover runs/mine/data")
def call_recover(call: Any) -> None:
    """Print what the data set holds."""
    data = call()
    say(f"{data.folder} holds {number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}")


@command("split", "recordings.splits:split_dataset", "sliplens split runs/mine/data --splits object --dry-run")
def call_split(call: Any) -> None:
    """Print the splits, and the trials that move."""
    from sliplens.recordings.dataset import load_dataset

    data = load_dataset(call.keywords["data"])
    result = call(data=data)
    moves = sum(info.split != split for info, split in zip(data.trials, result.splits, strict=True))
    output.show_splits([replace(info, split=split) for info, split in zip(data.trials, result.splits, strict=True)])
    output.show_moves(data.trials, result.splits)
    for note in result.notes:
        say(f"note: {note}")
    if call.keywords.get("dry_run"):
        say("nothing is written (--dry-run)")
        return
    print_file(data.folder, f"{moves} of {len(data.trials)} trials moved")
    if moves:
        say("networks trained before had other splits: a trial of the test may have trained them; train again")


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


@command("slip", "live.slip_clips:evaluate_slip", "sliplens slip lifts.csv --after 10")
def call_slip(call: Any) -> None:
    """Print the balanced accuracy of the slip detector and of trivial baselines."""
    with reporting(Terminal()), open_stage("Reading clips"):
        result = call()
    print_table(f"Slip of {number_of(len(result.fall), 'clip')}", result.scores.to_arrow().to_pylist())


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
    output.print_scores(evaluation)


@command(
    "predict",
    "models.predictions:predict",
    "sliplens predict cup.mp4 --sensor tip.toml --plot margin.png -o margins.csv",
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
    output.show_predictions(predictions)
    for reason, frames in predictions.withheld.items():
        say(f"withheld in {number_of(frames, 'frame')}: {reason}")
    if "friction" in call.keywords:
        say(f"margins for the given friction of {call.keywords['friction']}")
    if plot is not None:
        from sliplens.plots.figure import plot as draw
        from sliplens.plots.style import save_page

        save_page(draw(predictions), plot)
        print_file(plot, "margin over time of the first trial")
    if predictions.path is not None:
        print_file(predictions.path, f"{number_of(predictions.frames, 'frame')}, by {predictions.engine}")


@command("export onnx", "models.onnx:export_onnx", "sliplens export onnx runs/mine/train -o tip.onnx")
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


command("score", "study.scoring:score", "sliplens score runs/mine/train runs/mine/explain -o runs/mine/score")(
    lambda call: output.print_faithfulness(call())
)


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
    output.draw_report(Path(call.keywords["out"]))


@command(
    "grip",
    "grip.episodes:run_episodes",
    "sliplens grip -o runs/grip --object egg --rendered",
    ("settings", "--set"),
    writes="folder to make",
)
def call_grip(call: Any) -> None:
    """Print what became of the episodes, and draw the first."""
    from sliplens.plots.figure import plot
    from sliplens.plots.style import save_page

    out = Path(call.keywords["out"])
    grip = call(out=out / "grip")
    save_page(plot(grip), out / "grip.png")
    output.print_grip(grip)


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
    from sliplens.grip.source import open_grip, usual_network
    from sliplens.live import LiveReader
    from sliplens.live.contract import LiveOptions
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
            network = options.get("network") or (usual_network(name) if "sensor" not in settings else None)
            finger = open_grip(name, LiveOptions()) or name
            readers.append(stack.enter_context(LiveReader(finger, network, reference=image, **settings)))
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


command("report", "report.page:write_report", "sliplens report runs/mine")(lambda call: output.print_written(call()))
