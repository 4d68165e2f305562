"""Proper motions: as astropy turns the same velocities, with the populations' dispersions, and Oort's rotation."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

from jobs.catalogue import parameters
from jobs.catalogue.stars import kinematics
from lake_schema import sky

# km/s of 1 mas/yr at 1 kpc.
KAPPA = 4.74047
SUN = parameters.section("kinematics.toml", "sun")
ELLIPSOIDS = parameters.section("kinematics.toml", "ellipsoids")


def galactic_motions(lon, lat, distance, component, deviates):
    """(mu_l cos(b), mu_b) mas/yr, turned by astropy."""
    ra, dec = sky.equatorial(lon, lat)
    east, north = kinematics.proper_motions(ra, dec, distance, component, deviates)
    placed = SkyCoord(ra * u.deg, dec * u.deg, pm_ra_cosdec=east * u.mas / u.yr, pm_dec=north * u.mas / u.yr).galactic
    return placed.pm_l_cosb.value, placed.pm_b.value


@pytest.mark.parametrize("component", range(6))
def test_towards_the_pole_and_the_centre_the_ellipsoid_is_seen(component):
    """At the pole the motion is that in the plane, in the anticentre the two others; the mean is lag and Sun."""
    n, rng = 20_000, np.random.default_rng(component)
    deviates, far = rng.normal(size=(3, n)), np.full(n, 100.0)
    populations = np.full(n, component)
    forwards, towards_pole = galactic_motions(np.full(n, 180.0), np.zeros(n), far, populations, deviates)
    km_s = KAPPA * 0.1
    # Towards larger longitude is against the rotation there.
    assert (km_s * forwards).std() == pytest.approx(ELLIPSOIDS["along_rotation"][component], rel=0.03)
    assert -(km_s * forwards).mean() == pytest.approx(
        -ELLIPSOIDS["lag"][component] - SUN["motion"][1], abs=0.04 * ELLIPSOIDS["along_rotation"][component]
    )
    assert (km_s * towards_pole).std() == pytest.approx(ELLIPSOIDS["towards_pole"][component], rel=0.03)
    assert (km_s * towards_pole).mean() == pytest.approx(
        -SUN["motion"][2], abs=0.04 * ELLIPSOIDS["towards_pole"][component]
    )
    _, inwards = galactic_motions(np.zeros(n), np.full(n, 89.9), far, populations, deviates)
    assert (km_s * inwards).std() == pytest.approx(ELLIPSOIDS["towards_centre"][component], rel=0.03)
    # North of b = 90 on longitude 0 is away from the centre.
    assert (km_s * inwards).mean() == pytest.approx(
        SUN["motion"][0], abs=0.04 * ELLIPSOIDS["towards_centre"][component]
    )


def test_the_disc_turns_as_oort_s_constants_say():
    """Of a flat curve A = -B = V / 2 R: 14.6 km/s/kpc, 15.3 and -11.9 observed (Bovy 2017)."""
    lon = np.arange(0.0, 360.0, 5.0)
    n, far = lon.size, 50.0
    none, thin = np.zeros((3, n)), np.zeros(n, int)
    along, _ = galactic_motions(lon, np.zeros(n), np.full(n, far), thin, none)
    # The Sun's own motion and the lag go as one over the distance.
    nearer, _ = galactic_motions(lon, np.zeros(n), np.full(n, far / 2), thin, none)
    rotation = KAPPA * (2 * along - nearer)
    a = 2 * (rotation * np.cos(2 * np.radians(lon))).mean()
    b = rotation.mean()
    flat = SUN["circular"] / (2 * SUN["radius"] / 1000)
    assert a == pytest.approx(flat, rel=0.05)
    assert b == pytest.approx(-flat, rel=0.05)
    assert a == pytest.approx(15.3, rel=0.1)
    assert b == pytest.approx(-11.9, rel=0.25)


def test_a_star_without_a_distance_has_no_motion():
    place, far = np.array([30.0]), np.array([np.nan])
    east, north = kinematics.proper_motions(place, place, far, np.array([0]), np.zeros((3, 1)))
    assert np.isnan(east).all()
    assert np.isnan(north).all()
