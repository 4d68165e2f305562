"""Quasars, galaxies beyond redshift 6, and the boost of their numbers."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids
from lake_schema.store import validate
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue.galaxies import high_redshift
from truesky.cosmology import FIDUCIAL
from truesky.fluxes.high_redshift import HIGH_REDSHIFT, QUASAR, ultraviolet_magnitude

GALAXIES_BEYOND, QUASARS = high_redshift.model(FIDUCIAL)
# Table 7 (PLE + LEDE) of Palanque-Delabrouille et al. 2016 has 223 deg-2 to r = 22.5; fits to it, summed separately.
COUNTS = {19.0: 7.4, 20.0: 32.0, 21.0: 87.0, 22.0: 178.0, 22.5: 240.0, 23.0: 316.0}


def quasars(pivot, limits):
    """Return the number per deg2 brighter than magnitudes at a wavelength (A), for f_nu ~ nu^-0.5."""
    numbers = high_redshift.parameters.section("high_redshift.toml", "quasars")
    z, m = np.arange(0.31, 6.0, 0.02), np.arange(-31.99, -15.0, 0.02)
    volume = FIDUCIAL.comoving_volume(z - 0.01, z + 0.01) * np.radians(1.0) ** 2 / 0.67**3
    number = high_redshift.density(QUASAR, numbers, m, z[:, None]) * volume[:, None] * 0.02
    seen = ultraviolet_magnitude(FIDUCIAL, m, z[:, None]) - 1.25 * np.log10(pivot / (1450.0 * (1.0 + z)))[:, None]
    return [float(number[seen < limit].sum()) for limit in limits]


def test_galaxies_beyond_6():
    """Integrals of Bouwens et al. 2021 to H = 26, per deg2."""
    found = [GALAXIES_BEYOND.per_deg2(z, z + 1) for z in (6, 7, 8, 9)]
    assert found == pytest.approx([560, 138, 31, 6], rel=0.10)


def test_quasars_beyond_6():
    """Matsuoka et al. 2018 with the decline of Barnett et al. 2019, to H = 25, per deg2."""
    (_, far) = high_redshift.model(FIDUCIAL, limit=25.0)
    assert [far.per_deg2(z, z + 1) for z in (6, 7, 8)] == pytest.approx([0.196, 0.030, 0.0047], rel=0.10)


def test_quasars_below_6():
    assert quasars(7600.0, COUNTS) == pytest.approx(list(COUNTS.values()), rel=0.02)
    assert quasars(6200.0, [22.5]) == pytest.approx([223.0], rel=0.15)


def test_the_two_populations_of_quasars_meet():
    """At z = 6: 0.76 - 0.95 of Matsuoka et al. 2018 from M = -26 to -23."""
    numbers, m = high_redshift.parameters.section("high_redshift.toml", "quasars"), np.arange(-26.0, -22.9, 0.5)
    ratio = np.divide(*(high_redshift.density(QUASAR, numbers, m, np.full(m.size, z)) for z in (5.999, 6.001)))
    assert np.all((ratio > 0.73) & (ratio < 0.96))


@pytest.mark.parametrize(("limit", "z_end"), [(23.0, 6.0), (24.4, 6.0), (25.5, 2.5)])
def test_a_shallower_or_nearer_request_is_part_of_a_deeper_one(universe, dust, limit, z_end):
    for deep, part in zip(
        high_redshift.model(FIDUCIAL, 30.0, 30.0), high_redshift.model(FIDUCIAL, 30.0, 30.0, limit, z_end), strict=True
    ):
        whole, some = (high_redshift.draw(99, 5, kind, universe.lens, dust) for kind in (deep, part))
        mag, z = whole["mag_r01"].to_numpy(), whole["z_true"].to_numpy()
        assert some.equals(whole.filter(pa.array((mag < limit) & ((z < z_end) | (z >= 6.0)))))
        assert 0 < some.num_rows < whole.num_rows or limit < 24.0


def test_rows_contain_the_boost(universe, dust):
    """Sample of one cell of each kind; significance 6e-7 of its number (5 standard errors)."""
    for code, kind in (
        (HIGH_REDSHIFT, high_redshift.model(FIDUCIAL, 8.0, 0.0)[0]),
        (QUASAR, high_redshift.model(FIDUCIAL, 0.0, 20.0)[0]),
    ):
        rows = high_redshift.draw(1234, 5, kind, universe.lens, dust)
        assert validate.find_violations(rows, GALAXIES) == []
        assert len(rows) == pytest.approx(kind.boost * kind.per_deg2() * 0.05245, abs=5 * np.sqrt(len(rows)))
        assert np.all(rows["density_boost"].to_numpy() == kind.boost)
        assert np.all(ids.kind_from_id(rows["id"].to_numpy()) == code)
        assert rows["mag_r01"].to_numpy().max() < 26.0
        assert rows["z_true"].to_numpy().min() >= (0.3 if code == QUASAR else 6.0)
        assert np.unique(rows["id"].to_numpy()).size == len(rows)
        again = high_redshift.draw(1234, 5, kind, universe.lens, dust)
        assert again.equals(rows)


def test_nothing_is_drawn_without_a_boost():
    assert high_redshift.model(FIDUCIAL, 0.0, 0.0) == ()


def test_fluxes_can_be_computed(universe, dust):
    from truesky.fluxes import high_redshift as spectra
    from truesky.fluxes import passbands

    rows = high_redshift.draw(77, 5, GALAXIES_BEYOND, universe.lens, dust)
    flux = spectra.fluxes(rows, [passbands.load("lsst_g"), passbands.load("euclid_h")])
    assert np.all(flux[:, 1] > 0)
    # No flux below Lyman alpha, except through the leaks of the filter.
    assert np.all(flux[:, 0] < 1e-3 * flux[:, 1])
    assert np.median(23.9 - 2.5 * np.log10(flux[:, 1])) == pytest.approx(25.6, abs=0.5)


def test_they_are_in_the_catalogue(drawn):
    number = np.sum(drawn.every["kind"].to_numpy() == HIGH_REDSHIFT)
    assert number == pytest.approx(735 * drawn.area, rel=0.15)
