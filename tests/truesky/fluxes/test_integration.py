"""Compare fast band fluxes with whole spectra, and test that irrelevant changes have no effect."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import units
from lake_schema.errors import BadInput
from lake_schema.store import validate
from lake_schema.tables.fluxes import fluxes
from truesky.fluxes import band_fluxes, integration, passbands
from truesky.fluxes.libraries import vega

# Space and ground, ultraviolet to infrared, one of them with a gap to the others.
BANDS = ("euclid_h", "lsst_u", "gaia_bp", "twomass_ks", "cfis_u")


def columns(table: pa.Table) -> np.ndarray:
    return np.stack([table[name].to_numpy() for name in table.column_names if name.startswith("f_nu_")], 1)


def whole(table, library):
    out = []
    for name in BANDS:
        band = passbands.load(name)
        out.append(band_fluxes.band_fluxes(band_fluxes.galaxy_spectra(table, library, band.medium), [band])[:, 0])
    return np.stack(out, 1)


def test_galaxy_fluxes_agree_with_whole_spectra(galaxies, library):
    table = galaxies(40)
    fast = band_fluxes.galaxy_fluxes(table, BANDS, library)
    np.testing.assert_allclose(columns(fast), whole(table, library), rtol=1e-6)
    for name in ("id", "ra", "dec", "_healpix_29"):
        assert fast[name].equals(table[name])


@pytest.mark.parametrize("band", ["euclid_h", "cfis_u"])
def test_the_reference_band_may_lie_elsewhere(galaxies, library, band):
    table = galaxies(10)
    got = columns(band_fluxes.galaxy_fluxes(table, [band], library))[:, 0]
    np.testing.assert_allclose(got, whole(table, library)[:, BANDS.index(band)], rtol=1e-6)


def test_line_fluxes_agree_with_whole_spectra(galaxies, library):
    table = galaxies(30, mag_r01=45.0)
    np.testing.assert_allclose(
        columns(band_fluxes.galaxy_fluxes(table, BANDS, library)), whole(table, library), rtol=1e-6
    )


def test_a_source_does_not_depend_on_its_neighbours(galaxies, library, monkeypatch):
    table = galaxies(60)
    wanted = columns(band_fluxes.galaxy_fluxes(table, BANDS, library))
    rng = np.random.default_rng(8)
    order = rng.permutation(60)
    shuffled = columns(band_fluxes.galaxy_fluxes(table.take(order), BANDS, library))
    np.testing.assert_allclose(shuffled, wanted[order], rtol=2e-7)
    monkeypatch.setattr(integration, "_BLOCK", 1)
    monkeypatch.setattr(band_fluxes, "_SLICE", 7)
    alone = columns(band_fluxes.galaxy_fluxes(table, BANDS, library))
    np.testing.assert_allclose(alone, wanted, rtol=2e-7)


def test_a_band_does_not_depend_on_the_others(galaxies, library):
    table = galaxies(10)
    wanted = columns(band_fluxes.galaxy_fluxes(table, BANDS, library))
    for k, name in enumerate(BANDS):
        np.testing.assert_allclose(
            columns(band_fluxes.galaxy_fluxes(table, [name], library))[:, 0], wanted[:, k], rtol=2e-7
        )


def test_star_fluxes_agree_with_whole_spectra(stars, stars_library):
    table = stars(100)
    curves = [passbands.load(name) for name in BANDS]
    wanted = band_fluxes.band_fluxes(band_fluxes.star_spectra(table, stars_library), curves)
    got = band_fluxes.star_fluxes(table, BANDS, stars_library)
    np.testing.assert_allclose(columns(got), wanted, rtol=1e-6)
    assert got["id"].equals(table["id"])


def test_stars_have_their_vega_magnitude_in_h(stars, stars_library):
    """For every spectrum before dust, m_AB of the flux in 2MASS H is mag_h + 1.3753."""
    n = len(stars_library)
    table = stars(n, sed=np.arange(n), a_v=0.0)
    flux = band_fluxes.star_fluxes(table, ["twomass_h"], stars_library)["f_nu_twomass_h"].to_numpy()
    (level,) = vega.vega_magnitudes([passbands.load("twomass_h")])
    assert level == pytest.approx(1.3753, abs=1e-4)
    np.testing.assert_allclose(units.mag_of_f_nu(flux) - table["mag_h"].to_numpy(), level, atol=1e-5)


def test_the_tables_are_the_declared_ones(galaxies, stars, library, stars_library):
    made = band_fluxes.galaxy_fluxes(galaxies(), BANDS, library)
    assert made.schema.equals(fluxes("galaxy", BANDS).arrow_schema(), check_metadata=True)
    assert validate.find_violations(made, fluxes("galaxy", BANDS)) == []
    made = band_fluxes.star_fluxes(stars(), BANDS, stars_library)
    assert made.schema.equals(fluxes("star", BANDS).arrow_schema(), check_metadata=True)


def test_no_rows_no_bands(galaxies, stars, library, stars_library):
    assert band_fluxes.galaxy_fluxes(galaxies().slice(0, 0), BANDS, library).num_rows == 0
    assert band_fluxes.star_fluxes(stars().slice(0, 0), BANDS, stars_library).num_rows == 0
    with pytest.raises(BadInput, match="passbands: at least one"):
        band_fluxes.galaxy_fluxes(galaxies(), [], library)
    with pytest.raises(BadInput, match="nonsense"):
        band_fluxes.galaxy_fluxes(galaxies(), ["nonsense"], library)
    with pytest.raises(BadInput, match="_healpix_29"):
        band_fluxes.galaxy_fluxes(galaxies().drop_columns(["_healpix_29"]), BANDS, library)


def test_a_galaxy_without_light_after_dust_is_refused(bare, library):
    table = bare(z_obs=6.0, sed_1=0, ext_law_1=1, ebv_1=3.0)
    with pytest.raises(BadInput, match="no light in the reference band"):
        band_fluxes.galaxy_fluxes(table, BANDS, library)


def test_strong_dust_behind_a_high_redshift_is_finite(galaxies, library):
    table = galaxies(200, ebv_1=2.0, ebv_2=2.0)
    got = columns(band_fluxes.galaxy_fluxes(table, BANDS, library))
    assert np.isfinite(got).all()
    assert (got > 0.0).all()
