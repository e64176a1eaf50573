"""Commands made of functions: options, defaults, types and help come from signature and docstring."""

import ast
import re
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from functools import cache, partial
from importlib import import_module
from inspect import Parameter, Signature, signature
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, Unpack, get_args, get_origin, get_type_hints, is_typeddict

import cyclopts
import docstring_parser

from sliplens.cli.console import Terminal
from sliplens.errors import InputError
from sliplens.files import find_run, partial_folder, require_folder, require_new_file

ALIASES = {"out": ("-o", "--output")}
"""Further names of parameters on the command line."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """A function on the command line."""

    function: str
    """Function of the library, as `module:name`."""
    run: Callable[..., object]
    """Calls it and prints the result; its keyword-only parameters are further options."""
    example: str
    aliases: tuple[tuple[str, str], ...] = ()
    """Parameters with a further name, such as `("source", "--from")`."""
    suffixes: tuple[str, ...] = ()
    """Endings of the file `out`; without an ending it is a folder."""

    @property
    def summary(self) -> str:
        """First line of the function's docstring."""
        module, _, name = self.function.partition(":")
        return _docstring(_statements(module)[name]).partition("\n")[0]


_PACKAGE = Path(__file__).parents[1]
_LONGEST_TYPE = 100


class _AnythingType(type):
    def __getattr__(cls, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return cls


class _Anything(metaclass=_AnythingType):
    """Stands for all that no option needs, such as arrays and networks."""

    def __init__(self, *_: object, **__: object) -> None: ...

    __class_getitem__ = classmethod(lambda cls, _: cls)


@cache
def _statements(module: str) -> dict[str, ast.stmt]:
    """Return the statement that binds each name of a module, or of the stub of a package."""
    path = _PACKAGE.joinpath(*module.split(".")[1:])
    files = path / "__init__.pyi", path / "__init__.py", path.with_suffix(".py")
    statements: dict[str, ast.stmt] = {}
    for node in ast.parse(next(file for file in files if file.is_file()).read_text(encoding="utf-8")).body:
        match node:
            case ast.Import() | ast.ImportFrom():
                names = [alias.asname or alias.name for alias in node.names]
            case ast.FunctionDef() | ast.ClassDef():
                names = [node.name]
            case _:
                stored = (each for each in ast.walk(node) if isinstance(each, ast.Name))
                names = [each.id for each in stored if isinstance(each.ctx, ast.Store)]
        statements |= dict.fromkeys(names, node)
    return statements


_READ: dict[tuple[str, str], Any] = {}


def read_name(module: str, name: str) -> Any:
    """Return a function, a type of options or a value of sliplens, made of its source alone.

    Functions have no body and classes no methods; what comes from another library than Python's own is missing.
    Importing a function takes seconds where its module needs torch, and a mistake is to be told at once.
    """
    if (module, name) not in _READ:
        _READ[module, name] = _Anything  # for a type that names itself
        _READ[module, name] = _made(_statements(module).get(name), module, name)
    return _READ[module, name]


def _made(node: ast.stmt | None, module: str, name: str) -> Any:
    if isinstance(node, ast.ImportFrom):
        parts = module.split(".")
        above = parts[: len(parts) - node.level + _PACKAGE.joinpath(*parts[1:]).is_dir()] if node.level else []
        source = ".".join([*above, node.module or ""])
        original = next(alias.name for alias in node.names if name in {alias.asname, alias.name})
        if source.startswith("sliplens"):
            return read_name(source, original)
        standard = source.partition(".")[0] in sys.stdlib_module_names
        return getattr(import_module(source), original) if standard else _Anything
    options = isinstance(node, ast.ClassDef) and _is_options(node, module)
    if node is None or not (options or isinstance(node, ast.FunctionDef | ast.Assign | ast.AnnAssign)):
        return _Anything
    node = deepcopy(node)
    if isinstance(node, ast.FunctionDef):
        node.decorator_list, node.body = [], [ast.Expr(ast.Constant(_docstring(node)))]
    elif isinstance(node, ast.ClassDef):
        node.body = [each for each in node.body if isinstance(each, ast.AnnAssign)] or [ast.Pass()]
    texts = [each.value for each in ast.walk(node) if isinstance(each, ast.Constant) and isinstance(each.value, str)]
    words = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
    space: dict[str, Any] = {"__name__": module}
    for _ in range(2):  # types may be texts, and texts may name types
        words.update(*(re.findall(r"\w+", text) for text in texts if len(text) < _LONGEST_TYPE))
        space |= {word: read_name(module, word) for word in words & _statements(module).keys() - {name}}
        texts = [value for value in space.values() if isinstance(value, str)]
    exec(compile(ast.fix_missing_locations(ast.Module([node], [])), module, "exec"), space)
    return space[name]


def _is_options(node: ast.ClassDef, module: str) -> bool:
    """Return True for a typed dictionary, and for a dataclass whose fields all have defaults."""
    if node.decorator_list:
        return all(each.value for each in node.body if isinstance(each, ast.AnnAssign))
    bases = [base.id for base in node.bases if isinstance(base, ast.Name)]
    return any(base == "TypedDict" or is_typeddict(read_name(module, base)) for base in bases)


def _docstring(node: ast.stmt) -> str:
    return (ast.get_docstring(node) if isinstance(node, ast.FunctionDef | ast.ClassDef) else "") or ""


@dataclass(frozen=True, kw_only=True)
class _Option:
    """A parameter on the command line."""

    name: str
    kind: Any
    """Type of its value: text, numbers, paths, choices, or a tuple of these."""
    default: Any
    help: str
    positional: bool = False
    group: str = ""
    """Parameter of the function that holds it as a field of a dataclass; empty if it is a parameter itself."""
    further: bool = False
    """True for an option of `Command.run`."""
    aliases: tuple[str, ...] = ()

    @property
    def parameter(self) -> Parameter:
        """Parameter of the function that cyclopts calls."""
        several = get_origin(self.kind) is tuple
        about = cyclopts.Parameter(
            help=self.help,
            alias=self.aliases,
            negative=f"--no-{self.name.replace('_', '-')}" if self.default is True else (),
            consume_multiple=several,
            show_default=self.default not in (None, False, True, (), Parameter.empty),
        )
        optional = self.kind if self.default is not None else self.kind | None
        return Parameter(
            self.name,
            Parameter.POSITIONAL_OR_KEYWORD if self.positional else Parameter.KEYWORD_ONLY,
            default=self.default,
            annotation=Annotated[optional, about],
        )


def adapt(command: Command) -> tuple[Callable[..., object], list[str]]:
    """Return the function that cyclopts calls for a command, and the names of its options."""
    module, _, name = command.function.partition(":")
    function = read_name(module, name)
    aliases = {**ALIASES, **{name: (alias,) for name, alias in command.aliases}}
    further = _options(read_name(command.run.__module__, command.run.__name__), further=True)
    ordered = sorted((*_options(function), *further), key=lambda option: not option.positional)
    options = [replace(option, aliases=aliases.get(option.name, ())) for option in ordered]
    by_name = {option.name: option for option in options}
    reports = _hint_of(function, "on_progress") is not None
    groups = {option.group: _options_type(_hint_of(function, option.group)) for option in options if option.group}

    def run(*positional: object, **arguments: object) -> object:
        return getattr(import_module(module), name)(*positional, **arguments)

    def call(*positional: object, **values: object) -> None:
        places = [option.name for option in options if option.positional]
        values = dict(zip(places, positional, strict=False)) | values
        further = {name: values.pop(name) for name in list(values) if by_name[name].further}
        arguments: dict[str, Any] = {"on_progress": Terminal()} if reports else {}
        for name, value in values.items():
            group = by_name[name].group
            if group:
                arguments.setdefault(group, {})[name] = value
            else:
                arguments[name] = constants(value) if _is_constants(function, name) else value
        typed = {name: value if isinstance(value, tuple) else (value,) for name, value in arguments.items() if value}
        texts = {name: tuple(map(str, several)) for name, several in typed.items()}
        _refuse_early(texts, second="".join(places[1:2]), suffixes=command.suffixes)
        for group, kind in groups.items():
            if group in arguments:
                arguments[group] = getattr(import_module(kind.__module__), kind.__name__)(**arguments[group])
        command.run(partial(run, **arguments), **further)

    parsed = docstring_parser.parse(function.__doc__ or "")
    texts = [parsed.short_description, parsed.long_description, f"Example: {command.example}"]
    call.__doc__ = "\n\n".join(filter(None, texts))
    call.__signature__ = Signature([option.parameter for option in options])  # pyright: ignore[reportFunctionMemberAccess]
    call.__annotations__ = {option.name: option.parameter.annotation for option in options}
    return call, list(by_name)


def _refuse_early(texts: Mapping[str, Sequence[str]], *, second: str, suffixes: Sequence[str]) -> None:
    """Refuse networks, data and files that are not there before the function is imported: that may take seconds."""
    # `predict FILE` names no network
    names, source = (("run",), "source") if second in texts else ((), "run")
    for network in (each for name in ("network", "networks", "start_from", *names) for each in texts.get(name, ())):
        find_run(Path(network))
    for data in texts.get("data", ()):
        require_folder(Path(data), what="the data set")
    for path in (*texts.get("sources", ()), *(texts.get(source, ()) if "run" in texts else ())):
        if not Path(path).exists():
            raise InputError(f"{path} does not exist; check the path")
    for out in map(Path, texts.get("out", ())):
        if suffixes and out.suffix:
            require_new_file(out, suffix=suffixes, overwrite="overwrite" in texts or partial_folder(out).exists())


def _options(function: Callable[..., object], *, further: bool = False) -> list[_Option]:
    """Return the parameters of a function that can be typed, if `further` those of `Command.run` besides the call.

    Fields of dataclasses are options of their own.
    """
    helps, hints, options = _parameter_help(function), get_type_hints(function), dict[str, _Option]()
    for name, parameter in list(signature(function).parameters.items())[further:]:
        hint, default = hints.get(name, Any), parameter.default
        kind, group = typed_kind(hint), _options_type(hint)
        if parameter.kind is Parameter.VAR_KEYWORD or group is not None:
            fields_of = _fields_of(*get_args(hint)) if group is None else _fields_of(group, group=name)
            for option in fields_of:
                options.setdefault(option.name, replace(option, further=further))
        elif kind is not None:
            options[name] = _Option(
                name=name,
                kind=kind,
                default=(default,) if isinstance(default, str) and get_origin(kind) is tuple else default,
                help=helps.get(name, ""),
                positional=parameter.kind is Parameter.POSITIONAL_OR_KEYWORD,
                further=further,
            )
        elif default is Parameter.empty:
            raise TypeError(f"{function.__qualname__} needs {name}, which cannot be typed")
    return list(options.values())


def _fields_of(kind: Any, *, group: str = "") -> list[_Option]:
    """Return the fields of a dataclass or TypedDict as options."""
    helps, hints, options = _parameter_help(kind), get_type_hints(kind), []
    defaults = {field.name: field.default for field in fields(kind)} if is_dataclass(kind) else {}
    for name, hint in hints.items():
        typed, inner = typed_kind(hint), _options_type(hint)
        if typed is not None:
            options.append(
                _Option(name=name, kind=typed, default=defaults.get(name), help=helps.get(name, ""), group=group)
            )
        elif inner is not None and inner.__name__.endswith("Options") and not group:
            options += _fields_of(inner, group=name)
    return options


def _parameter_help(kind: Any) -> dict[str, str]:
    """Return the description of each parameter or field, as one paragraph."""
    node, helps = _statements(kind.__module__)[kind.__name__], {}
    if isinstance(node, ast.ClassDef):
        for base in (base.id for base in node.bases if isinstance(base, ast.Name)):
            above = read_name(kind.__module__, base)
            helps |= _parameter_help(above) if getattr(above, "__module__", "").startswith("sliplens.") else {}
        for field, below in pairwise(node.body):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
            ):
                helps[ast.unparse(field.target)] = str(below.value.value)
    for param in docstring_parser.parse(_docstring(node)).params:
        helps |= dict.fromkeys(param.arg_name.replace(" ", "").split(","), param.description or "")
    return {name: " ".join(text.split()) for name, text in helps.items()}


def _options_type(hint: Any) -> Any:
    """Return the dataclass of options that a parameter takes; None for any other parameter."""
    kinds = [kind for kind in _members(hint) if is_dataclass(kind)] if typed_kind(hint) is None else []
    return next((kind for kind in kinds if all(_has_default(field) for field in fields(kind))), None)


def _has_default(field: Field) -> bool:
    return field.default is not MISSING or field.default_factory is not MISSING


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
        if origin is Mapping and arguments == (str, float):
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


def _hint_of(function: Callable[..., object], name: str) -> Any:
    """Return the type of a parameter, or of a key of its typed keyword arguments."""
    hints = get_type_hints(function)
    for hint in hints.values():
        if get_origin(hint) is Unpack:
            hints = hints | get_type_hints(get_args(hint)[0])
    return hints.get(name)


def _is_constants(function: Callable[..., object], name: str) -> bool:
    members = _members(_hint_of(function, name))
    return any(get_origin(member) is Mapping and get_args(member) == (str, float) for member in members)


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
