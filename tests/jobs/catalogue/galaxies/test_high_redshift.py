"""Galaxies and quasars beyond redshift 6, and the boost of their numbers."""

import numpy as np
import pytest

from jobs.catalogue.galaxies import high_redshift
from jobs.fluxes.high_redshift import HIGH_REDSHIFT, QUASAR
from lake_schema import ids
from lake_schema.store import validate
from lake_schema.tables.galaxies import GALAXIES

GALAXIES_BEYOND, QUASARS = high_redshift.model()


def between(kind, near, far):
    inside = (kind.z > near - 1e-6) & (kind.z < far - 1e-6)
    return float(kind.counts[inside].sum())


def test_galaxies_beyond_6():
    """Integrals of Bouwens et al. 2021 to H = 26, per deg2."""
    found = [between(GALAXIES_BEYOND, z, z + 1) for z in (6, 7, 8, 9)]
    assert found == pytest.approx([560, 138, 31, 6], rel=0.10)


def test_quasars_beyond_6():
    """Matsuoka et al. 2018 with the decline of Barnett et al. 2019, to H = 25, per deg2."""
    assert [between(QUASARS, z, z + 1) for z in (6, 7, 8)] == pytest.approx([0.196, 0.030, 0.0047], rel=0.10)


def test_a_boost_is_written_beside_its_rows(universe, dust):
    for code, kind in (
        (HIGH_REDSHIFT, high_redshift.model(8.0, 0.0)[0]),
        (QUASAR, high_redshift.model(0.0, 4500.0)[0]),
    ):
        rows = high_redshift.draw(1234, 5, kind, universe.lens, dust)
        assert validate.violations(rows, GALAXIES) == []
        assert len(rows) == pytest.approx(kind.boost * kind.per_deg2 * 0.05245, abs=5 * np.sqrt(len(rows)))
        assert np.all(rows["density_boost"].to_numpy() == kind.boost)
        assert np.all(ids.kind_of(rows["id"].to_numpy()) == code)
        assert rows["mag_r01"].to_numpy().max() < kind.numbers["limit"] + 0.05
        assert rows["z_true"].to_numpy().min() >= 6.0
        again = high_redshift.draw(1234, 5, kind, universe.lens, dust)
        assert again.equals(rows)


def test_nothing_is_drawn_without_a_boost():
    assert high_redshift.model(0.0, 0.0) == ()


def test_fluxes_can_be_computed(universe, dust):
    from jobs.fluxes import high_redshift as spectra
    from jobs.fluxes import passbands

    rows = high_redshift.draw(77, 5, GALAXIES_BEYOND, universe.lens, dust)
    flux = spectra.fluxes(rows, [passbands.load("lsst_g"), passbands.load("euclid_h")])
    assert np.all(flux[:, 1] > 0)
    # Nothing below Lyman alpha, but for what the filter leaks.
    assert np.all(flux[:, 0] < 1e-3 * flux[:, 1])
    assert np.median(23.9 - 2.5 * np.log10(flux[:, 1])) == pytest.approx(25.6, abs=0.5)


def test_they_are_in_the_catalogue(drawn):
    number = np.sum(drawn.every["kind"].to_numpy() == HIGH_REDSHIFT)
    assert number == pytest.approx(735 * drawn.area, rel=0.15)
