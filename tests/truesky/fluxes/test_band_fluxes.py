"""Test spectra end to end: each step of appendix B of Serrano et al. 2024, and its misprints."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import units
from lake_schema.errors import OutOfRange
from truesky.fluxes import band_fluxes, passbands
from truesky.fluxes.libraries import vega as libraries_vega
from truesky.fluxes.spectra import extinction, lines
from truesky.request.accuracy import SURVEY

GRID = passbands.grid()
R01 = passbands.load("sdss_r01")


def reference_magnitude(f_lambda):
    return units.mag_of_f_nu(band_fluxes.band_fluxes(f_lambda, [R01])[:, 0])


def test_the_continuum_has_its_reference_magnitude(bare, library):
    n = 31
    table = bare(n, sed_1=np.arange(n), ext_law_1=3, ebv_1=0.4, z_obs=np.linspace(0.0, 2.3, n))
    f_lambda = band_fluxes.galaxy_spectra(table, library)
    assert f_lambda.shape == (n, 23401)
    assert (f_lambda >= 0.0).all()
    np.testing.assert_allclose(reference_magnitude(f_lambda), table["mag_r01"].to_numpy(), atol=1e-6)


@pytest.mark.parametrize("mag", [-5.0, 60.0])
def test_extreme_magnitudes_neither_overflow_nor_underflow(bare, library, mag):
    # With the printed 10^(-0.4 m + 48.6) the spectrum would be 10^68 too bright.
    f_lambda = band_fluxes.galaxy_spectra(bare(mag_r01=mag, z_obs=0.5), library)
    assert float(reference_magnitude(f_lambda)[0]) == pytest.approx(mag, abs=1e-6)
    at_r = f_lambda[0, 5624 - 600]
    assert at_r == pytest.approx(3.63e-20 * 10 ** (-0.4 * mag) * 2.998e18 / 5624.0**2, rel=0.5, abs=0.0)


def test_redshift_moves_the_edges(bare, library):
    # 30 has a Lyman edge: at 912 (1 + z).
    f_lambda = band_fluxes.galaxy_spectra(bare(sed_1=30, sed_2=30, z_obs=1.0), library)[0]
    at = 2 * 912 - 600
    assert f_lambda[at - 6] < 0.05 * f_lambda[at + 6]


@pytest.mark.parametrize("medium", ["vacuum", "air"])
def test_lines_hold_their_flux_in_the_spectrum(bare, library, medium):
    table = bare(flux_halpha=1e-15, flux_oiii=3e-16, z_obs=0.7, mag_r01=28.0)
    without = band_fluxes.galaxy_spectra(bare(z_obs=0.7, mag_r01=28.0), library, medium)
    only = band_fluxes.galaxy_spectra(table, library, medium) - without
    assert only.sum() == pytest.approx(1e-15 + (1.0 + 1.0 / 2.98) * 3e-16, rel=1e-6, abs=0.0)
    centre = float(lines.observed_wavelength(6564.614, 0.7, medium))
    near = np.abs(GRID - centre) < 60.0
    assert only[0, near].sum() == pytest.approx(1e-15, rel=1e-6, abs=0.0)
    assert GRID[near][np.argmax(only[0, near])] == pytest.approx(centre, abs=0.5)


def test_the_lens_magnifies_continuum_and_lines_alike(galaxies, library):
    still = galaxies(5, kappa=0.0, gamma1=0.0, gamma2=0.0)
    lensed = galaxies(5, kappa=0.2, gamma1=0.1, gamma2=-0.2)
    mu = 1.0 / ((1.0 - 0.2) ** 2 - 0.1**2 - 0.2**2)
    before, after = (band_fluxes.galaxy_spectra(table, library) for table in (still, lensed))
    np.testing.assert_allclose(after, mu * before, rtol=1e-12)


def test_the_milky_way_dims_with_its_curve(galaxies, library):
    # The printed A = E(B-V) R_V would dim all wavelengths equally.
    clear, dusty = (band_fluxes.galaxy_spectra(galaxies(4, a_v=a_v), library) for a_v in (0.0, 1.24))
    seen = clear > 0.0
    magnitudes = -2.5 * np.log10(dusty[seen] / clear[seen])
    curve = np.broadcast_to(1.24 * extinction.milky_way(GRID), clear.shape)[seen]
    np.testing.assert_allclose(magnitudes, curve, rtol=1e-9)
    assert np.ptp(magnitudes) > 1.0


def test_internal_dust_reddens_at_fixed_reference_magnitude(bare, library):
    n = 10
    table = bare(n, ext_law_1=2, ebv_1=np.linspace(0.0, 0.5, n), sed_1=15, z_obs=0.1, mag_r01=20.0)
    f_nu = band_fluxes.band_fluxes(band_fluxes.galaxy_spectra(table, library), [passbands.load("lsst_u"), R01])
    assert (np.diff(f_nu[:, 0]) < 0.0).all()
    np.testing.assert_allclose(f_nu[:, 1], f_nu[0, 1], rtol=1e-6)


def test_message_names_sources_beyond_the_critical_curve(galaxies, library):
    kappa = np.zeros(20)
    kappa[4] = 0.99
    with pytest.raises(OutOfRange, match="magnification of source 104"):
        band_fluxes.galaxy_spectra(galaxies(kappa=kappa), library)


def test_stars_have_their_vega_magnitude_in_h(stars, stars_library):
    # Read as AB, as printed, H would be off by 1.37 mag.
    table = stars(30, a_v=0.0)
    f_lambda = band_fluxes.star_spectra(table, stars_library)
    band = passbands.load("twomass_h")
    vega = float(passbands.ab_flux(band, *libraries_vega.vega()))
    seen = units.cgs_of_ujy(band_fluxes.band_fluxes(f_lambda, [band])[:, 0])
    np.testing.assert_allclose(-2.5 * np.log10(seen / vega), table["mag_h"].to_numpy(), atol=1e-6)


def test_dust_on_the_way_to_a_star_comes_after_its_magnitude(stars, stars_library):
    clear, dusty = (band_fluxes.star_spectra(stars(6, a_v=a_v), stars_library) for a_v in (0.0, 0.5))
    seen = clear > 0.0
    curve = np.broadcast_to(0.5 * extinction.milky_way(GRID), clear.shape)[seen]
    np.testing.assert_allclose(-2.5 * np.log10(dusty[seen] / clear[seen]), curve, rtol=1e-9)


def test_synthetic_photometry_is_speclites(galaxies, library):
    import astropy.units as u
    from speclite.filters import load_filter

    # Bright: a strong line in the outermost 1e-5 of a band, which is cut off, does not show.
    f_lambda = band_fluxes.galaxy_spectra(galaxies(5, mag_r01=20.0), library)
    pairs = {
        "euclid_vis": "Euclid-VIS",
        "euclid_h": "Euclid-H",
        "lsst_r": "lsst2023-r",
        "gaia_g": "gaiadr2-G",
    }
    got = band_fluxes.band_fluxes(f_lambda, [passbands.load(name) for name in pairs])
    for k, published in enumerate(pairs.values()):
        maggies = load_filter(published).get_ab_maggies(f_lambda * u.erg / u.s / u.cm**2 / u.AA, GRID * u.AA)
        # speclite's are relative to 3631 Jy; 1e-4 mag.
        np.testing.assert_allclose(got[:, k], 3631e6 * np.asarray(maggies), rtol=0.9e-4)


def test_dust_is_applied_at_every_wavelength_not_to_the_band(bare, library):
    """A band's extinction at E(B-V) = 0.2, scaled to 0.5 as printed, is wrong in wide and in steep bands."""

    def dimming(band, **dust):
        clear, dim = (np.asarray(t[f"f_nu_{band}"], float)[0] for t in (flux(), flux(**dust)))
        return -2.5 * np.log10(dim / clear)

    def flux(**dust):
        table = bare(sed_1=8, sed_2=8, z_obs=0.4, mag_r01=20.0, **dust)
        return band_fluxes.galaxy_fluxes(table, list(worst), library, SURVEY)

    worst = {"euclid_vis": 0.01, "gaia_g": 0.02, "lsst_u": 0.01}
    for band, error in worst.items():
        scaled = 2.5 * dimming(band, a_v=3.1 * 0.2)
        assert abs(dimming(band, a_v=3.1 * 0.5) - scaled) > error
    # For dust inside the galaxy, compare with the sum over wavelengths at its E(B-V).
    rest, band = library.wavelength, passbands.load("lsst_u")
    dusty = library.flux[8] * extinction.transmission(extinction.laws(rest)[2], 0.5)
    ratio = passbands.ab_flux(band, rest * 1.4, dusty) / passbands.ab_flux(R01, rest * 1.4, dusty)
    got = flux(ext_law_1=2, ebv_1=0.5)["f_nu_lsst_u"][0].as_py() / float(units.f_nu_of_mag(20.0))
    assert got == pytest.approx(float(ratio), rel=1e-3)


def test_no_rows(galaxies, stars, library, stars_library):
    assert band_fluxes.galaxy_spectra(galaxies().slice(0, 0), library).shape == (0, 23401)
    assert band_fluxes.star_spectra(stars().slice(0, 0), stars_library).shape == (0, 23401)


def test_a_null_line_is_no_line(bare, library):
    table = bare(2, z_obs=0.3)
    null = table.set_column(table.column_names.index("flux_oii"), "flux_oii", pa.array([None, np.nan], pa.float32()))
    np.testing.assert_array_equal(band_fluxes.galaxy_spectra(null, library), band_fluxes.galaxy_spectra(table, library))
