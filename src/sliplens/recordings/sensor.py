"""Sensor profiles: how the frames of a camera are prepared, as one small TOML file."""

import json
import re
import tomllib
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sliplens.errors import ImageError, InputError
from sliplens.files import MOST_TEXT, require_file, whole_file
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.labelling import ReferenceChoice
from sliplens.recordings.options import LabelSettings

_MOST_STRETCH = 0.02  # of width against height: markers stay round, and distances mean the same along both
_FLIPPED_AXES = {"none": (), "horizontal": 1, "vertical": 0, "both": (0, 1)}
_SHIPPED = Path(str(files("sliplens"))) / "sensors"
SENSORS_FOLDER = "sensors"
"""Folder in a data set with the profiles that its frames went through."""


@dataclass(frozen=True, kw_only=True)
class SensorProfile:
    """Facts about a sensor and its camera: how to prepare its frames, and how to label them.

    A frame is first brought to red, green and blue, then cropped, rotated, flipped and resized, in this order. Steps
    that are not set are left out.
    """

    name: str  #: Name of the sensor in trials and networks.
    camera_size_px: tuple[int, int] | None = None
    """Width and height of the frames to which the crop refers; it is scaled for others of the same shape."""
    colours: Literal["rgb", "rbg", "grb", "gbr", "brg", "bgr"] = "rgb"  #: Order in which the channels arrive.
    crop_px: tuple[int, int, int, int] | None = None  #: Left, top, width and height of the gel.
    rotate_deg: Literal[0, 90, 180, 270] = 0  #: Clockwise.
    flip: Literal["none", "horizontal", "vertical", "both"] = "none"  #: Horizontal swaps left and right.
    resize_px: tuple[int, int] | None = None  #: Width and height of prepared frames, of the same shape.
    markers: str | None = None  #: Kind of markers, a row of `markers.KINDS`; None where there are none, or unknown.
    reference_frame: int | None = None  #: Number of the untouched frame where the source has none.
    frame_rate_hz: float | None = None  #: Frame rate of images, and of videos whose stamps are missing or wrong.
    normal_axis: Literal["x", "y", "z"] | None = None  #: Axis of the force sensor that presses; estimated if None.
    normal_sign: Literal[1, -1] | None = None  #: 1 if pressing is positive as recorded, else -1; estimated if None.
    pull_direction_deg: float | None = None
    """Direction in which the object pulls, mostly that of gravity, in prepared frames: 0 is right, 90 down the image.
    Checked against the directions that a network was trained on."""
    network: str | None = None  #: Network for these frames: a folder, or the name of one that comes with sliplens.

    def __post_init__(self) -> None:
        # a data set stores the profile in a file of this name
        if not re.fullmatch(r"[A-Za-z0-9._-]+", self.name):
            raise ValueError(f"a sensor's name has letters, digits, dots, dashes and underscores, not {self.name!r}")
        for what, size in (("camera_size_px", self.camera_size_px), ("resize_px", self.resize_px)):
            if size is not None and min(size) <= 0:
                raise ValueError(f"{what} is {size}; widths and heights are positive")
        if self.crop_px is not None:
            if self.camera_size_px is None:
                raise ValueError("crop_px is in pixels of a frame; set its camera_size_px, too")
            x, y, width, height = self.crop_px
            inside = x + width <= self.camera_size_px[0] and y + height <= self.camera_size_px[1]
            if min(x, y) < 0 or min(width, height) <= 0 or not inside:
                raise ValueError(f"crop_px is {list(self.crop_px)}, not inside a frame of {list(self.camera_size_px)}")
        if self.pull_direction_deg is not None and not 0 <= self.pull_direction_deg < 360:
            raise ValueError(f"pull_direction_deg is {self.pull_direction_deg:g}; give 0 (right), 90 (down) up to 360")

    def output_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return height and width of a prepared frame, from those of the camera's frame."""
        x0, y0, x1, y1 = self._box(size)
        height, width = y1 - y0, x1 - x0
        if self.rotate_deg in {90, 270}:
            height, width = width, height
        if self.resize_px is None:
            return height, width
        wanted_width, wanted_height = self.resize_px
        if abs(wanted_width * height / (wanted_height * width) - 1) > _MOST_STRETCH:
            made = f"{width} x {height} to {wanted_width} x {wanted_height} pixels"
            raise ImageError(f"the profile {self.name} stretches {made}; crop to the same shape with its crop_px")
        return wanted_height, wanted_width

    def apply(self, frame: Frame) -> UInt8[np.ndarray, "rows columns 3"]:
        """Prepare a frame for networks and trackers of markers.

        Examples
        --------
        >>> import numpy as np
        >>> from sliplens.recordings.sensor import SensorProfile
        >>> tip = SensorProfile(name="tip", camera_size_px=(640, 480), crop_px=(80, 0, 480, 480), resize_px=(224, 224))
        >>> tip.apply(np.zeros((480, 640, 3), dtype=np.uint8)).shape
        (224, 224, 3)
        """
        size = frame.shape[0], frame.shape[1]
        height, width = self.output_size(size)
        if self.colours != "rgb":
            frame = frame[..., [self.colours.index(channel) for channel in "rgb"]]
        x0, y0, x1, y1 = self._box(size)
        frame = np.rot90(frame[y0:y1, x0:x1], k=-self.rotate_deg // 90)
        frame = np.ascontiguousarray(np.flip(frame, _FLIPPED_AXES[self.flip]))
        if frame.shape[:2] == (height, width):
            return frame
        # a triangle as wide as the step between new pixels: the noise of neighbours averages out instead of aliasing
        return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.BILINEAR))

    def prepare(self, capture: Capture) -> Capture:
        """Return a recording with prepared frames and reference, and the name of the sensor."""
        index, choice = capture.reference_index, capture.reference_choice
        if index is None and capture.reference is None and self.reference_frame is not None:
            index = self.reference_frame
            choice = ReferenceChoice(index=index, method=f"named by the profile {self.name}")
        if index is not None and not 0 <= index < len(capture):
            frames = f"{capture.source} has {len(capture)} frames but the profile {self.name} takes frame {index}"
            raise InputError(f"{frames} for the untouched sensor; name one that is there with --reference-frame")
        return replace(
            capture,
            sensor=self.name,
            frame_size=self.output_size(capture.frame_size),
            read_frames=lambda: map(self.apply, capture.read_frames()),
            reference=None if capture.reference is None else self.apply(capture.reference),
            reference_index=index,
            reference_choice=choice,
        )

    def settings(self, settings: LabelSettings) -> LabelSettings:
        """Return settings with the axis and sign of the profile where the user set none."""
        axis, sign = settings.normal_axis or self.normal_axis, settings.normal_sign or self.normal_sign
        return replace(settings, normal_axis=axis, normal_sign=sign)

    def _box(self, size: tuple[int, int]) -> tuple[int, int, int, int]:
        """Return the corners of the crop: x, y of the first pixel, and of the first one beyond."""
        rows, columns = size
        if self.camera_size_px is None:
            return 0, 0, columns, rows
        width, height = self.camera_size_px
        across, down = columns / width, rows / height
        if abs(across / down - 1) > _MOST_STRETCH:
            camera = f"is for a camera of {width} x {height}, and frames are {columns} x {rows}"
            raise ImageError(f"the profile {self.name} {camera}; make one with `sliplens sensor new`")
        x, y, width, height = self.crop_px or (0, 0, width, height)
        right, bottom = min(round((x + width) * across), columns), min(round((y + height) * down), rows)
        return round(x * across), round(y * down), right, bottom


def shipped_profiles() -> tuple[str, ...]:
    """List the names of the profiles that come with sliplens."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def load_profile(profile: Path | str | SensorProfile) -> SensorProfile:
    """Read a sensor profile: a TOML file, or the name of one that comes with sliplens.

    Examples
    --------
    >>> from sliplens.recordings.sensor import load_profile
    >>> load_profile("digit").camera_size_px
    (320, 240)
    """
    if isinstance(profile, SensorProfile):
        return profile
    path, names = Path(profile), shipped_profiles()
    if not path.exists() and str(profile) in names:
        path = _SHIPPED / f"{profile}.toml"
    if not path.is_file():
        raise InputError(f"there is no sensor profile {profile}; name a file, or one of {', '.join(names)}")
    require_file(path, most=MOST_TEXT)
    try:
        # Windows editors put a mark before the text that TOML does not know
        values = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}; correct it there") from None
    keys = [field.name for field in fields(SensorProfile)]
    if strange := sorted(set(values) - set(keys)):
        raise InputError(f"{path} has {strange[0]!r}, which no sensor profile has; choose from {', '.join(keys)}")
    try:
        return msgspec.convert(values, SensorProfile)
    except (msgspec.ValidationError, ValueError) as error:
        text, _, place = str(error).partition(" - at ")
        where = f" at {place.strip('`').removeprefix('$.')}" if place.strip("`") not in {"", "$"} else ""
        raise InputError(f"{path} is no sensor profile: {text}{where}; correct it there") from None


def is_profile(sensor: Path | str | SensorProfile) -> bool:
    """Return True for a profile, a name that looks like a file, or that of a profile that comes with sliplens."""
    like_a_file = re.search(r"[/\\]|\.[A-Za-z]+$", str(sensor)) is not None
    return isinstance(sensor, SensorProfile | Path) or str(sensor) in shipped_profiles() or like_a_file


def save_profile(profile: SensorProfile, path: Path, *, notes: tuple[str, ...] = ()) -> None:
    """Write a profile as TOML, with notes as comments before it."""
    # texts, numbers and lists of numbers are equal in JSON and TOML
    values = {name: json.dumps(value, ensure_ascii=False) for name, value in vars(profile).items() if value is not None}
    lines = [*(f"# {note}" for note in notes), *(f"{name} = {text}" for name, text in values.items()), ""]
    with whole_file(path) as part:
        part.write_text("\n".join(lines), encoding="utf-8")
