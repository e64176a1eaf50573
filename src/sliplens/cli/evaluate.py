"""`sliplens evaluate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.console import print_table, progress_bar, say, unchanged, wrote
from sliplens.provenance import output_folder, to_jsonable, write_json

if TYPE_CHECKING:
    from sliplens.training import Evaluation

_TOLD = ("conditions", "days", "trials", "reliability", "wet_auroc", "lead_times")
"""What `result.json` holds of an evaluation."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure how well a network reads the safety margin, dry and wet.

    MSE, R2, MAE, the MSE in ten bins of the margin, by day and trial; whether its intervals hold, whether it knows when
    it does not know, how early it warns of a slip and how often in vain.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")]
    """Folder of a trained network."""
    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Data set with labels."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """Folder to make: the table and every prediction."""
    split: str = "test"
    """Which trials of the data set."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Evaluate and write the scores."""
        import pyarrow.parquet as pq

        from sliplens.datasets import load_frames
        from sliplens.models import load_checkpoint
        from sliplens.models.shipped import find_run
        from sliplens.recordings import Dataset
        from sliplens.report.evaluation import draw_evaluation
        from sliplens.training import evaluate

        trained = load_checkpoint(find_run(self.model))
        data = Dataset.open(self.data)
        trials = data.select(split=self.split)
        for trial in trials:
            trained.require_frame_size((trial.height, trial.width))
        seen = sum(trial.sha256[:12] in trained.manifest.trained_on for trial in trials)
        if seen:
            say(f"  note: {seen} of the {len(trials)} trials trained or validated this network; its scores flatter it")
        recipe = {
            "weights_sha256": trained.manifest.weights_sha256,
            "data_hash": data.hash,
            "input": trained.manifest.input,
            "split": self.split,
        }
        with output_folder(self.output, stage="evaluate", config=recipe, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            with progress_bar(f"Reading test trials ({trained.manifest.input})") as bar:
                frames = load_frames(
                    data, trials, encoding=trained.encoding, image_size=trained.manifest.image_size, on_trial=bar
                )
            with progress_bar("Predicting frames") as bar:
                evaluation = evaluate(trained, frames, on_batch=bar)
            pq.write_table(evaluation.predictions, out.folder / "predictions.parquet")
            told = to_jsonable({name: getattr(evaluation, name) for name in _TOLD})
            write_json(out.folder / "result.json", {"input": trained.manifest.input, "split": self.split, **told})
            title = f"{self.model.name}, {self.split} trials of {self.data.name}"
            draw_evaluation(evaluation.predictions, told, out.folder / "evaluation.png", title=title)
        print_table(
            f"{trained.manifest.input} images, {self.split} trials",
            ("condition", "frames", "MSE", "R2", "MAE", "in 90 % interval", "warns before slip", "false alarms/min"),
            [_row(name, evaluation) for name in evaluation.conditions],
        )
        if evaluation.wet_auroc is not None:
            say(f"wet is told from dry by the network's own uncertainty: AUROC {evaluation.wet_auroc:.2f}")
        wrote(self.output, "scores, predictions, and evaluation.png")


def _row(name: str, evaluation: "Evaluation") -> tuple[str, ...]:
    scores, lead = evaluation.conditions[name], evaluation.lead_times[name]
    r2 = "none" if scores.r2 is None else f"{scores.r2:.3f}"
    held = evaluation.reliability[name].coverage.get("0.9")
    warned = "-" if lead.median_ms is None else f"{lead.median_ms:.0f} ms ({lead.warned} of {lead.trials})"
    return (
        name,
        f"{scores.frames:,}",
        f"{scores.mse:.4f}",
        r2,
        f"{scores.mae:.3f}",
        "-" if held is None else f"{100 * held:.0f} %",
        warned,
        f"{lead.false_per_minute:.1f}",
    )
