"""`sliplens help`, and what every command tells of itself: examples, options as they are typed, lines that fit."""

import io
import shutil
import sys
from collections.abc import Iterable
from dataclasses import MISSING, dataclass, fields, replace
from difflib import get_close_matches
from functools import cache
from textwrap import fill
from types import UnionType
from typing import Annotated, Union, get_args

import docstring_parser
import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from sliplens.cli.console import say
from sliplens.errors import InputError

EXAMPLES = {
    "demo": "sliplens demo runs/demo",
    "live": "sliplens live 0 --network chromatouch-pair --reference untouched.png",
    "sensor": "sliplens sensor new --from tip.mp4 -o tip.toml",
    "simulate": "sliplens simulate runs/mine/data --preset small",
    "import": "sliplens import cup.mp4 --forces cup.csv --sensor tip.toml -o runs/mine/data",
    "label": "sliplens label runs/mine/data --draft corrections.csv",
    "recover": "sliplens recover runs/mine/data",
    "split": "sliplens split runs/mine/data --splits object --dry-run",
    "check": "sliplens check runs/mine/data",
    "view": "sliplens view runs/mine/data --trial cup --predictions margins.parquet --maps runs/mine/explain",
    "track": "sliplens track cup.mp4 --reference untouched.png -o markers.parquet",
    "train": "sliplens train runs/mine/data -o runs/mine/train --start-from chromatouch-pair --epochs 5",
    "evaluate": "sliplens evaluate runs/mine/train runs/mine/data -o runs/mine/evaluate",
    "predict": "sliplens predict cup.mp4 --sensor tip.toml --plot margin.png -o margins.csv",
    "export": "sliplens export runs/mine/train --onnx -o tip.onnx",
    "explain": "sliplens explain runs/mine/train --frames frames --reference untouched.png -o runs/mine/explain",
    "score": "sliplens score runs/mine/train runs/mine/explain -o runs/mine/score",
    "diagnose": "sliplens diagnose runs/mine/train runs/mine/data -o runs/mine/why",
    "study": "sliplens study runs/mine/data --network runs/mine/train -o runs/mine/study",
    "status": "sliplens status runs/mine/margins",
    "grip": "sliplens grip -o runs/grip --object egg",
    "hold": "sliplens hold grip:cup --gripper simulated",
    "report": "sliplens report runs/mine",
    "doctor": "sliplens doctor",
    "help": "sliplens help teach",
}
"""One line for each command that can be typed as it stands, once the files are there."""
TASKS = {
    "look": ("See what sliplens does, without any data", ("demo",)),
    "read": ("Read the safety margin from images, a video or a bag", ("sensor", "predict", "view")),
    "explain": ("See which parts of an image a margin comes from", ("explain", "score")),
    "teach": ("Teach a network your own sensor", ("sensor", "import", "check", "label", "train", "evaluate")),
    "judge": ("Find out where a network fails, and which explanation can be believed", ("diagnose", "study")),
    "live": ("Read a running camera, and hold what it feels", ("live", "grip", "hold")),
}
"""What users come for, and the commands that do it, in their order."""
# options of several words, as they are shown
_SEVERAL = {"allow_large": "LIMIT ...", "force_columns": "NAME ...", "bad_frames": "FIRST LAST ..."}


@dataclass(frozen=True, kw_only=True)
class Help:
    """Show which commands do what you came for: look, read, explain, teach, judge or live."""

    task: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[TASK]")] = None
    """One of the six; all if not given."""

    def run(self) -> None:
        """Show the commands of one task, or of all."""
        if self.task is not None and self.task not in TASKS:
            raise InputError(f"there is no help on {self.task!r}; choose one of {', '.join(TASKS)}")
        for name in TASKS if self.task is None else (self.task,):
            title, commands = TASKS[name]
            say(f"{title} ({name})")
            for command in commands:
                say(f"  {EXAMPLES[command]}")
        say("`sliplens COMMAND --help` tells every option of a command.")


def tell_unknown(word: str, known: Iterable[str], *, what: str, help_of: str) -> str:
    """Say that a command or an option is not there, and which one may have been meant."""
    if what == "option" and not word.startswith("-"):
        return f"{word!r} is one word too many for `{help_of}`; `{help_of} --help` tells what it takes"
    [near] = get_close_matches(word, list(known), n=1) or [None]
    meant = f"did you mean {near}? `{help_of} --help` tells all" if near else f"`{help_of} --help` tells what there is"
    return f"there is no {what} {word}{f' of `{help_of}`' if what == 'option' else ''}; {meant}"


OPTIONAL = ConstructorRegistry()
"""Rules of the command line: what may be left out is shown by its own type, not as `{None}|STR`."""


@OPTIONAL.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    kinds = [kind for kind in get_args(info.type) if kind is not type(None)]
    if info.type_origin not in {Union, UnionType} or len(kinds) != 1 or len(get_args(info.type)) != 2:
        return None
    inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    if not isinstance(inner, PrimitiveConstructorSpec):
        return None
    return replace(
        inner,
        is_instance=lambda value: value is None or inner.is_instance(value),
        str_from_instance=lambda value: [] if value is None else inner.str_from_instance(value),
    )


@cache  # once is enough: what they are annotated with stays
def describe_options(*commands: type) -> None:
    """Give every option of commands its help as one paragraph, and no default where that is to be left out.

    tyro keeps the line breaks of a docstring whose lines are indented, and shows `(default: None)`.
    """
    for kind in {base for command in commands for base in command.__mro__ if "__dataclass_fields__" in vars(base)}:
        said = {one.arg_name: one.description for one in docstring_parser.parse_from_object(kind).params}
        hints: dict[str, str] = {}
        for one in fields(kind):  # pyright: ignore[reportArgumentType]
            if one.default in (None, (), False):
                hints[one.name] = ""
            elif one.default is MISSING and one.default_factory is MISSING:
                hints[one.name] = "(required)"
        for name, annotation in list(vars(kind).get("__annotations__", {}).items()):
            words = " ".join((said.get(name) or "").split()) or None
            told = tyro.conf.arg(help=words, help_behavior_hint=hints.get(name), metavar=_SEVERAL.get(name))
            kind.__annotations__[name] = Annotated[annotation, told]


def overview(description: str, commands: Iterable[type]) -> str:
    """Say what the program is for, and what each of its commands does, in lines as wide as the terminal."""
    width, said = shutil.get_terminal_size().columns, {kind.__name__.lower(): kind.__doc__ or "" for kind in commands}
    lines = [fill(f"  {name:10}{said[name].splitlines()[0]}", width, subsequent_indent=" " * 12) for name in EXAMPLES]
    return "\n".join(["usage: sliplens COMMAND ...", "", fill(description, width), "", *lines])


class HelpText(io.StringIO):
    """What tyro prints, which asks where it goes whether that can show boxes."""

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride, reportIncompatibleVariableOverride]
        """That of the terminal."""
        return (sys.__stdout__ or sys.stdout).encoding


def print_help(text: str, words: Iterable[str]) -> None:
    """Print what tyro says of a command: its lines as wide as the terminal, an example below."""
    width = shutil.get_terminal_size().columns
    # what stands in boxes is as wide already
    lines = [line if len(line) <= width else fill(line, width, break_on_hyphens=False) for line in text.splitlines()]
    tail = next((["", "Example:", f"  {EXAMPLES[word]}"] for word in words if word in EXAMPLES), [])
    print("\n".join([*lines, *tail]), flush=True)
