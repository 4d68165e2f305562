"""Red and blue galaxies, their colours, dust and spectra."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jobs.catalogue.galaxies import band_ratios
from jobs.catalogue.galaxies import sed_assignment as sed

MODEL = sed.colours_model()


@pytest.fixture(scope="module")
def table(library):
    return band_ratios.load(library, "sdss_g01", 0.0, MODEL.dust.highest)


@given(st.floats(-26.0, -8.0), st.floats(0.0, 3.0), st.integers(0, 1))
def test_red_fraction_is_a_fraction(m_r, z, kind):
    share = sed.red_fraction(MODEL.fraction, np.array([m_r]), np.array([z]), np.array([kind]))[0]
    assert 0.0 <= share <= MODEL.fraction.highest


def test_red_galaxies_are_bright_satellites_and_late_in_time():
    def share(m_r, z=0.1, kind=0):
        return float(sed.red_fraction(MODEL.fraction, np.array([m_r]), np.array([z]), np.array([kind]))[0])

    # x = M_r + 20: 1 - (0.46 + 0.07 x), times 0.9 for centrals; the evolution is 1 at z = 0.1.
    assert share(-21.0) == pytest.approx(0.9 * (1 - (0.46 - 0.07)))
    assert share(-22.0) > share(-20.0) > share(-18.0) > share(-16.0)
    assert share(-20.0, kind=1) > share(-20.0)
    assert share(-20.0, z=1.0) < share(-20.0, z=0.5) < share(-20.0)
    assert share(-16.0) == pytest.approx(0.9 * (1 - (0.46 + 0.28)) * 10**-0.5)


def test_colours_are_two_sequences(rng):
    """Means and scatters of Skibba & Sheth 2009 at M_r = -20.5, z = 0.1."""
    n = 40_000
    m_r, z, kind = np.full(n, -20.5), np.full(n, 0.1), np.zeros(n, int)
    red, colour = sed.draw_colour(MODEL, m_r, z, kind, rng)
    assert red.mean() == pytest.approx(0.9 * (1 - 0.425), abs=0.01)
    assert np.median(colour[red]) == pytest.approx(0.932 + 0.016 - 0.004, abs=0.003)
    below = np.percentile(colour[red], 15.866)
    assert np.median(colour[red]) - below == pytest.approx(0.065, abs=0.003)
    assert np.mean(colour[~red]) == pytest.approx(0.62 + 0.055, abs=0.004)
    assert np.std(colour[~red]) == pytest.approx(0.11, abs=0.003)


def test_blue_galaxies_are_bluer_at_higher_redshift_and_lower_luminosity(rng):
    def blue(m_r, z):
        red, colour = sed.draw_colour(MODEL, np.full(4000, m_r), np.full(4000, z), np.zeros(4000, int), rng)
        return np.median(colour[~red])

    assert blue(-21.0, 0.1) > blue(-21.0, 0.6) > blue(-21.0, 1.5)
    assert blue(-21.5, 0.5) > blue(-20.0, 0.5) > blue(-18.0, 0.5)


def test_dust_is_in_blue_galaxies_only(rng):
    n = 50_000
    red, colour = rng.random(n) < 0.3, rng.uniform(-0.2, 1.0, n)
    law, ebv = sed.draw_dust(MODEL.dust, np.full(n, -19.5), red, colour, rng)
    assert np.all(law[red] == 0)
    assert np.all(ebv[law == 0] == 0.0)
    dusty = law > 0
    assert ebv[dusty].min() >= MODEL.dust.lowest
    assert ebv.max() <= MODEL.dust.highest
    assert np.all((law[dusty] == sed.PREVOT) == (colour[dusty] > MODEL.dust.prevot_colour))
    odds = np.bincount(law[dusty & (colour <= 0.55)], minlength=5)[2:]
    assert odds / odds.sum() == pytest.approx((0.5, 0.25, 0.25), abs=0.01)
    # Gamma(1.6) of mean 0.12, cut below 0.01 and at 0.5.
    assert ebv[~red].mean() == pytest.approx(0.12, abs=0.004)


def test_templates_grow_bluer_along_the_library_for_every_dust(table):
    assert np.diff(table.values[0], axis=1).min() > 0.01


def test_spectra_have_the_wanted_colours(table, rng):
    n = 5000
    wanted, law, ebv = rng.uniform(-0.2, 1.01, n), rng.integers(0, 5, n), rng.uniform(0.0, 0.5, n)
    spectra = sed.invert(table, wanted, law, ebv)
    realised = sed.colours(table, spectra)
    inside = (spectra.frac_1 > 0) & (spectra.frac_1 < 1)
    assert inside.mean() > 0.5
    assert realised[inside] == pytest.approx(wanted[inside], abs=1e-6)
    # Where dust leaves none, the end of the library: the bluest for colours too blue.
    too_blue = realised > wanted + 1e-5
    assert np.all((spectra.template_1 == 30)[too_blue] & (spectra.frac_1 == 1)[too_blue])
    too_red = realised < wanted - 1e-5
    assert np.all((spectra.template_2 == 0)[too_red] & (spectra.frac_2 == 1)[too_red])


@given(st.floats(-0.5, 1.5), st.integers(0, 4), st.floats(0.0, 0.5))
def test_every_spectrum_is_two_neighbours_with_shares(table, colour, law, ebv):
    spectrum = sed.invert(table, np.array([colour]), np.array([law]), np.array([ebv]))
    assert 1 <= spectrum.template_1[0] <= 30
    assert spectrum.template_2[0] == spectrum.template_1[0] - 1
    assert 0.0 <= spectrum.frac_1[0] <= 1.0
    assert spectrum.frac_1[0] + spectrum.frac_2[0] == pytest.approx(1.0)


def test_the_numbers_can_be_replaced(rng):
    no_red = dataclasses.replace(MODEL.fraction, highest=0.0)
    model = dataclasses.replace(MODEL, fraction=no_red)
    red, _ = sed.draw_colour(model, np.full(100, -21.0), np.full(100, 0.1), np.zeros(100, int), rng)
    assert not red.any()
