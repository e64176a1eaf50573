"""`sliplens view`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.command import Command, Data
from sliplens.cli.console import Terminal, say, wrote
from sliplens.files import require_new_file


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Look at a trial in the Rerun viewer: frames, differences, forces and labels on one clock.

    Needs the extra `view`: pip install "sliplens[view]". The viewer opens on this machine and listens to it alone; with
    --output a file is written instead, to be opened with `rerun FILE.rrd` wherever Rerun is installed.
    """

    data: Data
    trial: str | None = None
    """Name of the trial; the first of the data set if not given."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="FILE.rrd")] = None
    """File to write instead of opening the viewer."""

    def run(self) -> None:
        """Open the viewer, or write its file."""
        from sliplens.plots.viewer import open_viewer, require_rerun, require_rrd_path, write_rrd
        from sliplens.recordings import load_dataset

        require_rerun()
        if self.output is not None:
            require_rrd_path(self.output)
            require_new_file(self.output, overwrite=self.overwrite)
        data = load_dataset(self.data)
        info = data.trials[0] if self.trial is None else data.find(self.trial)
        with Terminal().stage(f"Reading {info.trial}") as bar:
            if self.output is None:
                open_viewer(data, info, on_progress=bar)
            else:
                write_rrd(data, info, self.output, on_progress=bar)
        if self.output is None:
            say(f"{info.trial} is in the Rerun viewer, {info.frames:,} frames")
            say("the viewer tells its makers that it is used, not what is seen; `rerun analytics disable` ends that")
        else:
            wrote(self.output, f"{info.trial}, {info.frames:,} frames; open it with `rerun {self.output}`")
