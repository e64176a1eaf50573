"""`sliplens explain`."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sliplens.cli.console import print_table, progress_bar, say, unchanged, wrote
from sliplens.codec import save_result
from sliplens.errors import InputError
from sliplens.extras import require_device
from sliplens.files import output_folder

if TYPE_CHECKING:
    from sliplens.explainers import Explainer
    from sliplens.models import TrainedModel
    from sliplens.study import ChosenFrames, Explained

_BY_MARKER = "occlusion-marker"
_FULL_STICK = 0.9
"""Safety margin from which a labelled frame counts as one without slip."""


@dataclass(frozen=True, kw_only=True)
class Explain:
    """Show which parts of a frame made the network answer as it did, rather than as for the untouched sensor.

    Explains frames of a data set along the safety margin, or a folder of images (`--frames`). The folder holds the maps
    without loss (arrays.npz), an overlay of each (overlays/METHOD/FRAME.png) and all of them side by side (panel.png).
    """

    model: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")] = None
    """Folder of a trained network, or the name of one that comes with sliplens."""
    data: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DATA]")] = None
    """Data set to take frames from; leave out with --frames."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Folder to make: maps, inputs, table, pictures."""
    frames: Path | None = None
    """Folder of 8-bit RGB images: difference images, or camera frames together with --reference."""
    reference: Path | None = None
    """Image of the untouched sensor, for camera frames in --frames."""
    labels_in_names: bool = False
    """Read the safety margin in percent from names such as image_433_20.png."""
    method: tuple[str, ...] = ("grad-cam", "integrated-gradients", "poly-cam")
    """Explainers to run; --list-methods tells which there are."""
    list_methods: bool = False
    """Print the table of explainers and do nothing else."""
    budget: float = 1.0
    """Share of the channels that poly-cam measures at first; below 1 it is faster. It goes on where the map is not
    expected to be like the exact one, and tells how far it is."""
    colours: Literal["inferno", "jet"] = "inferno"
    """Of the pictures: perceptually uniform, or as the thesis's figures have them."""
    split: str = "test"
    """Trials of the data set to take frames from."""
    condition: str = "dry"
    """Condition of those trials."""
    trials: int = 1
    """How many trials."""
    levels: tuple[float, ...] = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
    """Safety margins at which frames are taken."""
    device: str = "cpu"
    """Where the network runs: cpu, cuda or cuda:1."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Explain and write the maps."""
        from sliplens.models.checkpoint import load
        from sliplens.study import explain_frames
        from sliplens.study.explaining import require_methods

        if self.list_methods:
            _print_methods()
            return
        if self.model is None or self.output is None:
            raise InputError("name the network and the folder to make: sliplens explain RUN DATA -o FOLDER")
        if (self.data is None) == (self.frames is None):
            raise InputError("name either a data set or --frames FOLDER, to say which frames to explain")
        if self.trials < 1:
            raise InputError(f"--trials must be at least 1, got {self.trials}")
        require_methods(self.method)
        require_device(self.device)
        trained = load(self.model, device=self.device)
        chosen = self._choose(trained)
        recipe = {
            "weights_sha256": trained.manifest.weights_sha256,
            "input": trained.manifest.input,
            "source": chosen.source,
            "ids": chosen.ids,
            "images_sha256": _hash_images(chosen),
            "method": self.method,
            "budget": self.budget,
            "colours": self.colours,
        }
        explainers = self._table(trained, chosen)
        with output_folder(self.output, stage="explain", config=recipe, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            with progress_bar(
                f"Explaining {len(chosen.ids)} frames ({trained.manifest.input}, {chosen.source})"
            ) as bar:
                explained = explain_frames(
                    trained,
                    chosen,
                    methods=self.method,
                    explainers=explainers,
                    parts=out.folder / "parts",
                    on_progress=bar,
                )
            shutil.rmtree(out.folder / "parts")
            self._draw(explained, out.folder)
            save_result(explained, out.folder)
        for name, notes in explained.methods.items():
            for warning in notes.warnings:
                say(f"  note, {name}: {warning}")
        wrote(self.output, f"{len(self.method)} maps of each of {len(chosen.ids)} frames, panel.png")

    def _table(self, trained: "TrainedModel", chosen: "ChosenFrames") -> "dict[str, Explainer | Sequence[Explainer]]":
        """The explainers with the options that were asked for."""
        from sliplens.explainers import EXPLAINERS, ExpectedGradients, PolyCam

        free = [index for index, margin in enumerate(chosen.safety_margin) if margin >= _FULL_STICK]
        background = trained.encoding.normalise(chosen.images[free]) if free else None
        table: dict[str, Explainer | Sequence[Explainer]] = {
            **EXPLAINERS,
            "poly-cam": PolyCam(budget=self.budget),
            "expected-gradients": ExpectedGradients(background=background),
        }
        if _BY_MARKER in self.method:
            table[_BY_MARKER] = self._occlude_markers(trained, chosen)
        return table

    def _occlude_markers(self, trained: "TrainedModel", chosen: "ChosenFrames") -> "list[Explainer]":
        """Occlusion by marker, frame by frame: where the simulator put them, else where they are found."""
        from sliplens.explainers import Occlusion
        from sliplens.explainers.occlusion import markers_in_frame, markers_in_recording
        from sliplens.images import list_images, read_image
        from sliplens.recordings import Dataset

        size = trained.manifest.image_size
        if self.data is not None:
            data = Dataset.open(self.data)
            opened = {info.trial: data.load(info) for info in data.trials if info.trial in chosen.trial}
            places = [
                markers_in_recording(opened[trial], int(name.removeprefix(f"{trial}-f")), image_size=size)
                for name, trial in zip(chosen.ids, chosen.trial, strict=True)
            ]
        elif self.frames is not None and self.reference is not None:
            places = [markers_in_frame(read_image(path), image_size=size) for path in list_images(self.frames)]
        else:
            raise InputError(
                f"{_BY_MARKER} finds the markers in camera frames, which difference images are not; give camera frames "
                "and --reference, or a data set"
            )
        return [Occlusion(markers_px=one) for one in places]

    def _draw(self, explained: "Explained", folder: Path) -> None:
        import numpy as np

        from sliplens.images import write_png
        from sliplens.plots.saliency import draw_panel, overlay_jet, overlay_saliency, stretch_saliency
        from sliplens.plots.style import drawing_style, method_name, percent

        lay = overlay_jet if self.colours == "jet" else lambda one, two: overlay_saliency(one, stretch_saliency(two))
        rows = {"Input": list(explained.pictures)}
        for method in self.method:
            (overlays := folder / "overlays" / method).mkdir(parents=True, exist_ok=True)
            row = rows[method_name(method)] = []
            for frame, picture, saliency in zip(
                explained.frames, explained.pictures, explained.saliency[method], strict=True
            ):
                # a map that holds NaN is named in the notes, and is not shown
                row.append(lay(picture, saliency) if np.isfinite(saliency).all() else None)
                if row[-1] is not None:
                    write_png(overlays / f"{frame.id}.png", row[-1])
        titles = [
            # of recorded images the margin need not be known
            ("" if frame.safety_margin is None else f"true {percent(frame.safety_margin)}, ")
            + f"read {percent(frame.prediction)}"
            for frame in explained.frames
        ]
        with drawing_style():
            draw_panel(rows, titles=titles).savefig(folder / "panel.png")

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


def _print_methods() -> None:
    from sliplens.explainers import EXPLAINERS

    rows = []
    for name, explainer in EXPLAINERS.items():
        summary = (type(explainer).__doc__ or "").strip().splitlines()[0].rstrip(".")
        rows.append((name, summary))
    print_table("Explainers", ("method", "what it does"), rows)
