"""Compare passbands with speclite, closed forms and published zero points."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from speclite.filters import load_filter

from lake_schema import units
from lake_schema.errors import BadInput
from truesky.fluxes import passbands

GRID = passbands.grid()
# speclite's AB zero point is 3631 Jy, 48.6 means 3630.78.
OFFSET = 2.5 * np.log10(3631.0 / float(units.f_nu_of_mag(0.0)) * 1e6)
SPECLITE = {
    "euclid_vis": "Euclid-VIS",
    "euclid_y": "Euclid-Y",
    "euclid_j": "Euclid-J",
    "euclid_h": "Euclid-H",
    "lsst_u": "lsst2023-u",
    "lsst_g": "lsst2023-g",
    "lsst_r": "lsst2023-r",
    "lsst_i": "lsst2023-i",
    "lsst_z": "lsst2023-z",
    "lsst_y": "lsst2023-y",
    "lsst2016_u": "lsst2016-u",
    "lsst2016_y": "lsst2016-y",
    "des_g": "decamDR1-g",
    "des_z": "decamDR1-z",
    "cfis_u": "cfht_megacam-u",
    "cfis_r": "cfht_megacam-r",
    "ps1_i": "panstarrs-i",
    "hsc_g": "hsc2017-g",
    "hsc_r": "hsc2017-r2",
    "hsc_i": "hsc2017-i2",
    "hsc_z": "hsc2017-z",
    "hsc_y": "hsc2017-y",
    "gaia_g": "gaiadr2-G",
    "gaia_bp": "gaiadr2-BP",
    "gaia_rp": "gaiadr2-RP",
    "sdss_r": "sdss2010-r",
    "twomass_j": "twomass-J",
    "twomass_h": "twomass-H",
    "twomass_ks": "twomass-Ks",
}


@pytest.mark.parametrize("name", passbands.names())
def test_every_band_is_a_response_on_whole_angstroms(name):
    band = passbands.load(name)
    assert band.medium in {"air", "vacuum"}
    np.testing.assert_array_equal(np.diff(band.wavelength), 1.0)
    np.testing.assert_array_equal(band.wavelength, GRID[band.first : band.first + len(band.wavelength)])
    assert (band.response >= 0.0).all()
    assert 0.0 < band.response.max() <= 1.0
    assert 3000.0 < passbands.pivot_wavelength(band) < 22000.0


@pytest.mark.parametrize(("name", "published"), SPECLITE.items())
@pytest.mark.parametrize("slope", [-2.0, 0.0, 1.0])
def test_ab_magnitudes_are_speclites(name, published, slope):
    f_lambda = 1e-17 * (GRID / 5000.0) ** slope
    mine = float(units.mag_of_f_nu(units.ujy_of_cgs(passbands.ab_flux(passbands.load(name), GRID, f_lambda))))
    theirs = load_filter(published).get_ab_magnitude(f_lambda * u.erg / u.s / u.cm**2 / u.AA, GRID * u.AA)
    assert mine == pytest.approx(theirs - OFFSET, abs=1e-4)


@given(st.sampled_from(passbands.names()), st.floats(-30.0, 60.0))
def test_a_flat_f_nu_comes_back(name, mag):
    f_nu = units.cgs_of_ujy(units.f_nu_of_mag(mag))
    band = passbands.load(name)
    got = passbands.weights(band) @ (f_nu * units.LIGHT_ANGSTROM_S / band.wavelength**2)
    assert got == pytest.approx(float(f_nu), rel=1e-12, abs=0.0)


def test_pivot_wavelength_relates_f_nu_and_f_lambda():
    band = passbands.load("euclid_vis")
    f_lambda = 1e-17 * np.exp(-GRID / 3000.0)
    seen = f_lambda[band.first : band.first + len(band.wavelength)]
    photons = band.response * band.wavelength
    mean = np.sum(photons * seen) / np.sum(photons)
    wanted = mean * passbands.pivot_wavelength(band) ** 2 / units.LIGHT_ANGSTROM_S
    assert float(passbands.ab_flux(band, GRID, f_lambda)) == pytest.approx(wanted, rel=1e-12, abs=0.0)


def test_the_reference_band_is_shifted_to_the_blue():
    # R_01(lambda) = R(1.1 lambda): pivot 6177 / 1.1; R(lambda / 1.1) would be at 6795.
    r, r01 = passbands.load("sdss_r"), passbands.load("sdss_r01")
    assert passbands.pivot_wavelength(r01) == pytest.approx(passbands.pivot_wavelength(r) / 1.1, rel=1e-4)
    # It is the rest-frame range that r observes at z = 0.1.
    rest = 1.0 + 0.3 * np.sin(GRID / 40.0)
    seen = np.interp(GRID, GRID * 1.1, rest) / 1.1
    wanted = float(passbands.ab_flux(r01, GRID, rest)) * 1.1
    assert float(passbands.ab_flux(r, GRID, seen)) == pytest.approx(wanted, rel=1e-4, abs=0.0)


@pytest.mark.parametrize(
    ("name", "wanted"), [("euclid_vis", 25.93), ("euclid_y", 25.00), ("euclid_j", 25.18), ("euclid_h", 25.11)]
)
def test_zero_points_of_euclid(name, wanted):
    # 9926 cm2 is the clear area of the telescope.
    width = passbands.log_width(passbands.load(name))
    assert units.zero_point(9926.0, width) == pytest.approx(wanted, abs=0.01)


def test_red_leaks_stay():
    band = passbands.load("lsst_u")
    leak = band.response[band.wavelength > 8000.0]
    assert len(leak) > 1000
    assert leak.max() > 1e-5


def test_logistic_edges():
    band = passbands.load("jedis_g")
    at = dict(zip(band.wavelength, band.response, strict=True))
    assert at[3990.0] == pytest.approx(0.75 / 2.0, rel=1e-6)
    assert at[5480.0] == pytest.approx(0.75 / 2.0, rel=1e-6)
    assert band.response.max() == pytest.approx(0.75, rel=1e-4)


def test_uncovered_bands_are_refused():
    with pytest.raises(BadInput, match="euclid_i'"):
        passbands.load("euclid_i")
    with pytest.raises(BadInput, match="does not cover"):
        passbands.ab_flux(passbands.load("euclid_h"), GRID[:10000], np.ones(10000))


def test_duplicate_names_are_refused(tmp_path, monkeypatch):
    table = passbands.TABLE.read_text(encoding="utf-8")
    row = next(line for line in table.splitlines() if line.startswith("euclid_vis,"))
    (tmp_path / "passbands.csv").write_text(f"{table}{row.replace('Euclid-VIS', 'sdss2010-g')}\n", encoding="utf-8")
    monkeypatch.setattr(passbands, "TABLE", tmp_path / "passbands.csv")
    for ask in (passbands.names, lambda: passbands.load("euclid_vis"), lambda: passbands.provenance("euclid_h")):
        with pytest.raises(BadInput, match=r"passbands\.csv: passband euclid_vis occurs twice"):
            ask()
