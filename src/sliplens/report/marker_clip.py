"""A clip of the markers for people to watch: rings where they are, arrows from where they were."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from sliplens.errors import InputError
from sliplens.markers.tracks import MarkerStatus, TrackedFrame

# Okabe and Ito's palette, told apart under every common colour blindness; as the figures
_COLOURS = {
    MarkerStatus.FOLLOWED: "#F0E442",
    MarkerStatus.BROKEN: "#D55E00",
    MarkerStatus.NEW: "#56B4E9",
}
_LEAST_SIDE = 640
_MAGNIFIED = 3  # arrows, so that a pixel of motion shows


def draw_tracked(
    frame: UInt8[np.ndarray, "height width 3"],
    tracked: TrackedFrame,
    *,
    rest_px: Float[np.ndarray, "markers 2"],
    scale: int = 1,
    magnified: float = _MAGNIFIED,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Frame with a ring round every marker that is seen and an arrow along its displacement.

    Yellow was followed, orange is broken, blue is new; what is missing has no ring.

    Parameters
    ----------
    frame
        RGB.
    tracked
        Its markers.
    rest_px
        Where those of the reference frame were.
    scale
        Whole factor by which the picture is enlarged.
    magnified
        Length of an arrow over the displacement.
    """
    image = Image.fromarray(frame).resize((frame.shape[1] * scale, frame.shape[0] * scale), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(image)
    for index, (place, radius, status) in enumerate(
        zip(tracked.position_px, tracked.radius_px, tracked.status.tolist(), strict=True)
    ):
        colour = _COLOURS.get(MarkerStatus(status))
        if colour is None:
            continue
        x, y = (place + 0.5) * scale - 0.5
        reach = radius * scale
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), outline=colour, width=max(1, scale))
        if status == MarkerStatus.FOLLOWED:
            shift = (place - rest_px[index]) * scale * magnified
            _arrow(draw, (x, y), (x + shift[0], y + shift[1]), width=max(1, scale))
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
    # dark below bright: seen on any ground
    draw.line([start, end], fill="black", width=width + 2)
    draw.line([start, end], fill="white", width=width)
    draw.polygon(corners, fill="white", outline="black")


@contextmanager
def clip_writer(
    path: Path, *, size: tuple[int, int], frames_per_s: float
) -> Iterator[Callable[[UInt8[np.ndarray, "height width 3"], TrackedFrame, Float[np.ndarray, "markers 2"]], None]]:
    """Write an MP4 of frames with their markers; it appears when complete, and not at all when something fails.

    It is for the eye only: lossy video moves markers, so measure in the table, never in its clip.

    Parameters
    ----------
    path
        File to write, .mp4 (H.264).
    size
        Height and width of the frames, in pixels.
    frames_per_s
        Frames a second of the clip, 1 to 120.

    Yields
    ------
    Callable
        Takes a frame, its markers and where they were at rest.

    Raises
    ------
    InputError
        If the suffix is another one, the rate lies outside 1 to 120, or the file cannot be written.
    """
    if path.suffix.lower() != ".mp4":
        raise InputError(f"{path} does not end in .mp4; name a clip, such as markers.mp4")
    if not 1 <= frames_per_s <= 120:
        raise InputError(f"{frames_per_s:g} frames a second cannot be watched; ask for 1 to 120")
    import av  # noqa: PLC0415 (it brings all of FFmpeg, and only clips need it)

    scale = max(1, _LEAST_SIDE // max(size))
    # H.264 keeps one colour for two by two pixels
    rows, columns = (side * scale // 2 * 2 for side in size)
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(part), "w", format="mp4", options={"movflags": "faststart"}) as container:
            rate = Fraction(frames_per_s).limit_denominator(1001)
            stream = container.add_stream("libx264", rate=rate, options={"crf": "20", "preset": "veryfast"})
            stream.height, stream.width, stream.pix_fmt = rows, columns, "yuv420p"

            def add(
                frame: UInt8[np.ndarray, "height width 3"],
                tracked: TrackedFrame,
                rest_px: Float[np.ndarray, "markers 2"],
            ) -> None:
                pixels = draw_tracked(frame, tracked, rest_px=rest_px, scale=scale)[:rows, :columns]
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")))

            yield add
            container.mux(stream.encode())
        part.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror or error}); choose another file") from None
    finally:
        with suppress(OSError):  # it has its name by now, or could not be made
            part.unlink()
