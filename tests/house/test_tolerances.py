"""Require that tests state the tolerances of comparisons."""

import ast
from pathlib import Path

import numpy as np
import pytest

from tests import tolerances

TESTS = Path(__file__).resolve().parents[1]
TINY = 1e-15


@pytest.mark.parametrize(
    "expected",
    [
        TINY, -TINY, np.float32(TINY), 1j * TINY, [1.0, TINY], (0.0, (TINY, 3.0)), {"large": 1.0, "small": TINY},
        np.array([[1.0, np.inf], [np.nan, TINY]]), np.array([1e20, -TINY], np.float32),
    ],
    ids=str,
)  # fmt: skip
def test_tiny_numbers_need_an_absolute_tolerance(expected):
    for tolerance in ({}, {"rel": 1e-3}, {"rel": 1e-9, "nan_ok": True}):
        with pytest.raises(ValueError, match=r"approx of 1e-15 .* give rel and abs=0.0"):
            pytest.approx(expected, **tolerance)
    if not isinstance(expected, tuple):
        assert expected == pytest.approx(expected, rel=1e-3, abs=0.0, nan_ok=True)


def test_small_relative_tolerances_need_an_absolute_tolerance():
    with pytest.raises(ValueError, match="approx of 1 within 1e-12"):
        pytest.approx(1.0, rel=1e-13)
    with pytest.raises(ValueError, match="approx of 2e-07 within 1e-12"):
        pytest.approx([3.0, 2e-7])
    assert pytest.approx(1.0, rel=1e-13, abs=0.0) != 1.0 + 1e-12


@pytest.mark.parametrize("expected", [0.0, 1.0, -3e-6, [0.0, 5.0], {}, [], np.zeros(3), np.nan, np.inf, {"a": None}])
def test_other_numbers_are_compared_as_by_pytest(expected):
    assert expected == pytest.approx(expected, nan_ok=True)
    assert pytest.approx(3.0, rel=0.1) == 3.2
    assert pytest.approx(3.0, rel=0.1) != 3.4
    assert pytest.approx(0.0, abs=0.1) == 0.05


def test_all_tests_use_the_strict_approx():
    assert pytest.approx is tolerances.approx
    assert not [path for path in TESTS.rglob("*.py") if "import approx" in path.read_text() and path != Path(__file__)]


def test_absolute_tolerance_of_numpy_comparisons_is_stated():
    """The default is 1e-8 for isclose and allclose, and 0 for assert_allclose."""
    silent = [
        f"{path.relative_to(TESTS)}:{call.lineno}"
        for path in sorted(TESTS.rglob("*.py"))
        if "close" in (text := path.read_text())
        for call in ast.walk(ast.parse(text))
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Attribute)
        and call.func.attr in ("isclose", "allclose")
        and not any(keyword.arg in ("atol", "abs_tol") for keyword in call.keywords)
    ]
    assert silent == []
