"""Red galaxies by halo."""

from types import SimpleNamespace

import numpy as np
import pytest

from truesky.catalogue.galaxies import sequences
from truesky.catalogue.halos import luminosity_function, matching, quenching
from truesky.catalogue.halos.population import SATELLITE
from truesky.cosmology import FIDUCIAL

MODEL = sequences.model()
MASSES = matching.masses(FIDUCIAL)
MATCHED = matching.match_luminosities(
    MASSES, luminosity_function.inverse(luminosity_function.schechter(), matching.Z_LAST)
)
SHARES = quenching.shares(quenching.model(), MASSES, MATCHED.occupation)


def members(z, mass, kind=0, radius=0.0, proxy=None):
    z, mass = np.atleast_1d(z).astype(float), np.atleast_1d(mass).astype(float)
    n = max(z.size, mass.size)
    proxy = mass if proxy is None else np.atleast_1d(proxy)
    each = (np.broadcast_to(np.asarray(value), n) for value in (z, mass, proxy, kind, radius))
    return SimpleNamespace(**dict(zip(("z", "host_mass", "proxy", "kind", "radius"), each, strict=True)))


def odds(of):
    m_r = MATCHED.magnitude(of.z, of.proxy)
    share = sequences.red_fraction(MODEL.fraction, m_r, of.z, quenching.satellite_share(SHARES, of))
    return quenching.odds(SHARES, of, share)


@pytest.mark.parametrize(("m_r", "fraction"), [(-19.0, 0.28), (-20.0, 0.21), (-21.0, 0.13)])
def test_satellites_of_a_luminosity(m_r, fraction):
    """Zehavi et al. 2011, z = 0.1, of galaxies brighter than that."""
    least = MATCHED.proxy_mass(np.array([0.1]), np.array([m_r]))[0]
    above = MASSES.interpolate(
        np.log(matching.proxy_density(MASSES, MATCHED.occupation)), np.array([0.1]), MASSES.log_mass
    )
    number = np.diff(-np.exp(above[0]))[MASSES.log_mass[:-1] > least]
    share = MASSES.interpolate_pairs(
        SHARES.satellites, np.full(number.size, 0.1), MASSES.log_mass[:-1][MASSES.log_mass[:-1] > least]
    )
    assert np.average(share, weights=number) == pytest.approx(fraction, abs=0.03)


def test_centrals_of_clusters_are_red():
    """Four in five or more at any z < 1.2; central galaxies of halos like the Milky Way's are rarely red."""
    for z in (0.2, 0.6, 1.0):
        cluster, milky_way = odds(members(z, np.array([13.8, 12.0])))
        assert cluster > 0.8
        assert milky_way < 0.5


def test_satellites_are_redder_in_rich_halos_and_near_their_centres():
    rich = odds(members(0.3, np.array([12.5, 13.5, 14.4]), SATELLITE, 0.4, np.full(3, 11.8)))
    assert np.all(np.diff(rich) > 0.05)
    near = odds(members(0.3, np.full(3, 14.0), SATELLITE, np.array([0.1, 0.5, 1.0]), np.full(3, 11.8)))
    assert np.all(np.diff(near) < -0.02)


@pytest.mark.parametrize("z", [0.2, 0.7, 1.3])
@pytest.mark.parametrize("proxy", [11.6, 12.0])
def test_the_mean_over_halos_is_the_share_of_the_sequence(rng, z, proxy):
    """Centrals and satellites drawn by mass function, occupation and scatter, of one proxy mass."""
    occupation, step = MATCHED.occupation, 0.02
    density = np.exp(MASSES.interpolate(MASSES.ln_density, np.array([z]), MASSES.log_mass))[0] * step
    above = matching.satellites_above(MASSES.log_mass, occupation) * matching.satellite_evolution(
        np.array(z), occupation
    )
    inside = np.concatenate([above[:-1] - above[1:], above[-1:]])
    scatter = np.exp(-0.5 * ((MASSES.log_mass - proxy) / occupation.scatter) ** 2)
    weight = np.concatenate([density * scatter, (inside * density * scatter[:, None]).ravel()])
    n, masses = 40_000, MASSES.log_mass.size
    place = rng.choice(weight.size, n, p=weight / weight.sum())
    satellite = place >= masses
    host = np.where(satellite, (place - masses) % masses, place)
    radius = np.where(satellite, quenching._mean_radius(np.full(n, 8.0)), 0.0)
    of = members(np.full(n, z), MASSES.log_mass[host], satellite.astype(int), radius, np.full(n, proxy))
    m_r = MATCHED.magnitude(of.z[:1], of.proxy[:1])
    share = sequences.red_fraction(
        MODEL.fraction, m_r, of.z[:1], MASSES.interpolate_pairs(SHARES.satellites, of.z[:1], of.proxy[:1])
    )
    assert MASSES.interpolate_pairs(SHARES.quenched, of.z[:1], of.proxy[:1])[0] < share[0]
    assert odds(of).mean() == pytest.approx(share[0], abs=0.015)


def test_halos_change_who_is_red_not_how_many():
    """At one luminosity: the mean over halos of any shares of quenching is the share of the sequence."""
    rng = np.random.default_rng(3)
    quenched = rng.beta(0.5, 2.0, 10_000)
    for share in (0.3, 0.6, 0.9):
        odds = quenching.red_odds(np.full(quenched.size, share), quenched, quenched.mean())
        assert odds.mean() == pytest.approx(share, abs=1e-9)
        assert (np.diff(odds[np.argsort(quenched)]) >= 0).all()
    # Where halos quench more than the sequence has, they have their way.
    assert quenching.red_odds(np.array([0.1]), 0.5, 0.2) == pytest.approx(0.5)
