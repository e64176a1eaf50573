"""Size and language of the code: lines, modules, names, parameters, and the modules that a frame passes in `predict`.

    python benchmarks/house.py --json
    python benchmarks/house.py --list src/sliplens/live     # each finding below a folder, with its line

The source is parsed without importing the package; `modules_predict_passes` is measured by a prediction.
"""

import argparse
import ast
import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "sliplens"
RIDDLES = frozenset(
    "one own told known found kept left held named shown said given asked looked wished seen".split()  # noqa: SIM905
)
"""Names that say nothing of their value; counted among variables and parameters."""
VAGUE_OPENINGS = ("What", "Whether", "As", "The same")
"""First words of docstrings that cannot be read without the lines around them."""
_BAGS = ("dict[str, Any]", "dict[str, object]", "Mapping[str, Any]", "Mapping[str, object]")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, kw_only=True)
class House:
    """Counts of the code below `src/sliplens`, of tests, benchmarks and pages."""

    lines: int
    modules: int
    test_lines: int
    benchmark_lines: int
    doc_words: int
    words_per_sentence: float
    """Mean over the docs; code, tables and headings do not count."""
    riddles_per_1000: float
    """Variables and parameters named by a riddle word, in 1,000 lines."""
    vague_docstrings: int
    """Docstrings that begin with a word of `VAGUE_OPENINGS`."""
    most_parameters: int
    functions_with_on_progress: int
    functions_with_out: int
    functions_with_overwrite: int
    functions_with_device: int
    names_defined_twice: int
    """Public classes and functions whose name stands in two or more modules."""
    dicts_across_functions: int
    """Functions that take or return `dict[str, Any]` or the like."""


def sources(folder: Path) -> dict[Path, str]:
    """Return the text of every module below a folder."""
    return {path: path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*.py"))}


def functions(tree: ast.Module) -> Iterator[Function]:
    """Iterate over all functions and methods of a module."""
    return (node for node in ast.walk(tree) if isinstance(node, Function))


def parameters(function: Function) -> list[ast.arg]:
    """Return all parameters of a function, `self` and `cls` excepted."""
    arguments = function.args
    starred = [argument for argument in (arguments.vararg, arguments.kwarg) if argument is not None]
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, *starred]
    return [argument for argument in every if argument.arg not in {"self", "cls"}]


def riddles(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Find variables and parameters that are named by a riddle word: line and name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.arg) and node.arg.lstrip("_") in RIDDLES:
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id.lstrip("_") in RIDDLES:
            yield node.lineno, node.id


def vague_docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Find docstrings, of fields too, that begin with a word of `VAGUE_OPENINGS`: line and first line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            text = node.value.value.strip()
            if any(text.startswith((f"{opening} ", f"{opening},")) for opening in VAGUE_OPENINGS):
                yield node.lineno, text.splitlines()[0]


def bags(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Find functions that take or return an untyped dict: line and name."""
    for function in functions(tree):
        annotations = [argument.annotation for argument in parameters(function)] + [function.returns]
        texts = [ast.unparse(annotation) for annotation in annotations if annotation is not None]
        if any(bag in text for bag in _BAGS for text in texts):
            yield function.lineno, function.name


def sentences(page: str) -> list[str]:
    """Return the sentences of a Markdown page, without code, tables, headings and directives."""
    text = re.sub(r"^(```|:::).*?^\1$|\$\$.*?\$\$", "", page, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^(?:[|#:]|\(.*\)=$|\{).*$", "", text, flags=re.MULTILINE)
    blocks = re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) ", text)
    every = [part.strip() for block in blocks for part in re.split(r"(?<=[.!?:;])\s+", block)]
    return [sentence for sentence in every if len(sentence.split()) > 2]


def public_names(tree: ast.Module) -> set[str]:
    """Return the public classes and functions that a module defines."""
    return {
        node.name for node in tree.body if isinstance(node, ast.ClassDef | Function) and not node.name.startswith("_")
    }


def measure(root: Path = ROOT) -> House:
    """Count the code of a checkout."""
    package = sources(root / "src" / "sliplens")
    trees = {path: ast.parse(text) for path, text in package.items()}
    lines = count_lines(package)
    pages = [path.read_text(encoding="utf-8") for path in sorted((root / "docs").rglob("*.md"))]
    prose = [sentence for page in pages for sentence in sentences(page)]
    every = [function for tree in trees.values() for function in functions(tree)]
    names = Counter(name for tree in trees.values() for name in public_names(tree))
    uses = Counter(argument.arg for function in every for argument in parameters(function))
    return House(
        lines=lines,
        modules=len(package),
        test_lines=count_lines(sources(root / "tests")),
        benchmark_lines=count_lines(sources(root / "benchmarks")),
        doc_words=sum(len(page.split()) for page in pages),
        words_per_sentence=round(sum(len(one.split()) for one in prose) / len(prose), 1),
        riddles_per_1000=round(1000 * sum(len(list(riddles(tree))) for tree in trees.values()) / lines, 2),
        vague_docstrings=sum(len(list(vague_docstrings(tree))) for tree in trees.values()),
        most_parameters=max(len(parameters(function)) for function in every),
        functions_with_on_progress=uses["on_progress"],
        functions_with_out=uses["out"],
        functions_with_overwrite=uses["overwrite"],
        functions_with_device=uses["device"],
        names_defined_twice=sum(1 for count in names.values() if count > 1),
        dicts_across_functions=sum(len(list(bags(tree))) for tree in trees.values()),
    )


def count_lines(texts: dict[Path, str]) -> int:
    """Count the lines of several modules."""
    return sum(len(text.splitlines()) for text in texts.values())


def modules_predict_passes() -> list[str]:
    """Return the modules whose functions run once more for every further frame that `predict` reads."""
    import sliplens as sl  # noqa: PLC0415 (torch takes seconds, and the counts need none)

    run = sl.load("chromatouch-pair")
    frames = np.random.default_rng(0).integers(0, 256, (48, 224, 224, 3), dtype=np.uint8)

    def calls(count: int) -> Counter[str]:
        passed: Counter[str] = Counter()

        def record(frame: object, event: str, _: object) -> None:
            name = getattr(frame, "f_globals", {}).get("__name__", "")
            if event == "call" and name.startswith("sliplens."):
                passed[name] += 1

        sys.setprofile(record)
        try:
            sl.predict(run, frames[:count], reference=frames[0])
        finally:
            sys.setprofile(None)
        return passed

    calls(8)
    few, many = calls(16), calls(48)
    return sorted(name for name, count in many.items() if count > few[name])


def list_findings(folder: Path) -> None:
    """Print every riddle, vague docstring, untyped dict and long signature below a folder."""
    for path, text in sources(folder).items():
        tree = ast.parse(text)
        rows = [(line, f"riddle: {name}") for line, name in riddles(tree)]
        rows += [(line, f"docstring: {first}") for line, first in vague_docstrings(tree)]
        rows += [(line, f"untyped dict: {name}") for line, name in bags(tree)]
        for function in functions(tree):
            if (count := len(parameters(function))) > 12:
                rows.append((function.lineno, f"{count} parameters: {function.name}"))
        for line, message in sorted(rows):
            print(f"{path}:{line}: {message}")


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    parser.add_argument("--list", type=Path, metavar="FOLDER", help="print each finding below a folder")
    options = parser.parse_args()
    if options.list is not None:
        list_findings(options.list)
        return
    passed = modules_predict_passes()
    facts = asdict(measure()) | {"modules_predict_passes": len(passed)}
    print(json.dumps(facts, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
