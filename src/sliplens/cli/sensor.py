"""`sliplens sensor`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sliplens.cli.command import Command
from sliplens.cli.console import print_table, say, wrote
from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK

_TASK = "new makes a profile, list shows those that come with sliplens."


@dataclass(frozen=True, kw_only=True)
class Sensor(Command):
    """Make the profile of your sensor from a recording: `sliplens sensor new --from tip.mp4 -o tip.toml`.

    Finds the gel's rectangle and the markers, proposes crop and size of the frames, and draws a picture beside the
    file. Check the picture, correct the file, and name it in --sensor of the other commands.
    """

    task: Annotated[Literal["new", "list"], tyro.conf.Positional, tyro.conf.arg(help=_TASK)]
    source: Annotated[Path | None, tyro.conf.arg(name="from", metavar="VIDEO")] = None
    """Video, bag or folder of images that begins with the sensor untouched."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="FILE.toml")] = None
    """Profile to write; the picture stands beside it as PNG."""
    name: str | None = None
    """Name of the sensor; that of the file if not given."""
    network: str = DEFAULT_NETWORK
    """Network for the frames, which are resized for it."""
    keep_size: bool = False
    """Keep the camera's resolution, to train a new network; the profile then names no network."""

    def run(self) -> None:
        """Propose, draw and write a profile, or list profiles."""
        from sliplens.recordings.sensor import load_profile, shipped_profiles

        if self.task == "list":
            shipped = {name: load_profile(name) for name in shipped_profiles()}
            rows = [
                (name, profile.markers or "none", str(profile.camera_size_px or "any"))
                for name, profile in shipped.items()
            ]
            print_table("Sensor profiles", ("name", "markers", "camera, width x height"), rows)
            return
        if self.source is None or self.output is None:
            raise InputError("give a recording and the file to write: sliplens sensor new --from VIDEO -o FILE.toml")
        from sliplens.files import require_new_file
        from sliplens.markers.gel import propose_profile
        from sliplens.models.checkpoint import read_manifest
        from sliplens.plots.figure import write_proposal
        from sliplens.recordings.sensor import profile_text

        require_new_file(self.output, suffix=".toml", overwrite=self.overwrite)
        network = None if self.keep_size else self.network
        height, width = (0, 0) if network is None else read_manifest(network).frame_size
        size_px = None if network is None else (width, height)
        name = self.name or self.output.stem
        proposal = propose_profile(self.source, name=name, network=network, size_px=size_px)
        self.output.write_text(profile_text(proposal.profile, notes=proposal.notes), encoding="utf-8")
        for sentence in proposal.notes:
            say(f"  {sentence}")
        wrote(self.output, "correct it where the picture shows an error")
        write_proposal(proposal, self.output.with_suffix(".png"))
        wrote(self.output.with_suffix(".png"), "a frame before and after the profile")
