"""Clips to watch: a trial with its forces and labels, or frames with their markers."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import binary_dilation

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.markers.tracks import MarkerStatus, TrackedFrame
from sliplens.plots.contact_sheet import (
    STATE_COLOURS,
    TIMES,
    brighten,
    brightening,
    outline_handles,
    plot_forces,
    plot_margin,
)
from sliplens.plots.style import BLACK, GREY, PURPLE, SKY, VERMILLION, YELLOW, drawing_style, percent, written_whole
from sliplens.progress import track
from sliplens.recordings import Recording
from sliplens.recordings.trial import OUTSIDE, STICKS

_SLOWEST, _FASTEST = 25, 30  # frames a second that every player shows smoothly
_SAMPLES = 32  # frames that set the brightness of all
# pixels; pictures are enlarged up to the first size and reduced down to the second one, given as (height, width)
_SMALL, _LARGE = (480, 640), (720, 960)
_DPI, _EDGE, _HEAD, _FOOT, _AXIS, _CHART, _STATUS, _LEAST = 100, 18, 74, 54, 76, 560, 84, 448


class _Stage(NamedTuple):
    """Constant part of a clip's frames, and the places of the rest, in pixels as (top, left)."""

    factor: float  # of the differences' brightness
    still: UInt8[np.ndarray, "rows columns 3"]
    places: tuple[tuple[int, int], ...]  # of the camera frame, the difference image and the state
    cursor_rows: slice
    cursor_column: Callable[[float], int]  # of a time in seconds


def write_clip(recording: Recording, path: Path, *, frames_per_s: float | None = None) -> None:
    """Write a trial as an MP4 that plays at real speed; it appears when complete.

    It shows the camera frames, outlines of the true contact and stick zone of simulated trials, the difference images,
    and the forces and safety margin under a moving cursor. Lossy video moves markers: measure in the recording, never
    in its clip.

    Frames of the recording are repeated or left out to keep time; by default the clip has its frames a second if they
    are between 25 and 30, otherwise 30.
    """
    rate = natural_rate(recording.time_s) if frames_per_s is None else frames_per_s
    require_clip_path(path)
    stage = _set_stage(recording)
    with _open_clip(path, stage.still.shape[:2], rate) as add:
        indices = clip_frames(recording.time_s, rate)
        for _, pixels in zip(track(indices), _draw_frames(recording, indices, stage, rate), strict=True):
            add(pixels)


def require_clip_path(path: Path) -> None:
    """Check that a file name is that of a clip."""
    if path.suffix.lower() != ".mp4":
        raise InputError(f"{path} does not end in .mp4; name a clip, such as trial.mp4")


def natural_rate(time_s: Float[np.ndarray, " frames"]) -> float:
    """Choose the frames a second of a clip: those of the recording where players show them smoothly, otherwise 30."""
    rate = round(1 / _interval(time_s, otherwise=1 / _FASTEST), 2)  # stored times are rounded
    return rate if _SLOWEST <= rate <= _FASTEST else float(_FASTEST)


def clip_frames(time_s: Float[np.ndarray, " frames"], frames_per_s: float) -> Int[np.ndarray, " clip"]:
    """Find the recorded frame nearest in time to each frame of the clip; the last is shown for a typical interval."""
    duration = time_s[-1] - time_s[0] + _interval(time_s, otherwise=1 / frames_per_s)
    moments = time_s[0] + np.arange(max(1, round(duration * frames_per_s))) / frames_per_s
    return np.searchsorted((time_s[1:] + time_s[:-1]) / 2, moments)


def _interval(time_s: Float[np.ndarray, " frames"], *, otherwise: float) -> float:
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else otherwise


def _draw_frames(
    recording: Recording, indices: Int[np.ndarray, " clip"], stage: _Stage, frames_per_s: float
) -> Iterator[UInt8[np.ndarray, "rows columns 3"]]:
    scene, drawn = stage.still.copy(), None
    for place, index in enumerate(indices.tolist()):
        if index != drawn:
            frame, drawn = recording.frames[index], index
            camera = _resize(frame)
            if recording.truth is not None:
                paint_outlines(camera, recording.truth.contact_map[index])
            difference = _resize(brighten(absolute_difference(frame, recording.reference), stage.factor))
            pictures = (camera, difference, _draw_state(recording, index))
            for picture, (y, x) in zip(pictures, stage.places, strict=True):
                scene[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
        pixels = scene.copy()
        column = stage.cursor_column(min(recording.time_s[0] + place / frames_per_s, recording.time_s[-1]))
        pixels[stage.cursor_rows, column - 1 : column + 2] = _bytes(PURPLE)
        yield pixels


def _set_stage(recording: Recording) -> _Stage:
    some = recording.frames[:: -(-len(recording) // _SAMPLES)]
    factor = brightening([absolute_difference(some, recording.reference)])
    rows, columns = _resize(recording.reference).shape[:2]
    second, charts = 2 * _EDGE + columns, 3 * _EDGE + 2 * columns + _AXIS
    # even sizes: H.264 keeps one colour for two by two pixels
    width, height = -(-(charts + _CHART + _EDGE) // 2) * 2, -(-(_HEAD + max(rows, _LEAST) + _FOOT) // 2) * 2
    first, last = _HEAD + _STATUS, height - _FOOT
    middle = first + round(0.55 * (last - first))
    title = f"{recording.trial}: {recording.condition}, day {recording.day}, {recording.sensor}"
    small = {"fontsize": 8, "ha": "right", "color": GREY}
    with drawing_style():
        figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
        canvas = FigureCanvasAgg(figure)
        forces, margin = (
            figure.add_axes((charts / width, 1 - end / height, _CHART / width, (end - begin) / height))
            for begin, end in ((first, middle - 8), (middle + 8, last))
        )
        plot_forces(recording, ax=forces).tick_params(labelbottom=False)
        plot_margin(recording, ax=margin)
        figure.align_ylabels([forces, margin])
        for x, y, text, settings in (
            (_EDGE, 32, title, {"fontsize": 13, "fontweight": "bold", "parse_math": False}),
            (_EDGE, _HEAD - 8, "camera", {}),
            (second, _HEAD - 8, f"difference $|T_n - T_0|$ {TIMES} {factor:g}", {}),
            (second + columns, height - 20, "for the eye only: lossy video", small),
        ):
            figure.text(x / width, 1 - y / height, text, **settings)
        at = (_EDGE / width, 16 / height)
        figure.legend(
            handles=outline_handles([recording]), loc="lower left", bbox_to_anchor=at, ncols=2, borderaxespad=0
        )
        canvas.draw()
    return _Stage(
        factor=factor,
        still=np.asarray(canvas.buffer_rgba())[..., :3].copy(),
        places=((_HEAD, _EDGE), (_HEAD, second), (_EDGE, charts)),
        cursor_rows=slice(first, last),
        cursor_column=lambda time_s: round(float(forces.transData.transform((time_s, 0))[0])),
    )


def _draw_state(recording: Recording, index: int) -> UInt8[np.ndarray, "rows columns 3"]:
    image = Image.new("RGB", (_CHART, 100), "white")
    draw, margin, state = ImageDraw.Draw(image), float(recording.safety_margin[index]), recording.contact_state[index]
    force, pull = recording.normal_force_n[index], recording.tangential_force_n[index]
    numbers = f"{recording.time_s[index]:.2f} s   Fₙ {force:.2f} N   Fₜ {pull:.2f} N"
    draw.text((0, 78), f"Γ {percent(None if np.isnan(margin) else margin)}", fill=BLACK, font=_font(64), anchor="ls")
    draw.rectangle((302, 22, 324, 44), fill=STATE_COLOURS[state])
    draw.text((336, 43), str(state), fill=BLACK, font=_font(25), anchor="ls")
    draw.text((302, 77), numbers, fill=GREY, font=_font(16), anchor="ls")
    return np.asarray(image)


@cache
def _font(size_px: int) -> ImageFont.FreeTypeFont:
    # matplotlib brings it along: the same letters on every machine
    return ImageFont.truetype(Path(mpl.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"), size_px)


def _scale(height: int, width: int) -> tuple[int, int]:
    """Choose whole factors to enlarge and to reduce a picture by, one of them 1."""
    return max(1, min(_SMALL[0] // height, _SMALL[1] // width)), max(-(-height // _LARGE[0]), -(-width // _LARGE[1]))


def _resize(pixels: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
    up, down = _scale(*pixels.shape[:2])
    image = Image.fromarray(pixels).reduce(down)
    return np.array(image.resize((image.width * up, image.height * up), Image.Resampling.LANCZOS))


def paint_outlines(camera: UInt8[np.ndarray, "rows columns 3"], contact: UInt8[np.ndarray, "height width"]) -> None:
    """Paint white around the contact, and blue inside its stick zone, both with a dark rim: neither hides the other."""
    up, down = _scale(*contact.shape)
    contact = contact[::down, ::down].repeat(up, axis=0).repeat(up, axis=1)
    touches, loose = contact != OUTSIDE, contact != STICKS
    for zone, steps, colour in ((touches, 3, BLACK), (touches, 2, "white"), (loose, 3, BLACK), (loose, 2, SKY)):
        camera[binary_dilation(zone, iterations=steps) & ~zone] = _bytes(colour)


def _bytes(colour: str) -> UInt8[np.ndarray, "3"]:
    return np.round(255 * np.array(to_rgb(colour))).astype(np.uint8)


_COLOURS = {MarkerStatus.FOLLOWED: YELLOW, MarkerStatus.BROKEN: VERMILLION, MarkerStatus.NEW: SKY}
_LEAST_SIDE = 640
_MAGNIFIED = 3  # arrows, so that a pixel of motion shows


def draw_tracked(
    frame: UInt8[np.ndarray, "height width 3"], tracked: TrackedFrame, rest_px: np.ndarray, scale: int
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Draw a ring round every detected marker of an enlarged frame, and a magnified arrow along its displacement.

    Followed markers are yellow, broken ones orange, new ones blue.
    """
    image = Image.fromarray(frame).resize((frame.shape[1] * scale, frame.shape[0] * scale), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(image)
    markers = zip(tracked.position_px, tracked.radius_px, tracked.status.tolist(), strict=True)
    for index, (place, radius, status) in enumerate(markers):
        if status not in _COLOURS:
            continue
        colour = _COLOURS[status]
        x, y = (place + 0.5) * scale - 0.5
        reach = radius * scale
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), outline=colour, width=scale)
        if status == MarkerStatus.FOLLOWED:
            shift = (place - rest_px[index]) * scale * _MAGNIFIED
            _arrow(draw, (x, y), (x + shift[0], y + shift[1]), width=scale)
    return np.asarray(image)


def _arrow(draw: ImageDraw.ImageDraw, start: tuple[float, float], end: tuple[float, float], *, width: int) -> None:
    way = np.subtract(end, start)
    length = float(np.hypot(*way))
    if length < 1:
        return
    head = way / length * min(5.0 * width, length / 2)
    side = np.array([-head[1], head[0]]) * 0.5
    tip = np.array(end)
    corners = [tuple(tip), tuple(tip - head + side), tuple(tip - head - side)]
    # dark below bright: visible on any ground
    draw.line([start, end], fill="black", width=width + 2)
    draw.line([start, end], fill="white", width=width)
    draw.polygon(corners, fill="white", outline="black")


@contextmanager
def clip_writer(
    path: Path, *, size: tuple[int, int], frames_per_s: float
) -> Iterator[Callable[[UInt8[np.ndarray, "height width 3"], TrackedFrame, Float[np.ndarray, "markers 2"]], None]]:
    """Write an MP4 of frames with their markers; it appears when complete.

    Gives a function that adds a frame of that height and width, its markers and their places at rest. Lossy video moves
    markers: measure in the table, never in its clip.
    """
    scale = max(1, _LEAST_SIDE // max(size))
    # H.264 keeps one colour for two by two pixels
    rows, columns = (side * scale // 2 * 2 for side in size)
    with _open_clip(path, (rows, columns), frames_per_s) as add:
        yield lambda frame, tracked, rest_px: add(draw_tracked(frame, tracked, rest_px, scale)[:rows, :columns])


@contextmanager
def _open_clip(
    path: Path, size: tuple[int, int], frames_per_s: float
) -> Iterator[Callable[[UInt8[np.ndarray, "rows columns 3"]], None]]:
    """Open a clip of a height and width; gives a function that adds a picture."""
    require_clip_path(path)
    if not 1 <= frames_per_s <= 120:
        raise InputError(f"{frames_per_s:g} frames a second cannot be watched; ask for {_SLOWEST} to {_FASTEST}")
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
