"""Work for processes of their own, which import it by this module's name."""

import os
import signal
import time
from pathlib import Path

import torch

from sliplens.cli.screen import Screen
from sliplens.errors import InputError


def write(folder: Path, name: str, screen: Screen) -> None:
    """Write a file, and say so."""
    with screen.progress_bar(f"Writing {name}") as count:
        (folder / name).write_text(f"{os.getpid()} {torch.get_num_threads()}")
        count(1, 1)
    screen.wrote(folder / name, f"the file of {name}")


def refuse(name: str, screen: Screen) -> None:
    """Fail by a mistake of the user, but for one name that goes on for an hour."""
    if name == "slow":
        time.sleep(3600)
    screen.say(f"{name} begins")
    raise InputError(f"{name} cannot be used; use another")


def die(name: str, screen: Screen) -> None:
    """End as the system ends a process that takes too much memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def break_down(name: str, screen: Screen) -> None:
    """Fail by a mistake of the program."""
    raise ZeroDivisionError
