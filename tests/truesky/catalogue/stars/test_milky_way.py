"""Star counts of the Milky Way against independent sums, and the labels of drawn stars."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.catalogue.stars import milky_way as mw
from truesky.catalogue.stars.stellar_populations import GIANT, WHITE_DWARF
from truesky.request import schema
from truesky.validation.model.star_counts import COUNTS, LIMITS

GALAXY = mw.milky_way()
BESANCON = mw.milky_way("besancon")
GALAXIES = st.sampled_from([GALAXY, BESANCON])
OWNER = np.repeat(np.arange(4), np.diff([*GALAXY.first[:, 0], GALAXY.pieces.number.size]))


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
    radius, height, _ = mw.cylindrical(GALAXY, lon, lat, np.array([5000.0]))
    assert (radius[0], height[0]) == pytest.approx(place)


def mean_counts(b):
    """Stars deg^-2 at the LIMITS in H (Vega), mean over longitude, no dust; few are white dwarfs."""
    m_h = 0.5 * (GALAXY.m_h[1:] + GALAXY.m_h[:-1])
    modulus = 2.5 * np.log10(GALAXY.distance[1:] * GALAXY.distance[:-1]) - 5.0
    mag_h = m_h + modulus[:, None]
    total, longitudes = np.zeros(len(LIMITS)), np.arange(0, 360, 30)
    for lon in longitudes:
        # Without the bulge, which the sums leave out.
        number = mw.expected_per_bin(GALAXY, float(lon), float(b), 1.0, 40.0)[:3].sum(0)
        total += [number[mag_h < limit].sum() for limit in LIMITS]
    return total / len(longitudes)


@pytest.mark.parametrize("b", COUNTS)
def test_star_counts(b):
    """Counts of the same laws, summed once by an independent program from other isochrones, no white dwarfs (5 %)."""
    found = mean_counts(b)
    assert found == pytest.approx(COUNTS[b], rel=0.13)
    assert np.all(found > COUNTS[b])


@given(GALAXIES, st.floats(0.0, 360.0), st.floats(-90.0, 90.0), st.floats(0.0, 30.0))
def test_numbers_are_the_sum_of_what_is_expected(galaxy, lon, lat, limit):
    found = mw.expected_counts(galaxy, np.array([lon, lon]), np.array([lat, -lat]), 0.05, np.array([limit, 12.0]))
    alone = dataclasses.replace(galaxy, companions=0.0 * galaxy.companions)
    single = mw.expected_counts(alone, np.array([lon, lon]), np.array([lat, -lat]), 0.05, np.array([limit, 12.0]))
    assert single[0] == pytest.approx(mw.expected_per_bin(galaxy, lon, lat, 0.05, limit).sum(), rel=1e-9, abs=0.0)
    assert single[1] == pytest.approx(mw.expected_per_bin(galaxy, lon, -lat, 0.05, 12.0).sum(), rel=1e-9)
    assert np.all(found <= 1.3 * single)
    assert np.all(found >= single)


@given(GALAXIES, st.floats(0.0, 360.0), st.floats(20.0, 60.0), st.floats(0.1, 10.0), st.floats(5.0, 30.0))
def test_there_are_fewer_stars_away_from_the_plane(galaxy, lon, lat, step, limit):
    """This does not hold around the poles, which are closer to the Galactic centre than the anticentre side of them."""
    near, far = mw.expected_counts(galaxy, np.array([lon] * 2), np.array([lat, lat + step]), 1.0, np.array([limit] * 2))
    assert 0.0 < far < near < np.inf


def test_all_that_may_be_bright_enough_is_expected(rng):
    """Sample of 0.05 deg2, drawn twice; significance 2e-5 of the difference (6 Poisson errors of one)."""
    everything = mw.expected_per_bin(GALAXY, 40.0, 30.0, 0.05, 60.0)
    bright = mw.expected_per_bin(GALAXY, 40.0, 30.0, 0.05, 22.0)
    assert np.all((bright == everything) | (bright == 0.0))
    drawn = mw.draw(GALAXY, everything, rng, rng)
    apparent = drawn.m_h + 5 * np.log10(drawn.distance) - 5
    wanted = np.sum(apparent < 22)
    again = mw.draw(GALAXY, bright, rng, rng)
    found = np.sum(again.m_h + 5 * np.log10(again.distance) - 5 < 22)
    assert found == pytest.approx(wanted, abs=6 * np.sqrt(wanted))


def test_a_sample_has_the_expected_distribution(rng):
    """Sample of 4 deg2; significance 6e-7 of each number (5 standard errors)."""
    mean = mw.expected_per_bin(GALAXY, 120.0, -50.0, 4.0, 26.0)
    sample = mw.draw(GALAXY, mean, rng, rng)
    n = sample.m_h.size
    assert n == pytest.approx(mean.sum(), abs=5 * np.sqrt(mean.sum()))
    for k, component in enumerate(GALAXY.components):
        found = np.sum(sample.component == component.code)
        assert found == pytest.approx(mean[k].sum(), abs=5 * np.sqrt(mean[k].sum()) + 1)
    shells = np.histogram(sample.distance, GALAXY.distance[::50])[0]
    wanted = mean.sum((0, 2)).reshape(-1, 50).sum(1)
    assert shells == pytest.approx(wanted, abs=5 * np.sqrt(wanted.max()))
    bins = np.histogram(sample.m_h, GALAXY.m_h)[0]
    assert bins == pytest.approx(mean.sum((0, 1)), abs=5 * np.sqrt(mean.sum((0, 1)).max()))


def test_nothing_expected_nothing_drawn(rng):
    sample = mw.draw(GALAXY, np.zeros((4, 500, GALAXY.m_h.size - 1)), rng, rng)
    assert sample.m_h.size == sample.distance.size == 0


def test_labels(rng):
    """The thin disc has every age, other components have one age; metallicities follow the populations' parameters."""
    sample = mw.draw(GALAXY, mw.expected_per_bin(GALAXY, 90.0, 60.0, 10.0, 24.0), rng, rng)
    born = sample.stage != WHITE_DWARF
    for code, mean, scatter in ((mw.THIN, -0.10, 0.2), (mw.THICK, -0.60, 0.3), (mw.HALO, -1.50, 0.4)):
        here = born & (sample.component == code)
        assert sample.metallicity[here].mean() == pytest.approx(mean, abs=0.03)
        # Cut at 3 sigma, and at the highest that there is.
        assert sample.metallicity[here].std() == pytest.approx(scatter, rel=0.07)
    assert set(sample.age[born & (sample.component == mw.HALO)]) == {12.5}
    thin = sample.age[born & (sample.component == mw.THIN)]
    assert (thin.min(), thin.max()) == (0.075, 9.25)
    # As many were born in the first half of the disc's life as in the second; few of these have died.
    assert np.mean(thin > 5.0) == pytest.approx(0.5, abs=0.03)
    assert np.all(np.isnan(sample.age) == (sample.stage == WHITE_DWARF))
    assert np.all(np.isnan(sample.mass) == (sample.stage == WHITE_DWARF))


def test_the_halo_turns_off_where_it_is_observed(rng):
    """The hottest main-sequence stars have 6400 to 6700 K; dwarfs of 0.2 Msun are hotter than dwarfs of the disc."""
    sample = mw.draw(GALAXY, mw.expected_per_bin(GALAXY, 90.0, 80.0, 200.0, 20.0), rng, rng)
    halo = (sample.component == mw.HALO) & (sample.stage == 0)
    assert np.quantile(sample.teff[halo], 0.98) == pytest.approx(6500, abs=200)
    light = (sample.mass > 0.3) & (sample.mass < 0.35)
    cool = [np.median(sample.teff[light & (sample.component == code)]) for code in (mw.THIN, mw.HALO)]
    assert 100 < cool[1] - cool[0] < 700


def test_stars_of_the_solar_neighbourhood():
    """pc^-3: systems below a solar mass, giants brighter than M_V = 1 (1e-4: Jahreiss & Wielen 1997), white dwarfs."""
    own, disc = GALAXY.pieces, OWNER < 3
    light = 10.0 ** own.log_mass.mean(0) < 1.0
    assert own.number[disc & light & (own.stage != WHITE_DWARF)].sum() == pytest.approx(0.075, rel=0.01)
    giants = own.number[disc & (own.stage == GIANT)].sum()
    assert 1.5e-4 < giants < 3e-4
    dwarfs = own.number[disc & (own.stage == WHITE_DWARF)]
    assert dwarfs.sum() == pytest.approx(4e-3, rel=1e-6)
    assert GALAXY.companions[:3].sum() / GALAXY.local[:3].sum() == pytest.approx(0.2, abs=0.05)


def test_white_dwarfs_are_few():
    share = mw.expected_per_bin(GALAXY, 90.0, 60.0, 1.0, 24.0)[:3].sum((1, 2))
    sample = mw.draw(GALAXY, mw.expected_per_bin(GALAXY, 90.0, 60.0, 20.0, 24.0), *2 * [np.random.default_rng(1)])
    assert share.sum() * 20 == pytest.approx(sample.m_h.size, rel=0.02)
    assert 0.005 < np.mean(sample.stage == WHITE_DWARF) < 0.05


def test_the_mass_of_the_bulge_along_lines_of_sight():
    """Msun deg^-2, of 1.5e10 in total (../milky_way.toml): 4.8e7 at (1, -4), 1.5e7 at (0, -6), 1.6e6 at (10, -10).

    Sums of the same law by an independent program; there are more stars on the side of the bar's near end.
    """
    own = GALAXY.pieces
    weight = np.where(own.stage == WHITE_DWARF, 0.6, 10.0 ** own.log_mass.mean(0)) * own.number
    mass = weight[OWNER == 3].sum() / GALAXY.local[3].sum()
    for (lon, lat), published in (((1.0, -4.0), 4.8e7), ((0.0, -6.0), 1.5e7), ((10.0, -10.0), 1.6e6)):
        found = mass * mw.expected_per_bin(GALAXY, lon, lat, 1.0, 40.0)[3].sum()
        assert 0.6 < found / published < 1.4
    near, far = (mw.expected_per_bin(GALAXY, lon, 6.0, 1.0, 40.0)[3].sum() for lon in (8.0, -8.0))
    assert near > 1.2 * far


def test_the_besancon_model_has_the_same_number_of_stars_at_the_sun():
    systems = [galaxy.local[:-1].sum() for galaxy in (GALAXY, BESANCON)]
    assert systems[1] == pytest.approx(systems[0], rel=0.02)
    near = [mw.expected_per_bin(galaxy, 200.0, 80.0, 1.0, 12.0).sum() for galaxy in (GALAXY, BESANCON)]
    assert near[1] == pytest.approx(near[0], rel=0.5)


def test_a_request_can_choose_every_model():
    assert schema.DENSITY_MODELS == mw.MODELS
