"""The benchmark of the first minutes of a new user."""

import json

import pytest

from tests.benchmarks import run


@pytest.mark.spark
@pytest.mark.nightly
def test_the_benchmark(tmp_path):
    file = tmp_path / "first_minutes.json"
    run("first_minutes", "--quick", "--json", file)
    figures = json.loads(file.read_text())
    assert {"help_s", "check_s", "count_s", "small_cold_s", "small_warm_s", "worst_time", "worst_bytes"} <= set(figures)
    # Sizes do not depend on the load of the machine.
    assert 0.8 < figures["small_warm_lake_ratio"] < 1.2
    assert figures["longest_silence_s"] > 0.0
