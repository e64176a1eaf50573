"""Clips to watch: a trial beside its difference images, or frames with their markers."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw, ImageFont

from sliplens.errors import InputError
from sliplens.extras import import_cv2
from sliplens.images import absolute_difference
from sliplens.markers.tracker import MarkerStatus, Tracks
from sliplens.plots.contact_sheet import (
    STATE_COLOURS,
    TIMES,
    brighten,
    brightening,
    enlarge,
    paint_outlines,
    to_bytes,
)
from sliplens.plots.style import BLACK, VERMILLION, YELLOW, percent, written_whole
from sliplens.progress import report_each
from sliplens.recordings import Recording

_SAMPLES = 32  # frames that set the brightness of all
_FOOT, _LETTERS = 60, 20


def write_clip(recording: Recording, path: Path, *, frames_per_s: float = 30.0) -> None:
    """Write a trial as an MP4 that plays at real speed; it appears when complete.

    It shows the camera frames, with outlines of the true contact and stick zone of simulated trials, beside the
    difference images, and time, margin, contact state and forces below. Lossy video moves markers: measure in the
    recording, never in its clip.
    """
    require_clip_path(path)
    some = recording.frames[:: -(-len(recording) // _SAMPLES)]
    factor = brightening([absolute_difference(some, recording.reference)])
    size = _draw_frame(recording, 0, factor).shape[:2]
    with _open_clip(path, size, frames_per_s) as add:
        for index in report_each(clip_frames(recording.time_s, frames_per_s).tolist()):
            add(_draw_frame(recording, index, factor))


def require_clip_path(path: Path) -> None:
    """Check that a file name is that of a clip."""
    if path.suffix.lower() != ".mp4":
        raise InputError(f"{path} does not end in .mp4; name a clip, such as trial.mp4")


def clip_frames(time_s: Float[np.ndarray, " frames"], frames_per_s: float) -> Int[np.ndarray, " clip"]:
    """Find the recorded frame nearest in time to each frame of the clip; the last is shown for a typical interval."""
    last_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1 / frames_per_s
    count = max(1, round((time_s[-1] - time_s[0] + last_s) * frames_per_s))
    return np.searchsorted((time_s[1:] + time_s[:-1]) / 2, time_s[0] + np.arange(count) / frames_per_s)


def _draw_frame(recording: Recording, index: int, factor: float) -> UInt8[np.ndarray, "rows columns 3"]:
    """Draw a camera frame, its difference image, and a line of numbers below both."""
    frame, margin, state = recording.frames[index], recording.safety_margin[index], recording.contact_state[index]
    camera = enlarge(frame)
    if recording.truth is not None:
        paint_outlines(camera, recording.truth.contact_map[index])
    difference = enlarge(brighten(absolute_difference(frame, recording.reference), factor))
    pixels = np.concatenate([camera, difference], axis=1)
    height, width = (side // 2 * 2 for side in pixels.shape[:2])  # H.264 keeps one colour for two by two pixels
    image = Image.new("RGB", (max(width, 640), height + _FOOT), "white")
    image.paste(Image.fromarray(pixels[:height, :width]))
    draw = ImageDraw.Draw(image)
    # matplotlib brings the font along: the same letters on every machine
    font = ImageFont.truetype(Path(mpl.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"), _LETTERS)
    force, pull = recording.normal_force_n[index], recording.tangential_force_n[index]
    words = f"{recording.time_s[index]:.2f} s   Γ {percent(None if np.isnan(margin) else float(margin))}   {state}"
    draw.rectangle((6, height + 8, 20, height + 22), fill=STATE_COLOURS[state])
    draw.text((28, height + 3), words, fill=BLACK, font=font)
    words = f"Fₙ {force:.2f} N   Fₜ {pull:.2f} N   difference {TIMES} {factor:g}"
    draw.text((28, height + 30), words, fill=BLACK, font=font)
    return np.asarray(image)


_COLOURS = {MarkerStatus.FOLLOWED: YELLOW, MarkerStatus.BROKEN: VERMILLION}
_LEAST_SIDE = 640
_MAGNIFIED = 3  # arrows, so that a pixel of motion shows


def draw_tracked(
    frame: UInt8[np.ndarray, "height width 3"], tracked: Tracks, scale: int
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Draw a ring round every detected marker of an enlarged frame, and a magnified arrow along its displacement.

    Followed markers are yellow, broken ones orange.
    """
    cv2 = import_cv2()
    picture = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    for index, status in enumerate(tracked.status.tolist()):
        if status not in _COLOURS:
            continue
        start = np.rint((tracked.position_px[index] + 0.5) * scale - 0.5).astype(int)
        radius = round(float(tracked.radius_px[index]) * scale)
        cv2.circle(picture, start.tolist(), radius, to_bytes(_COLOURS[status]), scale)
        if status == MarkerStatus.FOLLOWED:
            end = start + np.rint((tracked.position_px[index] - tracked.rest_px[index]) * scale * _MAGNIFIED).astype(
                int
            )
            # dark below bright: visible on any ground
            for colour, width in ((BLACK, scale + 2), ("white", scale)):
                cv2.arrowedLine(picture, start.tolist(), end.tolist(), to_bytes(colour), width, tipLength=0.3)
    return picture


@contextmanager
def clip_writer(
    path: Path, *, size: tuple[int, int], frames_per_s: float
) -> Iterator[Callable[[UInt8[np.ndarray, "height width 3"], Tracks], None]]:
    """Write an MP4 of frames with their markers; it appears when complete.

    Gives a function that adds a frame of that height and width, and its markers. Lossy video moves
    markers: measure in the table, never in its clip.
    """
    scale = max(1, _LEAST_SIDE // max(size))
    rows, columns = (side * scale // 2 * 2 for side in size)
    with _open_clip(path, (rows, columns), frames_per_s) as add:
        yield lambda frame, tracked: add(draw_tracked(frame, tracked, scale)[:rows, :columns])


@contextmanager
def _open_clip(
    path: Path, size: tuple[int, int], frames_per_s: float
) -> Iterator[Callable[[UInt8[np.ndarray, "rows columns 3"]], None]]:
    """Open a clip of an even height and width; gives a function that adds a picture."""
    require_clip_path(path)
    if not 1 <= frames_per_s <= 120:
        raise InputError(f"{frames_per_s:g} frames a second cannot be watched; ask for 25 to 30")
    import av  # noqa: PLC0415 (it brings all of FFmpeg, and only clips need it)

    with (
        written_whole(path) as part,
        # the index comes first, so that a browser plays before it has all
        av.open(str(part), "w", format="mp4", options={"movflags": "faststart"}) as container,
    ):
        rate = Fraction(frames_per_s).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate, options={"crf": "20", "preset": "veryfast"})
        stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
        # BT.601, into which FFmpeg converts RGB: without it players guess by the size
        stream.codec_context.colorspace = 5
        yield lambda pixels: container.mux(
            stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24"))
        )
        container.mux(stream.encode())
