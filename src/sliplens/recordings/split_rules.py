"""Rules that say which trials train, validate and test, and the file that holds them."""

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from sliplens.errors import InputError

FACTS = ("trial", "day", "object", "condition", "sensor")
"""What is known of a trial before it is looked at: what rules ask for, and trials are grouped by."""
_TEXTS = tuple(fact for fact in FACTS if fact != "day")
_DEALING = ("share", "by", "seed")
_SPLIT_NAME = re.compile(r"[a-z][a-z0-9_-]*")
# shares are written with few digits: thirds as 0.3333 are to be mended by the one who wrote them
_SUM_TOLERANCE = 1e-6


@runtime_checkable
class TrialLike(Protocol):
    """What is known of a trial, whether it is stored (`TrialInfo`) or not yet (`TrialFacts`)."""

    @property
    def trial(self) -> str:
        """Its name."""
        ...

    @property
    def sensor(self) -> str:
        """Name of the sensor."""
        ...

    @property
    def day(self) -> int:
        """Day of the recording."""
        ...

    @property
    def condition(self) -> str:
        """State of the surface."""
        ...

    @property
    def object(self) -> str:
        """What was held; empty where it is not told."""
        ...


@dataclass(frozen=True, kw_only=True)
class TrialFacts:
    """What is known of a trial that is not stored yet."""

    trial: str
    sensor: str
    day: int
    condition: str
    object: str = ""


@dataclass(frozen=True, kw_only=True)
class SplitRule:
    """Which trials a rule fits, and the split they go to, or the splits they are dealt to.

    Texts may hold `*`, `?` and `[a-z]` and are compared with upper and lower case told apart. What is left empty fits
    every trial.

    Raises
    ------
    InputError
        If the rule names a split and shares too, or neither, or its shares cannot be dealt.
    """

    trial: tuple[str, ...] = ()
    day: tuple[int, ...] = ()
    object: tuple[str, ...] = ()
    condition: tuple[str, ...] = ()
    sensor: tuple[str, ...] = ()
    name: str | None = None
    """The split of every trial the rule fits; None where they are dealt."""
    share: Mapping[str, float] = field(default_factory=dict)
    """Part of the groups that each split gets; empty where all go to one."""
    by: str | None = None
    """What makes a group, one of `FACTS`: trials alike in it stay together."""
    seed: int = 0
    """Another seed deals the groups in another order."""

    def __post_init__(self) -> None:
        """Check that the rule can be followed."""
        if (self.name is None) == (not self.share):
            said = "neither name nor share" if self.name is None else "both name and share"
            raise InputError(f"it has {said}; give the name of a split, or the share of each")
        for split in self.share or (self.name,):
            if not _SPLIT_NAME.fullmatch(str(split)):
                raise InputError(f"a split cannot be named {split!r}; use a lower-case word such as train or test")
        if not self.share and self.by is not None:
            raise InputError("by goes with share; leave it out, or give shares in place of the name")
        if self.share:
            self._check_shares()

    def _check_shares(self) -> None:
        if self.by not in FACTS:
            said = "share needs by" if self.by is None else f"trials cannot be grouped by {self.by!r}"
            raise InputError(f"{said}; choose {', '.join(FACTS[:-1])} or {FACTS[-1]}")
        for split, part in self.share.items():
            if not (math.isfinite(part) and part > 0):
                raise InputError(f"the share of {split} is {part:g}; give more than 0, or leave {split} out")
        total = math.fsum(self.share.values())
        if abs(total - 1) > _SUM_TOLERANCE:
            raise InputError(f"the shares sum to {total:.6g}; change them so that they sum to 1")

    def fits(self, trial: TrialLike) -> bool:
        """Tell whether all that the rule asks for is so of a trial."""
        if self.day and trial.day not in self.day:
            return False
        return all(
            any(_alike(getattr(trial, fact), pattern) for pattern in getattr(self, fact))
            for fact in _TEXTS
            if getattr(self, fact)
        )

    def __str__(self) -> str:
        """Say what the rule asks for."""
        asked = [
            f"{fact} {' or '.join(str(one) for one in getattr(self, fact))}" for fact in FACTS if getattr(self, fact)
        ]
        return ", ".join(asked) or "any trial"

    def as_table(self) -> dict[str, Any]:
        """Give the rule as its file would hold it, with what is left empty left out."""
        unsaid = ("seed",) if self.name is not None else ()
        return {key: one for key, one in asdict(self).items() if one not in ((), {}, None) and key not in unsaid}


@dataclass(frozen=True, kw_only=True)
class SplitPlan:
    """Rules in order: the first that fits a trial decides.

    Raises
    ------
    InputError
        If there is no rule.
    """

    rules: tuple[SplitRule, ...]
    source: str = "the plan"
    """The file or preset it comes from, for messages."""

    def __post_init__(self) -> None:
        """Check that there is a rule."""
        if not self.rules:
            raise InputError(f"{self.source} has no rule; write one that begins with [[split]]")


def read_splits(path: Path) -> SplitPlan:
    """Read the rules of a TOML file, as described in `docs/splits.md`.

    Parameters
    ----------
    path
        File with one table `[[split]]` for each rule.

    Raises
    ------
    InputError
        If the file cannot be read or is not TOML, has no rule, or a rule has a key or a value that it cannot have;
        rules are counted from 1.
    """
    try:
        # Windows editors put a mark before the text that TOML does not know
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}; mend it there") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); name a TOML file of rules") from None
    other = sorted(set(table) - {"split"})
    if other:
        raise InputError(f"{path} has {other[0]!r} outside of a rule; put it under a line [[split]], or leave it out")
    rows = table.get("split", [])
    if not (isinstance(rows, list) and all(isinstance(row, dict) for row in rows)):
        raise InputError(f"{path} has a split that is no list of rules; begin each rule with [[split]]")
    rules = []
    for number, row in enumerate(rows, start=1):
        try:
            rules.append(_rule(row))
        except InputError as error:
            raise InputError(f"{path}, rule {number}: {error}") from None
    return SplitPlan(rules=tuple(rules), source=str(path))


def _alike(text: str, pattern: str) -> bool:
    # a name that holds brackets fits itself too
    return text == pattern or fnmatchcase(text, pattern)


def _rule(row: Mapping[str, Any]) -> SplitRule:
    keys = (*FACTS, "name", *_DEALING)
    unknown = [key for key in row if key not in keys]
    if unknown:
        raise InputError(f"{unknown[0]!r} is no key of a rule; use {', '.join(keys[:-1])} or {keys[-1]}")
    if "seed" in row and "share" not in row:
        raise InputError("seed goes with share; leave it out")
    values: dict[str, Any] = {fact: _texts(row[fact], fact) for fact in _TEXTS if fact in row}
    if "day" in row:
        values["day"] = _some(row["day"], "day")
        if not all(_is_integer(day) for day in values["day"]):
            raise InputError(f"day is {row['day']!r}; give a whole number, or a list of them, without quotes")
    for key in ("name", "by"):
        if key in row:
            if not isinstance(row[key], str):
                raise InputError(f"{key} is {row[key]!r}; give one text in quotes")
            values[key] = row[key]
    if "seed" in row:
        if not _is_integer(row["seed"]):
            raise InputError(f"seed is {row['seed']!r}; give a whole number")
        values["seed"] = row["seed"]
    if "share" in row:
        share = row["share"]
        if not (isinstance(share, dict) and all(_is_integer(x) or isinstance(x, float) for x in share.values())):
            raise InputError(f"share is {share!r}; write it like {{ train = 0.8, validation = 0.2 }}")
        values["share"] = {split: float(part) for split, part in share.items()}
    return SplitRule(**values)


def _texts(value: Any, key: str) -> tuple[str, ...]:
    texts = _some(value, key)
    if not all(isinstance(text, str) for text in texts):
        raise InputError(f"{key} is {value!r}; give a text in quotes, or a list of them")
    return texts


def _some(value: Any, key: str) -> tuple[Any, ...]:
    """One value, or a list of them."""
    values = tuple(value) if isinstance(value, list) else (value,)
    if not values:
        raise InputError(f"{key} is an empty list, which fits no trial; name some, or leave {key} out")
    return values


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
