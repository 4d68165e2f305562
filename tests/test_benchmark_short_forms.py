"""Benchmarks that have no test of their own: with --quick, they end and all results are numbers."""

import json
import math
from pathlib import Path

import pytest

from tests.benchmarks import run

ROOT = Path(__file__).resolve().parents[1]
SHORT = ("effects", "nisp_p", "planner", "preparation", "render", "stars", "vis", "wide_plan")
# The reference images need another environment; `report` has functions that the other modules share.
NOT_TESTED = {"cti_reference", "report"}


@pytest.mark.spark
@pytest.mark.nightly
@pytest.mark.parametrize("name", SHORT)
def test_the_short_form(tmp_path, name):
    file = tmp_path / "figures.json"
    run(name, "--quick", "--json", file)
    figures = json.loads(file.read_text())
    assert {"name", "commit", "machine", "repeats"} < set(figures)
    assert figures["name"] == name
    numbers = [value for key, value in figures.items() if key not in ("name", "commit", "machine", "repeats")]
    assert len(numbers) > 1
    assert all(math.isfinite(value) for value in numbers)


def test_every_benchmark_has_a_short_form_in_the_tests():
    names = {file.stem for file in (ROOT / "benchmarks").glob("[a-z]*.py")}
    tested = {file.stem.removeprefix("test_benchmark_") for file in (ROOT / "tests").glob("test_benchmark_*.py")}
    assert names - tested - NOT_TESTED == set(SHORT)
