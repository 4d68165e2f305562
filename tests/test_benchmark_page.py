"""The benchmark of the page with --quick: all figures are present."""

import json

import pytest

from benchmarks import _browser
from benchmarks import page as benchmark


@pytest.mark.nightly
def test_the_figures(tmp_path):
    file = tmp_path / "page.json"
    assert benchmark.main(["--quick", "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    browsers = (
        {"cube_ms", "brush_1m_ms", "brush_1m_95_ms", "first_sky_browser_s"} if _browser.missing_requirement() else set()
    )
    assert set(benchmark.NOTES) - browsers <= set(figures)
    assert all(figures[key] >= 0 for key in set(benchmark.NOTES) - browsers)
    # Memory does not depend on the load of the machine.
    assert figures["server_gb"] < 0.5
    assert figures["download_mb"] < 300
