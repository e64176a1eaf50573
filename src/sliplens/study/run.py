"""A whole study: frames chosen, explained, and their explanations tested in every way that is known."""

import weakref
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias

from sliplens.codec import load_result, save_record, save_result
from sliplens.errors import InputError
from sliplens.explainers.attribution import CLOSE
from sliplens.explainers.contract import Explainer
from sliplens.faithfulness.removal import Faithfulness
from sliplens.files import DEFAULT_NETWORK, hash_json, output_folder, remove, scratch_folder
from sliplens.intervals import FEWEST_UNITS
from sliplens.models import Network
from sliplens.models.checkpoint import open_run
from sliplens.progress import OnProgress, note, number_of, stage, wrote
from sliplens.recordings import Dataset, load_dataset
from sliplens.results.explanation import Explanation
from sliplens.results.faithfulness import NEW_WEIGHTS, DeletionScores
from sliplens.results.study import (
    ASKED_FILE,
    STAGES,
    TABLES,
    Asked,
    Choice,
    States,
    Study,
    UntrainedMaps,
    tell_left_out,
)
from sliplens.runner import MakePart, Work, require_executor
from sliplens.simulation.intervention import rebuild_trial
from sliplens.study.checks import CASCADE, Measuring, Randomising, Untrained, time_explainers
from sliplens.study.choice import (
    STUDY_BUDGET,
    STUDY_METHODS,
    Material,
    choose_frames,
    gather,
    method_options,
    seen_places,
    show_states,
    study_explainers,
    with_markers,
    without_markers,
    worth_scoring,
)
from sliplens.study.explaining import Explaining, frames_at
from sliplens.study.scoring import (
    SETTINGS,
    STEPS,
    STUDY_AREAS,
    Deletion,
    Influence,
    RemedialDeletion,
    Removal,
    Setting,
    influences,
)
from sliplens.study.stages import Stage
from sliplens.study.truth import TRUE_FILL, TRUTH_PAIRS, JudgingByTruth, true_curves
from sliplens.training.evaluation import evaluate

_COMMAND = "sliplens study"
_KINDS: dict[str, type] = {"explain": Explanation, "score": DeletionScores, "control": UntrainedMaps, **STAGES}
NetworkLike: TypeAlias = Network | Path | str
_Work: TypeAlias = Callable[[Path, OnProgress], object]
"""Takes a folder for parts, and what is called with the steps done and their number."""

_CONTROLS = {"controls": "each method on a network of new weights a trial", "statistics": "images"}
"""What the controls depend on, and with them all that is compared with them."""
_SCORED = {"least_change": CLOSE}
"""What decides which of the chosen frames are scored (`worth_scoring`)."""


TESTS = ("score", "remedies", "faithfulness", "randomisation", "map-quality", "truth", "timing")
"""Stages that a study may leave out: the thesis's score and its remedies, removal curves, weights drawn anew, ..."""


def run_study(
    data: Dataset | Path | str,
    networks: NetworkLike | Sequence[NetworkLike] = DEFAULT_NETWORK,
    *,
    out: Path | str | None = None,
    methods: Sequence[str] = STUDY_METHODS,
    split: str = "test",
    condition: str = "dry",
    trials: int = 14,
    tolerance: float = 0.03,
    budget: float = STUDY_BUDGET,
    tests: Collection[str] = TESTS,
    settings: Sequence[Setting] = SETTINGS,
    random_orders: int = 10,
    steps: int | None = None,
    device: str = "cpu",
    on: str = "serial",
    retry_failed: bool = False,
    seed: int = 0,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Study:
    """Find out which explanation of a network can be believed: the experiment of the thesis, and controls it lacks.

    Evaluates the networks on the test trials, picks trials that they read well, explains frames from full stick to full
    slip, scores the explanations by removal under several fills against controls, by randomisation and, where the data
    are simulated, by the truth.
    Every stage is a folder that is complete or absent: interrupted, the same call goes on where it stopped.

    Parameters
    ----------
    networks
        Network, or networks of different inputs, each as it was loaded, as its folder, or as the name of one that comes
        with sliplens. Stages and tables are named by the input that a network reads: `difference`, `pair`, `raw`.
    out
        Folder of the study, a subfolder a stage; a temporary one that lives as long as the result if None.
    methods, budget
        Explainers to compare (`study_explainers`), and the share of the channels that Poly-CAM measures at first.
    trials, tolerance
        How many trials to look at, and the largest error of an answer in them, in margin units; where too few qualify,
        the next best are taken.
    tests, settings, random_orders
        What to judge explanations by, some of `TESTS`; what is removed and put there by the removal curves, and how
        many random orders every method has to beat.
    steps
        Steps of the thesis's deletion score; as many as there are rows of pixels, as in the thesis, if None.
    on, retry_failed
        Where maps are made and judged, a row of `runner.EXECUTORS`: `serial`, `processes`, `processes=4`; and whether
        those are tried again that failed three times before. Processes need a script that starts its work under
        `if __name__ == "__main__":`, as all that starts processes does.

    Raises
    ------
    InputError
        If a number is out of range, a method is unknown, or two networks read one input.
    RecordingError
        If no trial has a frame near every safety margin that is looked at.
    PartError
        If part of a stage failed again and again, when all the rest of it is done.

    Examples
    --------
    >>> from sliplens import run_study, write_report
    >>> study = run_study("runs/mine/data", "chromatouch-pair", out="runs/mine/study", trials=5)  # doctest: +SKIP
    >>> study.faithfulness["pair"].scores[0].srg.estimate  # doctest: +SKIP
    0.031
    >>> page = write_report(study)  # doctest: +SKIP
    """
    if random_orders < 1:
        raise InputError(f"{random_orders} random orders are too few; --random-orders must be at least 1")
    if unknown := sorted(set(tests) - set(TESTS)):
        raise InputError(f"a study has no test named {unknown[0]!r}; choose from {', '.join(TESTS)}")
    require_executor(on)
    explainers = study_explainers(methods, budget=budget)
    data = data if isinstance(data, Dataset) else load_dataset(data)
    if (count := min(trials, len(data.select(split=split, condition=condition)))) < FEWEST_UNITS:
        these = f"{number_of(count, f'{split} trial')} of condition {condition}"
        cure = f"--trials is {trials}" if trials == count else "record more, or name another --split or --condition"
        note(on_progress, f"{these}: fewer than {FEWEST_UNITS} decide nothing, whatever the page then shows; {cure}")
    runs = load_networks(networks, device=device)
    scratch = ExitStack()
    stages = _Stages(
        folder=scratch.enter_context(scratch_folder()) if out is None else Path(out),
        data=data,
        networks=runs,
        explainers=explainers,
        seed=seed,
        overwrite=overwrite,
        on_progress=on_progress,
    )
    for name, run in runs.items():
        folder = stages.folder / f"evaluate-{name}"
        evaluation = evaluate(run, stages.data, folder, overwrite=overwrite, on_progress=on_progress)
        stages.found[name] = {"evaluate": evaluation}
    choice, states = stages.choose(split=split, condition=condition, trials=trials, tolerance=tolerance)
    asked = Asked(tests=tuple(test for test in TESTS if test in tests))
    save_record(asked, stages.folder / ASKED_FILE)
    judging = _Judging(
        folder=stages.folder,
        data=data,
        networks=runs,
        explainers=stages.explainers,
        settings=tuple(settings),
        random_orders=random_orders,
        steps=steps,
        seed=seed,
        redrawn="truth" in tests and stages.redrawn,
    )
    for name in runs:
        stages.judge(name, judging, on=on, tests=frozenset(tests), retry_failed=retry_failed)
    for name in runs if "timing" in tests else ():  # while nothing else runs
        stages.time(name, judging)
    tables: dict[str, Any] = {
        table: {name: own[stage] for name, own in stages.found.items() if stage in own}
        for stage, table in TABLES.items()
    }
    study = Study(folder=stages.folder, asked=asked, choice=choice, states=states, **tables)
    weakref.finalize(study, scratch.close)
    return study


def load_networks(networks: NetworkLike | Sequence[NetworkLike], *, device: str = "cpu") -> dict[str, Network]:
    """Networks of a study by the input that each reads, in one order whatever order they were named in."""
    several = [networks] if isinstance(networks, Network | Path | str) else networks
    runs = [open_run(network, device=device) for network in several]
    by_input = {run.encoding.name: run for run in runs}
    if twice := [name for name in by_input if sum(run.encoding.name == name for run in runs) > 1]:
        raise InputError(
            f"two networks read the input {twice[0]}, and a study takes one network an input; study them one by one"
        )
    return dict(sorted(by_input.items()))


_NEEDED_BY = {"score": {"score", "remedies"}, "control": {"faithfulness", "truth"}}
"""Tests that need a stage, where it is not that test alone."""


@dataclass(frozen=True, kw_only=True)
class _Judging:
    """Settings of all stages that judge explanations; pickled without what is open."""

    folder: Path
    data: Dataset
    networks: Mapping[str, Network]
    explainers: Mapping[str, Explainer]
    settings: tuple[Setting, ...]
    random_orders: int
    steps: int | None
    seed: int
    redrawn: bool
    """Whether frames are drawn anew, with markers put back."""
    _opened: dict[str, "_Network"] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_opened": {}}  # whoever gets it opens its own

    def open(self, network: str) -> "_Network":
        """What is known of a network; of one at a time."""
        if network not in self._opened:
            self._opened.clear()
            self._opened[network] = _Network(study=self, name=network)
        return self._opened[network]


@dataclass(frozen=True, kw_only=True)
class _StageWork(Work):
    """Work of one stage of a network, opened in whatever process."""

    judging: _Judging
    network: str
    stage: str

    @property
    def on_gpu(self) -> bool:
        return self.judging.networks[self.network].device.type != "cpu"

    def begin(self) -> MakePart:
        return self.judging.open(self.network).stage(self.stage).begin()


@dataclass(kw_only=True)
class _Network:
    """What the stages of a network are made of, read from the folder of the study when it is asked for."""

    study: _Judging
    name: str
    _ready: dict[str, Stage] = field(default_factory=dict)

    @property
    def run(self) -> Network:
        return self.study.networks[self.name]

    def result(self, stage: str) -> Any:
        """Result of a stage, of this network or of all."""
        folder = self.study.folder / f"{stage}-{self.name}"
        return load_result(folder if folder.is_dir() else self.study.folder / stage, _KINDS[stage], command=_COMMAND)

    @cached_property
    def material(self) -> Material:
        """Explanations of the frames that are scored."""
        explained = self.result("explain")
        scored = worth_scoring(self.result("choice").frames, explained)
        own: dict[str, Any] = {"markers": self.result("states").markers, "explainers": self.study.explainers}
        return gather(self.run, explained, self.study.data, scored, **own)

    @cached_property
    def influence(self) -> Mapping[str, Any]:
        """Maps to rank parts by, controls included."""
        return {**influences(self.material), **self.result("control").maps}

    def stage(self, name: str) -> Stage:
        """A stage, ready to be made anywhere; of one at a time."""
        if name not in self._ready:
            self._ready = {name: _WORKS[name][1](self)}
        return self._ready[name]

    def explaining(self) -> Explaining:
        """Explanations of all frames."""
        run, study, chosen = self.run, self.study, self.result("choice").frames
        frames = frames_at(run, study.data, [(frame.trial, frame.frame) for frame in chosen])
        images, find = run.encoding.normalise(frames.images), lambda: seen_places(run, chosen, markers)
        markers = self.result("states").markers
        return Explaining(trained=run, chosen=frames, explainers=with_markers(study.explainers, images, find))

    def deletion(self) -> Deletion:
        """Deletion as the thesis did it."""
        study = self.study
        return Deletion(trained=self.run, explained=self.material.explained, steps=study.steps, seed=study.seed)

    def removal(self) -> Removal:
        """Removal under every setting, and in simulation of markers that are put back."""
        study = self.study

        def put_back(part: Material, maps: Influence, seed: int, count: OnProgress) -> Mapping[str, Faithfulness]:
            own: dict[str, Any] = {"random_orders": study.random_orders, "seed": seed, "on_progress": count}
            return true_curves(self.run, part.explained, study.data, maps=maps, **own)

        return Removal(
            material=self.material,
            maps=self.influence,
            settings=study.settings,
            random_orders=study.random_orders,
            further={Setting(fill=TRUE_FILL, unit="marker"): put_back} if study.redrawn else {},
            seed=study.seed,
        )

    def by_truth(self) -> JudgingByTruth:
        """What putting markers back does, held against maps along the answer's change."""
        towards, raises_only = self.material.explained.towards[:, None, None], self.material.raises_only
        maps = {
            # its order is the published one, but where the answer fell what raises it opposes that
            name: towards * values if raises_only(name.removesuffix(NEW_WEIGHTS)) else values
            for name, values in self.influence.items()
        }
        return JudgingByTruth(
            trained=self.run,
            explained=self.material.explained,
            data=self.study.data,
            maps=maps,
            fills=tuple(dict.fromkeys(setting.fill for setting in SETTINGS)),
            seed=self.study.seed,
        )


_WORKS: dict[str, tuple[type[Stage], Callable[[_Network], Stage]]] = {
    "explain": (Explaining, _Network.explaining),
    "score": (Deletion, _Network.deletion),
    "remedies": (
        RemedialDeletion,
        lambda of: RemedialDeletion(material=of.material, grey=of.result("score"), seed=of.study.seed),
    ),
    "control": (Untrained, lambda of: Untrained(material=of.material, seed=of.study.seed)),
    "faithfulness": (Removal, _Network.removal),
    "randomisation": (Randomising, lambda of: Randomising(material=of.material, seed=of.study.seed)),
    "map-quality": (
        Measuring,
        lambda of: Measuring(material=of.material, data=of.study.data, seed=of.study.seed),
    ),
    "truth": (JudgingByTruth, _Network.by_truth),
}
"""Stages of a network in their order, and what makes each ready."""


@dataclass(kw_only=True)
class _Stages:
    """Runs the stages of a study that are not there yet."""

    folder: Path
    data: Dataset
    networks: Mapping[str, Network]
    explainers: Mapping[str, Explainer]
    seed: int
    overwrite: bool
    on_progress: OnProgress | None
    found: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Records by input and stage."""

    def choose(self, *, split: str, condition: str, trials: int, tolerance: float) -> tuple[Choice, States]:
        """Choose the frames, and keep what the camera saw of them."""
        wanted: dict[str, Any] = {"split": split, "condition": condition, "trials": trials, "tolerance": tolerance}
        weights = {name: run.manifest.weights_sha256 for name, run in self.networks.items()}
        config = {"data_hash": self.data.hash, "weights_sha256": weights, **wanted}
        choose = partial(choose_frames, self.networks, self.data, **wanted)
        choice = self._run("choice", "", config, "Choosing trials", lambda _, count: choose(on_progress=count))
        note(self.on_progress, choice.summary)
        show = partial(show_states, choice, self.data)
        states = self._run("states", "", self._frames, "Following markers", lambda _, count: show(on_progress=count))
        if unknown := [frame.id for frame in choice.frames if frame.id not in states.markers]:
            named, self.explainers = list(self.explainers), without_markers(self.explainers)
            if named != list(self.explainers):
                what = f"the markers of {number_of(len(unknown), 'frame')} are not known"
                note(self.on_progress, f"{what}, so that tiles are asked instead")
        return choice, states

    def judge(self, name: str, judging: _Judging, *, on: str, tests: frozenset[str], retry_failed: bool) -> None:
        """Explain the frames with one network's methods, and judge the explanations in every way but by the clock."""
        removal = {"random_orders": judging.random_orders, "areas": STUDY_AREAS, "settings": judging.settings}
        depends: dict[str, dict[str, Any]] = {
            # the report reads these of every score
            "score": {"input": name, "source": self.data.source, "fill": "grey"}
            | ({} if judging.steps is None else {"steps": judging.steps}),
            "remedies": {"steps": STEPS},
            "control": _CONTROLS,
            "faithfulness": removal | _CONTROLS | ({"further": TRUE_FILL} if judging.redrawn else {}),
            "randomisation": {"stages": CASCADE, "statistics": "images"},
            "truth": {"pairs": TRUTH_PAIRS, **_CONTROLS},
        }
        for test, (kind, _) in _WORKS.items():
            asked = test == "explain" or not _NEEDED_BY.get(test, {test}).isdisjoint(tests)
            if not asked or (test == "truth" and not judging.redrawn):
                continue

            def work(parts: Path, count: OnProgress, test: str = test) -> object:
                work = _StageWork(judging=judging, network=name, stage=test)
                stage = judging.open(name).stage(test)
                return stage.make(parts, work=work, on=on, retry_failed=retry_failed, on_progress=count)

            about = self._about(name) | ({} if test == "explain" else _SCORED)
            config, title = about | depends.get(test, {}), f"{kind.title} ({name})"
            self.found[name][test] = self._run(test, name, config, title, work)
            if test == "explain" and tests:
                chosen = [frame for frame in self._choice.frames if frame.scored]
                if left := len(chosen) - len(worth_scoring(chosen, self.found[name][test])):
                    note(self.on_progress, tell_left_out(left, len(chosen), name))

    def time(self, name: str, judging: _Judging) -> None:
        """Time one network's methods."""

        def work(_: Path, count: OnProgress) -> object:
            return time_explainers(judging.open(name).material, on_progress=count)

        title = f"Timing the methods ({name})"
        self.found[name]["timing"] = self._run("timing", name, self._about(name) | _SCORED, title, work)

    @cached_property
    def _choice(self) -> Choice:
        return load_result(self.folder / "choice", Choice, command=_COMMAND)

    @property
    def _frames(self) -> dict[str, Any]:
        return {"data_hash": self.data.hash, "choice": hash_json(self._choice)}

    def _about(self, name: str) -> dict[str, Any]:
        weights = self.networks[name].manifest.weights_sha256
        methods = method_options(self.explainers)
        return {**self._frames, "methods": methods, "seed": self.seed, "weights_sha256": weights}

    @property
    def redrawn(self) -> bool:
        """Whether the chosen frames can be drawn anew with markers put back; a recording never can."""
        if not self.data.simulated:
            return False
        info = next(info for info in self.data.trials if info.trial == self._choice.frames[0].trial)
        try:
            rebuild_trial(self.data.folder, self.data.load(info))
        except InputError as error:
            note(self.on_progress, f"the truth is left out, since {error}")
            return False
        return True

    def _run(self, name: str, network: str, config: Mapping[str, Any], title: str, work: _Work) -> Any:
        """Make a stage, of an input where there is one, that is not there yet, or read it."""
        target, what = self.folder / "-".join(filter(None, (name, network))), title[0].lower() + title[1:]
        with output_folder(target, stage=name, config=config, overwrite=self.overwrite) as out:
            if out.complete:
                wrote(self.on_progress, target, what, kept=True)
                return load_result(target, _KINDS[name], command=_COMMAND)
            with stage(self.on_progress, title) as count:
                result = work(out.folder / "parts", count)
            save_result(result, out.folder)
            remove(out.folder / "parts")  # not before: what fails above goes on from them
        # as it was kept, whose layout in memory may differ: what follows has the same bytes when it goes on from here
        result = load_result(target, _KINDS[name], command=_COMMAND)
        for alarm in getattr(result, "alarms", ()):
            note(self.on_progress, f"{target.name}: {alarm}")
        wrote(self.on_progress, target, what)
        return result
