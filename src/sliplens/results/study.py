"""Stages of a study: what was chosen, what the camera saw, how the explanations were tested; results of a workspace."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Float64, Int64, Shaped

from sliplens.codec import UNKNOWN, Columns, Result, load_record, load_result, table_rows
from sliplens.errors import InputError
from sliplens.files import RUN_FILE, Provenance, require_folder
from sliplens.intervals import Difference
from sliplens.progress import number_of
from sliplens.results.evaluation import AMOUNT, ANSWER, CORRELATION, MARGIN, PIXEL, Evaluation, OfNetwork, Training
from sliplens.results.explanation import BASELINES, Explanation, Strip
from sliplens.results.faithfulness import DeletionScores, Faithfulness, FrameRows, Lead, MethodGap

CLOSE_TO_LABELS = 0.05
"""Largest error of a trial that is taken where too few qualify, in margin units; five such are needed for a verdict."""


@dataclass(frozen=True, kw_only=True)
class ChosenTrial:
    """Trial of a study: whether every answer lay within the tolerance, and each network's worst error."""

    trial: str
    qualified: bool
    worst_error: dict[str, float]
    """Largest error over the chosen frames in margin units, by input."""

    @property
    def worst(self) -> float:
        """Largest error of any network."""
        return max(self.worst_error.values())


@dataclass(frozen=True, kw_only=True)
class ChosenFrame:
    """Frame of a study and what it is for; the level is the margin that was looked for."""

    id: str
    trial: str
    frame: Annotated[int, AMOUNT]
    level: Annotated[float, MARGIN]
    safety_margin: Annotated[float, MARGIN]
    scored: bool
    """True where it counts in the scores."""
    pictured: bool
    """True where the panels show it."""
    day: int = 1


@dataclass(frozen=True, kw_only=True)
class Choice(Result):
    """Trials and frames of a study, and how they came to be chosen."""

    trials_wanted: int
    tolerance: float
    """Largest error of an answer in margin units, within which a trial qualifies."""
    considered: int
    """Trials that have a frame near every level."""
    qualified: int
    """Trials that qualify with every network."""
    mean_error: dict[str, float]
    """Mean error of the answers on the scored frames, in margin units, by input."""
    source: str
    split: str = "test"
    condition: str
    trials: tuple[ChosenTrial, ...]
    frames: tuple[ChosenFrame, ...]

    @property
    def sound(self) -> bool:
        """True where every trial that was taken qualifies; otherwise errors are explained too."""
        return all(trial.qualified for trial in self.trials)

    @property
    def summary(self) -> str:
        """How the trials were chosen, and how wrong the explained predictions are, in a few sentences."""
        worst = 100 * max(trial.worst for trial in self.trials)
        errors = " and ".join(f"{100 * error:.0f} points ({name} images)" for name, error in self.mean_error.items())
        return (
            f"{number_of(self.considered, f'{self.condition} {self.split} trial')} have a frame near every level; of "
            f"{self.qualified} every network predicts all such frames within {100 * self.tolerance:g} points. "
            f"{len(self.trials)} of {self.trials_wanted} wanted were taken: {self.close} are predicted within "
            f"{100 * max(self.tolerance, CLOSE_TO_LABELS):g} points, the worst prediction is off by {worst:.0f}. "
            f"Predictions on the frames to score are off by {errors} on average."
        )

    @property
    def close(self) -> int:
        """Trials that were taken and are predicted within `CLOSE_TO_LABELS`, or within the tolerance."""
        return sum(trial.worst <= max(self.tolerance, CLOSE_TO_LABELS) for trial in self.trials)


@dataclass(frozen=True, kw_only=True)
class MarkerTable(Columns):
    """Markers of each frame in camera pixels: at rest, and now (NaN where one was not followed)."""

    frame_id: Shaped[np.ndarray, " rows"]
    marker: Annotated[Int64[np.ndarray, " rows"], AMOUNT]
    rest_x_px: Annotated[Float64[np.ndarray, " rows"], PIXEL]
    rest_y_px: Annotated[Float64[np.ndarray, " rows"], PIXEL]
    x_px: Annotated[Float64[np.ndarray, " rows"], PIXEL, UNKNOWN]
    y_px: Annotated[Float64[np.ndarray, " rows"], PIXEL, UNKNOWN]


@dataclass(frozen=True, kw_only=True)
class States(Result):
    """Markers of all chosen frames."""

    untracked: tuple[str, ...]
    """Trials in which the markers could not be followed, and why."""
    table: MarkerTable
    """Markers of every chosen frame in which they are known."""

    @cached_property
    def markers(self) -> dict[str, MarkerTable]:
        """Markers by frame, in the order of their numbers; frames in which none could be followed are absent."""
        rows = self.table.where(np.argsort(self.table.marker, kind="stable"))
        return {frame: markers for (frame,), markers in rows.groups("frame_id").items()}


@dataclass(frozen=True, kw_only=True)
class UntrainedMaps(OfNetwork):
    """Maps of networks whose weights were drawn again: controls that every map has to beat."""

    maps: dict[str, Annotated[Float32[np.ndarray, "frames size size"], ANSWER]]
    """Maps that the methods rank by, towards the targets of those networks, by method with `NEW_WEIGHTS`. Poly-CAM has
    5 % of its channels here and no likeness, Shapley values 100 pairs."""


@dataclass(frozen=True, kw_only=True)
class MapMeasures:
    """Properties of a method's maps beside their scores, as means over frames; None where undefined or not measured."""

    resolution: float | None
    total_variation: float | None
    infidelity: Annotated[float, ANSWER] | None = None
    """Error of the changes that maps of a few frames predict, in margin units (`controls.infidelity`)."""
    max_sensitivity: float | None = None
    """Largest change of the same maps under small noise, as a ratio (`controls.max_sensitivity`)."""


@dataclass(frozen=True, kw_only=True)
class MapQuality(OfNetwork):
    """Looks of maps by method."""

    frames: int
    methods: dict[str, MapMeasures]
    comparisons: tuple[MethodGap, ...] = ()
    """Of the total variation."""


@dataclass(frozen=True, kw_only=True)
class Localisation:
    """How far a method's maps agree with what markers do to the prediction."""

    neutral: Difference | None
    """Mean correlation (Pearson, signed) of the map's sums over groups of markers with the change of the prediction as
    the group is moved to another margin of the trial: the main judge. The fields beside it are other truths."""
    stick: Difference | None
    shapley: Difference | None
    """Mean rank correlation, signed, of the map's means over the markers with the columns of `MarkerEffects`."""
    lead_over_controls: Lead | None
    """Of `neutral`; None for what is no method, or where it is undefined."""
    edges: Difference | None
    """Mass on the edges of markers less the share of the image that they cover."""


@dataclass(frozen=True, kw_only=True)
class MetaTest:
    """How much larger the gain under one fill is for a perfect map than for a damaged one, over frames."""

    fill: str
    oracle: float
    degraded: float
    changed: float
    """Gain of |x - b|, how much each marker's pixels changed, which uses no network."""
    gap: Difference | None
    """Gain of the perfect map less that of the damaged one."""

    @property
    def holds(self) -> bool:
        """True where `gap` is above zero for sure, as few trials cannot show; else the gain cannot judge maps."""
        return self.gap is not None and self.gap.above_zero


@dataclass(frozen=True, kw_only=True)
class MarkerEffects(FrameRows):
    """Effect of each marker on the network's prediction, a row a marker and frame."""

    safety_margin: Annotated[Float64[np.ndarray, " rows"], MARGIN, UNKNOWN]
    marker: Annotated[Int64[np.ndarray, " rows"], AMOUNT]
    x_px: Annotated[Float64[np.ndarray, " rows"], PIXEL]
    y_px: Annotated[Float64[np.ndarray, " rows"], PIXEL]
    """Place in pixels of the network's input."""
    shapley: Annotated[Float64[np.ndarray, " rows"], ANSWER]
    shapley_error: Annotated[Float64[np.ndarray, " rows"], AMOUNT, UNKNOWN]
    """Shapley value in the prediction, over scenes with other markers put back to rest, and its standard error."""
    stick: Annotated[Float64[np.ndarray, " rows"], ANSWER, UNKNOWN]
    """Shapley value with markers put back to their places in the stick frame that is the baseline of the explanation;
    NaN where that is the untouched sensor."""
    state: Int64[np.ndarray, " rows"]
    """Slips (1), sticks (2), or lies outside of the contact (0)."""


@dataclass(frozen=True, kw_only=True)
class NeutralScores(FrameRows):
    """Correlation of each map with the effects of moved groups of markers, a row a frame and method."""

    method: Shaped[np.ndarray, " rows"]
    correlation: Annotated[Float64[np.ndarray, " rows"], CORRELATION, UNKNOWN]
    """NaN where the effects do not vary."""


@dataclass(frozen=True, kw_only=True)
class Truth(OfNetwork):
    """Comparison of explanations with the effects of markers, known in simulation."""

    frames: int
    methods: dict[str, Localisation]
    pairs: int
    """Pairs of scenes drawn for the Shapley values of each frame."""
    meta: tuple[MetaTest, ...]
    effects: MarkerEffects
    neutral: NeutralScores

    @property
    def summary(self) -> str:
        """How many frames and scenes were drawn."""
        return f"{number_of(self.frames, 'frame')}, {self.pairs} pairs of scenes each"


RECORDS: dict[str, type] = {
    "choice": Choice,
    "states": States,
    "strip": Strip,
    "explain": Explanation,
    "score": DeletionScores,
    "control": UntrainedMaps,
    "faithfulness": Faithfulness,
    "map-quality": MapQuality,
    "truth": Truth,
}
"""Record of each step of a study."""
TABLES = {
    "evaluate": "evaluations",
    "explain": "explanations",
    "score": "deletion",
    "faithfulness": "faithfulness",
    "map-quality": "map_quality",
    "truth": "truth",
}
"""Field of `Study` with the records of each step, one a network."""
CONFIG_FILE = "study.json"
"""File of a study's folder that holds its `StudyConfig`."""
TESTS = ("score", "faithfulness", "map-quality", "truth")
"""Steps that a study may leave out: the thesis's score, removal curves, looks of the maps, the truth."""
STUDY_METHODS = (
    "grad-cam-thesis",
    "integrated-gradients-thesis",
    "poly-cam-thesis",
    "grad-cam",
    "integrated-gradients",
    "poly-cam",
    "occlusion",
    "occlusion-marker",
    "shapley-marker",
)
"""The thesis's three as published, the same against the baseline, occlusion, Shapley values of the markers."""
RIVALS = ("integrated-gradients", "occlusion-marker")
"""Methods beside which the recommended one is always judged."""
QUICK_METHODS = ("shapley-marker", *RIVALS)
"""Methods of a quick study."""
STUDY_BUDGET = 0.15
"""Share of the channels that Poly-CAM measures at first: more where the map asks for it."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """Way to remove parts: their fill and their unit."""

    fill: str
    unit: str


SETTINGS = (
    Setting(fill="reference", unit="pixel"),
    Setting(fill="grey", unit="pixel"),
    Setting(fill="blur", unit="pixel"),
    Setting(fill="noisy-linear", unit="pixel"),
    Setting(fill="reference", unit="tile"),
    Setting(fill="reference", unit="marker"),
)
REDRAWN = Setting(fill="true", unit="marker")
"""Markers are put back in the scene, which is drawn again."""


@dataclass(frozen=True, kw_only=True)
class StudyConfig:
    """Options of a study, kept in its folder.

    See Also
    --------
    run_study : Run a study with these options.

    Examples
    --------
    >>> import sliplens as sl
    >>> sl.StudyConfig(trials=5, methods=("poly-cam", "shapley-marker")).trials
    5
    """

    methods: tuple[str, ...] = STUDY_METHODS
    """Explainers to compare."""
    budget: float = STUDY_BUDGET
    """Share of the channels that Poly-CAM measures at first."""
    baseline: Literal["untouched", "stick"] = "stick"
    """Baseline of the predictions: the last frame before the pull of the trial, or the untouched sensor."""
    split: str = "train"
    """Split of the trials to choose from: maps show what a network learned on trials it knows, as in the thesis; `test`
    where a data set has none to train on."""
    condition: str = "dry"
    """Condition of the trials to choose from."""
    trials: int = 14
    """Number of trials; where too few qualify, those within 5 points are taken too."""
    tolerance: float = 0.03
    """Largest error of a prediction in a trial that qualifies, in margin units."""
    tests: tuple[str, ...] = TESTS
    """Some of `score`, `faithfulness`, `map-quality` and `truth`."""
    seed: int = 0
    """Seed of random orders, new weights and noise."""
    quick: bool = False
    """If True, six trials, three methods and the judge that decides: about five minutes on two cores."""


@dataclass(frozen=True, kw_only=True)
class Study(Result):
    """All that a workspace holds, stage by stage; tables are by input, and empty where a stage was not run."""

    folder: Path = Path()
    """Workspace that holds the stages; a temporary one is there as long as the study."""
    config: StudyConfig | None = None
    """None where its folder has none: all that its data can show is expected."""
    evaluations: dict[str, Evaluation] = field(default_factory=dict)
    choice: Choice | None = None
    states: States | None = None
    explanations: dict[str, Explanation] = field(default_factory=dict)
    deletion: dict[str, DeletionScores] = field(default_factory=dict)
    faithfulness: dict[str, Faithfulness] = field(default_factory=dict)
    map_quality: dict[str, MapQuality] = field(default_factory=dict)
    truth: dict[str, Truth] = field(default_factory=dict)
    runs: dict[str, Provenance] = field(default_factory=dict)
    """By the name of the folder, last finished last."""
    trainings: dict[str, Training] = field(default_factory=dict)
    real: dict[str, Explanation] = field(default_factory=dict)
    """Explanations of frames of a real sensor, where the others are of simulated frames."""
    strip: Strip | None = None
    """One trial from stick to slip."""
    notes: tuple[str, ...] = ()
    """Sentences on how the results were chosen."""

    @property
    def summary(self) -> str:
        """Gain of the best method with each network, in a sentence."""
        scores = [f"{name} images: {record.summary}" for name, record in self.faithfulness.items()]
        for name, truth in self.truth.items():
            judged = {
                method: row.neutral for method, row in truth.methods.items() if row.neutral and row.lead_over_controls
            }
            best = max(judged, key=lambda method: judged[method].estimate, default="")
            scores += (
                [f"{name} images: correlation of {best} with the effects of markers {judged[best]}"] if best else []
            )
        return "; ".join(scores) or "no method was scored"

    def to_arrow(self) -> pa.Table:
        """Arrow table of the scores, a row a network, fill, unit and method; gains in margin units."""
        records = self.faithfulness.items()
        return pa.Table.from_pylist(
            [{"input": name} | row for name, each in records for row in table_rows(each.scores)]
        )

    @property
    def source(self) -> str:
        """Where the study's frames come from: "simulated" or "real"."""
        return next((record.source for record in (self.choice, *self._tests) if record), "simulated")

    @property
    def left_out(self) -> dict[str, str]:
        """How many frames to score no score counts, and why, in words by input; nothing where all count."""
        if self.choice is None:
            return {}
        chosen, sentences = sum(frame.scored for frame in self.choice.frames), {}
        for name, record in {**self.faithfulness, **self.truth}.items():
            if record.frames < chosen:
                baseline = self.explanations[name].baseline if name in self.explanations else "untouched"
                sentences[name] = (
                    f"{chosen - record.frames} of {chosen} frames to score are left out with the {name} network: it "
                    f"predicts nearly the margin of {BASELINES[baseline]} there, so that there is nothing to explain "
                    "and the direction is chance"
                )
        return sentences

    @property
    def begun(self) -> bool:
        """True where any step of a study was run."""
        return bool(self._tests) or self.choice is not None or self.states is not None

    @property
    def _tests(self) -> list[OfNetwork]:
        tables = self.faithfulness, self.map_quality, self.truth
        return [record for table in tables for record in table.values()]


_KINDS = RECORDS | {"train": Training, "evaluate": Evaluation}
"""Record of each stage."""
_COMMANDS = ("train", "evaluate", "explain", "score")
"""Stages that a command of their name makes; a study makes the others."""
_BY_SOURCE = ("explain", "score", "faithfulness")
"""Stages of which a workspace may hold two results of an input: of simulated and of real touch."""


def load_results(workspace: Path) -> Study:
    """Load every result in the direct subfolders of a workspace.

    A folder counts when it holds `run.json`; its stage, input and source say what it is. Of two results of one kind the
    one that finished last is loaded, and `Study.notes` says so.

    Raises
    ------
    InputError
        If the folder is missing or holds no result, or a file in it is malformed.
    """
    require_folder(workspace, what="the workspace")
    files = [path / RUN_FILE for path in sorted(workspace.iterdir()) if path.is_dir() and path.name[0] != "."]
    # a link that leads nowhere is refused, not passed over
    runs = [
        (path.parent, load_record(path, Provenance, command="sliplens"))
        for path in files
        if path.exists() or path.is_symlink()
    ]
    runs.sort(key=lambda item: item[1].finished)
    if not any(run.stage in {*_KINDS, "simulate"} for _, run in runs):
        raise InputError(
            f"{workspace} holds no result to report; run `sliplens simulate` and the stages after it into this folder"
        )
    records: dict[tuple[str, str, str], Any] = {}
    folders: dict[tuple[str, str, str], str] = {}
    notes = []
    for folder, run in runs:
        if run.stage not in _KINDS or run.stage == "control":  # large maps, which no page shows
            continue
        command = run.stage if run.stage in _COMMANDS else "study"
        record = load_result(folder, _KINDS[run.stage], command=f"sliplens {command}")
        source = record.source if run.stage in _BY_SOURCE else ""
        key = (run.stage, getattr(record, "input", ""), source)
        if key in records:
            notes.append(
                f"Two folders hold a result of “{' '.join(filter(None, key))}”: {folder.name} finished last and is "
                f"shown, {folders[key]} is not."
            )
        records[key], folders[key] = record, folder.name

    def of(stage: str, source: str = "") -> Any:
        return {
            name: record for (each, name, origin), record in records.items() if each == stage and origin in ("", source)
        }

    choice, config = of("choice").get(""), workspace / CONFIG_FILE
    tested = (record.source for (stage, *_), record in records.items() if stage in TESTS)
    source = choice.source if choice else next(tested, "simulated")
    tables = {table: of(stage, source) for stage, table in TABLES.items()}
    # `sliplens score` writes the deletion score with the removal, a study writes it as a step
    deletion = {name: scores for name, record in tables["faithfulness"].items() if (scores := record.deletion_scores)}
    return Study(
        folder=workspace,
        config=load_record(config, StudyConfig, command="sliplens study") if config.exists() else None,
        choice=choice,
        states=of("states").get(""),
        **tables | {"deletion": deletion | tables["deletion"]},
        runs={folder.name: run for folder, run in runs},
        trainings=of("train"),
        real=of("explain", "real") if source != "real" else {},
        strip=next(iter(of("strip").values()), None),
        notes=tuple(notes),
    )
