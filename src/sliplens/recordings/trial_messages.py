"""A labelled trial as ROS 2 messages: the topics, the messages that are ours, and the text that tells what it is."""

import json
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Told
from sliplens.recordings.given import GIVEN_SIGNALS
from sliplens.recordings.readers.clocks import trial_name

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

FORMAT, VERSION = "sliplens trial", 1
"""What the text of a trial calls itself."""

TRIAL, REFERENCE, IMAGE = "/tactile/trial", "/tactile/reference", "/tactile/image"
LABELS, MARGIN = "/tactile/labels", "/tactile/safety_margin"
WRENCH, WRENCH_TIMES = "/tactile/wrench", "/tactile/wrench_times"
TOPICS = {
    TRIAL: "std_msgs/msg/String",
    REFERENCE: "sensor_msgs/msg/CompressedImage",
    IMAGE: "sensor_msgs/msg/CompressedImage",
    LABELS: "sliplens_msgs/msg/SafetyMargin",
    MARGIN: "std_msgs/msg/Float64",
    WRENCH: "geometry_msgs/msg/WrenchStamped",
    WRENCH_TIMES: "sliplens_msgs/msg/SampleTimes",
}
"""Types of the messages; wrenches and their times are there where forces are known."""

NUMBERS = ("time_s", *GIVEN_SIGNALS, "safety_margin_sigma")
"""The numbers of a frame, named as in its message."""
OPTIONAL = ("safety_margin_sigma", "valid", "reason")
"""What labels may lack, though the message of each frame has room for it."""

_DEFINITIONS = {
    "sliplens_msgs/msg/SafetyMargin": """
std_msgs/Header header
float64 time_s
float64 normal_force_n
float64 tangential_force_n
float64 friction_coefficient
float64 safety_margin
float64 safety_margin_sigma
float64 stick_ratio
bool valid
string contact_state
string invalid_reason
""",
    "sliplens_msgs/msg/SampleTimes": """
std_msgs/Header header
float64[] time_s
""",
}
_LONGEST = 2**24
"""Characters of a text that is parsed; those of a trial are some thousands."""
_TOLD = {"sensor": str, "day": int, "condition": str, "object": str, "split": str, "simulated": bool}


def trial_types() -> "Typestore":
    """Messages of ROS 2 and ours: from these definitions, never from a file's, for `rosbags` turns them into code."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 (an extra)

    types = get_typestore(Stores.LATEST)
    for kind, definition in _DEFINITIONS.items():
        types.register(get_types_from_msg(definition, kind))
    return types


@dataclass(frozen=True, kw_only=True)
class TrialText:
    """What a trial is, and how many messages of each kind belong to it."""

    trial: str
    told: Told
    frames: int
    force_samples: int
    """0 where no force is known."""
    force_source: str
    """Topic, file or column names, for people."""
    optional: tuple[str, ...]
    """Those of `OPTIONAL` that the labels have."""
    labelling: dict[str, Any] | None
    """What the labels rest on."""

    def dump(self, **more: Any) -> str:
        """Text of `/tactile/trial`; `more` is for people and not read back."""
        return json.dumps(
            {"format": FORMAT, "version": VERSION, **asdict(self), **more}, allow_nan=False, ensure_ascii=False
        )

    @classmethod
    def parse(cls, text: str, *, where: str) -> "TrialText":
        """Read what `dump` wrote, believing nothing.

        Parameters
        ----------
        text
            JSON.
        where
            Beginning of the error message.

        Raises
        ------
        RecordingError
            If the text is damaged or of another version.
        """
        if len(text) > _LONGEST:
            raise RecordingError(f"{where} has {len(text)} characters, no description does; export the trial again")
        try:
            table = json.loads(text)
            # what JSON of another hand can hold and ours cannot: infinite numbers, halves of characters
            json.dumps(table, allow_nan=False, ensure_ascii=False).encode()
        except (ValueError, RecursionError) as error:
            raise RecordingError(f"{where} is no JSON ({error}); export the trial again") from None
        if not isinstance(table, dict) or table.get("format") != FORMAT:
            raise RecordingError(f"{where} does not describe a {FORMAT}; export the trial again")
        if table.get("version") != VERSION:
            raise RecordingError(
                f"{where} is of version {str(table.get('version'))[:20]}, this sliplens reads {VERSION}; update it"
            )
        wrong = [name for name, fits in _FITS.items() if name not in table or not fits(table[name])]
        if wrong:
            raise RecordingError(f"{where} has no proper {', '.join(wrong)}; export the trial again")
        values = {field.name: table[field.name] for field in fields(cls)}
        return cls(**{**values, "told": Told(**values["told"]), "optional": tuple(values["optional"])})


def _fits_told(value: object) -> bool:
    if not isinstance(value, dict) or set(value) != set(_TOLD):
        return False
    return all(type(value[name]) is kind or (value[name] is None and kind is not bool) for name, kind in _TOLD.items())


def _fits_count(value: object) -> bool:
    return type(value) is int and value >= 0


_FITS = {
    # it becomes the name of a file
    "trial": lambda value: isinstance(value, str) and trial_name(value) == value,
    "told": _fits_told,
    "frames": lambda value: _fits_count(value) and value > 0,
    "force_samples": _fits_count,
    "force_source": lambda value: isinstance(value, str),
    "optional": lambda value: isinstance(value, list) and all(name in OPTIONAL for name in value),
    "labelling": lambda value: value is None or isinstance(value, dict),
}
"""What each entry must be."""
