"""The benchmark of the catalogue."""

import json

import pytest

from tests.benchmarks import run


@pytest.mark.spark
@pytest.mark.nightly
def test_the_benchmark(tmp_path):
    pytest.importorskip("skypy", reason="skypy is not installed (extra bench)")
    file = tmp_path / "catalogue.json"
    run("catalogue", "--quick", "--json", file)
    figures = json.loads(file.read_text())
    keys = (
        "cell_rows", "cell_s", "cell_peak_gb", "speedup_2_cores", "galaxies_per_s_core", "photometry_vs_skypy",
        "projected_core_hours_922m",
    )  # fmt: skip
    assert {"name", "commit", "machine", "repeats", *keys} <= set(figures)
    assert figures["cell_peak_gb"] < 1.5
