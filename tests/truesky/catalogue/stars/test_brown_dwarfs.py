"""Brown dwarfs: counts, colours of their templates, and the boost of their numbers."""

import numpy as np
import pytest

from lake_schema import sky
from tests.truesky.catalogue.conftest import SEED
from truesky.catalogue.stars import brown_dwarfs, milky_way, stars
from truesky.fluxes import passbands
from truesky.fluxes.libraries import brown_dwarfs as spectra
from truesky.fluxes.libraries import templates
from truesky.fluxes.libraries.vega import vega_magnitude
from truesky.validation.model.star_counts import DWARFS as DWARF_COUNTS

GALAXY = milky_way.milky_way()
DWARFS = brown_dwarfs.brown_dwarfs(1.0)
TYPES = spectra.templates()


@pytest.mark.parametrize("b", DWARF_COUNTS)
def test_counts(b, rng):
    """L and T dwarfs over 100 deg2 along one line of sight.

    Sample of the total number; significance 3e-3 for the largest number (3 standard errors), or 20 %.
    """
    found = brown_dwarfs.draw(DWARFS, GALAXY, 90.0, float(b), 100.0, 30.0, rng)
    m_j = TYPES.abs_mag_j[found.template] + 5 * np.log10(found.distance) - 5
    is_t = TYPES.subtype[found.template] >= 10
    for kind, published in ((~is_t, DWARF_COUNTS[b][:3]), (is_t, DWARF_COUNTS[b][3:])):
        number = np.array([np.sum(kind & (m_j < limit)) for limit in (22, 24, 26)]) / 100.0
        published = np.array(published, float)
        assert number == pytest.approx(published, rel=0.2, abs=3 * np.sqrt(published.max() / 100))


def test_numbers_are_those_that_are_drawn(rng):
    """Samples of 50 deg2 and of 500 deg2; significance 6e-7 (5 standard errors)."""
    place = (90.0, 40.0, 50.0, 24.0)
    expected = brown_dwarfs.expected_counts(
        DWARFS, GALAXY, *(np.array([v]) for v in place[:2]), 50.0, np.array([24.0])
    )[0]
    assert brown_dwarfs.draw(DWARFS, GALAXY, *place, rng).distance.size == pytest.approx(
        expected, abs=5 * expected**0.5
    )
    boosted = brown_dwarfs.brown_dwarfs(10.0)
    found = brown_dwarfs.draw(boosted, GALAXY, *place, rng).distance.size
    assert found == pytest.approx(10 * expected, abs=5 * (10 * expected) ** 0.5)


def test_all_templates_take_part(rng):
    found = brown_dwarfs.draw(DWARFS, GALAXY, 90.0, 20.0, 2000.0, 28.0, rng)
    assert np.bincount(found.template, minlength=365).min() > 0


def test_templates_have_the_stated_colours():
    """J - H of the spectra themselves."""
    library = templates.stellar_library()
    assert library.names[DWARFS.first_template : DWARFS.first_template + 365] == spectra.template_names()
    flux = library.flux[DWARFS.first_template : DWARFS.first_template + 365].astype(float)
    mags = []
    for name in ("twomass_j", "twomass_h"):
        band = passbands.load(name)
        f_nu = flux[:, band.first : band.first + len(band.wavelength)] @ passbands.weights(band)
        mags.append(-2.5 * np.log10(f_nu) - vega_magnitude(band))
    assert mags[0] - mags[1] == pytest.approx(TYPES.abs_mag_j - TYPES.abs_mag_h, abs=2e-3)


def test_rows_contain_the_boost_and_other_stars_do_not_change(dust):
    cell = 402_512
    plain, boosted, none = (
        stars.draw(cell, SEED, stars.model(22.0, brown_dwarf_boost=boost), dust) for boost in (1.0, 50.0, 0.0)
    )
    is_brown = boosted["component"].to_numpy() == stars.BROWN
    assert is_brown.sum() > 50 * 0.3
    boosts = boosted["density_boost"].to_numpy()
    assert set(boosts[is_brown]) == {50.0}
    assert set(boosts[~is_brown]) == {1.0}
    assert boosted.filter(~is_brown).equals(none)
    assert plain.filter(plain["component"].to_numpy() != stars.BROWN).equals(none)
    rows = boosted.filter(is_brown)
    assert np.all(rows["stage"].to_numpy() == 3)
    assert np.all((rows["sed"].to_numpy() >= 76) & (rows["sed"].to_numpy() < 441))
    assert np.all(rows["teff"].to_numpy() < 2400)
    assert np.all(sky.cell_at(rows["ra"].to_numpy(), rows["dec"].to_numpy(), 8) == cell)
