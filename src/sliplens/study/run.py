"""A whole study: frames chosen, explained, and their explanations tested in every way that is known."""

import pickle
import shutil
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import torch

from sliplens.codec import load_result, save_result, to_builtins
from sliplens.errors import InputError
from sliplens.explainers import Explainer, IntegratedGradients
from sliplens.faithfulness.removal import RANDOM_ORDERS, Faithfulness
from sliplens.files import hash_json, output_folder
from sliplens.models import Run
from sliplens.models.checkpoint import load
from sliplens.progress import OnProgress, note, stage, wrote
from sliplens.recordings import Dataset, load_dataset
from sliplens.results.explanation import Explained
from sliplens.results.faithfulness import DeletionScores, Remedies, RemovalScores
from sliplens.results.study import (
    Choice,
    MapQuality,
    Randomisation,
    States,
    Study,
    Timing,
    Truth,
    UntrainedMaps,
)
from sliplens.simulation.intervention import rebuild_trial
from sliplens.study.choice import choose_frames
from sliplens.study.curves import RANDOMISED, SETTINGS, STUDY_AREAS, Influence, Setting, influences, score_removal
from sliplens.study.explaining import explain_frames, frames_at
from sliplens.study.map_quality import measure_maps
from sliplens.study.material import STUDY_BUDGET, STUDY_METHODS, Material, gather, method_options, study_explainers
from sliplens.study.processes import run_together
from sliplens.study.randomisation import STAGES, explain_untrained, randomise_weights
from sliplens.study.scoring import STEPS, score_explanations, score_remedies
from sliplens.study.states import show_states
from sliplens.study.timing import time_explainers
from sliplens.study.truth import TRUE_FILL, judge_by_truth, true_curves
from sliplens.training.evaluation import evaluate

_COMMAND = "sliplens study"
Network: TypeAlias = Run | Path | str
_Result = TypeVar("_Result")
_Work: TypeAlias = Callable[[Path, OnProgress], _Result]
"""Takes a folder for parts, and what is called with the steps done and their number."""

_CONTROL = IntegratedGradients(steps=32, max_steps=32)
"""Explains the network with new weights: a control need not be complete."""
_NEW_WEIGHTS = {"control": to_builtins(_CONTROL), "statistics": "images"}
"""What the control depends on, and with it all that it is compared with."""


TESTS = ("score", "remedies", "faithfulness", "randomisation", "map-quality", "truth", "timing")
"""Stages that a study may leave out: the thesis's score and its remedies, removal curves, weights drawn anew, ..."""


def run_study(
    data: Dataset | Path | str,
    *,
    difference: Network | None = "chromatouch-difference",
    raw: Network | None = "chromatouch-raw",
    out: Path | str | None = None,
    methods: Sequence[str] = STUDY_METHODS,
    split: str = "test",
    condition: str = "dry",
    trials: int = 14,
    tolerance: float = 0.03,
    budget: float = STUDY_BUDGET,
    tests: Collection[str] = TESTS,
    settings: Sequence[Setting] = SETTINGS,
    random_orders: int = RANDOM_ORDERS,
    device: str = "cpu",
    jobs: int = 1,
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
    difference, raw
        Networks on difference and on raw images, each as it was loaded, as its folder, or as the name of one that comes
        with sliplens; None to leave it out.
    out
        Folder of the study, a subfolder a stage; a temporary one that lives as long as the result if None.
    methods
        Explainers to compare (`study_explainers`).
    trials
        How many trials to look at.
    tolerance
        Largest error of an answer in them, in margin units; where too few qualify, the next best are taken.
    tests, settings
        What to judge explanations by, some of `TESTS`, and what is removed and put there by the removal curves.
    budget
        Share of the channels that Poly-CAM measures at first, 1 for all.
    random_orders
        Random orders that every method has to beat.
    device
        Where networks that are loaded here run: cpu, cuda or cuda:1.
    jobs
        Networks to judge at the same time, each by a process with its share of the cores. More than one needs a script
        that starts its work under `if __name__ == "__main__":`, as all that starts processes does.

    Raises
    ------
    InputError
        If a number is out of range, a method is unknown, or a network was trained on other images.
    RecordingError
        If no trial has a frame near every safety margin that is looked at.

    Examples
    --------
    >>> from sliplens import run_study, write_report
    >>> study = run_study("runs/mine/data", out="runs/mine/study", trials=5)  # doctest: +SKIP
    >>> study.faithfulness["raw"].scores[0].srg.estimate  # doctest: +SKIP
    0.031
    >>> page = write_report(study)  # doctest: +SKIP
    """
    if random_orders < 1:
        raise InputError(f"{random_orders} random orders are too few; --random-orders must be at least 1")
    if unknown := sorted(set(tests) - set(TESTS)):
        raise InputError(f"a study has no test named {unknown[0]!r}; choose from {', '.join(TESTS)}")
    if jobs < 1:
        raise InputError(f"--jobs must be at least 1, got {jobs}")
    explainers = study_explainers(methods, budget=budget)
    given = {name: network for name, network in (("difference", difference), ("raw", raw)) if network is not None}
    if not given:
        raise InputError("a study needs a network; leave out --difference none or --raw none")
    networks = {name: load_network(network, name, device=device) for name, network in given.items()}
    scratch = None if out is not None else tempfile.TemporaryDirectory(prefix="sliplens-study-")
    stages = _Stages(
        folder=Path(out if scratch is None else scratch.name),  # pyright: ignore[reportArgumentType] (one is given)
        data=data if isinstance(data, Dataset) else load_dataset(data),
        networks=networks,
        explainers=explainers,
        tests=frozenset(tests),
        settings=tuple(settings),
        random_orders=random_orders,
        seed=seed,
        overwrite=overwrite,
        on_progress=on_progress,
    )
    evaluations = {
        name: evaluate(
            run, stages.data, stages.folder / f"evaluate-{name}", overwrite=overwrite, on_progress=on_progress
        )
        for name, run in networks.items()
    }
    choice, states = stages.choose(split=split, condition=condition, trials=trials, tolerance=tolerance)
    cores = torch.get_num_threads()
    if min(jobs, len(networks), cores) > 1:
        # they leave their stages in folders, and what is here reads them
        work = pickle.dumps(replace(stages, on_progress=None))
        run_together(partial(_judge, work), list(networks), threads=cores // len(networks), on_progress=on_progress)
        judged = {name: replace(stages, overwrite=False, on_progress=None).judge(name) for name in networks}
    else:
        judged = {name: stages.judge(name) for name in networks}
    return Study(
        folder=stages.folder,
        scratch=scratch,
        evaluations=evaluations,
        choice=choice,
        states=states,
        explanations={name: own.explained for name, own in judged.items()},
        deletion={name: own.deletion for name, own in judged.items() if own.deletion is not None},
        remedies={name: own.remedies for name, own in judged.items() if own.remedies is not None},
        faithfulness={name: own.faithfulness for name, own in judged.items() if own.faithfulness is not None},
        randomisation={name: own.randomisation for name, own in judged.items() if own.randomisation is not None},
        map_quality={name: own.map_quality for name, own in judged.items() if own.map_quality is not None},
        truth={name: own.truth for name, own in judged.items() if own.truth is not None},
        # while nothing else runs
        timing={name: stages.time(name, own.explained) for name, own in judged.items() if "timing" in tests},
    )


def load_network(network: Network, name: str, *, device: str = "cpu") -> Run:
    """Network of a study by what it reads."""
    run = network if isinstance(network, Run) else load(str(network), device=device)
    if run.manifest.input != name:
        raise InputError(
            f"--{name} names a network on {run.manifest.input} images; give one that was trained on {name}"
        )
    return run


@dataclass(frozen=True, kw_only=True)
class _Judged:
    """What is known of the explanations of one network."""

    explained: Explained
    deletion: DeletionScores | None
    remedies: Remedies | None
    faithfulness: RemovalScores | None
    randomisation: Randomisation | None
    map_quality: MapQuality | None
    truth: Truth | None


_NEEDED_BY = {"score": {"score", "remedies"}, "control": {"faithfulness", "truth"}}
"""Tests that need a stage, where it is not that test alone."""


def _required(result: _Result | None) -> _Result:
    assert result is not None  # whatever needs it has it run (`_NEEDED_BY`)
    return result


def _judge(stages: bytes, name: str, on_progress: OnProgress) -> None:
    replace(pickle.loads(stages), on_progress=on_progress).judge(name)  # noqa: S301 (our own, of the process before)


@dataclass(kw_only=True)
class _Stages:
    """Runs the stages of a study that are not there yet."""

    folder: Path
    data: Dataset
    networks: Mapping[str, Run]
    explainers: Mapping[str, Explainer]
    tests: frozenset[str]
    settings: tuple[Setting, ...]
    random_orders: int
    seed: int
    overwrite: bool
    on_progress: OnProgress | None

    def choose(self, *, split: str, condition: str, trials: int, tolerance: float) -> tuple[Choice, States]:
        """Choose the frames, and keep what the camera saw of them."""
        settings: dict[str, Any] = {
            "split": split,
            "condition": condition,
            "trials": trials,
            "tolerance": tolerance,
        }
        weights = {name: run.manifest.weights_sha256 for name, run in self.networks.items()}
        choice = self._run(
            "choice",
            Choice,
            {"data_hash": self.data.hash, "weights_sha256": weights, **settings},
            "Choosing trials",
            lambda _, count: choose_frames(self.networks, self.data, on_progress=count, **settings),
        )
        note(self.on_progress, choice.summary)
        states = self._run(
            "states",
            States,
            self._frames,
            "Following markers",
            lambda _, count: show_states(choice, self.data, on_progress=count),
        )
        return choice, states

    def judge(self, name: str) -> _Judged:
        """Explain the frames with one network's methods, and judge the explanations in every way but by the clock."""
        run, about = self.networks[name], self._about(name)
        rows: dict[str, list[int]] = {}
        for frame in self._choice.frames:
            rows.setdefault(frame.trial, []).append(frame.frame)
        explained = self._run(
            f"explain-{name}",
            Explained,
            about,
            f"Explaining {len(self._choice.frames)} frames ({name})",
            lambda parts, count: explain_frames(
                run,
                frames_at(run, self.data, rows),
                methods=list(self.explainers),
                explainers=self.explainers,
                parts=parts,
                on_progress=count,
            ),
        )
        # gathered where a stage is missing: that takes longer than to see that all are there
        material = cache(lambda: self._gather(name, explained))

        def test(
            stage: str, kind: type[_Result], depends: Mapping[str, Any], title: str, work: _Work[_Result]
        ) -> _Result | None:
            if _NEEDED_BY.get(stage, {stage}).isdisjoint(self.tests):
                return None
            return self._run(f"{stage}-{name}", kind, {**about, **depends}, f"{title} ({name})", work)

        deletion = test(
            "score",
            DeletionScores,
            # the report reads these of every score
            {"input": name, "source": self.data.source, "fill": "grey"},
            "Deleting pixels, as the thesis did",
            lambda _, count: score_explanations(run, material().explained, seed=self.seed, on_progress=count),
        )
        remedies = test(
            "remedies",
            Remedies,
            {"steps": STEPS},
            "Trying the thesis's remedies",
            lambda _, count: score_remedies(material(), grey=_required(deletion), seed=self.seed, on_progress=count),
        )
        control = test(
            "control",
            UntrainedMaps,
            _NEW_WEIGHTS,
            "Explaining the network with new weights",
            lambda _, count: explain_untrained(material(), _CONTROL, seed=self.seed, on_progress=count),
        )
        influence = cache(lambda: {**influences(material()), RANDOMISED: _required(control).maps})
        faithfulness = test(
            "faithfulness",
            RemovalScores,
            {"random_orders": self.random_orders, "areas": STUDY_AREAS, "settings": self.settings, **_NEW_WEIGHTS},
            "Removing parts under every fill",
            lambda parts, count: self._score_removal(material(), influence(), parts, count),
        )
        randomisation = test(
            "randomisation",
            Randomisation,
            {"stages": STAGES, "statistics": "images"},
            "Drawing weights anew, layer by layer",
            lambda _, count: randomise_weights(material(), seed=self.seed, on_progress=count),
        )
        map_quality = test(
            "map-quality",
            MapQuality,
            {},
            "Measuring how maps look",
            lambda _, count: measure_maps(material(), self.data, seed=self.seed, on_progress=count),
        )
        truth = None
        if "truth" in self.tests and self._redrawn:
            truth = test(
                "truth",
                Truth,
                _NEW_WEIGHTS,
                "Putting every marker back",
                lambda parts, count: judge_by_truth(
                    run,
                    material().explained,
                    self.data,
                    maps=influence(),
                    fills=list(dict.fromkeys(setting.fill for setting in SETTINGS)),
                    seed=self.seed,
                    parts=parts,
                    on_progress=count,
                ),
            )
        return _Judged(
            explained=explained,
            deletion=deletion,
            remedies=remedies,
            faithfulness=faithfulness,
            randomisation=randomisation,
            map_quality=map_quality,
            truth=truth,
        )

    def time(self, name: str, explained: Explained) -> Timing:
        """Time one network's methods."""
        return self._run(
            f"timing-{name}",
            Timing,
            self._about(name),
            f"Timing the methods ({name})",
            lambda _, count: time_explainers(self._gather(name, explained), on_progress=count),
        )

    @cached_property
    def _choice(self) -> Choice:
        return load_result(self.folder / "choice", Choice, command=_COMMAND)

    @property
    def _frames(self) -> dict[str, Any]:
        return {"data_hash": self.data.hash, "choice": hash_json(to_builtins(self._choice))}

    def _about(self, name: str) -> dict[str, Any]:
        weights = self.networks[name].manifest.weights_sha256
        methods = method_options(self.explainers)
        return {**self._frames, "methods": methods, "seed": self.seed, "weights_sha256": weights}

    def _gather(self, name: str, explained: Explained) -> Material:
        return gather(
            self.networks[name],
            explained,
            self.data,
            tuple(frame for frame in self._choice.frames if frame.scored),
            markers=load_result(self.folder / "states", States, command=_COMMAND).markers,
            explainers=self.explainers,
        )

    def _score_removal(self, material: Material, maps: Influence, parts: Path, count: OnProgress) -> RemovalScores:
        def put_back(on_frames: OnProgress | None) -> Mapping[str, Faithfulness]:
            return true_curves(
                material.trained,
                material.explained,
                self.data,
                maps=maps,
                random_orders=self.random_orders,
                seed=self.seed,
                on_progress=on_frames,
            )

        redrawn = "truth" in self.tests and self._redrawn
        return score_removal(
            material,
            maps=maps,
            settings=self.settings,
            random_orders=self.random_orders,
            further={Setting(fill=TRUE_FILL, unit="marker"): put_back} if redrawn else None,
            seed=self.seed,
            parts=parts,
            on_progress=count,
        )

    @cached_property
    def _redrawn(self) -> bool:
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

    def _run(
        self, name: str, kind: type[_Result], config: Mapping[str, Any], title: str, work: _Work[_Result]
    ) -> _Result:
        """Make a stage that is not there yet, or read it."""
        target, what = self.folder / name, title[0].lower() + title[1:]
        with output_folder(target, stage=_stage(name), config=config, overwrite=self.overwrite) as out:
            if out.complete:
                wrote(self.on_progress, target, what, kept=True)
                return load_result(target, kind, command=_COMMAND)
            with stage(self.on_progress, title) as count:
                result = work(out.folder / "parts", count)
            shutil.rmtree(out.folder / "parts", ignore_errors=True)
            save_result(result, out.folder)
        for alarm in getattr(result, "alarms", ()):
            note(self.on_progress, f"{name}: {alarm}")
        wrote(self.on_progress, target, what)
        return result


def _stage(name: str) -> str:
    """Stage of a folder: its name without the input."""
    return name.removesuffix("-difference").removesuffix("-raw")
