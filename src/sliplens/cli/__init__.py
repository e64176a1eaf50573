"""The command line: every command is a function of the library."""

import errno
import os
import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches

import cyclopts

from sliplens.cli import commands  # noqa: F401 (they are listed when they are imported)
from sliplens.cli.app import COMMANDS, adapt, name_options
from sliplens.cli.console import OUT, fail, say
from sliplens.errors import InputError, PartError, SliplensError
from sliplens.files import versions

_DESCRIPTION = (
    "Predict how close a soft robotic fingertip is to losing its grip, from the images of the camera inside it, and "
    "show why the network says so. Start with `sliplens demo runs/demo`; `sliplens COMMAND --help` lists the options."
)
_NO_MEMORY = "allocate memory|out of memory|bad_alloc|start new thread|failed to map segment|create a primitive"
"""Messages of torch, threads and libraries where Python raises MemoryError."""


def _overview() -> None:
    """Print the commands with a line each."""
    OUT.print(f"usage: sliplens COMMAND ...\n\n{_DESCRIPTION}\n", highlight=False)
    from rich.table import Table

    table = Table.grid(padding=(0, 2, 0, 2))
    for name, command in COMMANDS.items():
        table.add_row(name, command.summary)
    OUT.print(table, highlight=False)


def call_command(words: list[str]) -> list[str]:
    """Call the command that the words name; returns the names of its options for the messages of its errors."""
    name = next((" ".join(words[:count]) for count in (2, 1) if " ".join(words[:count]) in COMMANDS), None)
    if name is None:
        under = [each for each in COMMANDS if each.startswith(f"{words[0]} ")]
        close = (get_close_matches(text, COMMANDS, n=1) for text in (" ".join(words[:2]), words[0]))
        near = under or next(filter(None, close), [])
        meant = f"did you mean {' or '.join(near)}? " if near else ""
        raise InputError(f"there is no command {words[0]}; {meant}`sliplens --help` lists all")
    words = words[len(name.split()) :]
    if "--help" not in words:
        COMMANDS[name].refuse_early(words)
    function, options = adapt(COMMANDS[name])
    app = cyclopts.App(
        name=f"sliplens {name}",
        help_format="plaintext",
        version_flags=(),
        console=OUT,
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    app.default(function)
    app["--help"].show = False
    try:
        app(words, exit_on_error=False, print_error=False)
    except cyclopts.CycloptsError as error:
        text = " ".join(str(error).split()).rstrip(".")
        raise InputError(f"{text[:1].lower()}{text[1:]}; `sliplens {name} --help` lists the options") from None
    except (SliplensError, OSError, MemoryError, RuntimeError, ImportError) as error:
        error.options = options  # pyright: ignore[reportAttributeAccessIssue]
        raise
    return options


def _sentence(error: Exception) -> str:
    """Return the message of a mistake or a fault; raise whatever else it is."""
    match error:
        case SliplensError():
            return name_options(str(error), getattr(error, "options", ()))
        case OSError() if error.errno != errno.ENOMEM:
            where, why = error.filename or "a file", error.strerror or error
            return f"{where} could not be read or written ({why}); check the path, its permissions and the space left"
        case _ if isinstance(error, MemoryError) or re.search(_NO_MEMORY, str(error)):
            return "the memory is used up; end other programs, or give fewer files at once, and run the command again"
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
        0 on success, 1 if some of many parts failed, 2 for a user's mistake, 130 if interrupted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    # threads that spin while they wait take the cores from those that work; must be set before torch is imported
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        if words[:1] == ["--version"]:
            say(", ".join(f"{name} {version}" for name, version in versions().items()))
        elif not words or words[0] in {"-h", "--help"}:
            _overview()
        else:
            call_command(words)
    except BrokenPipeError:
        # a reader such as `| head` has ended; what is still written goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except PartError as error:
        names = getattr(error, "options", ())
        fail(error.summary, *(f"{part}: {name_options(text, names)}" for part, text in error.errors.items()))
        return 1
    except (SliplensError, OSError, MemoryError, RuntimeError, ImportError) as error:
        fail(_sentence(error))
        return 2
    except KeyboardInterrupt:
        fail("interrupted; run the same command again to continue")
        return 130
    return 0
