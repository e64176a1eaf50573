"""How the benchmark counts what the package makes public."""

import ast

import pytest

from house import exported_names, is_loose, loose_dicts

CODE = '''
"""Module."""
_MODULES = {"load": "somewhere"}
__all__ = ["version", *_MODULES]


class Record:
    facts: dict[str, Any]
    _hidden: dict[str, Any]
    counts: dict[str, int]

    def tell(self, **more: Mapping[str, object]) -> None: ...


def read(path: Path) -> list[dict[str, Any]]: ...


def _read(path: Path) -> dict[str, Any]: ...


table: dict[str, Any] = {}
'''


def test_loose_dicts_are_those_that_others_see():
    assert list(loose_dicts(ast.parse(CODE))) == ["Record.facts", "Record.tell", "read"]


@pytest.mark.parametrize(("annotation", "loose"), [("'dict[str, Any]'", True), ("'batch 3 height width'", False)])
def test_annotations_may_be_texts(annotation: str, loose: bool):
    assert is_loose(ast.parse(annotation, mode="eval").body) is loose


def test_public_names_may_be_the_keys_of_a_table():
    assert exported_names(ast.parse(CODE)) == ["load", "version"]
