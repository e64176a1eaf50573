"""A study as a table of steps, each from records to a record, and the loop that keeps them in folders."""

import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

from sliplens.codec import load_result
from sliplens.errors import InputError
from sliplens.explainers.contract import Explainer
from sliplens.explainers.explain import network_inputs, with_markers
from sliplens.explainers.frames import frames_at
from sliplens.explainers.table import RECOMMENDED_METHOD
from sliplens.faithfulness.scoring import influences
from sliplens.files import DEFAULT_NETWORK, hash_json, scratch_folder, write_json
from sliplens.intervals import FEWEST_UNITS
from sliplens.models import Network
from sliplens.models.wrapping import open_run
from sliplens.progress import OnProgress, add_note, number_of, open_stage, reporting
from sliplens.recordings import Dataset, load_dataset
from sliplens.results import study as results
from sliplens.results.explanation import Explanation, Strip
from sliplens.results.faithfulness import NEW_WEIGHTS
from sliplens.results.study import Study, StudyConfig
from sliplens.runner import MakePart, Work, keep_record, require_executor
from sliplens.simulation.trials import rebuild_trial
from sliplens.study import choice
from sliplens.study.explaining import Explaining, make_strip
from sliplens.study.scoring import STUDY_ORDERS, Influence, PixelDeletion, Removal, Untrained, measure_maps
from sliplens.study.stages import Stage
from sliplens.study.truth import JudgingByTruth, true_curves
from sliplens.training.evaluation import evaluate

NetworkLike: TypeAlias = Network | nn.Module | Path | str


def run_study(
    data: Dataset | Path | str,
    networks: NetworkLike | Sequence[NetworkLike] = DEFAULT_NETWORK,
    config: StudyConfig | None = None,
    *,
    out: Path | str | None = None,
    device: str = "cpu",
    on: str = "serial",
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Study:
    """Test which explanation of a network can be trusted: the experiment of the thesis, and controls it lacks.

    Evaluates the networks on the test trials, chooses trials on which they predict well, explains frames from full
    stick to full slip, scores the explanations by removal under several fills against controls, and, where the data are
    simulated, by the truth.
    Every step is a folder that is complete or absent: interrupted, the same call goes on where it stopped.

    Parameters
    ----------
    data
        Labelled data set, or its folder.
    networks
        Network, or networks of different inputs, each as it was loaded, as its folder, or as the name of one that comes
        with sliplens. Steps and tables are named by the input of a network: `difference`, `pair`, `raw`.
    config
        Methods, trials, tests and settings; those of `StudyConfig()` if None.
    out
        Folder of the study, a subfolder a step; a temporary one that lives as long as the result if None.
    on
        Where maps are made and judged: `serial`, `processes`, `processes=4`. Processes
        need a script that starts its work under `if __name__ == "__main__":`.

    Raises
    ------
    InputError
        If an option is out of range, a method is unknown, or two networks have the same input.
    RecordingError
        If no trial has a frame near every safety margin of the study.
    PartError
        If part of a step failed again and again, when all the rest of it is done.

    See Also
    --------
    explain : Explain single frames.
    score : Score the maps of one method.
    write_report : Write the page of a study.

    Examples
    --------
    >>> import sliplens as sl
    >>> config = sl.StudyConfig(trials=5)
    >>> study = sl.run_study("runs/mine/data", "chromatouch-pair", config, out="runs/mine/study")  # doctest: +SKIP
    >>> study.faithfulness["pair"].scores[0].srg.estimate  # doctest: +SKIP
    0.031
    >>> page = sl.write_report(study)  # doctest: +SKIP
    """
    config = config or StudyConfig()
    if unknown := sorted(set(config.tests) - set(results.TESTS)):
        raise InputError(f"a study has no test named {unknown[0]!r}; choose from {', '.join(results.TESTS)}")
    require_executor(on)
    data = data if isinstance(data, Dataset) else load_dataset(data)
    config = _quick(config, data) if config.quick else config
    choice.study_explainers(config.methods, budget=config.budget)
    with reporting(on_progress), ExitStack() as stack:
        _require_trials(data, config)
        records = Records(
            folder=stack.enter_context(scratch_folder()) if out is None else Path(out),
            data=data,
            networks=load_networks(networks, device=device),
            config=config,
            on=on,
            overwrite=overwrite,
        )
        if not (records.folder / results.CONFIG_FILE).exists():
            minutes = max(1, round(estimate_minutes(records)))
            add_note(f"this study takes about {minutes} minutes of one core; --quick takes about five")
        for name, run in records.networks.items():
            evaluate(run, data, records.folder / f"evaluate-{name}", overwrite=overwrite)
        of_networks = [replace(records, network=name) for name in records.networks]
        for step in SHARED:
            _run_step(step, records)
        write_json(records.folder / results.CONFIG_FILE, config)
        tests = {*config.tests} - ({"truth"} if records.not_redrawn else set())
        if data.simulated and tests != {*config.tests}:
            add_note(f"the truth is left out, since {records.not_redrawn}")
        # frames are explained in any case, and two tests need the controls
        needed = {"explain", *tests} | ({"control"} if {"faithfulness", "truth"} & {*config.tests} else set())
        for of_network, step in product(of_networks, [name for name in STUDY if name in needed]):
            _run_step(step, of_network)
        study = results.load_results(records.folder)
        for sentence in (records["choice"].summary, *study.left_out.values()):
            add_note(sentence)
        weakref.finalize(study, stack.pop_all().close)
        return study


def load_networks(networks: NetworkLike | Sequence[NetworkLike], *, device: str = "cpu") -> dict[str, Network]:
    """Load the networks of a study by their inputs, in one order whatever order they were named in."""
    several = [networks] if isinstance(networks, Network | nn.Module | Path | str) else networks
    by_input: dict[str, Network] = {}
    for run in (open_run(network, device=device) for network in several):
        if by_input.setdefault(run.encoding.name, run) is not run:
            raise InputError(
                f"two networks read the input {run.encoding.name}, and a study takes one network an input; study them "
                "one by one"
            )
    if not by_input:
        raise InputError("a study needs a network; name one at least")
    return dict(sorted(by_input.items()))


@dataclass(frozen=True, kw_only=True)
class Records:
    """Records of a study by step, those of one network where it is named; loaded from the folder when first used."""

    folder: Path
    data: Dataset
    networks: Mapping[str, Network]
    config: StudyConfig
    on: str = "serial"
    overwrite: bool = False
    network: str = ""

    def path(self, step: str) -> Path:
        """Return the folder of a step."""
        return self.folder / (step if step in SHARED else f"{step}-{self.network}")

    def __getitem__(self, name: str) -> Any:
        """Load the record of a step."""
        return load_result(self.path(name), results.RECORDS[name], command="sliplens study")

    @property
    def run(self) -> Network:
        """Network that is explained."""
        return self.networks[self.network]

    @cached_property
    def not_redrawn(self) -> str:
        """Reason why the chosen frames cannot be drawn again with markers put back; empty where they can."""
        if not self.data.simulated:
            return "the data were recorded"
        try:
            rebuild_trial(self.data.folder, self.data.load(self.data.find(self["choice"].frames[0].trial)))
        except InputError as error:
            return str(error)
        return ""

    def explainers(self, frames: Sequence[str], images: Tensor) -> dict[str, Explainer]:
        """Explainers by name, with the markers of frames, whose network inputs are `images`."""
        explainers = choice.study_explainers(self.config.methods, budget=self.config.budget)
        markers = self["states"].markers
        # tiles stand for markers where the markers of some frame are unknown
        if any(frame.id not in markers for frame in self["choice"].frames):
            explainers = choice.without_markers(explainers)
        return with_markers(explainers, images, lambda: choice.marker_places(self.run, frames, markers))

    @cached_property
    def explained(self) -> Explanation:
        """Explanations of the frames that are scored."""
        every = self["explain"]
        places = {frame.id: at for at, frame in enumerate(every.frames)}
        return every.take([places[frame.id] for frame in choice.worth_scoring(self["choice"].frames, every)])

    @property
    def scored_explainers(self) -> dict[str, Explainer]:
        """Explainers with the markers of the frames that are scored."""
        return self.explainers([frame.id for frame in self.explained.frames], network_inputs(self.run, self.explained))

    @cached_property
    def influence(self) -> Influence:
        """Maps to rank parts by, controls included."""
        return {**influences(self.run, self.explained), **self["control"].maps}


def _quick(config: StudyConfig, data: Dataset) -> StudyConfig:
    """Shorten a study to the judge that decides; what differs from the defaults stays as it was asked for."""
    default, test = StudyConfig(), "truth" if data.simulated else "faithfulness"
    short = replace(default, methods=results.QUICK_METHODS, trials=6, tests=(test,))
    changed = {name for name, value in vars(config).items() if value != getattr(default, name)}
    return replace(config, **{name: value for name, value in vars(short).items() if name not in changed})


def _require_trials(data: Dataset, config: StudyConfig) -> None:
    """Refuse data of too few trials to decide anything; they can be asked for."""
    infos = choice.sample_trials(data, split=config.split, condition=config.condition)
    trials = f"{number_of(len(infos), f'{infos[0].split} trial')} of condition {config.condition}"
    if len(infos) < min(FEWEST_UNITS, config.trials):
        raise InputError(
            f"{data.folder} has {trials}, and fewer than {FEWEST_UNITS} decide nothing; record more, name another "
            f"--split or --condition, or look at the maps without a verdict with --trials {len(infos)}"
        )
    if config.trials < FEWEST_UNITS:
        add_note(f"fewer than {FEWEST_UNITS} trials decide nothing: the page shows maps and no verdict; raise --trials")


def estimate_minutes(records: Records) -> float:
    """Estimate the minutes that the steps take on one core, from a few forward passes; half or twice of it is usual."""
    config, seconds = records.config, 0.0
    infos = choice.sample_trials(records.data, split=config.split, condition=config.condition)
    frames = min(config.trials, len(infos)) * len(choice.SCORED_LEVELS)
    # a map takes some 200 passes, with its control 500, and scores as many again; the truth takes 3000
    passes = (500 if len(config.tests) == 1 else 1000) * len(config.methods) + 3000 * records.data.simulated
    for run in records.networks.values():
        size = run.manifest.image_size
        images = torch.zeros(32, run.encoding.colours, size, size, device=run.device)
        run.predict(images)
        started = time.perf_counter()
        run.predict(images)
        seconds += frames * passes * (time.perf_counter() - started) / len(images)
    return seconds / 60


# the steps, in their order


def _show_trial(records: Records) -> Strip:
    data, config, network = records.data, records.config, next(iter(records.networks.values()))
    recording = data.load(data.find(next(frame.trial for frame in records["choice"].frames if frame.pictured)))
    method = RECOMMENDED_METHOD if RECOMMENDED_METHOD in config.methods else config.methods[0]
    folder = data.folder if data.simulated else None
    return make_strip(
        network, recording, source=data.source, method=method, baseline=config.baseline, folder=folder, seed=config.seed
    )


def _explain(records: Records) -> Explaining:
    run, places = records.run, [(frame.trial, frame.frame) for frame in records["choice"].frames]
    frames = frames_at(run, records.data, places, baseline=records.config.baseline)
    explainers = records.explainers(frames.ids, run.encoding.normalise(frames.images))
    return Explaining(trained=run, chosen=replace(frames, find_markers=None), explainers=explainers)


def _delete(records: Records) -> PixelDeletion:
    return PixelDeletion(trained=records.run, explained=records.explained, seed=records.config.seed)


def _explain_untrained(records: Records) -> Untrained:
    explained, explainers = records.explained, records.scored_explainers
    return Untrained(trained=records.run, explained=explained, explainers=explainers, seed=records.config.seed)


def _measure(records: Records) -> Any:
    explained, markers = records.explained, records["states"].markers
    return measure_maps(records.run, explained, records.scored_explainers, markers, seed=records.config.seed)


def _remove(records: Records) -> Removal:
    put_back = partial(true_curves, records.run, data=records.data, random_orders=STUDY_ORDERS)
    return Removal(
        trained=records.run,
        explained=records.explained,
        units=choice.removal_units(records.run, records.explained, records["states"].markers),
        maps=records.influence,
        settings=results.SETTINGS[:1] if records.config.quick else results.SETTINGS,
        random_orders=STUDY_ORDERS,
        redraw=None if records.not_redrawn else put_back,
        seed=records.config.seed,
    )


def judge_by_truth(records: Records) -> JudgingByTruth:
    """Compare maps along the prediction's change with the effects of markers that are put back."""
    explained = records.explained
    raises_only = {name for name, notes in explained.methods.items() if notes.raises_only}
    towards = explained.towards[:, None, None]
    maps = {
        # the order of such a method is the published one, but where the answer fell what raises it opposes that
        name: towards * values if name.removesuffix(NEW_WEIGHTS) in raises_only else values
        for name, values in records.influence.items()
    }
    fills, seed = tuple(dict.fromkeys(setting.fill for setting in results.SETTINGS)), records.config.seed
    return JudgingByTruth(
        trained=records.run, explained=explained, data=records.data, maps=maps, fills=fills, seed=seed
    )


@dataclass(frozen=True)
class Step:
    """Step of a study: from records to a record, in a folder of its name."""

    title: str
    make: Callable[[Records], Any]
    """Makes the record, or a `Stage` whose parts workers share."""


SHARED: dict[str, Step] = {
    "choice": Step("Choosing trials", lambda each: choice.choose_frames(each.networks, each.data, each.config)),
    "states": Step("Following markers", lambda records: choice.show_states(records["choice"], records.data)),
    "strip": Step("Explaining a trial from stick to slip", _show_trial),
}
"""Steps whose record is of all networks."""
STUDY: dict[str, Step] = {
    **SHARED,
    "explain": Step(Explaining.title, _explain),
    "score": Step(PixelDeletion.title, _delete),
    "control": Step(Untrained.title, _explain_untrained),
    "faithfulness": Step(Removal.title, _remove),
    "map-quality": Step("Measuring how maps look", _measure),
    "truth": Step(JudgingByTruth.title, judge_by_truth),
}
"""Steps of a study in their order."""


class _StepWork(Work):
    """Parts of a step; another process loads the records that it needs itself."""

    def __init__(self, name: str, records: Records) -> None:
        self.name, self.records = name, records

    def __reduce__(self) -> tuple[type, tuple[str, Records]]:
        return type(self), (self.name, replace(self.records))  # without what is cached

    @property
    def on_gpu(self) -> bool:
        return self.records.run.device.type != "cpu"

    def begin(self) -> MakePart:
        return STUDY[self.name].make(self.records).begin()


def _run_step(name: str, records: Records) -> None:
    """Keep the record of a step, unless its folder is complete; one of another configuration is not reused."""
    folder, step = records.path(name), STUDY[name]
    weights: Any = {each: run.manifest.weights_sha256 for each, run in records.networks.items()}
    config = vars(records.config) | {"tests": (), "data_hash": records.data.hash, "weights_sha256": weights}
    title = step.title
    if records.network:
        config |= {"weights_sha256": weights[records.network], "choice": hash_json(records["choice"])}
        title = f"{step.title} ({records.network})"

    def make(parts: Path) -> Any:
        with open_stage(title):
            record = step.make(records)
            if isinstance(record, Stage):
                record = record.make(parts, work=_StepWork(name, records), on=records.on)
        if alarms := getattr(record, "alarms", ()):
            add_note(f"{folder.name}: {number_of(len(alarms), 'alarm')}, such as: {alarms[0]}")
        return record

    what = title[0].lower() + title[1:]
    keep_record(folder, make, stage=name, config=config, what=what, overwrite=records.overwrite)
