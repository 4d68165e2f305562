"""Star counts of the Milky Way against independent sums, and the labels of what is drawn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jobs.catalogue.stars import milky_way as mw
from jobs.fluxes.libraries import stellar
from jobs.request import schema
from jobs.validation.star_counts import COUNTS

GALAXY = mw.milky_way()
BESANCON = mw.milky_way("besancon")
GALAXIES = st.sampled_from([GALAXY, BESANCON])
# I - H of K giants.
GIANT_I_H = 1.68


@pytest.mark.parametrize(
    ("lon", "lat", "place"),
    [
        (0, 0, (3000.0, 25.0)),
        (180, 0, (13_000.0, 25.0)),
        (90, 0, (np.hypot(8000, 5000), 25.0)),
        (0, 90, (8000, 5025)),
    ],
)
def test_places_along_the_line_of_sight(lon, lat, place):
    radius, height = mw.cylindrical(GALAXY, lon, lat, np.array([5000.0]))
    assert (radius[0], height[0]) == pytest.approx(place)


def mean_counts(b):
    """Stars deg^-2 at I < 18, 20, 22, 24.5 and H < 18, 22, 26 (Vega), mean over longitude, no dust."""
    types = stellar.types()
    order = np.argsort(types.abs_mag_h)
    m_h = 0.5 * (GALAXY.m_h[1:] + GALAXY.m_h[:-1])
    m_i = np.interp(m_h, types.abs_mag_h[order], (types.abs_mag_v - types.color_vi)[order])
    modulus = 2.5 * np.log10(GALAXY.distance[1:] * GALAXY.distance[:-1]) - 5.0
    mag_i = np.stack([m_i] * 3 + [m_h + GIANT_I_H] * 3)[:, None, :] + modulus[None, :, None]
    mag_h = np.broadcast_to(m_h + modulus[:, None], mag_i.shape)
    total = np.zeros(7)
    longitudes = np.arange(0, 360, 30)
    for lon in longitudes:
        number = mw.expected(GALAXY, float(lon), float(b), 1.0, 40.0)[:6]
        total += [number[mag_i < limit].sum() for limit in (18, 20, 22, 24.5)] + [
            number[mag_h < limit].sum() for limit in (18, 22, 26)
        ]
    return total / len(longitudes)


@pytest.mark.parametrize("b", COUNTS)
def test_star_counts(b):
    """Counts of the same laws, summed once by a code of its own, without white dwarfs.

    2300 deg^-2 to V = 20 at the pole: Bahcall & Soneira 1980.
    """
    assert mean_counts(b) == pytest.approx(COUNTS[b], rel=0.05)


@given(GALAXIES, st.floats(0.0, 360.0), st.floats(-90.0, 90.0), st.floats(0.0, 30.0))
def test_numbers_are_the_sum_of_what_is_expected(galaxy, lon, lat, limit):
    found = mw.numbers(galaxy, np.array([lon, lon]), np.array([lat, -lat]), 0.05, np.array([limit, 12.0]))
    assert found[0] == pytest.approx(mw.expected(galaxy, lon, lat, 0.05, limit).sum(), rel=1e-9, abs=0.0)
    assert found[1] == pytest.approx(mw.expected(galaxy, lon, -lat, 0.05, 12.0).sum(), rel=1e-9)


@given(GALAXIES, st.floats(0.0, 360.0), st.floats(20.0, 60.0), st.floats(0.1, 10.0), st.floats(5.0, 30.0))
def test_there_are_fewer_stars_away_from_the_plane(galaxy, lon, lat, step, limit):
    """Not so about the poles, which are nearer to the Galactic centre than the anticentre's side of them."""
    near, far = mw.numbers(galaxy, np.array([lon] * 2), np.array([lat, lat + step]), 1.0, np.array([limit] * 2))
    assert 0.0 < far < near < np.inf


def test_all_that_may_be_bright_enough_is_expected(rng):
    everything = mw.expected(GALAXY, 40.0, 30.0, 0.05, 60.0)
    bright = mw.expected(GALAXY, 40.0, 30.0, 0.05, 22.0)
    assert np.all((bright == everything) | (bright == 0.0))
    drawn = mw.draw(GALAXY, everything, rng)
    apparent = drawn.m_h + 5 * np.log10(drawn.distance) - 5
    wanted = np.sum(apparent < 22)
    again = mw.draw(GALAXY, bright, rng)
    found = np.sum(again.m_h + 5 * np.log10(again.distance) - 5 < 22)
    assert found == pytest.approx(wanted, abs=6 * np.sqrt(wanted))


def test_a_sample_has_the_expected_distribution(rng):
    mean = mw.expected(GALAXY, 120.0, -50.0, 4.0, 26.0)
    sample = mw.draw(GALAXY, mean, rng)
    n = sample.m_h.size
    assert n == pytest.approx(mean.sum(), abs=5 * np.sqrt(mean.sum()))
    for population in range(9):
        found = np.sum((sample.component == population % 3) & (sample.stage == population // 3))
        assert found == pytest.approx(mean[population].sum(), abs=5 * np.sqrt(mean[population].sum()) + 1)
    shells = np.histogram(sample.distance, GALAXY.distance[::50])[0]
    wanted = mean.sum((0, 2)).reshape(-1, 50).sum(1)
    assert shells == pytest.approx(wanted, abs=5 * np.sqrt(wanted.max()))
    bins = np.histogram(sample.m_h, GALAXY.m_h)[0]
    assert bins == pytest.approx(mean.sum((0, 1)), abs=5 * np.sqrt(mean.sum((0, 1)).max()))


def test_nothing_expected_nothing_drawn(rng):
    sample = mw.draw(GALAXY, np.zeros((9, 500, GALAXY.m_h.size - 1)), rng)
    assert sample.m_h.size == sample.distance.size == 0


def test_labels(rng):
    component = np.repeat([mw.THIN, mw.THICK, mw.HALO], 4000)
    metals = mw.metallicity(GALAXY, component, rng)
    means = [metals[component == code].mean() for code in (mw.THIN, mw.THICK, mw.HALO)]
    # The halo: Ivezic et al. 2008.
    assert means == pytest.approx([-0.05, -0.60, -1.46], abs=0.03)
    sample = mw.Sample(component[:2], np.array([mw.DWARF, mw.GIANT]), np.ones(2), np.array([3.31, -1.5]))
    assert mw.teff(GALAXY, sample) == pytest.approx([5770, 4750], abs=60)
    assert mw.log_g(GALAXY, sample) == pytest.approx([4.43, 2.5], abs=0.05)


def test_metal_poor_components_are_hotter():
    """All but white dwarfs, which have their own temperatures."""
    stage, m_h = np.repeat([mw.DWARF, mw.GIANT, mw.WHITE_DWARF], 3), np.repeat([4.0, -1.5, 13.0], 3)
    teff = mw.teff(GALAXY, mw.Sample(np.tile([mw.THIN, mw.THICK, mw.HALO], 3), stage, np.ones(9), m_h)).reshape(3, 3)
    np.testing.assert_allclose(teff - teff[:, :1], [[0, 150, 400], [0, 150, 400], [0, 0, 0]], atol=1e-9)


def test_white_dwarfs_of_the_solar_neighbourhood():
    """4.6e-3 pc^-3, Harris et al. 2006; half of them fainter than M_bol = 14.3."""
    local = GALAXY.local[6:].sum(0)
    assert local.sum() == pytest.approx(4e-3, rel=1e-6)
    cooling = GALAXY.sequences[mw.WHITE_DWARF]
    assert np.interp([12_000.0, 6000.0], cooling.teff[::-1], cooling.m_h[::-1]) == pytest.approx([11.9, 12.8], abs=0.1)
    share = mw.expected(GALAXY, 90.0, 60.0, 1.0, 24.0)
    assert 0.005 < share[6:].sum() / share.sum() < 0.05


def test_the_besancon_model_has_the_same_stars_at_the_sun():
    """The laws of density differ, the luminosity functions do not, but for who has which share."""
    assert BESANCON.local.shape == (27, BESANCON.m_h.size - 1)
    faint = GALAXY.m_h[:-1] > 6.0
    assert BESANCON.local[:9, faint].sum(0) == pytest.approx(GALAXY.local[:3, faint].sum(0))
    near = [mw.expected(galaxy, 200.0, 80.0, 1.0, 12.0).sum() for galaxy in (GALAXY, BESANCON)]
    assert near[1] == pytest.approx(near[0], rel=0.5)


def test_a_request_can_choose_every_model():
    assert schema.DENSITIES == mw.MODELS
