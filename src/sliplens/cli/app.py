"""Commands made of functions: options, defaults, types and help come from signature and docstring."""

import ast
import inspect
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cached_property, partial
from importlib import import_module
from inspect import Parameter, Signature, signature
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, Unpack, get_args, get_origin, get_type_hints

import cyclopts
import docstring_parser

from sliplens.cli.console import Terminal
from sliplens.errors import InputError
from sliplens.files import partial_folder, require_new_file


@dataclass(frozen=True)
class Command:
    """A function on the command line."""

    function: str
    """Function of the library, as `module:name`."""
    run: Callable[..., object]
    """Calls it and prints the result; its keyword-only parameters are further options."""
    example: str
    aliases: tuple[tuple[str, str], ...] = ()
    """Parameters with a further name, such as `("source", "--from")`."""
    writes: str = ""
    """File or folder that must be named, such as `folder of the maps`; empty where the function does without."""
    suffixes: tuple[str, ...] = ()
    """Endings of the file `out`; without an ending it is a folder."""

    @cached_property
    def definition(self) -> ast.FunctionDef:
        """Source of the function, read without importing its module: that may take seconds."""
        module, _, name = self.function.partition(":")
        path = Path(__file__).parents[1].joinpath(*module.split(".")[1:]).with_suffix(".py")
        nodes = ast.parse(path.read_text(encoding="utf-8")).body
        return next(node for node in nodes if isinstance(node, ast.FunctionDef) and node.name == name)

    @property
    def summary(self) -> str:
        """First line of the function's docstring."""
        return (ast.get_docstring(self.definition) or "").partition("\n")[0]

    def names_of(self, parameter: str) -> list[str]:
        """Return the further names of a parameter on the command line."""
        aliases = [alias for name, alias in self.aliases if name == parameter]
        return ["-o", "--output"] if parameter == "out" else aliases

    def refuse_early(self, words: Sequence[str]) -> None:
        """Refuse a file that cannot be written before the function is imported, which may take seconds."""
        for option, out in pairwise(words):
            if option in {"--out", *self.names_of("out")} and self.suffixes and Path(out).suffix:
                overwrite = "--overwrite" in words or partial_folder(Path(out)).exists()
                require_new_file(Path(out), suffix=self.suffixes, overwrite=overwrite)


COMMANDS: dict[str, Command] = {}
"""Commands by name; `sensor new` and the like have two words."""
Run = Callable[..., None]


def command(
    name: str, function: str, example: str, *aliases: tuple[str, str], writes: str = "", suffixes: tuple[str, ...] = ()
) -> Callable[[Run], Run]:
    """Register a function that calls a function of the library, given with its arguments, and prints the result."""

    def register(run: Run) -> Run:
        COMMANDS[name] = Command(f"sliplens.{function}", run, example, aliases, writes, suffixes)
        return run

    return register


class _Option(NamedTuple):
    """An option of a command."""

    parameter: Parameter
    """Parameter of the function that cyclopts calls."""
    group: str
    """Parameter of the library's function that holds it as a field of a dataclass; empty if it is one itself."""


def adapt(command: Command) -> tuple[Callable[..., object], list[str]]:
    """Return the function that cyclopts calls for a command, and the names of its options."""
    module, _, name = command.function.partition(":")
    function = getattr(import_module(module), name)
    hints = get_type_hints(function)
    for hint in [hint for hint in hints.values() if get_origin(hint) is Unpack]:
        hints |= get_type_hints(get_args(hint)[0])
    further = _options(command.run, command, skip=1)
    options = _options(function, command) | further
    places = {name: option.parameter.kind is not Parameter.KEYWORD_ONLY for name, option in options.items()}
    names = sorted(options, key=lambda name: 2 - (name in further) if places[name] else 3)

    def call(*positional: object, **values: object) -> None:
        values = dict(zip(names, positional, strict=False)) | values
        if command.writes and "out" not in values:
            raise InputError(f"name the {command.writes} with -o; an example: {command.example}")
        others = {name: values.pop(name) for name in further.keys() & values.keys()}
        arguments: dict[str, Any] = {"on_progress": Terminal()} if "on_progress" in hints else {}
        groups: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            if group := options[name].group:
                groups.setdefault(group, {})[name] = value
            else:
                numbers = any(_is_constants(member) for member in _members(hints[name]))
                arguments[name] = constants(value) if numbers else value
        arguments |= {group: _options_type(hints[group])(**settings) for group, settings in groups.items()}
        command.run(partial(function, **arguments), **others)

    parsed = docstring_parser.parse(function.__doc__ or "")
    texts = [parsed.short_description, parsed.long_description, f"Example: {command.example}"]
    parameters = [options[name].parameter for name in names]
    call.__doc__ = "\n\n".join(filter(None, texts))
    call.__signature__ = Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call, names


def _options(kind: Any, command: Command, *, skip: int = 0, group: str = "") -> dict[str, _Option]:
    """Return the parameters of a function, or the fields of a dataclass or TypedDict, that can be typed.

    The first `skip` are left out. Fields of dataclasses are options of their own.
    """
    helps, hints, options = _parameter_help(kind), get_type_hints(kind), dict[str, _Option]()
    if inspect.isclass(kind) and issubclass(kind, dict):  # a TypedDict
        parameters = {name: Parameter(name, Parameter.KEYWORD_ONLY, default=None) for name in hints}
    else:
        parameters = signature(kind).parameters
    for name, parameter in list(parameters.items())[skip:]:
        hint, default, nested = hints.get(name, Any), parameter.default, {}
        typed, record = typed_kind(hint), _options_type(hint)
        if typed is not None:
            several = get_origin(typed) is tuple
            default = (default,) if isinstance(default, str) and several else default
            about = cyclopts.Parameter(
                help=helps.get(name, ""),
                alias=command.names_of(name),
                negative=f"--no-{name.replace('_', '-')}" if default is True else (),
                consume_multiple=several,
                show_default=default not in (None, False, True, (), Parameter.empty),
            )
            optional = Annotated[typed if default is not None else typed | None, about]
            positional = parameter.kind is Parameter.POSITIONAL_OR_KEYWORD and not group
            place = parameter.kind if positional else Parameter.KEYWORD_ONLY
            options[name] = _Option(Parameter(name, place, default=default, annotation=optional), group)
        elif parameter.kind is Parameter.VAR_KEYWORD:
            nested = _options(get_args(hint)[0], command)
        elif record is not None and (not inspect.isclass(kind) or record.__name__.endswith("Options")):
            nested = _options(record, command, group=name)
        options |= {name: option for name, option in nested.items() if name not in options}
    return options


def _parameter_help(kind: Any) -> dict[str, str]:
    """Return the description of each parameter or field, as one paragraph."""
    helps = {}
    for base in getattr(kind, "__orig_bases__", getattr(kind, "__bases__", ())):
        helps |= _parameter_help(base) if getattr(base, "__module__", "").startswith("sliplens.") else {}
    for param in docstring_parser.parse_from_object(kind).params:
        helps |= dict.fromkeys(param.arg_name.replace(" ", "").split(","), param.description or "")
    return {name: " ".join(text.split()) for name, text in helps.items()}


def _options_type(hint: Any) -> Any:
    """Return the dataclass of options that a parameter takes; None for any other parameter."""
    for kind in _members(hint) if typed_kind(hint) is None else ():
        if is_dataclass(kind) and all(
            MISSING is not field.default or MISSING is not field.default_factory for field in fields(kind)
        ):
            return kind
    return None


def _members(hint: Any) -> list[Any]:
    """Return the members of a union, of unions within it too, and of named types."""
    if get_origin(hint) is Annotated:
        return _members(get_args(hint)[0])
    if get_origin(hint) in {Union, UnionType}:
        return [member for each in get_args(hint) for member in _members(each)]
    return [hint]


def typed_kind(hint: Any) -> Any:
    """Return the simplest type of a parameter that can be typed on the command line; None if there is none.

    Examples
    --------
    >>> from collections.abc import Sequence
    >>> from pathlib import Path
    >>> from sliplens.cli.app import typed_kind
    >>> typed_kind(bytes | Path | str | None), typed_kind(Sequence[str]), typed_kind(bytes)
    (<class 'str'>, tuple[str, ...], None)
    """
    members = [member for member in _members(hint) if member is not NoneType]
    for member in members:
        origin, arguments = get_origin(member), get_args(member)
        if origin in {Sequence, Collection, list} and (inner := typed_kind(arguments[0])) is not None:
            return tuple[inner, ...]
        if _is_constants(member):
            return tuple[str, ...]
    for kind in (str, Path, bool, int, float):
        if kind in members:
            return kind
    for member in members:
        if get_origin(member) is Literal:
            return member
        if get_origin(member) is tuple and all(
            argument is Ellipsis or typed_kind(argument) is not None for argument in get_args(member)
        ):
            return member
    return None


def _is_constants(member: Any) -> bool:
    return get_origin(member) is Mapping and get_args(member) == (str, float)


def constants(texts: Any) -> dict[str, float]:
    """Parse texts such as `target=0.3`.

    Raises
    ------
    InputError
        If a text is no name and number.
    """
    values = {}
    for text in texts:
        name, _, number = text.partition("=")
        try:
            values[name] = float(number)
        except ValueError:
            raise InputError(f"{text!r} sets no constant; write NAME=NUMBER, such as target=0.3") from None
    return values


def name_options(message: str, names: Sequence[str]) -> str:
    """Write the parameters that a message names as options, as the user typed them."""
    for name in sorted(names, key=len, reverse=True):
        # within a sentence a single word may be just a word
        place = rf"(?<![\w-]){name}(?![\w-])" if "_" in name else rf"^{name}(?= (?:must|is \d|is -))"
        message = re.sub(place, f"--{name.replace('_', '-')}", message)
    return message
