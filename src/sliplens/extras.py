"""Packages of the extras, and packages that add rows to the tables of sliplens."""

import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from difflib import get_close_matches
from functools import cached_property
from importlib import import_module, metadata
from importlib.util import find_spec
from inspect import signature
from types import ModuleType
from typing import Any, TypeVar, get_args

from sliplens.errors import InputError

Row = TypeVar("Row")


class Table(Mapping[str, Row]):
    """Rows by name: those of sliplens, then those that installed packages add through an entry point.

    A package names its rows in its metadata: `[project.entry-points."sliplens.fills"]`, `my-fill = "package:row"`. They
    are imported when the table is walked or a name is not one of ours: a package may import sliplens first. One that
    cannot be imported is left out with a warning, and `pick` of its name raises the error. No package replaces a row of
    sliplens. Messages call a row by the `noun`.

    Examples
    --------
    >>> from sliplens.extras import Table
    >>> levels = Table("level", "sliplens.levels", {"black": 0.0, "white": 1.0})
    >>> levels["white"], list(levels)
    (1.0, ['black', 'white'])
    >>> levels.pick("pink")
    Traceback (most recent call last):
        ...
    sliplens.errors.InputError: there is no level named 'pink'; choose one of black, white
    """

    def __init__(self, noun: str, group: str, rows: Mapping[str, Row]) -> None:
        self.noun, self.group = noun, group
        self._rows = dict(rows)
        self._broken: dict[str, InputError] = {}

    def __getitem__(self, name: str) -> Row:
        return self._rows[name] if name in self._rows else self._added[name]

    def __iter__(self) -> Iterator[str]:
        yield from self._rows
        yield from self._added

    def __len__(self) -> int:
        return len(self._rows) + len(self._added)

    def pick(self, name: str) -> Row:
        """Row of a name that a user gave."""
        if name not in self and name in self._broken:
            raise self._broken[name]
        return pick(self, name, noun=self.noun)

    @cached_property
    def _added(self) -> dict[str, Row]:
        rows = {}
        for point in metadata.entry_points(group=self.group):
            package = point.dist.name if point.dist else point.value
            adds = f"the package {package} adds the {self.noun} {point.name!r}"
            if point.name in self._rows or point.name in rows:
                raise InputError(f"{adds}, a name that is taken; rename it there, or uninstall {package}")
            try:
                rows[point.name] = point.load()
            except Exception as error:  # whatever another package's import may raise
                reason = f"{adds}, but {point.value} cannot be imported ({error}); update or uninstall {package}"
                self._broken[point.name] = InputError(reason)
                warnings.warn(reason, stacklevel=2)
        return rows


def pick(rows: Mapping[str, Row], name: str, *, noun: str) -> Row:
    """Return the row of a name that a user gave; `noun` says in the message what a row is."""
    if name not in rows:
        raise InputError(f"there is no {noun} named {name!r}; choose one of {', '.join(rows)}")
    return rows[name]


def require_keywords(call: Callable[..., Any], keywords: Iterable[str]) -> None:
    """Raise a TypeError for a keyword that a call with `**options: Unpack[TypedDict]` does not take.

    Python itself accepts any keyword there.
    """
    *parameters, options = signature(call).parameters.values()
    accepted = get_args(options.annotation)[0].__annotations__
    for name in keywords:
        if name not in accepted:
            near = get_close_matches(name, [*accepted, *(parameter.name for parameter in parameters)], n=1)
            cure = f"did you mean {near[0]!r}?" if near else f"it takes {', '.join(accepted)}"
            raise TypeError(f"{call.__name__}() has no parameter {name!r}; {cure}")


ONNX_PACKAGES = ("onnx", "onnxscript", "onnxruntime")  #: Packages of the extra `onnx`.
_NAMES = {"cv2": "OpenCV", "rerun": "Rerun"}  # packages that people know by another name than Python does


def missing_packages(*names: str, extra: str) -> str | None:
    """Describe packages that are not installed, with the command that installs them; None if all are there.

    Packages are named as they are imported, extras of sliplens divided by commas. Nothing is imported.
    """
    # find_spec fails for what is known to be missing: None among the modules
    absent = (name for name in names if sys.modules.get(name, ...) is None or find_spec(name) is None)
    missing = [_NAMES.get(name, name) for name in absent]
    if not missing:
        return None
    verb = "is" if len(missing) == 1 else "are"
    return f'{" and ".join(missing)}, which {verb} not installed; install with `pip install "sliplens[{extra}]"`'


def require_packages(*names: str, extra: str, purpose: str) -> None:
    """Check that packages of an extra are installed; the message begins with what needs them."""
    if missing := missing_packages(*names, extra=extra):
        raise InputError(f"{purpose} needs {missing}")


def import_onnxruntime() -> ModuleType:
    """Import ONNX Runtime without its reports to Microsoft: Privacy.md of the package, "Disabling Telemetry"."""
    require_packages("onnxruntime", extra="onnx", purpose="ONNX Runtime")
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime  # noqa: PLC0415 (an extra)

    # all that can be done where someone else has loaded it before
    onnxruntime.disable_telemetry_events()
    return onnxruntime


def import_openvino() -> ModuleType:
    """Import OpenVINO without its report to Intel, which it makes unless its package for that cannot be found."""
    require_packages("openvino", extra="openvino", purpose="OpenVINO")
    reporter = "openvino_telemetry"
    hide = "openvino" not in sys.modules and reporter not in sys.modules
    if hide:
        sys.modules[reporter] = None  # pyright: ignore[reportArgumentType] (None: Python finds no such module)
    try:
        import openvino  # noqa: PLC0415 (an extra)
    finally:
        if hide:
            del sys.modules[reporter]
    return openvino


def import_cv2() -> ModuleType:
    """Import OpenCV where it is used: nothing else of sliplens needs it."""
    require_packages("cv2", extra="markers", purpose="finding markers")
    import cv2  # noqa: PLC0415 (an extra)

    return cv2


def require_device(name: str) -> None:
    """Refuse a device that is unknown or absent."""
    if name == "cpu":
        return  # the usual one, known without torch
    torch = import_module("torch")  # takes seconds, and the floors below the networks do without
    try:
        device = torch.device(name)
    except (RuntimeError, ValueError):
        device = None
    if device is None or device.type not in {"cpu", "cuda"}:
        raise InputError(f"device {name!r} is not known; use cpu, cuda or cuda:1")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(f"device {name} is not on this machine; use cpu")
