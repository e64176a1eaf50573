"""How large the house is and how much of it a newcomer meets: lines, modules, public names, examples, loose dicts.

Counted in the source text, without importing the package. `--json` prints one line of JSON.
"""

import argparse
import ast
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

_PACKAGE = Path(__file__).parents[1] / "src" / "sliplens"
_MAPPINGS = ("dict", "Mapping", "MutableMapping")
_ANYTHING = ("Any", "object")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, kw_only=True)
class House:
    """Size of the package."""

    lines: int
    modules: int
    public_top_level: int
    """Names in `sliplens.__all__`."""
    doctests: int
    """Docstrings with an example that runs."""
    dicts_across_modules: tuple[str, ...]
    """Public functions, methods and fields of records whose annotation holds a dict of anything."""
    largest_cli_module: str
    largest_cli_lines: int


def measure(package: Path) -> House:
    """Read every module of a package.

    Raises
    ------
    OSError
        If a module cannot be read.
    """
    texts = {path.relative_to(package): path.read_text(encoding="utf-8") for path in sorted(package.rglob("*.py"))}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    lines = {path: len(text.splitlines()) for path, text in texts.items()}
    commands = [path for path in lines if path.parts[0] == "cli"]
    largest = max(commands, key=lambda path: lines[path])
    return House(
        lines=sum(lines.values()),
        modules=len(texts),
        public_top_level=len(exported_names(trees[Path("__init__.py")])),
        doctests=sum(1 for tree in trees.values() for text in docstrings(tree) if ">>> " in text),
        dicts_across_modules=tuple(f"{path}: {name}" for path, tree in trees.items() for name in loose_dicts(tree)),
        largest_cli_module=largest.as_posix(),
        largest_cli_lines=lines[largest],
    )


def exported_names(tree: ast.Module) -> list[str]:
    """Names in a module's `__all__`: string literals, and the keys of a table named in it (`[*TABLE, "name"]`)."""
    values = {
        target.id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name)
    }

    def names(node: ast.expr) -> Iterator[str]:
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.Name) and node.id in values:
            yield from names(values[node.id])
        elif isinstance(node, ast.Dict):
            for key in node.keys:
                if key is not None:
                    yield from names(key)
        else:
            for child in ast.iter_child_nodes(node):
                if isinstance(child, ast.expr):
                    yield from names(child)

    return sorted(set(names(values["__all__"]))) if "__all__" in values else []


def docstrings(tree: ast.Module) -> Iterator[str]:
    """Every docstring of a module: its own, of classes, functions and methods."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | Function) and (text := ast.get_docstring(node)):
            yield text


def loose_dicts(tree: ast.Module) -> Iterator[str]:
    """Public functions, methods and annotated fields that give or take a dict of anything."""

    def visit(body: list[ast.stmt], prefix: str) -> Iterator[str]:
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield from visit(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, Function) and not node.name.startswith("_"):
                arguments = node.args
                everything = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
                everything += [extra for extra in (arguments.vararg, arguments.kwarg) if extra is not None]
                annotations = [argument.annotation for argument in everything] + [node.returns]
                if any(map(is_loose, annotations)):
                    yield f"{prefix}{node.name}"
            elif prefix and isinstance(node, ast.AnnAssign) and is_loose(node.annotation):
                name = ast.unparse(node.target)
                if not name.startswith("_"):
                    yield f"{prefix}{name}"

    return visit(tree.body, "")


def is_loose(annotation: ast.expr | None) -> bool:
    """Tell whether an annotation holds `dict[str, Any]`, `Mapping[str, object]` or the like."""
    if annotation is None:
        return False
    if isinstance(annotation, ast.Constant) and isinstance(annotation.value, str):
        try:
            annotation = ast.parse(annotation.value, mode="eval").body
        except SyntaxError:  # a shape, "batch 3 height width"
            return False
    return any(
        isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id in _MAPPINGS
        and isinstance(node.slice, ast.Tuple)
        and isinstance(value := node.slice.elts[-1], ast.Name)
        and value.id in _ANYTHING
        for node in ast.walk(annotation)
    )


def main() -> None:
    """Print the size of the package."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    options = parser.parse_args()
    house = measure(_PACKAGE)
    if options.json:
        facts = asdict(house) | {"dicts_across_modules": len(house.dicts_across_modules)}
        facts["largest_cli_module"] = facts.pop("largest_cli_lines")
        print(json.dumps(facts))
        return
    print(f"{house.lines} lines in {house.modules} modules; {house.public_top_level} names at the top level")
    print(f"{house.doctests} docstrings with an example")
    print(f"largest module of the command line: {house.largest_cli_module}, {house.largest_cli_lines} lines")
    print(f"{len(house.dicts_across_modules)} dicts of anything across modules")
    for name in house.dicts_across_modules:
        print(f"  {name}")


if __name__ == "__main__":
    main()
