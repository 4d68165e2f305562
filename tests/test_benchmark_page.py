"""The benchmark of the page in haste: the figures are there."""

import json

import pytest

from benchmarks import page as benchmark


@pytest.mark.nightly
def test_the_figures(tmp_path):
    file = tmp_path / "page.json"
    assert benchmark.main(["--quick", "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert set(benchmark.NOTES) <= set(figures)
    assert all(figures[key] >= 0 for key in benchmark.NOTES)
    # What no load spoils: memory.
    assert figures["server_gb"] < 0.5
    assert figures["download_mb"] < 300
