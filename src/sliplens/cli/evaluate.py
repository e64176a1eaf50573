"""`sliplens evaluate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.console import print_table, progress_bar, unchanged, wrote
from sliplens.provenance import output_folder, write_json

if TYPE_CHECKING:
    from sliplens.training import RegressionScores


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure how well a network reads the safety margin, dry and wet: MSE, R2, MAE, and MSE in ten bins."""

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
        from sliplens.recordings import Dataset
        from sliplens.training import evaluate

        trained = load_checkpoint(self.model)
        data = Dataset.open(self.data)
        trials = data.select(split=self.split)
        for trial in trials:
            trained.require_frame_size((trial.height, trial.width))
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
            write_json(
                out.folder / "result.json",
                {"input": trained.manifest.input, "split": self.split, "conditions": evaluation.conditions},
            )
        print_table(
            f"{trained.manifest.input} images, {self.split} trials",
            ("condition", "frames", "MSE", "R2", "MAE"),
            [_row(name, scores) for name, scores in evaluation.conditions.items()],
        )
        wrote(self.output, "scores and predictions")


def _row(name: str, scores: "RegressionScores") -> tuple[str, ...]:
    r2 = "none" if scores.r2 is None else f"{scores.r2:.3f}"
    return name, f"{scores.frames:,}", f"{scores.mse:.4f}", r2, f"{scores.mae:.3f}"
