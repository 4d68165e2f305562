"""Red, green and blue galaxies, their colours and dust."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from truesky.catalogue.galaxies import band_ratios, sequences
from truesky.catalogue.galaxies.sequences import BLUE, GREEN, RED
from truesky.fluxes.spectra.extinction import CALZETTI, PREVOT

MODEL = sequences.model()


@pytest.fixture(scope="module")
def table(library):
    return band_ratios.load(library, "sdss_g01", 0.0, MODEL.dust.highest)


@pytest.fixture(scope="module")
def ends(table):
    return sequences.colour_limits(table, MODEL.dust)


def drawn(ends, rng, m_r, z, n=40_000, odds=None, model=MODEL):
    m, at = np.full(n, m_r), np.full(n, z)
    odds = sequences.red_fraction(model.fraction, m, at, np.zeros(n)) if odds is None else np.full(n, odds)
    return sequences.draw(model, ends, m, at, odds, rng)


@given(st.floats(-26.0, -8.0), st.floats(0.0, 6.0), st.floats(0.0, 1.0))
def test_shares_are_shares(m_r, z, satellite):
    m_r, z = np.array([m_r]), np.array([z])
    assert 0.0 <= sequences.red_fraction(MODEL.fraction, m_r, z, np.array([satellite]))[0] <= MODEL.fraction.highest
    assert 0.0 <= sequences.green_share(MODEL.green, MODEL.fraction, m_r, z)[0] <= 1.0


def test_red_galaxies_are_bright_satellites_and_late_in_time():
    def share(m_r, z=0.1, kind=0):
        return float(sequences.red_fraction(MODEL.fraction, np.array([m_r]), np.array([z]), np.array([kind]))[0])

    # x = M_r + 20: 1 - (0.48 + 0.07 x), times 0.9 for centrals and the evolution at z = 0.1, M_r = -21.
    assert share(-21.0) == pytest.approx(0.9 * (1 - (0.48 - 0.07)) * (0.913 - 0.0387 * (1 + 0.314 * 0.5)))
    assert share(-22.0) > share(-20.0) > share(-18.0) > share(-16.0)
    assert share(-20.0, kind=1) / share(-20.0) == pytest.approx(1.25 / 0.9)
    assert share(-20.0, z=1.0) < share(-20.0, z=0.5) < share(-20.0)
    # Bright galaxies grew red first.
    assert share(-22.5, z=1.0) / share(-22.5) > share(-19.5, z=1.0) / share(-19.5)
    assert share(-16.0) / share(-18.0) == pytest.approx((1 - (0.48 + 0.28)) / (1 - (0.48 + 0.14)) * 10**-0.5, rel=0.05)


def test_colours_are_sequences(ends, rng):
    """Means and scatters at M_r = -20.5, z = 0.1; the reddest template cuts the red one off.

    Those of Skibba & Sheth 2009 are 0.944 and 0.065 (red), and 0.675 and 0.11 (blue).
    """
    found = drawn(ends, rng, -20.5, 0.1)
    assert found.red.mean() == pytest.approx(
        float(sequences.red_fraction(MODEL.fraction, np.array([-20.5]), np.array([0.1]), np.zeros(1))[0]), abs=0.01
    )
    red = found.colour[found.red]
    cut = stats.truncnorm(-np.inf, (ends.reddest - 0.002 - 0.937) / 0.065, 0.937, 0.065)
    assert np.percentile(red, (16, 50, 84)) == pytest.approx(cut.ppf((0.16, 0.5, 0.84)), abs=0.003)
    blue = found.colour[found.sequence == BLUE]
    assert np.mean(blue) == pytest.approx(0.605 + 0.055, abs=0.004)
    assert np.std(blue) == pytest.approx(0.10, abs=0.003)
    green = found.colour[found.sequence == GREEN]
    assert np.mean(green) == pytest.approx(0.5 * (0.937 + 0.660) - 0.01, abs=0.01)


def test_the_deviate_ranks_the_colours_of_a_sequence(ends, rng):
    found = drawn(ends, rng, -20.0, 0.8, 5000)
    for sequence in (BLUE, GREEN, RED):
        here = found.sequence == sequence
        assert stats.spearmanr(found.colour[here], found.deviate[here]).statistic == pytest.approx(1.0)


def test_blue_galaxies_are_bluer_at_higher_redshift_and_lower_luminosity(ends, rng):
    def blue(m_r, z):
        return np.median(drawn(ends, rng, m_r, z, 4000, odds=0.0).colour)

    assert blue(-21.0, 0.1) > blue(-21.0, 0.6) > blue(-21.0, 1.5) > blue(-21.0, 3.5)
    assert blue(-21.5, 0.5) > blue(-20.0, 0.5) > blue(-18.0, 0.5)


@pytest.mark.parametrize(("m_r", "z"), [(-24.0, 0.2), (-21.0, 1.7), (-18.0, 0.4), (-20.0, 4.0), (-12.0, 0.01)])
def test_no_colour_and_no_dust_occurs_twice(table, ends, rng, m_r, z):
    """Clipped colours put every twelfth galaxy on the bluest template, hundreds on the very same colour."""
    found = drawn(ends, rng, m_r, z, 20_000)
    m, at = np.full(20_000, m_r), np.full(20_000, z)
    law, ebv = sequences.draw_dust(MODEL, ends, m, at, found, rng)
    spectra = band_ratios.sed_of_colour(table, found.colour, law, ebv)
    assert np.unique(found.colour).size == found.colour.size
    assert np.unique(ebv[law > 0]).size == np.sum(law > 0)
    # Every colour is had: none lies beyond the last template behind its dust.
    assert band_ratios.colours(table, spectra) == pytest.approx(found.colour, abs=2e-4)
    assert np.mean(spectra.frac_1 == 1.0) < 2e-3
    index = spectra.template_1 - spectra.frac_2
    assert np.histogram(index, np.arange(0.0, 31.0, 0.005))[0].max() < 0.02 * index.size


@given(st.floats(-40.0, 40.0), st.floats(0.01, 5.0), st.floats(1e-12, 1.0 - 1e-12))
def test_truncated_normals_are_between_their_limits(low, width, u):
    low, high = np.array([low]), np.array([low + width])
    found = sequences.truncated_normal(low, high, np.array([u]))
    assert np.isfinite(found).all()
    if abs(low[0]) < 8.0:
        assert low[0] - 1e-6 <= found[0] <= high[0] + 1e-6
        assert found == pytest.approx(stats.truncnorm.ppf(u, low, high), abs=1e-6)


def test_dust_is_in_galaxies_that_are_not_red(ends, rng):
    n = 50_000
    m, z = np.full(n, -19.5), np.full(n, 0.3)
    colour = rng.uniform(0.3, 0.9, n)
    found = sequences.Colour(rng.choice([BLUE, GREEN, RED], n), colour, np.zeros(n))
    law, ebv = sequences.draw_dust(MODEL, ends, m, z, found, rng)
    assert np.all(law[found.red] == 0)
    assert np.all(ebv[law == 0] == 0.0)
    dusty, blue = law > 0, found.sequence == BLUE
    assert ebv[dusty].min() >= MODEL.dust.lowest
    assert ebv.max() <= MODEL.dust.highest
    assert np.all(law[dusty & ~blue] == CALZETTI)
    assert np.all((law[dusty & blue] == PREVOT) == (colour[dusty & blue] > MODEL.dust.prevot_colour[0]))
    odds = np.bincount(law[dusty & blue & (colour <= 0.42)], minlength=5)[2:]
    assert odds / odds.sum() == pytest.approx((0.5, 0.25, 0.25), abs=0.02)
    # Gamma(1.6) of mean 0.12, of red colours, which the bluest template behind 0.5 mag leaves room for.
    assert np.mean(ebv[blue & (colour > 0.75)]) == pytest.approx(0.119, abs=0.004)
    assert np.mean(ebv[found.sequence == GREEN]) > 1.6 * np.mean(ebv[blue])


def test_the_law_of_the_dust_depends_on_redshift(ends, rng):
    """Galaxies of one colour have Prevot's law at low redshift and Calzetti's at high redshift."""
    n = 1000
    found = sequences.Colour(np.full(n, BLUE), np.full(n, 0.5), np.zeros(n))
    for z, law in ((0.5, {PREVOT}), (3.0, {CALZETTI, CALZETTI + 1, CALZETTI + 2})):
        curve, _ = sequences.draw_dust(MODEL, ends, np.full(n, -19.5), np.full(n, z), found, rng)
        assert set(curve.tolist()) - {0} == law


def test_dust_leaves_room_for_the_bluest_colours(ends, rng):
    n = 2000
    for colour in (ends.bluest + 0.01, ends.bluest + 0.1):
        found = sequences.Colour(np.full(n, BLUE), np.full(n, colour), np.zeros(n))
        law, ebv = sequences.draw_dust(MODEL, ends, np.full(n, -19.5), np.full(n, 2.0), found, rng)
        for code in set(law.tolist()) - {0}:
            most = np.interp(colour, ends.bluest_dusty[code - 1], ends.ebv)
            assert ebv[law == code].max() <= most + 1e-9


def test_galaxies_of_other_catalogues_have_places_on_the_sequences():
    found = sequences.place_on_sequence(
        MODEL, np.full(3, -20.0), np.full(3, 0.1), np.array([0.605, 0.715, 5.0]), np.zeros(3, bool)
    )
    assert found.deviate == pytest.approx([0.0, 1.0, 3.0])


def test_the_numbers_can_be_replaced(ends, rng):
    model = dataclasses.replace(MODEL, fraction=dataclasses.replace(MODEL.fraction, highest=0.0))
    assert not drawn(ends, rng, -21.0, 0.1, 100, model=model).red.any()
