"""`sliplens evaluate`."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sliplens.cli.console import print_table, progress_bar, say, unchanged, wrote
from sliplens.cli.devices import require_device
from sliplens.errors import InputError
from sliplens.files import output_folder, to_jsonable, write_json

if TYPE_CHECKING:
    import pyarrow as pa

    from sliplens.models import Manifest
    from sliplens.recordings import Dataset, TrialInfo

_TOLD = ("conditions", "days", "trials", "reliability", "wet_auroc", "lead_times")
"""What `result.json` holds of an evaluation."""
_TOLD_BASELINES = ("markers", "hold", "training_trials", "training_frames", "followed", "failed", "estimators")


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure how well a network reads the safety margin, dry and wet.

    MSE, R2, MAE, the MSE in ten bins of the margin, by day and trial; whether its intervals hold, whether it knows when
    it does not know, how early it warns of a slip and how often in vain. With --baselines, what model-based estimators
    read from the markers of the same frames stands beside it.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")]
    """Folder of a trained network, or the name of one that comes with sliplens."""
    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Data set with labels."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """Folder to make: the table and every prediction."""
    split: str = "test"
    """Which trials of the data set."""
    baselines: tuple[str, ...] = ()
    """Estimators to put beside it, by name or all: they read the motion of the markers, fitted on training trials."""
    baseline_trials: int = 40
    """How many training trials they are fitted on, spread evenly over those of the data set."""
    markers: str | None = None
    """What markers look like: chromatouch, gelsight-mini, tactip or auto; by the sensor's name if not given."""
    device: str = "cpu"
    """Where the network runs: cpu, cuda or cuda:1."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Evaluate and write the scores."""
        import pyarrow.parquet as pq

        from sliplens.models import load_checkpoint
        from sliplens.models.checkpoint import find_run
        from sliplens.plots.errors import draw_evaluation
        from sliplens.recordings import Dataset
        from sliplens.training import evaluate
        from sliplens.training.data import load_frames

        require_device(self.device)
        trained = load_checkpoint(find_run(self.model), device=self.device)
        data = Dataset.open(self.data)
        trials = data.select(split=self.split)
        for trial in trials:
            trained.require_frame_size((trial.height, trial.width))
        seen = _count_seen(trials, trained.manifest)
        if seen:
            say(f"  note: {seen} of the {len(trials)} trials trained or validated this network; its scores flatter it")
        recipe: dict[str, Any] = {
            "weights_sha256": trained.manifest.weights_sha256,
            "data_hash": data.hash,
            "input": trained.manifest.input,
            "split": self.split,
        }
        plan = self._plan_baselines(data, trials) if self.baselines else None
        if plan is not None:
            recipe["baselines"] = plan.recipe
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
            if plan is not None:
                told["baselines"] = plan.run(data, evaluation.predictions, trained.manifest, folder=out.folder)
            write_json(out.folder / "result.json", {"input": trained.manifest.input, "split": self.split, **told})
            title = f"{self.model.name}, {self.split} trials of {self.data.name}"
            draw_evaluation(evaluation.predictions, told, out.folder / "evaluation.png", title=title)
        print_table(
            f"{trained.manifest.input} images, {self.split} trials",
            ("condition", "frames", "MSE", "R2", "MAE", "in 90 % interval", "warns before slip", "false alarms/min"),
            [_row(name, told) for name in told["conditions"]],
        )
        if told["wet_auroc"] is not None:
            say(f"wet is told from dry by the network's own uncertainty: AUROC {told['wet_auroc']:.2f}")
        if plan is not None:
            plan.tell(told)
        wrote(self.output, "scores, predictions, and evaluation.png")

    def _plan_baselines(self, data: "Dataset", trials: "Sequence[TrialInfo]") -> "_Plan":
        """Check all that may be wrong before anything is computed."""
        from sliplens.extras import import_cv2
        from sliplens.markers.detect import get_kind
        from sliplens.markers.estimators import ESTIMATORS, get_estimator
        from sliplens.training.baselines import choose_training, marker_kind

        names = tuple(ESTIMATORS) if self.baselines == ("all",) else self.baselines
        for name in names:
            get_estimator(name)
        import_cv2()
        offered = tuple(trial for trial in data.trials if trial.split == "train")
        if not offered:
            raise InputError(
                f"{self.data} has no training trials to fit baselines on; leave out --baselines, or share out its "
                "trials with sliplens split"
            )
        training = choose_training(offered, self.baseline_trials)
        kind = marker_kind((*training, *trials)) if self.markers is None else get_kind(self.markers).name
        return _Plan(names=names, training=training, of=len(offered), kind=kind, tested=frozenset(trials))


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """Which estimators are fitted on what."""

    names: tuple[str, ...]
    training: "tuple[TrialInfo, ...]"
    of: int
    """Training trials of the data set."""
    kind: str
    tested: "frozenset[TrialInfo]"

    @property
    def recipe(self) -> dict[str, Any]:
        return {
            "estimators": self.names,
            "markers": self.kind,
            "trials": [trial.trial for trial in self.training],
        }

    def run(self, data: "Dataset", predictions: "pa.Table", manifest: "Manifest", *, folder: Path) -> dict[str, Any]:
        """Follow, fit and score; gives what `result.json` holds of it."""
        import pyarrow.parquet as pq

        from sliplens.training.baselines import evaluate_baselines

        with progress_bar("Following markers") as bar:
            found = evaluate_baselines(
                self.names,
                data,
                training=self.training,
                predictions=predictions,
                kind=self.kind,
                folder=folder / "fields",
                on_trial=bar,
            )
        pq.write_table(found.predictions, folder / "baselines.parquet")
        # for whoever is interrupted before this line
        shutil.rmtree(folder / "fields")
        return to_jsonable(
            {name: getattr(found, name) for name in _TOLD_BASELINES}
            | {
                "training_trials_of_the_data": self.of,
                "training_trials_the_network_knew": _count_seen(self.training, manifest),
            }
        )

    def tell(self, told: Mapping[str, Any]) -> None:
        """Print the estimators beside the network, what they were fitted on, and what went wrong."""
        conditions, found = list(told["conditions"]), told["baselines"]
        readers = {"the network": told, **found["estimators"]}
        print_table(
            f"beside what {self.kind} markers tell by themselves",
            # two lines a head: the table fits into 80 columns
            ("reader", *(f"{name}\n{error}" for name in conditions for error in ("MSE", "R2", "MAE"))),
            [
                (reader, *(error for name in conditions for error in _errors(scores["conditions"][name])))
                for reader, scores in readers.items()
            ],
        )
        say(
            f"estimators were fitted on {found['training_frames']:,} frames of {found['training_trials']} of the "
            f"{self.of} training trials, {found['training_trials_the_network_knew']} of them known to the network; "
            f"{100 * found['followed']:.1f} % of the markers were followed while in view"
        )
        say(
            "  note: they count motion from the last frame before the pull, found in each trial as a whole; the "
            "network sees one frame"
        )
        if self.tested & set(self.training):
            say("  note: they were fitted on trials that they are scored on; their scores flatter them")
        if found["failed"]:
            name, why = next(iter(found["failed"].items()))
            say(
                f"  note: markers could not be followed in {len(found['failed'])} trials, which are answered with the "
                f"training mean, or not fitted on; {name}: {why}"
            )


def _count_seen(trials: "Sequence[TrialInfo]", manifest: "Manifest") -> int:
    return sum(trial.sha256[:12] in manifest.trained_on for trial in trials)


def _row(condition: str, told: Mapping[str, Any]) -> tuple[str, ...]:
    scores, lead = told["conditions"][condition], told["lead_times"][condition]
    held = told["reliability"][condition]["coverage"].get("0.9")
    warned = "-" if lead["median_ms"] is None else f"{lead['median_ms']:.0f} ms ({lead['warned']} of {lead['trials']})"
    return (
        condition,
        f"{scores['frames']:,}",
        *_errors(scores),
        "-" if held is None else f"{100 * held:.0f} %",
        warned,
        f"{lead['false_per_minute']:.1f}",
    )


def _errors(scores: Mapping[str, Any]) -> tuple[str, str, str]:
    r2 = "none" if scores["r2"] is None else f"{scores['r2']:.3f}"
    return f"{scores['mse']:.4f}", r2, f"{scores['mae']:.3f}"
