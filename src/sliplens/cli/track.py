"""`sliplens track`."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens._version import __version__
from sliplens.cli.console import progress_bar, say, wrote
from sliplens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from sliplens.markers.sources import MarkedTrial
    from sliplens.markers.tracks import TrackWriter

_CLIP_RATE_HZ = 25.0


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
        from sliplens.extras import import_cv2
        from sliplens.markers.detect import get_kind
        from sliplens.markers.tracks import track_writer
        from sliplens.plots.clip import clip_writer

        self._check()
        get_kind(self.markers)
        import_cv2()
        trials = self._open()
        for note in dict.fromkeys(note for trial in trials for note in trial.notes):
            say(f"note: {note}")
        total = sum(trial.frames for trial in trials)
        clip = nullcontext()
        if self.video is not None:
            height, width = trials[0].read_reference().shape[:2]
            clip = clip_writer(self.video, size=(height, width), frames_per_s=_rate(trials[0]))
        metadata = {
            "sliplens.version": __version__,
            "sliplens.source": str(self.source),
            "sliplens.markers": self.markers,
        }
        told = []
        with (
            progress_bar("Following markers") as bar,
            track_writer(self.output, metadata=metadata) as writer,
            clip as show,
        ):
            done = 0
            for trial in trials:
                told.append(
                    _follow(trial, self.markers, writer, show, lambda here, before=done: bar(before + here, total))
                )
                done += trial.frames
        for line in told:
            say(line)
        wrote(self.output, f"{total:,} frames of {len(trials)} {'trial' if len(trials) == 1 else 'trials'}")
        if self.video is not None:
            wrote(self.video, "for the eye only: lossy video moves markers")

    def _open(self) -> "list[MarkedTrial]":
        from sliplens.markers.sources import open_marked
        from sliplens.recordings.options import ReadOptions

        trials = open_marked(
            self.source,
            split=self.split,
            reference=self.reference,
            reference_frame=self.reference_frame,
            format=self.format,
            options=ReadOptions(frame_rate=self.frame_rate, image_topic=self.image_topic, camera_key=self.camera_key),
        )
        if self.trial is not None:
            names = [trial.name for trial in trials]
            if self.trial not in names:
                raise InputError(f"{self.source} has no trial {self.trial}; choose one such as {names[0]}")
            trials = [trials[names.index(self.trial)]]
        if self.video is not None and len(trials) > 1:
            raise InputError(f"a clip shows one trial and {self.source} has {len(trials)}; name one with --trial")
        return trials

    def _check(self) -> None:
        if self.output.suffix != ".parquet":
            raise InputError(f"{self.output} does not end in .parquet; name the file to write so")
        for path in (self.output, self.video):
            if path is not None and path.exists() and not self.overwrite:
                raise InputError(f"{path} exists; choose another file or pass --overwrite")


def _rate(trial: "MarkedTrial") -> float:
    import numpy as np

    if trial.time_s is None or len(trial.time_s) < 2:
        return _CLIP_RATE_HZ
    return float(np.clip(1 / np.median(np.diff(trial.time_s)), 1, 120))


def _follow(
    trial: "MarkedTrial",
    kind: str,
    writer: "TrackWriter",
    show: "Callable | None",
    on_frames: "Callable[[int], None]",
) -> str:
    """Follow one trial; gives a line on how it went."""
    from sliplens.markers import MarkerStatus, Tracker

    tracker = Tracker(trial.read_reference(), kind)
    rest, followed, seen, lost = tracker.rest.centre_px, 0, 0, 0
    for number, frame in enumerate(trial.read_frames()):
        tracked = tracker.update(frame)
        time_s = None if trial.time_s is None else float(trial.time_s[number])
        writer.add(trial.name, number, tracked, rest_px=rest, time_s=time_s)
        if show is not None:
            show(frame, tracked, rest)
        status = tracked.status[: len(rest)]
        followed += int((status == MarkerStatus.FOLLOWED).sum())
        seen += int((status != MarkerStatus.OUTSIDE).sum())
        lost += bool((status == MarkerStatus.LOST).all())
        on_frames(number + 1)
    share = f"{100 * followed / max(1, seen):.1f} % followed while in view"
    return f"{trial.name}: {len(rest)} markers, {share}" + (f", lost in {lost} frames" if lost else "")
