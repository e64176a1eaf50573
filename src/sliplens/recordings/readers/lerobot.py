"""LeRobot v3 data sets of a tactile camera and a force sensor."""

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.readers.clocks import trial_name
from sliplens.recordings.readers.lerobot_frames import VideoInfo, image_frames, read_video_info, video_frames
from sliplens.recordings.readers.lerobot_kept import kept_captures, read_kept
from sliplens.recordings.readers.lerobot_layout import Episode, Layout, read_episodes, read_layout
from sliplens.recordings.readers.lerobot_rows import EpisodeRows

_TACTILE = re.compile(r"tactile|touch|gel|digit|tactip|fingertip|skin", re.IGNORECASE)
_FORCE = re.compile(r"force|wrench|(?<![a-z])f_?t(?![a-z])", re.IGNORECASE)
_TORQUE = re.compile(r"torque|moment|(?<![a-z])[tm]_?[xyz](?![a-z])", re.IGNORECASE)


def read_lerobot(
    folder: Path, *, camera_key: str | None = None, force_key: str | None = None, episode: int | None = None
) -> list[Capture]:
    """Read a data set, one trial an episode.

    Frames and forces are rows of one table: each force was taken with its frame, and both have its time, in seconds
    from the start of the episode. Frames of a video are those shown within half a frame of their row's time.

    Trials that `write_lerobot` exported come back as they were, with their labels; where a feature is named, like those
    of any data set.

    Parameters
    ----------
    folder
        Folder with `meta/info.json` of version 3.
    camera_key
        Feature with the images; by default the only camera, or the only one named like a tactile sensor.
    force_key
        Feature of 3 or 6 numbers, the first three the force (x, y, z); by default the only one named like a force.
    episode
        Index of an episode; all by default.

    Returns
    -------
    list of Capture
        In the order of the episodes.

    Raises
    ------
    RecordingError
        If the folder is no such data set, it is damaged, or a feature or episode is missing or one of several.
    """
    layout = read_layout(folder)
    if camera_key is None and force_key is None and (kept := read_kept(layout)) is not None:
        return kept_captures(layout, kept, episode=episode)
    camera, notes = _choose_camera(layout, camera_key)
    force = _choose_force(layout, force_key)
    if force is None:
        notes.append("There are no forces: no feature of 3 or 6 numbers is named like one.")
    read = _Reader(layout, camera=camera, force=force, notes=tuple(notes))
    return [read.capture(one) for one in read_episodes(layout, camera_key=camera, only=episode)]


class _Reader:
    """Reads episodes one after another; those of one file share what was read of it."""

    def __init__(self, layout: Layout, *, camera: str, force: str | None, notes: tuple[str, ...]) -> None:
        self.layout, self.camera, self.force, self.notes = layout, camera, force, notes
        self.rows = EpisodeRows(layout, ["timestamp", *([force] if force else [])])
        self.videos: dict[Path, VideoInfo] = {}

    def capture(self, episode: Episode) -> Capture:
        rows = self.rows.of(episode)
        time = rows.column("timestamp").to_numpy().astype(np.float64)
        source = f"episode {episode.index} of {self.layout.folder}"
        forces = None
        if self.force is not None:
            force = self.rows.vectors(rows, self.force, episode)[:, :3].copy()
            forces = Forces(time_s=time, force_n=force, source=f"{self.force} of {source}")
        size, read_frames, notes = self._frames(episode, time)
        return Capture(
            name=trial_name(f"{self.layout.folder.resolve().name}-{episode.index:06d}"),
            source=f"{self.camera} of {source}",
            frame_time_s=time,
            frame_size=size,
            read_frames=read_frames,
            forces=forces,
            notes=(*self.notes, *notes),
        )

    def _frames(
        self, episode: Episode, time: Float[np.ndarray, " frames"]
    ) -> tuple[tuple[int, int], Callable[[], Iterator[UInt8[np.ndarray, "height width 3"]]], list[str]]:
        if episode.video_file is None:
            return *image_frames(episode, self.camera), []
        video = self.videos.get(episode.video_file)
        if video is None:
            video = self.videos[episode.video_file] = read_video_info(episode.video_file)
        notes = []
        if video.lossy:
            notes.append(f"Frames are coded with loss ({video.codec}), which moves markers a little.")
        read = partial(
            video_frames,
            episode.video_file,
            episode.video_start_s + time,
            tolerance_s=0.5 / self.layout.fps,
            frame_size=video.frame_size,
        )
        return video.frame_size, read, notes


def _choose_camera(layout: Layout, named: str | None) -> tuple[str, list[str]]:
    cameras = [
        key
        for key, feature in layout.features.items()
        if feature["dtype"] in {"video", "image"} and not _is_depth(feature)
    ]
    if named is not None:
        if named not in cameras:
            raise RecordingError(f"{layout.folder} has no camera {named}; it has {_listed(cameras)}")
        return named, []
    tactile = [key for key in cameras if _TACTILE.search(key)]
    if len(tactile) == 1:
        return tactile[0], []
    if len(cameras) == 1:
        return cameras[0], [f"{cameras[0]} was taken for the tactile camera, for there is no other."]
    if not cameras:
        raise RecordingError(f"{layout.folder} has no camera; record one, as video or images")
    raise RecordingError(
        f"{layout.folder} has cameras {_listed(cameras)}, of which {_listed(tactile)} could be tactile; "
        "name the camera_key"
    )


def _choose_force(layout: Layout, named: str | None) -> str | None:
    fitting = [
        key
        for key, feature in layout.features.items()
        if feature["dtype"].startswith("float") and feature["shape"] in ([3], [6])
    ]
    if named is not None:
        if named not in layout.features:
            raise RecordingError(f"{layout.folder} has no feature {named}; 3 or 6 numbers have {_listed(fitting)}")
        if named not in fitting:
            feature = layout.features[named]
            raise RecordingError(
                f"{named} of {layout.folder} is {feature['dtype']} of shape {feature['shape']}; a force has 3 or 6 "
                "floating-point numbers"
            )
        found = [named]
    else:
        # what was commanded is not what was felt
        found = [key for key in fitting if _FORCE.search(key) and not key.startswith("action")]
        if len(found) > 1:
            raise RecordingError(f"{layout.folder} has forces {_listed(found)}; name the force_key")
    if not found:
        return None
    first = _names(layout.features[found[0]].get("names"))[:3]
    if any(_TORQUE.search(name) for name in first):
        raise RecordingError(f"{found[0]} of {layout.folder} begins with {', '.join(first)}; forces must come first")
    return found[0]


def _names(names: object) -> list[str]:
    """Names of the numbers of a feature, in the two shapes there are: a list, or lists by group."""
    groups = names.values() if isinstance(names, dict) else [names]
    return [str(name) for group in groups if isinstance(group, list) for name in group]


def _is_depth(feature: dict) -> bool:
    details = [feature.get(name) for name in ("info", "video_info")]
    return any(
        found.get("is_depth_map") or found.get("video.is_depth_map") for found in details if isinstance(found, dict)
    )


def _listed(keys: list[str]) -> str:
    return ", ".join(keys) or "none"
