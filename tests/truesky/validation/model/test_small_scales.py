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
def cells():
    """Return w relative to the power law by cell and bin, with structure below the cells of the box."""
    return small_scales.measure_cells(_universe(), CELLS)


@pytest.fixture(scope="module")
def found(cells):
    return small_scales.summarise(cells)


def _universe(**settings):
    return small_scales.galaxy_population(SEED, Universe(box_cells=BOX_CELLS, **settings))


def test_galaxies_cluster_as_observed(found):
    """With a few cells the tolerance is that of the list plus two errors."""
    results = [check for check in checks.evaluate(found, 2.0) if check.name.startswith("w_m20")]
    assert len(results) == 3
    assert [(check.name, check.value) for check in results if check.is_unexpected_failure] == []


def test_structure_below_the_cells_adds_clustering(cells):
    """Both universes have the same halos except for their positions below the cells, and hence share much noise."""
    without = small_scales.measure_cells(_universe(structure_below_cells=False), CELLS)
    difference, error = _add_by_structure(cells, without)
    assert difference > 2.0 * error
    assert error < 0.5 * small_scales.summarise(cells)["w_m20_0.32_error"]


@pytest.mark.nightly
def test_a_check_fails_without_structure_below_the_cells():
    """A universe that clusters as observed passes, and fails without what the structure adds, which is 0.19 +- 0.04."""
    samples = [small_scales.measure_cells(_universe(structure_below_cells=value), 96) for value in (True, False)]
    difference, error = _add_by_structure(*samples)
    assert difference > 4.0 * error
    assert _failing({"w_m20_0.32": 1.0}) == []
    assert _failing({"w_m20_0.32": 1.0 - difference}) == ["w_m20_0.32"]


def _add_by_structure(with_structure, without):
    """Return by how much structure below the cells increases w at 0.32 to 1.28 Mpc/h, and the error."""
    results = small_scales.summarise(with_structure - without)
    return results["w_m20_0.32"], results["w_m20_0.32_error"]


def _failing(figures):
    return [check.name for check in checks.evaluate(figures) if not check.passes]


@pytest.mark.nightly
def test_galaxies_cluster_less_with_satellites_of_today(found, monkeypatch):
    monkeypatch.setattr(matching, "Occupation", lambda **values: replace(_OCCUPATION(**values), ratio_z=0.0))
    fewer = small_scales.figures(_universe(), CELLS)
    assert fewer["w_m20_0.04"] < 0.85 * found["w_m20_0.04"]


_OCCUPATION = matching.Occupation
