"""Work for processes of their own, which import it by this module's name."""

import os
from pathlib import Path

from sliplens.cli.screen import Screen
from sliplens.errors import InputError


def write(folder: Path, name: str, screen: Screen) -> None:
    """Write a file, and say so."""
    import torch

    with screen.progress_bar(f"Writing {name}") as count:
        (folder / name).write_text(f"{os.getpid()} {torch.get_num_threads()}")
        count(1, 1)
    screen.wrote(folder / name, f"the file of {name}")


def refuse(name: str, screen: Screen) -> None:
    """Fail by a mistake of the user, but for one name that goes on for an hour."""
    import time

    if name == "slow":
        time.sleep(3600)
    screen.say(f"{name} begins")
    raise InputError(f"{name} cannot be used; use another")


def die(name: str, screen: Screen) -> None:  # noqa: ARG001 (as all work is)
    """End as the system ends a process that takes too much memory."""
    os._exit(9)
