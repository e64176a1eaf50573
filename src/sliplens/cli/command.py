"""What commands share: options that mean the same in several, and the call that hands options to the library."""

import re
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import tyro

from sliplens.cli.console import Terminal
from sliplens.errors import InputError
from sliplens.extras import require_device
from sliplens.files import find_run
from sliplens.recordings.options import Budget, ReadOptions

Result = TypeVar("Result")
NETWORK_HELP = "Folder of a trained network, or the name of one that comes with sliplens."
NetworkPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN", help=NETWORK_HELP)]
Data = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA", help="Data set to read.")]
Output = Annotated[Path, tyro.conf.arg(aliases=("-o",))]
SOURCE_HELP = "Data set, folder of images, video, ROS 2 bag, or whatever `sliplens import` reads."
Source = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE", help=SOURCE_HELP)]
TableFile = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE.parquet", help="File to write.")]
_FRICTION = (
    "Coefficient of friction of the object, where it is known: 0.62, a range such as 0.5..0.8, or mean and spread such "
    "as 0.58+-0.05."
)
Friction = Annotated[str | None, tyro.conf.arg(metavar="MU|LOW..HIGH|MU+-SD", help=_FRICTION)]
_SAME_OBJECT = "Every grasp is of one object: what a slip taught of its friction counts in the grasps that follow."
SameObject = Annotated[bool, tyro.conf.arg(help=_SAME_OBJECT)]
_SEQUENCE = "Read frames in order: what those before tell counts too; for a network of the recipe sequence."
InOrder = Annotated[bool, tyro.conf.arg(help=_SEQUENCE)]
On = Annotated[str, tyro.conf.arg(metavar="serial|processes[=N]|ray[=ADDRESS]", help="Where the work is done.")]
RetryFailed = Annotated[bool, tyro.conf.arg(help="Try again what failed three times before.")]
Device = Annotated[str, tyro.conf.arg(help="Where the network runs: cpu, cuda or cuda:1.")]


def require_network(name: Path | str) -> None:
    """Refuse a network that is not there, before torch is imported to load it."""
    find_run(Path(name))


def require_path(path: Path, *, what: str) -> None:
    """Refuse what does not exist, before what reads it is imported."""
    if not path.exists():
        raise InputError(f"{what} {path} does not exist; check the path")


def in_options(message: str, command: object) -> str:
    """Write the parameters that a message names as the options of a command that the user typed."""
    for name in sorted((field.name for field in fields(command)), key=len, reverse=True):  # pyright: ignore
        # in the middle of a sentence a single word may be just a word
        place = rf"(?<![\w-]){name}(?![\w-])" if "_" in name else rf"^{name}(?= (?:must|is \d|is -))"
        message = re.sub(place, f"--{name.replace('_', '-')}", message)
    return message


def option_names(command: object) -> list[str]:
    """Options of a command as they are typed, those of its groups among them."""
    groups = [value for value in vars(command).values() if is_dataclass(value)]
    own = [f"--{name.replace('_', '-')}" for name in vars(command)]
    return own + [name for group in groups for name in option_names(group)]


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command that writes; its options are named as the parameters of the library's calls are."""

    overwrite: bool = False
    """Replace what is there."""

    def check(self) -> None:
        """Refuse what is wrong at first sight, before anything is imported that takes seconds."""
        given = vars(self)
        if isinstance(network := given.get("model"), Path):
            require_network(network)
        for name, what in (("data", "the data set"), ("source", "the source"), ("reference", "the reference image")):
            if isinstance(path := given.get(name), Path):
                require_path(path, what=what)
        if isinstance(device := given.get("device"), str):
            require_device(device)

    def call(self, function: Callable[..., Result], **others: Any) -> Result:
        """Call the library with every option that it has a parameter for, and with what is named here."""
        options = {"on_progress": Terminal(), **vars(self)}
        takes = set(signature(function).parameters)
        for parameter in signature(function).parameters.values():
            if parameter.kind is parameter.VAR_KEYWORD:  # declared by a TypedDict
                (bag,) = get_args(get_type_hints(function)[parameter.name])
                takes |= set(bag.__annotations__)
        return function(**{**{name: value for name, value in options.items() if name in takes}, **others})


@dataclass(frozen=True, kw_only=True)
class SourceCommand(Command):
    """A command that reads frames of any source."""

    reference: Path | None = None
    """Image of the untouched sensor."""
    reference_frame: int | None = None
    """Number of the frame that shows the untouched sensor, in place of --reference."""
    split: str | None = None
    """Split of a data set to read, such as test; all if not given."""
    format: str | None = None
    """rosbag, lerobot, thesis, gelsight, images or video; recognised if not given."""
    frame_rate: float | None = None
    """Frames a second, for images, or where a video's stamps are missing or wrong."""
    image_topic: str | None = None
    """Topic of the images; the only one if not given."""
    camera_key: str | None = None
    """Feature of a LeRobot data set with the images."""
    allow_large: tuple[Budget, ...] = ()
    """Limits that do not hold, where a recording really is so large: frames, pixels, samples or span (of time)."""
    sensor: Path | None = None
    """Profile of the sensor: a file that `sliplens sensor new` made, or chromatouch, digit, gelsight-mini or tactip."""

    @property
    def options(self) -> ReadOptions:
        """What is said of the source, as the library takes it."""
        said = ("frame_rate", "image_topic", "camera_key", "allow_large")
        return ReadOptions(**{name: getattr(self, name) for name in said})
