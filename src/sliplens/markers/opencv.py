"""OpenCV, which comes as an extra."""

from importlib.util import find_spec
from types import ModuleType

from sliplens.errors import InputError


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
