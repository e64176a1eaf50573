"""What may be installed beside sliplens: packages of its extras, and packages that add rows to its tables."""

import os
import sys
from importlib import metadata
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from sliplens.errors import InputError


def entry_points(group: str) -> dict[str, Any]:
    """Rows that installed packages add to a table, by name.

    A package names them in its metadata: `[project.entry-points."sliplens.explainers"]`, `my-method = "package:row"`.

    Parameters
    ----------
    group
        Name of the table's group, such as `sliplens.explainers`.

    Raises
    ------
    InputError
        If a package names a row that cannot be imported.
    """
    rows = {}
    for point in metadata.entry_points(group=group):
        try:
            rows[point.name] = point.load()
        except Exception as error:  # whatever another package's import may raise
            package = point.dist.name if point.dist else point.value
            raise InputError(
                f"the package {package} adds {point.name!r} to {group}, but {point.value} cannot be imported "
                f"({error}); update or uninstall {package}"
            ) from error
    return rows


ONNX_PACKAGES = ("onnx", "onnxscript", "onnxruntime")
"""What the extra `onnx` installs."""


def missing_packages(*names: str) -> tuple[str, ...]:
    """Those of some packages that are not installed, told without importing any."""
    return tuple(name for name in names if find_spec(name) is None)


def require_packages(*names: str, extra: str, purpose: str) -> None:
    """Check that packages of an extra are installed.

    Parameters
    ----------
    names
        Packages, as they are imported.
    extra
        Of sliplens, that installs them.
    purpose
        What needs them, as the message begins.

    Raises
    ------
    InputError
        Naming those that are missing, and how to install them.
    """
    missing = missing_packages(*names)
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise InputError(
            f"{purpose} needs {' and '.join(missing)}, which {verb} not installed; "
            f'install with `pip install "sliplens[{extra}]"`'
        )


def import_onnxruntime() -> ModuleType:
    """ONNX Runtime, silenced: from 1.29 on it reports its use to Microsoft unless told not to before it is loaded.

    Raises
    ------
    InputError
        If it is not installed.

    References
    ----------
    Privacy.md of the package ("Disabling Telemetry").
    """
    require_packages("onnxruntime", extra="onnx", purpose="ONNX Runtime")
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime  # noqa: PLC0415 (an extra)

    # all that can be done where someone else has loaded it before
    onnxruntime.disable_telemetry_events()
    return onnxruntime


def import_openvino() -> ModuleType:
    """OpenVINO, silenced: to import it reports that to Intel, unless its package for that cannot be found.

    Raises
    ------
    InputError
        If it is not installed.
    """
    require_packages("openvino", extra="onnx,openvino", purpose="OpenVINO")
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
    """OpenCV, imported where it is used: nothing else of sliplens needs it.

    Raises
    ------
    InputError
        If it is not installed.
    """
    if find_spec("cv2") is None:
        raise InputError(
            'markers are found with OpenCV, which is not installed; install with `pip install "sliplens[markers]"`'
        )
    import cv2  # noqa: PLC0415 (an extra)

    return cv2
