"""Clustering at the size of halos: pairs of known points, the power law, and a few cells of the universe."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from tests.truesky.catalogue.conftest import BOX_CELLS, SEED
from truesky.catalogue.halos import matching
from truesky.request.schema import Universe
from truesky.validation import checks
from truesky.validation.model import small_scales

CELLS = 8


def test_pairs_are_counted_by_their_separation():
    ra, dec = np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.01, 0.04])
    theta = np.radians([0.005, 0.02, 0.035, 0.1])
    assert small_scales._count_pairs(ra, dec, theta).tolist() == [2.0, 2.0, 2.0]


def test_the_power_law_is_the_integral_along_the_line_of_sight():
    """With a constant number of galaxies per distance, w is twice the integral of xi along the line of sight."""
    chi, theta = np.linspace(1100.0, 1500.0, 400_001), np.array([3.0e-4, 3.001e-4])
    length, slope, near, far = small_scales.LENGTH, small_scales.SLOPE, 1100.0, 1500.0

    def along(at):
        across = at * theta.mean()
        return 2.0 * quad(lambda pi: (np.hypot(across, pi) / length) ** -slope, 0.0, np.inf, limit=200)[0]

    expected = quad(along, near, far)[0] / (far - near) ** 2
    assert small_scales.power_law(chi, theta)[0] == pytest.approx(expected, rel=1e-3)


@pytest.fixture(scope="module")
def found():
    return small_scales.figures(small_scales.galaxy_population(SEED, Universe(box_cells=BOX_CELLS)), CELLS)


def test_galaxies_cluster_as_observed(found):
    """With a few cells the tolerance is that of the list plus two errors."""
    results = [check for check in checks.evaluate(found, 2.0) if check.name.startswith("w_m20")]
    assert len(results) == 3
    assert [(check.name, check.value) for check in results if check.is_unexpected_failure] == []


def test_a_check_fails_without_structure_below_the_cells(found):
    """The sample is the one with structure, 8 cells with the same halos, so that both share most of their noise.

    Seeds are fixed: the checks have no tolerance for the noise of the sample, and no chance of failure.
    """
    without = small_scales.figures(_without_structure(), CELLS)
    assert without["w_m20_0.32"] < 0.85 * found["w_m20_0.32"]
    assert _failing(found) == []
    assert _failing(without) == ["w_m20_0.32"]


@pytest.mark.nightly
def test_a_check_fails_without_structure_below_the_cells_in_many_cells():
    """With 96 cells, the tolerances of the list are increased by one standard error of the sample."""
    populations = small_scales.galaxy_population(SEED, Universe(box_cells=BOX_CELLS)), _without_structure()
    whole, without = (small_scales.figures(population, 96) for population in populations)
    assert _failing(whole, 1.0) == []
    assert _failing(without, 1.0) == ["w_m20_0.32"]


def _without_structure():
    return small_scales.galaxy_population(SEED, Universe(box_cells=BOX_CELLS, structure_below_cells=False))


def _failing(figures, n_sigma=0.0):
    results = checks.evaluate(figures, n_sigma)
    return [check.name for check in results if check.name.startswith("w_m20") and not check.passes]


@pytest.mark.nightly
def test_galaxies_cluster_less_with_satellites_of_today(found, monkeypatch):
    monkeypatch.setattr(matching, "Occupation", lambda **values: replace(_OCCUPATION(**values), ratio_z=0.0))
    fewer = small_scales.figures(small_scales.galaxy_population(SEED, Universe(box_cells=BOX_CELLS)), CELLS)
    assert fewer["w_m20_0.04"] < 0.85 * found["w_m20_0.04"]


_OCCUPATION = matching.Occupation
