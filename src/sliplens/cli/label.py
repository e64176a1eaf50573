"""`sliplens label`."""

import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.console import progress_bar, unchanged, wrote
from sliplens.cli.labelling import LabelOptions, draw_audit_page, show_found, summary, write_trials
from sliplens.errors import InputError
from sliplens.files import output_folder, write_json

if TYPE_CHECKING:
    from sliplens.recordings.capture import Capture


@dataclass(frozen=True, kw_only=True)
class Label:
    """Label the trials of a data set anew, from the frames and the force samples that it keeps.

    For another friction, axis or threshold than on import, or to see how well the labels of a simulated data set come
    back when only its frames and forces are known. Splits stay. Without --output the data set itself gets the new
    labels, once all of them are there.
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Data set, imported or simulated."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Folder to make with the new labels; the data set itself if not given."""
    labels: Annotated[LabelOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=LabelOptions)
    audit_only: bool = False
    """Change no label: draw the audit pages of the labels that are there, into `audit/` of the output folder."""
    overwrite: bool = False
    """Replace the output folder if it exists."""

    def run(self) -> None:
        """Label anew, write, and show what was found."""
        from sliplens.recordings import Dataset
        from sliplens.recordings.formats.stored import read_stored
        from sliplens.recordings.importing import About
        from sliplens.recordings.splits import SPLITS_FILE

        data = Dataset.open(self.data)
        if self.audit_only:
            self._audit()
            return
        captures = read_stored(self.data)
        self._require_forces(captures)
        target = self.data if self.output is None else self.output
        if self.output is None:
            strange = next((one for one in captures if one.labels is None or not one.labels.found), None)
            if strange is not None:
                raise InputError(
                    f"the labels of {strange.name} did not come from its forces and would be lost; "
                    "name a new folder with --output"
                )
        recipe = {**vars(self.labels), "data_hash": data.hash}
        in_place = self.output is None or target.resolve() == self.data.resolve()
        with output_folder(target, stage="label", config=recipe, overwrite=self.overwrite or in_place) as out:
            if out.complete:
                unchanged(target)
                return
            bare = [_without_labels(one) for one in captures]
            abouts = [
                About(sensor=info.sensor, day=info.day, condition=info.condition, object=info.object)
                for info in data.trials
            ]
            splits = [info.split for info in data.trials]
            found = write_trials(out.folder, bare, abouts, splits, self.labels, title="Labelling frames")
            if (self.data / SPLITS_FILE).is_file():
                shutil.copyfile(self.data / SPLITS_FILE, out.folder / SPLITS_FILE)
            write_json(out.folder / "result.json", {"trials": summary(found)})
        show_found("Labelled", found)
        wrote(target, f"{len(found)} trials, {sum(info.frames for info in data.trials):,} frames")
        if self.labels.audit:
            wrote(target / "audit", "a page a trial: look at them before you train")

    def _audit(self) -> None:
        from sliplens.recordings import Dataset
        from sliplens.recordings.dataset import trial_path
        from sliplens.recordings.store import read_labelling

        data, folder = Dataset.open(self.data), (self.output or self.data) / "audit"
        told = {info.trial: read_labelling(trial_path(self.data, info.trial)) for info in data.trials}
        missing = [trial for trial, labelling in told.items() if labelling is None]
        if missing:
            raise InputError(
                f"{missing[0]} of {self.data} was not imported, and nothing tells what its labels rest on; "
                "label it into a new folder with --output"
            )
        folder.mkdir(parents=True, exist_ok=True)
        with progress_bar("Drawing pages") as bar:
            for done, (trial, labelling) in enumerate(told.items(), start=1):
                draw_audit_page(trial_path(self.data, trial), folder / f"{trial}.png", labelling or {})
                bar(done, len(told))
        wrote(folder, f"{len(told)} pages: look at them before you train")

    def _require_forces(self, captures: "list[Capture]") -> None:
        bare = [one.name for one in captures if one.forces is None]
        if bare:
            raise InputError(
                f"{bare[0]} of {self.data} has no forces, and without them there is no label; "
                "import it again with its table of forces"
            )


def _without_labels(capture: "Capture") -> "Capture":
    """A stored trial as if it came from where it was recorded, with what was noted then."""
    kept = capture.labels.labelling if capture.labels else None
    if kept is None:
        return replace(capture, labels=None)
    return replace(capture, labels=None, source=kept["source"], notes=tuple(kept["notes"]))
