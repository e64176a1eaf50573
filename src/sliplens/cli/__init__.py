"""The command line: one frozen dataclass a subcommand."""

import errno
import os
import re
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from typing import Any, get_args

import tyro

from sliplens._version import __version__
from sliplens.cli.check import Check
from sliplens.cli.command import in_options, option_names
from sliplens.cli.console import fail
from sliplens.cli.demo import Demo
from sliplens.cli.doctor import Doctor
from sliplens.cli.evaluate import Evaluate
from sliplens.cli.explain import Explain, Score
from sliplens.cli.export import Export
from sliplens.cli.grip import Grip
from sliplens.cli.help import EXAMPLES, OPTIONAL, Help, HelpText, describe_options, overview, print_help, tell_unknown
from sliplens.cli.hold import Hold
from sliplens.cli.import_ import Import
from sliplens.cli.label import Label
from sliplens.cli.live import Live
from sliplens.cli.predict import Predict
from sliplens.cli.recover import Recover
from sliplens.cli.report import Report
from sliplens.cli.sensor import Sensor
from sliplens.cli.simulate import Simulate
from sliplens.cli.split import Split
from sliplens.cli.status import Status
from sliplens.cli.study import Diagnose, Study
from sliplens.cli.track import Track
from sliplens.cli.train import Train
from sliplens.cli.view import View
from sliplens.errors import InputError, PartError, SliplensError
from sliplens.recordings.options import LabelSettings, ReadOptions

_Recordings = Sensor | Simulate | Import | Label | Recover | Split | Check | View | Track
_Networks = Train | Evaluate | Predict | Export
_Holds = Grip | Hold
_Why = Explain | Score | Diagnose | Study
Command = Demo | Live | _Recordings | _Networks | _Why | Status | _Holds | Report | Doctor | Help

_DESCRIPTION = """sliplens tells how close a soft robotic fingertip is to losing its grip, from the images of the camera
inside it, and shows why the network says so. Start with `sliplens demo runs/demo`; `sliplens help` tells which commands
do what you came for, `sliplens COMMAND --help` every option of one."""


def _parse(words: Sequence[str]) -> Any:
    """Make the command that the words name; help is printed here, and ends the program."""
    if words[0] in {"-h", "--help"}:
        print(overview(_DESCRIPTION, get_args(Command)))
        raise SystemExit(0)
    if words[0] not in EXAMPLES and not words[0].startswith("-"):
        raise InputError(tell_unknown(words[0], EXAMPLES, what="command", help_of="sliplens"))
    help_text = HelpText()
    describe_options(*get_args(Command), LabelSettings, ReadOptions)
    try:
        with redirect_stdout(help_text):
            command, unknown = tyro.cli(
                Command,  # pyright: ignore[reportArgumentType]
                prog="sliplens",
                args=words,
                registry=OPTIONAL,
                return_unknown_args=True,
            )
    except SystemExit:
        if help_text.getvalue():
            print_help(help_text.getvalue(), words)
        raise
    if unknown:
        raise InputError(tell_unknown(unknown[0], option_names(command), what="option", help_of=f"sliplens {words[0]}"))
    return command


_NO_MEMORY = "allocate memory|out of memory|bad_alloc|start new thread|failed to map segment|create a primitive"
"""What torch, threads and libraries say where Python says MemoryError."""


def _sentence(error: Exception, command: object | None) -> str:
    """What a mistake or a fault is called; whatever else it is goes on."""
    match error:
        case SliplensError():
            return str(error) if command is None else in_options(str(error), command)
        case OSError() if error.errno != errno.ENOMEM:
            where, why = error.filename or "a file", error.strerror or error
            return f"{where} could not be read or written ({why}); check the path, its permissions and the space left"
        case _ if isinstance(error, MemoryError) or re.search(_NO_MEMORY, str(error)):
            return "the memory is used up; end other programs, or name less at once, and give the same command again"
    raise error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments
        Words after the program's name; those of the process if None.

    Returns
    -------
    int
        0 on success, 1 where some of many parts failed, 2 for a mistake the user can mend, 130 when interrupted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"sliplens {__version__}")
        return 0
    # threads that spin while they wait take the cores from those that work; must be set before torch is imported
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    command = None
    try:
        command = _parse(words or ["--help"])
        getattr(command, "check", lambda: None)()
        command.run()
    except BrokenPipeError:
        # whoever read it has seen enough, as `| head` does; what is still to be written on the way out goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except PartError as error:
        fail(error.summary, *(f"{name}: {in_options(sentence, command)}" for name, sentence in error.errors.items()))
        return 1
    except (SliplensError, OSError, MemoryError, RuntimeError, ImportError) as error:
        fail(_sentence(error, command))
        return 2
    except KeyboardInterrupt:
        fail("interrupted; run the same command again and it goes on where it stopped")
        return 130
    return 0
