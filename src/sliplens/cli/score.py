"""`sliplens score`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.console import print_table, progress_bar, say, unchanged, wrote
from sliplens.codec import ARRAYS_FILE, save_result
from sliplens.extras import require_device
from sliplens.files import hash_file, output_folder


@dataclass(frozen=True, kw_only=True)
class Score:
    """Score explanations by deletion: remove the most salient pixels first and watch the answer.

    D = (1 - |y_base - y_mask|)^2 at each step, averaged over the steps (thesis, eq. 2): lower is more faithful. A
    random order is scored beside every method; one that does not beat it has shown nothing.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")]
    """Folder of the network that was explained."""
    explanations: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="EXPLANATIONS")]
    """Folder that `sliplens explain` made."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """Folder to make: curves and table."""
    fill: str = "grey"
    """What removed pixels become: grey, black, white, background, blur or noisy-linear."""
    steps: int | None = None
    """Steps until every pixel is gone; the image's height if not given."""
    device: str = "cpu"
    """Where the network runs: cpu, cuda or cuda:1."""
    seed: int = 0
    """Seed of the random order."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Score and write the curves."""
        from sliplens.faithfulness import get_fill
        from sliplens.models.checkpoint import load
        from sliplens.study import load_explained, score_explanations
        from sliplens.study.scoring import require_same_network

        get_fill(self.fill)
        require_device(self.device)
        trained = load(self.model, device=self.device)
        explained = load_explained(self.explanations)
        require_same_network(trained, explained)
        recipe = {
            "weights_sha256": trained.manifest.weights_sha256,
            "maps_sha256": hash_file(self.explanations / ARRAYS_FILE),
            "input": explained.input,
            "source": explained.source,
            "fill": self.fill,
            "steps": self.steps,
            "seed": self.seed,
        }
        with output_folder(self.output, stage="score", config=recipe, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            with progress_bar(f"Deleting pixels ({explained.input}, {explained.source})") as bar:
                result = score_explanations(
                    trained,
                    explained,
                    fill=self.fill,
                    steps=self.steps,
                    seed=self.seed,
                    on_progress=bar,
                )
            save_result(result, out.folder)
        print_table(
            f"deletion score, {explained.input} images ({explained.source}), fill {self.fill}: lower is more faithful",
            ("method", "D_AUC", "+-", "last step", "frames"),
            [
                (name, f"{one.mean:.3f}", f"{one.sd:.3f}", f"{one.last_step_mean:.3f}", str(one.frames))
                for name, one in result.methods.items()
            ],
        )
        for alarm in result.alarms:
            say(f"  alarm: {alarm}")
        wrote(self.output, "curves and scores")
