"""Published star counts against the Milky Way in a few cells; benchmarks/stars.py has the full table."""

import json

import numpy as np
import pytest

from benchmarks import stars as benchmark
from tests.benchmarks import run
from truesky.catalogue.stars import stars
from truesky.validation.model import star_counts

KEYS = ("stars_per_s_core", "cell_peak_gb")


@pytest.mark.parametrize("b", [60, 20])
def test_counts_of_drawn_stars(b, dust):
    """The mean of 12 cells to I = 18 .. 24.5 and H = 18 .. 26 is within 15 % and its Poisson error.

    Sample of the 12 cells; significance 3e-3 (3 standard errors) beyond the 15 %.
    """
    found = star_counts.counts(b, 12, stars.model(), dust)
    published = np.array(star_counts.COUNTS[b], float)
    error = 3 * np.sqrt(published / (12 * star_counts.AREA))
    assert np.all(np.abs(found - published) < 0.15 * published + error)


def test_stars_far_from_the_plane():
    assert benchmark.count_far_from_plane(1024) == pytest.approx(benchmark.SKY_20, rel=0.15)


def test_bright_stars_of_the_whole_sky(dust):
    """Tycho-2 has 1.05e6 stars brighter than V = 11."""
    assert 0.85e6 < benchmark.brighter_than_11(61, dust) < 1.15e6


def test_stars_at_the_pole(dust):
    """Counts to G = 20 and V = 20 from the flux table agree with Bahcall & Soneira 1980, which is good to 15 %."""
    found = benchmark.pole_figures(12, dust)
    assert found["against_pole_g20"] == pytest.approx(1.0, abs=0.2)
    assert found["against_pole_v20"] == pytest.approx(1.0, abs=0.2)


@pytest.mark.nightly
def test_the_benchmark(tmp_path):
    file = tmp_path / "stars.json"
    run("stars", "--quick", "--json", file)
    figures = json.loads(file.read_text())
    assert set(KEYS) <= set(figures)
    assert {"name", "commit", "machine", "repeats"} <= set(figures)
    assert figures["cell_peak_gb"] < 1.5
