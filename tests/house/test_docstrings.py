"""Docstrings: a public function of more than three parameters says what each of them is."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for package in ("lake_schema", "truesky") for path in (ROOT / package).rglob("*.py"))
FEW = 3


def public(node: ast.AST, prefix: str = "") -> Iterator[tuple[str, ast.FunctionDef]]:
    """(name, function) of all that other modules may call: functions, and methods of public classes."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
            yield from public(child, f"{prefix}{child.name}.")
        elif isinstance(child, ast.FunctionDef) and not child.name.startswith("_"):
            yield prefix + child.name, child


def unsaid(text: str) -> dict[str, list[str]]:
    """Function -> parameters that its docstring does not name; self and cls are no parameters."""
    found = {}
    for name, function in public(ast.parse(text)):
        given = function.args
        names = [one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
        names = [one for one in names if one not in ("self", "cls")]
        said = ast.get_docstring(function) or ""
        missing = [one for one in names if not re.search(rf"\b{one}\b", said)]
        if len(names) > FEW and missing:
            found[name] = missing
    return found


def test_parameters_are_said() -> None:
    found = {path.relative_to(ROOT).as_posix(): unsaid(path.read_text()) for path in SOURCES}
    assert {path: names for path, names in found.items() if names} == {}


def test_what_is_not_said_is_found() -> None:
    text = '''
def few(a, b, c): pass
def none(a, b, c, *, d): pass
def some(a, b, c, d):
    """a, b : numbers;  cd : no parameter"""
def _own(a, b, c, d): pass
class Kept:
    def method(self, a, b, c, d):
        """a, b, c, d : all of them"""
    def other(self, a, b, c, d):
        """a, b, c : all but one"""
class _Own:
    def method(self, a, b, c, d): pass
'''
    assert unsaid(text) == {"none": ["a", "b", "c", "d"], "some": ["c", "d"], "Kept.other": ["d"]}
