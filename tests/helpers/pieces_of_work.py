"""Work for processes of their own, which import it by this module's name."""

import os
import signal
import time
from pathlib import Path

import torch

from sliplens.errors import InputError
from sliplens.progress import OnProgress, note, stage, wrote


def write(folder: Path, name: str, on_progress: OnProgress) -> None:
    """Write a file beside another one's, and say so."""
    with stage(on_progress, f"Writing {name}") as count:
        (folder / name).write_text(f"{os.getpid()} {torch.get_num_threads()}")
        count(1, 1)
        while len(list(folder.iterdir())) < 2:
            time.sleep(0.01)
    wrote(on_progress, folder / name, f"the file of {name}")


def refuse(name: str, on_progress: OnProgress) -> None:
    """Fail by a mistake of the user, but for one name that goes on for an hour."""
    if name == "slow":
        time.sleep(3600)
    note(on_progress, f"{name} begins")
    raise InputError(f"{name} cannot be used; use another")


def die(name: str, on_progress: OnProgress) -> None:
    """End as the system ends a process that takes too much memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def break_down(name: str, on_progress: OnProgress) -> None:
    """Fail by a mistake of the program."""
    raise ZeroDivisionError
