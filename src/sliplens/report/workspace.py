"""All that a workspace holds, as a report sees it."""

from dataclasses import dataclass, field
from pathlib import Path

from sliplens.files import Provenance
from sliplens.results.evaluation import Evaluation
from sliplens.results.explanation import Explained
from sliplens.results.faithfulness import DeletionScores
from sliplens.results.simulation import Simulation
from sliplens.results.strip import Strip
from sliplens.results.study import Study
from sliplens.results.training import Training


@dataclass(frozen=True, kw_only=True)
class Results:
    """All that a workspace holds; a stage that was not run is None or an empty table.

    Attributes
    ----------
    runs
        By the name of the folder, last finished last.
    trainings, evaluations
        By input ("raw", "difference").
    explanations, scores
        By input and source ("simulated", "real").
    strip
        One trial from stick to slip.
    study
        What a study adds; false where none was run.
    notes
        What a reader must know of how the results were chosen.
    """

    workspace: Path
    runs: dict[str, Provenance]
    simulation: Simulation | None = None
    trainings: dict[str, Training] = field(default_factory=dict)
    evaluations: dict[str, Evaluation] = field(default_factory=dict)
    explanations: dict[tuple[str, str], Explained] = field(default_factory=dict)
    scores: dict[tuple[str, str], DeletionScores] = field(default_factory=dict)
    strip: Strip | None = None
    study: Study = field(default_factory=Study)
    notes: tuple[str, ...] = ()

    @property
    def inputs(self) -> set[str]:
        """Inputs that any stage tells of."""
        named = {*self.trainings, *self.evaluations, *(name for name, _ in (*self.explanations, *self.scores))}
        return named | self.study.inputs if self.study or not named else named

    def scored_inputs(self, source: str) -> set[str]:
        """Inputs that have deletion scores on frames of this source."""
        return {name for name, own in self.scores if own == source}
