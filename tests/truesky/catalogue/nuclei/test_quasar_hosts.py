"""Tests of quasars in halos."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema.errors import BadInput
from lake_schema.store import validate
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue.galaxies import high_redshift
from truesky.catalogue.galaxies.lensing import Shear
from truesky.catalogue.halos import halos
from truesky.cosmology import FIDUCIAL
from truesky.fluxes.high_redshift import HUBBLE, QUASAR, ultraviolet_magnitude

CELLS, BOOST = range(40_000, 40_030), 6.0
AREA = len(CELLS) * 0.05245


def kind(boost=BOOST, limit=26.0, z_end=6.0):
    (quasars,) = high_redshift.model(FIDUCIAL, 0.0, boost, limit, z_end)
    return quasars


@pytest.fixture(scope="module")
def quasars(universe, dust):
    """Return the quasars of 30 cells, 1.6 deg2."""
    tables = high_redshift.hosts(kind(), universe.population.halos)
    rows = [high_redshift.draw_in_halos(cell, 5, kind(), tables, Shear(), dust) for cell in CELLS]
    return pa.concat_tables(rows)


def expected_number(z_1, z_2, limit=26.0):
    z, m = np.arange(z_1 + 0.01, z_2, 0.02), np.arange(-31.99, -22.0, 0.02)
    volume = FIDUCIAL.comoving_volume(z - 0.01, z + 0.01) * np.radians(1.0) ** 2 / HUBBLE**3
    number = high_redshift.density(QUASAR, kind().numbers, m, z[:, None]) * volume[:, None] * 0.02
    return float(number[ultraviolet_magnitude(FIDUCIAL, m, z[:, None]) < limit].sum())


def test_rows_follow_the_luminosity_function(quasars):
    """Numbers in three ranges of redshift, of quasars brighter than M_1450 = -22.

    Sample: 30 cells with 6 times the natural density. Significance: 4.5 Poisson errors, and 10 % for the clustering of
    halos in 1.6 deg2.
    """
    z = quasars["z_true"].to_numpy()
    for low, high in ((0.3, 1.5), (1.5, 2.5), (2.5, 6.0)):
        expected, found = BOOST * AREA * expected_number(low, high), np.sum((z > low) & (z < high))
        assert found == pytest.approx(expected, abs=4.5 * np.sqrt(expected) + 0.1 * expected), (low, high)
    m = quasars["abs_mag_r01"].to_numpy() + 5.0 * np.log10(HUBBLE)
    assert m.max() < -22.0
    assert validate.find_violations(quasars, GALAXIES) == []


def test_masses_of_hosts(quasars):
    """The median at z = 1 to 2 is 10^12.3 to 10^12.6 Msun/h. Sample: 700 quasars; its error is 0.015 dex."""
    z, mass = (quasars[name].to_numpy() for name in ("z_true", "log_halo_mass"))
    assert 12.3 < np.median(mass[(z > 1.0) & (z < 2.0)]) < 12.6
    assert 12.0 < np.median(mass[z > 3.0]) < 12.5


def test_each_quasar_is_in_a_halo_that_deep_requests_contain(universe, quasars):
    """Position, mass and identifier are those of a drawn halo, whatever the depth of galaxies."""
    cell = CELLS[3]
    every = halos.draw(universe.population.halos, 5, 8, cell, np.full(universe.population.halos.steps.z.size, 11.5))
    own = quasars.filter(pa.array(quasars["halo_id"].to_numpy() >> 40 == cell))
    place = {identifier: row for row, identifier in enumerate(every.id.tolist())}
    rows = [place[identifier] for identifier in own["halo_id"].to_pylist()]
    assert len(rows) > 10
    assert own["log_halo_mass"].to_numpy() == pytest.approx(every.log_mass[rows], abs=1e-5)
    np.testing.assert_array_equal(own["id"].to_numpy(), every.id[rows] | 2 << 60)
    assert np.unique(quasars["id"].to_numpy()).size == quasars.num_rows


@pytest.mark.parametrize(("limit", "z_end"), [(21.0, 6.0), (23.0, 2.0)])
def test_a_shallower_request_has_fewer_of_the_same(universe, dust, limit, z_end):
    cell, part = CELLS[0], kind(limit=limit, z_end=z_end)
    rows = []
    for wanted in (kind(), part):
        tables = high_redshift.hosts(wanted, universe.population.halos)
        rows.append(high_redshift.draw_in_halos(cell, 5, wanted, tables, Shear(), dust))
    many, few = rows
    selected = (many["mag_r01"].to_numpy() < limit) & (many["z_true"].to_numpy() < z_end)
    assert 0 < few.num_rows < many.num_rows
    assert few.equals(many.filter(pa.array(selected)))


def test_a_boost_for_which_halos_are_too_few_is_refused(universe):
    with pytest.raises(BadInput, match=r"universe.quasar_boost = 1000 must be at most 6\.\d+ with universe.variables"):
        high_redshift.hosts(kind(1000.0), universe.population.halos)


def test_the_clustering_is_that_of_heavy_halos(universe):
    """The mean bias of hosts at z = 1.55 is within 15 % of that of eBOSS, 2.45 (Laurent et al. 2017, JCAP 7, 17)."""
    tables = high_redshift.hosts(kind(), universe.population.halos)
    model = universe.population.halos
    step = int(np.argmin(np.abs(model.steps.z - 1.55)))
    weight = model.number[step] * tables.weight
    bias = np.sum(weight * model.x[step]) / np.sum(weight) / float(FIDUCIAL.growth(model.steps.z[step]))
    assert bias == pytest.approx(2.45, rel=0.15)
