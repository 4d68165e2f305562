"""Each line of the tables in docs/security.md names tests that exist."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in (ROOT / "docs" / "security.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("| ") and not line.startswith("| Way in")
]


def functions_of(path):
    """Return the names of the functions of a module that are not in a class."""
    return {node.name for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.FunctionDef)}


def test_the_tables_are_read():
    assert len(ROWS) > 20
    assert {len(row) for row in ROWS} == {5}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_each_promise_has_tests_that_exist(row):
    promise, tests = row[2], row[4]
    named = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", tests)
    assert promise
    assert re.sub(r"`tests/[\w/]+\.py::test_\w+`", "", tests).strip(", ") == ""
    assert named
    for path, name in named:
        assert name in functions_of(ROOT / path), f"{path} has no function {name}"
