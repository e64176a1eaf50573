"""`sliplens evaluate`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.command import Command, Data, Device, InOrder, NetworkPath, Output
from sliplens.cli.console import print_table, say
from sliplens.progress import number_of

if TYPE_CHECKING:
    from sliplens.results.evaluation import Baselines, Evaluation, RegressionScores


@dataclass(frozen=True, kw_only=True)
class Evaluate(Command):
    """Measure how well a network predicts the safety margin, dry and wet.

    MSE, R2, MAE, the MSE in ten bins of the margin, by day and trial; whether its intervals hold, whether it knows when
    it does not know, how early it warns of a slip and how often in vain. With --baselines, what model-based estimators
    read from the markers of the same frames stands beside it.
    """

    model: NetworkPath
    data: Data
    output: Output
    """Folder to make: the table and every prediction."""
    split: str = "test"
    """Which trials of the data set."""
    friction: Annotated[str | None, tyro.conf.arg(metavar="MU|LOW..HIGH|each")] = None
    """Coefficient of friction that the network is told: 0.62, a range such as 0.5..0.8, or each for that of every
    trial."""
    sequence: InOrder = False
    baselines: tuple[str, ...] = ()
    """Estimators to put beside it, by name or all: they read the motion of the markers, fitted on training trials."""
    baseline_trials: int = 40
    """How many training trials they are fitted on, spread evenly over those of the data set."""
    markers: str | None = None
    """Kind of markers: chromatouch, gelsight-mini, tactip or auto; by the sensor's name if not given."""
    device: Device = "cpu"

    def run(self) -> None:
        """Evaluate, draw the scores and print them."""
        from sliplens.models.checkpoint import load
        from sliplens.plots.errors import draw_evaluation
        from sliplens.training import evaluate

        evaluation = self.call(evaluate, run=load(self.model, device=self.device), out=self.output)
        picture = self.output / "evaluation.png"
        if not picture.is_file():
            title = f"{self.model.name}, {self.split} trials of {self.data.name}"
            draw_evaluation(evaluation, picture, title=title)
        _print_scores(evaluation)
        if evaluation.baselines is not None:
            _print_baselines(evaluation, evaluation.baselines)


def _print_scores(evaluation: "Evaluation") -> None:
    shared, trials = evaluation.known_trials, len(evaluation.trials)
    if shared:
        say(f"  note: {shared} of the {trials} trials trained or validated this network; its scores flatter it")
    print_table(
        f"{evaluation.input} images, {evaluation.split} trials",
        # so short that it fits into 80 columns
        ("condition", "frames", "MSE", "R2", "MAE", "in 90 %", "warns\nbefore", "false\n/min"),
        [_row(name, evaluation) for name in evaluation.conditions],
    )
    if evaluation.friction:
        say(f"friction: {evaluation.friction}")
    if evaluation.sequence:
        say("several frames: each margin is read from those of its contact so far")
    if evaluation.ratio_r2:
        scores = (f"{name} {'none' if r2 is None else f'{r2:.3f}'}" for name, r2 in evaluation.ratio_r2.items())
        say(f"F_t / F_n is predicted with R2 {', '.join(scores)}")
    if evaluation.wet_auroc is not None:
        say(f"wet is told from dry by the network's own uncertainty: AUROC {evaluation.wet_auroc:.2f}")
    if evaluation.risk is not None:
        say(str(evaluation.risk))


def _row(condition: str, evaluation: "Evaluation") -> tuple[str, ...]:
    scores, lead = evaluation.conditions[condition], evaluation.lead_times[condition]
    coverage = evaluation.reliability[condition].coverage.get("0.9")
    return (
        condition,
        f"{scores.frames:,}",
        *_errors(scores),
        "-" if coverage is None else f"{100 * coverage:.0f} %",
        "-" if lead.median_ms is None else f"{lead.median_ms:.0f} ms {lead.warned}/{lead.trials}",
        f"{lead.false_per_minute:.1f}",
    )


def _print_baselines(evaluation: "Evaluation", baselines: "Baselines") -> None:
    """Print the estimators beside the network, what they were fitted on, and what went wrong."""
    conditions = list(evaluation.conditions)
    readers = {"the network": evaluation.conditions}
    readers |= {name: scores.conditions for name, scores in baselines.estimators.items()}
    print_table(
        f"beside what {baselines.markers} markers tell by themselves",
        # two lines a head: the table fits into 80 columns
        ("reader", *(f"{name}\n{error}" for name in conditions for error in ("MSE", "R2", "MAE"))),
        [
            (reader, *(error for name in conditions for error in _errors(scores[name])))
            for reader, scores in readers.items()
        ],
    )
    say(
        f"estimators were fitted on {baselines.training_frames:,} frames of {baselines.training_trials} of the "
        f"{baselines.offered_trials} training trials, {baselines.known_trials} of them known to the network; "
        f"{100 * baselines.followed:.1f} % of the markers were followed while in view"
    )
    say(
        "  note: but for the causal ones they count motion from the last frame before the pull, found in each trial as "
        "a whole; the network sees one frame"
    )
    if baselines.shared_trials:
        say("  note: they were fitted on trials that they are scored on; their scores flatter them")
    if baselines.failed:
        name, why = next(iter(baselines.failed.items()))
        say(
            f"  note: markers could not be followed in {number_of(len(baselines.failed), 'trial')}, answered with the "
            f"training mean, or not fitted on; {name}: {why}"
        )


def _errors(scores: "RegressionScores") -> tuple[str, str, str]:
    r2 = "none" if scores.r2 is None else f"{scores.r2:.3f}"
    return f"{scores.mse:.4f}", r2, f"{scores.mae:.3f}"
