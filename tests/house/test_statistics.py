"""Require that statistical tests state sample and significance (how often a correct program fails by chance)."""

import ast
import re
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
LAWS = {"kstest", "ks_2samp", "chisquare"}
# Multiples of a standard error that are limits of a statistical test.
FEWEST, MOST = 3, 6


def is_root(node):
    """Return True if a number is the square root of an expression that is not constant."""
    if isinstance(node, ast.Call) and ast.unparse(node.func) in ("np.sqrt", "math.sqrt"):
        inside = node.args[0]
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow) and ast.unparse(node.right) == "0.5":
        inside = node.left
    else:
        return False
    return any(isinstance(part, ast.Name) for part in ast.walk(inside))


def is_limit(node):
    """Return True if an expression is a few standard errors: a number times or divided by a square root."""
    if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Mult | ast.Div):
        return False
    first = node.left
    while isinstance(first, ast.BinOp) and isinstance(first.op, ast.Mult | ast.Div):
        first = first.left
    few = isinstance(first, ast.Constant) and isinstance(first.value, int | float) and FEWEST <= first.value <= MOST
    return few and 2 * first.value % 1 == 0 and any(is_root(part) for part in ast.walk(node))


# A file with none of these contains no statistical test, so it is not parsed.
STATISTICAL = re.compile("|".join((*LAWS, "sqrt", re.escape("**"))))


def silent(text):
    """Return functions that compare with a distribution or standard errors without sample and significance."""
    if not STATISTICAL.search(text):
        return
    for function in ast.walk(ast.parse(text)):
        if isinstance(function, ast.FunctionDef):
            parts = list(ast.walk(function))
            called = {part.func.attr for part in parts if isinstance(part, ast.Call) and hasattr(part.func, "attr")}
            said = (ast.get_docstring(function) or "").lower()
            is_said = re.search(r"\bsamples?\b", said) and "significance" in said
            if (called & LAWS or any(map(is_limit, parts))) and not is_said:
                yield function.name


def test_statistical_tests_state_sample_and_significance():
    found = {path.relative_to(TESTS).as_posix(): list(silent(path.read_text())) for path in TESTS.rglob("*.py")}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("assert stats.kstest(x, 'norm').pvalue > 0.01", True),
        ("assert abs(x.mean()) < 5 * x.std() / np.sqrt(x.size)", True),
        ("assert abs(x.mean()) < 4.5 / n**0.5", True),
        ("assert x == pytest.approx(n, abs=6.0 * np.sqrt(n))", True),
        ("assert radius == 4 * np.sqrt(3) * a", False),
        ("assert x == pytest.approx(2 * np.sqrt(n))", False),
        ("'''A sample of 50; significance 1e-3.'''\n    assert stats.chisquare(x).pvalue > 1e-3", False),
        ("'''A sample of 50.'''\n    assert stats.chisquare(x).pvalue > 1e-3", True),
    ],
)
def test_statements_without_significance_are_detected(line, found):
    assert list(silent(f"def test_x():\n    {line}\n")) == ["test_x"] * found
