"""`sliplens track`."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.console import Terminal, say, wrote
from sliplens.errors import InputError
from sliplens.files import require_new_file


@dataclass(frozen=True, kw_only=True)
class Track:
    """Follow the markers of a data set, a folder of images, a video, or any recording.

    Writes a row for each marker of each frame: where it is, how far it moved from the untouched sensor, and whether it
    was followed, missing, broken, outside, new, or lost.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Data set, folder of images, video, ROS 2 bag, or whatever `sliplens import` reads."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE.parquet")]
    """File to write."""
    markers: str = "auto"
    """What they look like: chromatouch, gelsight-mini, tactip, or auto."""
    reference: Path | None = None
    """Image of the untouched sensor; the first frame if the source names none."""
    reference_frame: int | None = None
    """Number of the frame that shows the untouched sensor, in place of --reference."""
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE.mp4")] = None
    """Also write a clip with rings and arrows, of one trial."""
    trial: str | None = None
    """Name of one trial; all if not given."""
    split: str | None = None
    """Trials of a data set; all if not given."""
    format: str | None = None
    """rosbag, lerobot, thesis, gelsight, images or video; recognised if not given."""
    frame_rate: float | None = None
    """Frames a second, for images, or where a video's stamps are missing or wrong."""
    image_topic: str | None = None
    """Topic of the images; the only one if not given."""
    camera_key: str | None = None
    """Feature of a LeRobot data set with the images."""
    overwrite: bool = False
    """Write the file anew if it exists."""

    def run(self) -> None:
        """Follow and write."""
        from sliplens.markers.tracking import track
        from sliplens.plots.clip import clip_writer
        from sliplens.recordings.options import ReadOptions
        from sliplens.recordings.source import open_source

        trials = open_source(
            self.source,
            reference=self.reference,
            reference_frame=self.reference_frame,
            split=self.split,
            trial=self.trial,
            format=self.format,
            options=ReadOptions(frame_rate=self.frame_rate, image_topic=self.image_topic, camera_key=self.camera_key),
        )
        clip = nullcontext()
        if self.video is not None:
            if len(trials) != 1:
                raise InputError(f"a clip shows one trial and {self.source} has {len(trials)}; name one with --trial")
            (trial,) = trials
            require_new_file(self.video, overwrite=self.overwrite)
            clip = clip_writer(self.video, size=trial.frame_size, frames_per_s=trial.frame_rate_hz)
        with clip as draw:
            tracking = track(
                trials,
                markers=self.markers,
                out=self.output,
                overwrite=self.overwrite,
                on_tracked=draw,
                on_progress=Terminal(),
            )
        for trial in tracking.trials:
            say(str(trial))
        count = len(tracking.trials)
        wrote(self.output, f"{tracking.frames:,} frames of {count} {'trial' if count == 1 else 'trials'}")
        if self.video is not None:
            wrote(self.video, "for the eye only: lossy video moves markers")
