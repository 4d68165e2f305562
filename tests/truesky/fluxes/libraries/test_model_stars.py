"""Mixtures of model stars: continuous, linear, and with the colours that are published."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.fluxes import passbands
from truesky.fluxes.libraries import model_stars, stellar, templates

TYPES = stellar.types()
FIRST = templates.first_model()
BANDS = ("sdss_u", "sdss_g", "sdss_r", "sdss_i", "sdss_z")
# Teff, log g, [M/H]: u - g, g - r, r - i, i - z, of the same model atmospheres by another interpolation.
PUBLISHED = {
    (5772.0, 4.44, 0.0): (1.29, 0.471, 0.107, 0.016),
    (6439.0, 4.19, -1.5): (0.83, 0.234, 0.052, -0.017),
    (6100.0, 4.20, -0.5): (1.01, 0.341, 0.078, -0.003),
    (5000.0, 4.65, -1.0): (1.52, 0.664, 0.220, 0.107),
    (4500.0, 1.64, -1.0): (2.11, 0.882, 0.313, 0.182),
}


def mix(teff, log_g, metallicity):
    return model_stars.mixture(TYPES, FIRST, *(np.atleast_1d(np.asarray(x, float)) for x in (teff, log_g, metallicity)))


@pytest.fixture(scope="module")
def light(stars_library):
    """f_nu of each template in BANDS."""
    out = []
    for name in BANDS:
        band = passbands.load(name)
        out.append(stars_library.flux[:, band.first : band.first + len(band.wavelength)] @ passbands.weights(band))
    return np.array(out)


def colours(light, teff, log_g, metallicity):
    found = mix(teff, log_g, metallicity)
    return -np.diff(-2.5 * np.log10((light[:, found.sed] * found.frac).sum(1)), axis=0)


@pytest.mark.parametrize("star", PUBLISHED)
def test_colours_are_those_of_the_model_atmospheres(light, star):
    found = colours(light, *star)[:, 0]
    assert found[0] == pytest.approx(PUBLISHED[star][0], abs=0.05)
    assert found[1:] == pytest.approx(PUBLISHED[star][1:], abs=0.015)


@given(st.floats(2300.0, 40_000.0), st.floats(-1.0, 6.0), st.floats(-4.0, 1.0))
def test_shares_are_a_mixture(teff, log_g, metallicity):
    found = mix(teff, log_g, metallicity)
    assert found.frac.sum() == pytest.approx(1.0)
    assert found.frac.min() >= 0.0
    assert found.frac[0, 0] == found.frac.max()
    inside = (found.sed < len(TYPES.names)) | ((found.sed >= FIRST) & (found.sed < FIRST + len(model_stars.names())))
    assert inside[found.frac > 0].all()


@given(st.floats(3700.0, 8400.0), st.floats(1.6, 4.6), st.floats(-2.5, 0.5))
def test_a_mixture_has_the_parameters_of_the_star(teff, log_g, metallicity):
    """Mixtures are linear in ln Teff, log g and [M/H]: the weighted mean of the nodes equals the star."""
    found = mix(teff, log_g, metallicity)
    shape = (model_stars.TEFF.size, model_stars.LOG_G.size, model_stars.METALLICITY.size)
    t, g, z = np.unravel_index(np.where(found.frac > 0, found.sed - FIRST, 0), shape)
    assert (found.frac * np.log(model_stars.TEFF[t])).sum() == pytest.approx(np.log(teff), abs=1e-9)
    assert (found.frac * model_stars.LOG_G[g]).sum() == pytest.approx(log_g, abs=1e-9)
    assert (found.frac * model_stars.METALLICITY[z]).sum() == pytest.approx(metallicity, abs=1e-9)


@pytest.mark.parametrize(("log_g", "metallicity"), [(4.7, 0.0), (4.7, -1.5), (2.0, -1.0), (4.6, 0.3)])
def test_no_steps_in_colour(light, log_g, metallicity):
    """For stars that differ by 0.2 % in temperature, g - r differs by less than 0.01; it is continuous."""
    teff = np.exp(np.arange(np.log(3700.0), np.log(20_000.0), 0.002))
    found = colours(light, teff, np.full(teff.size, log_g), np.full(teff.size, metallicity))
    assert np.abs(np.diff(found[1])).max() < 0.01
    assert np.abs(np.diff(found[0])).max() < 0.02
    teff = np.exp(np.arange(np.log(2400.0 if log_g > 4.0 else 3600.0), np.log(20_000.0), 2e-5))
    found = colours(light, teff, np.full(teff.size, log_g), np.full(teff.size, metallicity))
    assert np.abs(np.diff(found[:2])).max() < 1e-3


def test_metals_make_u_fainter(light):
    """At g - r = 0.3, stars of the discs and of the halo differ by an ultraviolet excess of 0.2 mag."""
    teff, found = np.arange(5500.0, 7000.0, 5.0), []
    for metals in (-2.0, -1.5, -1.0, -0.6, 0.0):
        colour = colours(light, teff, np.full(teff.size, 4.2), np.full(teff.size, metals))
        found.append(np.interp(0.3, colour[1][::-1], colour[0][::-1]))
    assert np.all(np.diff(found) > 0.02)
    assert found[3] - found[1] == pytest.approx(0.2, abs=0.07)


def test_the_sun_s_bolometric_correction():
    """Dwarfs and models have M_bol - M_H = 1.44 (Willmer 2018: M_H = 3.30); cool dwarfs have the published values."""
    from truesky.fluxes.libraries.vega import vega_magnitude

    vega = vega_magnitude(passbands.load("twomass_h"))
    found = model_stars.bolometric_h(TYPES, vega, np.array([5772.0, 3000.0]), np.array([4.44, 5.1]), np.zeros(2))
    assert found[0] == pytest.approx(1.44, abs=0.04)
    assert found[1] == pytest.approx(np.interp(-3000.0, -TYPES.teff, TYPES.bolometric_h), abs=0.02)


def test_v_minus_h_is_that_of_the_spectra(stars_library):
    from truesky.fluxes.libraries.vega import vega_magnitude

    bands = [passbands.load(name) for name in ("bessell_v", "twomass_h")]
    vega = [vega_magnitude(band) for band in bands]
    said = model_stars.v_minus_h(TYPES, (vega[0], vega[1]))
    n = len(TYPES.names)
    flux = np.concatenate([stars_library.flux[:n], stars_library.flux[FIRST:]]).astype(float)
    light = [flux[:, b.first : b.first + len(b.wavelength)] @ passbands.weights(b) for b in bands]
    assert said == pytest.approx(-2.5 * np.log10(light[0] / light[1]) - vega[0] + vega[1], abs=0.03)
