"""`sliplens explain`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.console import progress_bar, say, unchanged, wrote
from sliplens.errors import InputError
from sliplens.provenance import output_folder, read_json

if TYPE_CHECKING:
    from sliplens.models import TrainedModel
    from sliplens.study import ChosenFrames


@dataclass(frozen=True, kw_only=True)
class Explain:
    """Show which parts of a frame made the network answer as it did, rather than as for the untouched sensor.

    Explains frames of a data set along the safety margin, or a folder of images (`--frames`).
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")]
    """Folder of a trained network."""
    data: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DATA]")] = None
    """Data set to take frames from; leave out with --frames."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """Folder to make: maps, inputs, table."""
    frames: Path | None = None
    """Folder of 8-bit RGB images: difference images, or camera frames together with --reference."""
    reference: Path | None = None
    """Image of the untouched sensor, for camera frames in --frames."""
    labels_in_names: bool = False
    """Read the safety margin in percent from names such as image_433_20.png."""
    method: tuple[str, ...] = ("grad-cam", "integrated-gradients", "poly-cam")
    """Explainers to run."""
    split: str = "test"
    """Trials of the data set to take frames from."""
    condition: str = "dry"
    """Condition of those trials."""
    trials: int = 1
    """How many trials."""
    levels: tuple[float, ...] = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
    """Safety margins at which frames are taken."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Explain and write the maps."""
        from sliplens.models import load_checkpoint
        from sliplens.models.shipped import find_run
        from sliplens.study import explain_frames
        from sliplens.study.explaining import require_methods

        if (self.data is None) == (self.frames is None):
            raise InputError("name either a data set or --frames FOLDER, to say which frames to explain")
        if self.trials < 1:
            raise InputError(f"--trials must be at least 1, got {self.trials}")
        require_methods(self.method)
        trained = load_checkpoint(find_run(self.model))
        chosen = self._choose(trained)
        recipe = {
            "weights_sha256": trained.manifest.weights_sha256,
            "input": trained.manifest.input,
            "source": chosen.source,
            "ids": chosen.ids,
            "images_sha256": _hash_images(chosen),
            "method": self.method,
        }
        with output_folder(self.output, stage="explain", config=recipe, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            with progress_bar(
                f"Explaining {len(chosen.ids)} frames ({trained.manifest.input}, {chosen.source})"
            ) as bar:
                explain_frames(trained, chosen, out.folder, methods=self.method, on_map=bar)
        for name, notes in read_json(self.output / "result.json")["methods"].items():
            for warning in notes["warnings"]:
                say(f"  note, {name}: {warning}")
        wrote(self.output, f"{len(self.method)} maps of each of {len(chosen.ids)} frames")

    def _choose(self, trained: "TrainedModel") -> "ChosenFrames":
        from sliplens.recordings import Dataset
        from sliplens.study import frames_from_dataset, frames_from_folder

        if self.frames is not None:
            return frames_from_folder(
                trained, self.frames, reference=self.reference, labels_in_names=self.labels_in_names
            )
        assert self.data is not None  # one of the two is given
        return frames_from_dataset(
            trained,
            Dataset.open(self.data),
            split=self.split,
            condition=self.condition,
            trials=self.trials,
            levels=self.levels,
        )


def _hash_images(chosen: "ChosenFrames") -> str:
    import hashlib

    return hashlib.sha256(chosen.images.numpy().tobytes() + chosen.references.numpy().tobytes()).hexdigest()
