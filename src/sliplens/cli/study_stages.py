"""The stages of a study, each a folder that is complete or absent."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from sliplens.cli.screen import Count, Screen, Terminal
from sliplens.errors import InputError
from sliplens.explainers import Explainer, IntegratedGradients
from sliplens.faithfulness.removal import Faithfulness
from sliplens.files import hash_json, output_folder, read_json
from sliplens.models import TrainedModel
from sliplens.recordings import Dataset
from sliplens.simulation.intervention import rebuild_trial
from sliplens.study.choice import Choice, choose_frames, load_choice, save_choice
from sliplens.study.curves import (
    RANDOMISED,
    SETTINGS,
    STUDY_AREAS,
    Influence,
    Scoring,
    Setting,
    influences,
    score_curves,
)
from sliplens.study.explaining import RESULT_FILE, explain_frames, frames_at, load_explained
from sliplens.study.map_quality import check_looks
from sliplens.study.material import Material, gather
from sliplens.study.randomisation import STAGES, check_randomisation, explain_untrained, load_untrained
from sliplens.study.scoring import STEPS, load_curves, score_explanations, score_remedies
from sliplens.study.states import load_markers, save_states
from sliplens.study.timing import time_explainers
from sliplens.study.truth import judge_by_truth, true_curves

_CONTROL = IntegratedGradients(steps=32, max_steps=32)
"""Of the network with new weights: a control need not be complete."""
_NEW_WEIGHTS = {"control": _CONTROL, "statistics": "images"}
"""What the control depends on, and with it all that it is compared with."""

Work = Callable[[Path, Count], object]


@dataclass(kw_only=True)
class Stages:
    """Runs the stages of a study that are not there yet."""

    output: Path
    data: Dataset
    networks: Mapping[str, TrainedModel]
    explainers: Mapping[str, Explainer]
    settings: Mapping[str, Any]
    """What the maps depend on, beside the network and the frames."""
    random_orders: int
    seed: int
    overwrite: bool
    screen: Screen = field(default_factory=Terminal)

    def choose(self, *, split: str, condition: str, trials: int, tolerance: float) -> None:
        """Choose the frames, and keep what the camera saw of them."""
        config = {
            "data_hash": self.data.hash,
            "weights_sha256": {name: one.manifest.weights_sha256 for name, one in self.networks.items()},
            "split": split,
            "condition": condition,
            "trials": trials,
            "tolerance": tolerance,
        }

        def choose(folder: Path, bar: Count) -> None:
            found = choose_frames(
                self.networks,
                self.data,
                split=split,
                condition=condition,
                trials=trials,
                tolerance=tolerance,
                on_trial=bar,
            )
            save_choice(found, folder)

        self._run("choice", "choice", config, "Choosing trials", choose)
        self.screen.say(f"  {self.choice.told}")
        self._run(
            "states",
            "states",
            self._frames(),
            "Following markers",
            lambda folder, bar: save_states(self.choice, self.data, folder, on_frame=bar),
        )

    @cached_property
    def choice(self) -> Choice:
        """What `choose` chose."""
        return load_choice(self.output / "choice")

    def judge(self, name: str) -> None:
        """Explain the frames with one network's methods, and judge the explanations in every way but by the clock."""
        trained, about = self.networks[name], self._about(name)
        rows: dict[str, list[int]] = {}
        for pick in self.choice.frames:
            rows.setdefault(pick.trial, []).append(pick.frame)
        self._run(
            f"explain-{name}",
            "explain",
            about,
            f"Explaining {len(self.choice.frames)} frames ({name})",
            lambda folder, bar: explain_frames(
                trained,
                frames_at(trained, self.data, rows),
                folder,
                methods=list(self.explainers),
                explainers=self.explainers,
                on_map=bar,
            ),
        )
        # gathered where a stage is missing: that takes longer than to see that all are there
        material = cache(lambda: self._material(name))
        control = self.output / f"control-{name}"
        influence = cache(lambda: {**influences(material()), RANDOMISED: load_untrained(control)})
        works: dict[str, tuple[str, Mapping[str, Any], Work]] = {
            "score": (
                "Deleting pixels, as the thesis did",
                # the report reads these of every score
                {"input": name, "source": self.data.source, "fill": "grey"},
                lambda folder, bar: score_explanations(
                    trained, material().explained, folder, seed=self.seed, on_curve=bar
                ),
            ),
            "remedies": (
                "Trying the thesis's remedies",
                {"steps": STEPS},
                lambda folder, bar: score_remedies(
                    material(),
                    folder,
                    grey=load_curves(self.output / f"score-{name}", material().explained),
                    seed=self.seed,
                    on_curve=bar,
                ),
            ),
            "control": (
                "Explaining the network with new weights",
                _NEW_WEIGHTS,
                lambda folder, bar: explain_untrained(material(), _CONTROL, folder, seed=self.seed, on_frame=bar),
            ),
            "faithfulness": (
                "Removing parts under every fill",
                {"random_orders": self.random_orders, "areas": STUDY_AREAS, "settings": SETTINGS, **_NEW_WEIGHTS},
                lambda folder, bar: score_curves(
                    material(),
                    folder,
                    maps=influence(),
                    random_orders=self.random_orders,
                    further=self._true_curves(material(), influence()),
                    seed=self.seed,
                    on_frame=bar,
                ),
            ),
            "randomisation": (
                "Drawing weights anew, layer by layer",
                {"stages": STAGES, "statistics": "images"},
                lambda folder, bar: check_randomisation(material(), folder, seed=self.seed, on_method=bar),
            ),
            "map-quality": (
                "Measuring how maps look",
                {},
                lambda folder, bar: check_looks(material(), self.data, folder, seed=self.seed, on_method=bar),
            ),
        }
        if self._redrawn:
            works["truth"] = (
                "Putting every marker back",
                _NEW_WEIGHTS,
                lambda folder, bar: judge_by_truth(
                    trained,
                    material().explained,
                    self.data,
                    folder,
                    maps=influence(),
                    fills=list(dict.fromkeys(setting.fill for setting in SETTINGS)),
                    seed=self.seed,
                    on_frame=bar,
                ),
            )
        for stage, (title, more, work) in works.items():
            self._run(f"{stage}-{name}", stage, {**about, **more}, f"{title} ({name})", work)

    def time(self, name: str) -> None:
        """Time one network's methods; to be done while nothing else runs."""
        self._run(
            f"timing-{name}",
            "timing",
            self._about(name),
            f"Timing the methods ({name})",
            lambda folder, bar: time_explainers(self._material(name), folder, on_method=bar),
        )

    def _about(self, name: str) -> dict[str, Any]:
        weights = self.networks[name].manifest.weights_sha256
        return {**self._frames(), **self.settings, "weights_sha256": weights}

    def _material(self, name: str) -> Material:
        return gather(
            self.networks[name],
            load_explained(self.output / f"explain-{name}"),
            self.data,
            tuple(pick for pick in self.choice.frames if pick.scored),
            markers=load_markers(self.output / "states"),
            explainers=self.explainers,
        )

    def _true_curves(self, material: Material, maps: Influence) -> dict[Setting, Scoring]:
        if not self._redrawn:
            return {}

        def put_back(report: Count) -> Mapping[str, Faithfulness]:
            return true_curves(
                material.trained,
                material.explained,
                self.data,
                maps=maps,
                random_orders=self.random_orders,
                seed=self.seed,
                on_frame=report,
            )

        return {Setting(fill="true", unit="marker"): put_back}

    @cached_property
    def _redrawn(self) -> bool:
        """Whether the chosen frames can be drawn anew with markers put back; a recording never can."""
        if not self.data.simulated:
            return False
        info = next(info for info in self.data.trials if info.trial == self.choice.frames[0].trial)
        try:
            rebuild_trial(self.data.folder, self.data.load(info))
        except InputError as error:
            self.screen.say(f"  note: the truth is left out, since {error}")
            return False
        return True

    def _frames(self) -> dict[str, Any]:
        return {"data_hash": self.data.hash, "choice": hash_json(self.choice)}

    def _run(self, name: str, stage: str, config: Mapping[str, Any], title: str, work: Work) -> None:
        target = self.output / name
        with output_folder(target, stage=stage, config=config, overwrite=self.overwrite) as out:
            if out.complete:
                self.screen.unchanged(target)
                return
            with self.screen.progress_bar(title) as bar:
                work(out.folder, bar)
        for alarm in read_json(target / RESULT_FILE).get("alarms", []):
            self.screen.say(f"  alarm: {alarm}")
        self.screen.wrote(target, title[0].lower() + title[1:])
