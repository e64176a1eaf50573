"""Changes of files that a process makes, counted, and its end before one of them."""

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_CHANGES = frozenset({"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate"})


def count_changes(folder: Path, *, kill_before: int | None = None) -> Callable[[], int]:
    """Count the changes that this process makes below a folder; it kills itself before one of them."""
    count, below = 0, str(folder)

    def heard(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal count
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if (writes or event in _CHANGES) and os.path.abspath(str(arguments[0])).startswith(below):  # noqa: PTH100
            count += 1
            if count == kill_before:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(heard)
    return lambda: count
