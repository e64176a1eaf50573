"""`sliplens track`."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.command import On, RetryFailed, Source, SourceCommand, TableFile
from sliplens.cli.console import say, wrote
from sliplens.errors import InputError
from sliplens.files import require_new_file
from sliplens.progress import number_of


@dataclass(frozen=True, kw_only=True)
class Track(SourceCommand):
    """Track the markers of a data set, a folder of images, a video, or any recording.

    Writes a row for each marker of each frame: its place, its displacement from the untouched sensor (the first frame
    if neither you nor the source names one), and its status: followed, missing, broken, outside, new, or lost.
    """

    source: Source
    output: TableFile
    markers: str | None = None
    """Look of the markers: chromatouch, gelsight-mini, tactip, or auto; as --sensor says if not given."""
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE.mp4")] = None
    """Also write a clip with rings and arrows, of one trial."""
    trial: str | None = None
    """Name of one trial; all if not given."""
    on: On = "serial"
    retry_failed: RetryFailed = False

    def run(self) -> None:
        """Track and write."""
        from sliplens.markers.tracking import track
        from sliplens.plots.clip import clip_writer
        from sliplens.recordings.sensor import load_profile
        from sliplens.recordings.source import open_source

        profile = None if self.sensor is None else load_profile(self.sensor)
        markers = self.markers or (profile and profile.markers) or "auto"
        source = {"source": self.source, "options": self.options, "sensor": profile}
        clip = nullcontext()
        if self.video is not None:
            trials = self.call(open_source, **source)
            if len(trials) != 1:
                raise InputError(f"a clip shows one trial and {self.source} has {len(trials)}; name one with --trial")
            if self.on != "serial":
                raise InputError("a clip is drawn as its trial is followed; leave out --on, or --video")
            (trial,) = trials
            require_new_file(self.video, overwrite=self.overwrite)
            clip = clip_writer(self.video, size=trial.frame_size, frames_per_s=trial.frame_rate_hz)
        with clip as draw:
            tracking = self.call(track, **source, markers=markers, out=self.output, on_tracked=draw)
        for trial in tracking.trials:
            say(str(trial))
        count = number_of(len(tracking.trials), "trial")
        wrote(self.output, f"{number_of(tracking.frames, 'frame')} of {count}")
        if self.video is not None:
            wrote(self.video, "for the eye only: lossy video moves markers")
