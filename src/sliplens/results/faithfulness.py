"""Scores of explanations: by deletion as the thesis does, and by removal against controls."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float64, Int, Int64, Shaped

from sliplens.codec import UNKNOWN, Columns, Result
from sliplens.errors import InputError
from sliplens.intervals import Difference
from sliplens.progress import number_of
from sliplens.results.evaluation import AMOUNT, ANSWER, MARGIN, SHARE, UNIT, OfNetwork, OfOutput

Key = tuple[str, str, str]
"""Fill, unit and method."""
CHANCE = "random"
NEW_WEIGHTS = "-new-weights"
"""Ends the name of a method's maps of networks whose weights were drawn again."""
CONTROLS = ("change", "local-change", "weights-1", "centre", "edges", CHANCE)


def is_control(name: str) -> bool:
    """Return True for the name of maps that use nothing the network learned, which explanations have to beat."""
    return name in CONTROLS or name.endswith(NEW_WEIGHTS)


@dataclass(frozen=True, kw_only=True)
class Lead:
    """Score of a method less that of the strongest control, with an interval that lies below those over each."""

    control: str
    """The strongest in these frames."""
    gap: Difference
    """Where it is not above zero for sure, the method shows nothing about this network."""


@dataclass(frozen=True, kw_only=True)
class MethodScore:
    """Deletion score D_AUC over frames: mean and standard deviation, and mean D once the last pixel is gone."""

    mean: Annotated[float, AMOUNT]
    sd: Annotated[float, AMOUNT]
    last_step_mean: Annotated[float, AMOUNT]
    frames: Annotated[int, AMOUNT]


@dataclass(frozen=True, kw_only=True)
class FrameRows(Columns):
    """Rows that each are of one frame."""

    frame_id: Shaped[np.ndarray, " rows"]
    day: Int64[np.ndarray, " rows"]
    trial: Shaped[np.ndarray, " rows"]


@dataclass(frozen=True, kw_only=True)
class DeletionTable(FrameRows):
    """Deletion score D and prediction (in margin units) of each frame, method and step."""

    method: Shaped[np.ndarray, " rows"]
    step: Annotated[Int64[np.ndarray, " rows"], AMOUNT]
    pixels_removed: Annotated[Int64[np.ndarray, " rows"], AMOUNT]
    prediction: Annotated[Float64[np.ndarray, " rows"], ANSWER]
    score: Annotated[Float64[np.ndarray, " rows"], AMOUNT]


@dataclass(frozen=True, kw_only=True)
class DeletionCurve:
    """Deletion score D of each frame while pixels are removed, and the predictions behind it, in margin units."""

    frame_ids: tuple[str, ...]
    clusters: Shaped[np.ndarray, "2 frames"]
    """Day and trial of each."""
    pixels_removed: Int[np.ndarray, " steps"]
    scores: Float64[np.ndarray, "frames steps"]
    predictions: Float64[np.ndarray, "frames steps"]


@dataclass(frozen=True, kw_only=True)
class Deletion(Result):
    """Deletion score of the thesis by method, a random order among the methods."""

    fill: str
    steps: int
    methods: dict[str, MethodScore]
    alarms: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class DeletionScores(Deletion, OfNetwork):
    """Deletion score of the thesis of one network's explanations, with its curves."""

    table: DeletionTable

    @cached_property
    def curves(self) -> dict[str, DeletionCurve]:
        """Curves by method, frames sorted by their ids."""
        curves = {}
        for (method,), rows in self.table.groups("method").items():
            ids, clusters, (pixels, scores, predictions) = _by_frame(
                rows, rows.step, (rows.pixels_removed, rows.score, rows.prediction)
            )
            curves[method] = DeletionCurve(
                frame_ids=ids, clusters=clusters, pixels_removed=pixels[0], scores=scores, predictions=predictions
            )
        return curves


@dataclass(frozen=True, kw_only=True)
class RemovalScore:
    """Symmetric relevance gain of one method under one fill and unit, in margin units."""

    fill: str
    unit: str
    method: str
    control: bool
    srg: Annotated[Difference, UNIT]
    lead_over_controls: Lead | None
    """None for a control."""

    @property
    def key(self) -> Key:
        """Fill, unit and method."""
        return self.fill, self.unit, self.method


@dataclass(frozen=True, kw_only=True)
class MethodGap:
    """Measure of the first method's maps less that of the second's, under a fill and unit if it is of removal."""

    first: str
    second: str
    gap: Difference
    fill: str = ""
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class RemovalCurve:
    """Change of a network's predictions while parts of frames are removed, by one method, fill and unit.

    Changes are in margin units, along the sign of f(x) - f(baseline) where it is known, else by size.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.results.faithfulness import RemovalCurve
    >>> most, least, random = (np.array([[0, middle, 0.4]]) for middle in (0.4, 0.0, 0.2))
    >>> curve = RemovalCurve(areas=np.array([0, 0.5, 1.0]), most_first=most, least_first=least, random=random)
    >>> curve.symmetric_gain
    array([0.2])
    """

    frame_ids: tuple[str, ...] = ()
    clusters: Shaped[np.ndarray, "2 frames"] | None = None
    """Day and trial of each frame."""
    areas: Float64[np.ndarray, " areas"]
    """Share of the image that is removed at each step, from 0 to 1."""
    most_first: Float64[np.ndarray, "frames areas"]
    """Most influential parts first."""
    least_first: Float64[np.ndarray, "frames areas"]
    random: Float64[np.ndarray, "frames areas"]
    """Mean over random orders."""

    @property
    def symmetric_gain(self) -> Float64[np.ndarray, " frames"]:
        """Symmetric relevance gain of each frame: area between the most and the least influential first, 0 by chance.

        References
        ----------
        Bluecher, Vielhaben and Strodthoff, *Decoupling Pixel Flipping and Occlusion Strategy* (2024): SRG.
        """
        return np.trapezoid(self.most_first, self.areas, axis=-1) - np.trapezoid(self.least_first, self.areas, axis=-1)


@dataclass(frozen=True, kw_only=True)
class RemovalTable(FrameRows):
    """Change of the prediction (in margin units) of each frame, fill, unit, method and share of the image removed."""

    fill: Shaped[np.ndarray, " rows"]
    unit: Shaped[np.ndarray, " rows"]
    method: Shaped[np.ndarray, " rows"]
    safety_margin: Annotated[Float64[np.ndarray, " rows"], MARGIN, UNKNOWN]
    area: Annotated[Float64[np.ndarray, " rows"], SHARE]
    most_first: Annotated[Float64[np.ndarray, " rows"], ANSWER]
    least_first: Annotated[Float64[np.ndarray, " rows"], ANSWER]
    random: Annotated[Float64[np.ndarray, " rows"], ANSWER]


@dataclass(frozen=True, kw_only=True)
class Faithfulness(OfOutput):
    """Scores of one network's explanations: removal of parts against controls, and the thesis's deletion score."""

    frames: int
    trials: int
    random_orders: int
    scores: tuple[RemovalScore, ...]
    """Scores by fill, unit and method, controls included, with intervals over days and trials."""
    comparisons: tuple[MethodGap, ...]
    """Gaps of every two methods under each fill and unit, with intervals of the paired difference."""
    alarms: tuple[str, ...]
    """Reasons why a score may not measure the maps."""
    table: RemovalTable
    deletion: Deletion | None = None
    """Deletion score of the thesis; None if it was not computed."""
    deletion_table: DeletionTable | None = None

    @cached_property
    def curves(self) -> dict[Key, RemovalCurve]:
        """Curves by fill, unit and method, frames sorted by their ids."""
        curves = {}
        for key, rows in self.table.groups("fill", "unit", "method").items():
            ids, clusters, (areas, most, least, random) = _by_frame(
                rows, rows.area, (rows.area, rows.most_first, rows.least_first, rows.random)
            )
            curves[key] = RemovalCurve(
                frame_ids=ids, clusters=clusters, areas=areas[0], most_first=most, least_first=least, random=random
            )
        return curves

    @property
    def deletion_scores(self) -> DeletionScores | None:
        """Deletion score of the thesis with its curves; None if it was not computed."""
        if self.deletion is None or self.deletion_table is None:
            return None
        return DeletionScores(input=self.input, source=self.source, table=self.deletion_table, **vars(self.deletion))

    def with_deletion(self, scores: DeletionScores) -> "Faithfulness":
        """Return these scores with the deletion score of the thesis."""
        short = Deletion(fill=scores.fill, steps=scores.steps, methods=scores.methods, alarms=scores.alarms)
        return replace(self, deletion=short, deletion_table=scores.table)

    def score(self, method: str) -> RemovalScore:
        """Return the score of a method or control under the first fill and unit."""
        for score in self.scores:
            if score.method == method:
                return score
        raise InputError(f"no method {method!r} was scored; choose one of {', '.join(s.method for s in self.scores)}")

    @property
    def summary(self) -> str:
        """Gain of the best method, over the best control and the next method, in a sentence."""
        counts = f"{number_of(self.frames, 'frame')} of {number_of(self.trials, 'trial')}"
        methods = [score for score in self.scores if not score.control and score.key[:2] == self.scores[0].key[:2]]
        if not methods:
            return f"no method was scored; {counts}"
        best, *others = sorted(methods, key=lambda score: -score.srg.estimate)
        lead, compared = best.lead_over_controls, {best.method, *(score.method for score in others[:1])}
        over = "" if lead is None else f", {lead.gap} over the best control ({lead.control})"
        for each in self.comparisons:
            if {each.first, each.second} == compared and (each.fill, each.unit) == best.key[:2]:
                over += f"; that of {each.first} less that of {each.second} {each.gap}"
        return f"symmetric relevance gain of {best.method} {best.srg} {self.unit_words}{over}; {counts}"


def _by_frame(
    rows: FrameRows, step: np.ndarray, values: Sequence[np.ndarray]
) -> tuple[tuple[str, ...], Shaped[np.ndarray, "2 frames"], list[np.ndarray]]:
    """Frames in the order of their ids, their days and trials, and values by frame and step."""
    order = np.lexsort((step, rows.frame_id))
    ids = np.unique(rows.frame_id)
    day, trial, *columns = (column[order].reshape(len(ids), -1) for column in (rows.day, rows.trial, *values))
    return tuple(ids.tolist()), np.stack([day[:, 0].astype(str), trial[:, 0].astype(str)]), columns
