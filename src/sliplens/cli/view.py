"""`sliplens view`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.command import SOURCE_HELP, SourceCommand
from sliplens.cli.console import Terminal, say, wrote
from sliplens.errors import InputError
from sliplens.files import require_new_file
from sliplens.progress import number_of

if TYPE_CHECKING:
    from sliplens.live.viewer import ViewedTrial

_SOURCE = f"{SOURCE_HELP} Or a table of `sliplens predict`, which names its source, or a folder of `sliplens explain`."


@dataclass(frozen=True, kw_only=True)
class View(SourceCommand):
    """Show a trial in the Rerun viewer: frames, differences, forces, labels, predictions, maps on one clock.

    Needs the extra `view`: pip install "sliplens[view]". The viewer opens on this machine and listens to it alone. Or
    name a file to write (-o), to be opened with `rerun FILE.rrd` wherever Rerun is installed.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE", help=_SOURCE)]
    trial: str | None = None
    """Name of the trial; the first if not given."""
    predictions: Annotated[Path | None, tyro.conf.arg(metavar="FILE.parquet")] = None
    """Margins with their intervals, as `sliplens predict` or `sliplens evaluate` wrote them."""
    maps: Path | None = None
    """Folder of maps that `sliplens explain` wrote."""
    tracks: Annotated[Path | None, tyro.conf.arg(metavar="FILE.parquet")] = None
    """Markers that `sliplens track` followed."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="FILE.rrd")] = None
    """File to write instead of opening the viewer."""

    def run(self) -> None:
        """Open the viewer, or write its file."""
        from sliplens.live.viewer import Overlays, open_viewer, require_rerun, require_rrd_path, write_rrd
        from sliplens.results.explanation import is_explanation, load_explanation

        require_rerun()
        if self.output is not None:
            require_rrd_path(self.output)
            require_new_file(self.output, overwrite=self.overwrite)
        table, maps = self.predictions, self.maps
        if self.source.suffix == ".parquet":
            table = self.source
        elif is_explanation(self.source):
            maps = self.source
        explained = None if maps is None else load_explanation(maps)
        viewed = self._open()
        with Terminal().stage(f"Reading {viewed.trial.trial}") as bar:
            overlays = Overlays(predictions=table, maps=explained, tracks=self.tracks)
            if self.output is None:
                open_viewer(viewed, overlays=overlays, on_progress=bar)
            else:
                write_rrd(viewed, self.output, overlays=overlays, on_progress=bar)
        about = f"{viewed.trial.trial}, {number_of(len(viewed.trial), 'frame')}"
        if self.output is None:
            say(f"{about}, are in the Rerun viewer")
            say("the viewer reports to its makers that it is used, not what it shows: see `rerun analytics disable`")
        else:
            wrote(self.output, f"{about}; open it with `rerun {self.output}`")

    def _open(self) -> "ViewedTrial":
        """Prepare the trial of the source."""
        from sliplens.live.viewer import view_capture, view_explained, view_stored
        from sliplens.recordings import load_dataset
        from sliplens.recordings.dataset import DATASET_FILE
        from sliplens.recordings.source import open_source
        from sliplens.results.explanation import is_explanation, load_explanation

        source, trial = self.source, self.trial
        if is_explanation(source):
            return view_explained(load_explanation(source))
        if source.suffix == ".parquet":
            source, first = self._source_of(source)
            trial = trial or first
        if (source / DATASET_FILE).is_file():
            data = load_dataset(source)
            infos = data.select(split=self.split)
            return view_stored(data, infos[0] if trial is None else data.find(trial))
        return view_capture(self.call(open_source, source=source, trial=trial, whole=False)[0])

    def _source_of(self, table: Path) -> tuple[Path, str | None]:
        """Find the source of a table of predictions, and its first trial."""
        from sliplens.codec import open_parquet

        with open_parquet(table, {"trial": "texts"}, cure="name a table that sliplens predict wrote") as file:
            named = (file.schema_arrow.metadata or {}).get(b"sliplens.source", b"").decode()
            trials = next(file.iter_batches(1, columns=["trial"]), None)
        if not Path(named).exists() or not named:
            raise InputError(
                f"{table} was predicted from {named or 'an unknown source'}, which does not exist; name the source "
                f"first, and the table with --predictions {table}"
            )
        return Path(named), None if trials is None else trials["trial"][0].as_py()
