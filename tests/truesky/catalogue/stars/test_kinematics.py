"""Velocities agree with astropy's rotations, the populations' dispersions, and Oort's constants."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

from lake_schema import sky
from truesky.catalogue import parameters
from truesky.catalogue.stars import kinematics

# km/s of 1 mas/yr at 1 kpc.
KAPPA = 4.74047
SUN = parameters.section("kinematics.toml", "sun")
ELLIPSOIDS = parameters.section("kinematics.toml", "ellipsoids")
AGES = len(ELLIPSOIDS["age"]) - 1


def galactic_motions(lon, lat, distance, component, deviates, age=np.nan):
    """(mu_l cos(b), mu_b) mas/yr, turned by astropy."""
    ra, dec = sky.equatorial(lon, lat)
    ages = np.full(ra.size, age)
    east, north, _ = kinematics.velocities(ra, dec, distance, component, ages, deviates)
    placed = SkyCoord(ra * u.deg, dec * u.deg, pm_ra_cosdec=east * u.mas / u.yr, pm_dec=north * u.mas / u.yr).galactic
    return placed.pm_l_cosb.value, placed.pm_b.value


@pytest.mark.parametrize(("component", "age"), [*((k, np.nan) for k in range(5)), (0, 0.1), (0, 2.5), (0, 9.0)])
def test_towards_the_pole_and_the_centre_the_ellipsoid_is_seen(component, age):
    """At the pole the motion is that in the plane, in the anticentre the two others; the mean is lag and Sun."""
    n, rng = 20_000, np.random.default_rng(component)
    k = kinematics.ellipsoid_index(np.array([component]), np.array([age]))[0]
    assert k == (AGES + component if np.isnan(age) else {0.1: 0, 2.5: 3, 9.0: 6}[age])
    deviates, far = rng.normal(size=(3, n)), np.full(n, 100.0)
    populations = np.full(n, component)
    forwards, towards_pole = galactic_motions(np.full(n, 180.0), np.zeros(n), far, populations, deviates, age)
    km_s = KAPPA * 0.1
    # Towards larger longitude is against the rotation there.
    assert (km_s * forwards).std() == pytest.approx(ELLIPSOIDS["along_rotation"][k], rel=0.03)
    assert -(km_s * forwards).mean() == pytest.approx(
        -ELLIPSOIDS["lag"][k] - SUN["motion"][1], abs=0.04 * ELLIPSOIDS["along_rotation"][k]
    )
    assert (km_s * towards_pole).std() == pytest.approx(ELLIPSOIDS["towards_pole"][k], rel=0.03)
    assert (km_s * towards_pole).mean() == pytest.approx(-SUN["motion"][2], abs=0.04 * ELLIPSOIDS["towards_pole"][k])
    _, inwards = galactic_motions(np.zeros(n), np.full(n, 89.9), far, populations, deviates, age)
    assert (km_s * inwards).std() == pytest.approx(ELLIPSOIDS["towards_centre"][k], rel=0.03)
    # North of b = 90 on longitude 0 is away from the centre.
    assert (km_s * inwards).mean() == pytest.approx(SUN["motion"][0], abs=0.04 * ELLIPSOIDS["towards_centre"][k])


def test_the_disc_rotates_with_oort_s_constants():
    """A flat rotation curve has A = -B = V / 2 R: 14.6 km/s/kpc; 15.3 and -11.9 are observed (Bovy 2017)."""
    lon = np.arange(0.0, 360.0, 5.0)
    n, far = lon.size, 50.0
    none, thin = np.zeros((3, n)), np.zeros(n, int)
    along, _ = galactic_motions(lon, np.zeros(n), np.full(n, far), thin, none, 0.1)
    # The Sun's own motion and the lag go as one over the distance.
    nearer, _ = galactic_motions(lon, np.zeros(n), np.full(n, far / 2), thin, none, 0.1)
    rotation = KAPPA * (2 * along - nearer)
    a = 2 * (rotation * np.cos(2 * np.radians(lon))).mean()
    b = rotation.mean()
    flat = SUN["circular"] / (2 * SUN["radius"] / 1000)
    assert a == pytest.approx(flat, rel=0.05)
    assert b == pytest.approx(-flat, rel=0.05)
    assert a == pytest.approx(15.3, rel=0.1)
    assert b == pytest.approx(-11.9, rel=0.25)


def test_space_velocities_are_those_of_astropy(rng):
    """Proper motion, radial velocity and distance together: the same vector as the ellipsoid's, in Galactic axes."""
    n = 200
    lon, lat = rng.uniform(0, 360, n), np.degrees(np.arcsin(rng.uniform(-1, 1, n)))
    far, component = rng.uniform(10.0, 20_000.0, n), rng.integers(0, 6, n)
    ra, dec = sky.equatorial(lon, lat)
    deviates = rng.normal(size=(3, n))
    pm_ra, pm_dec, v_r = kinematics.velocities(ra, dec, far, component, np.full(n, np.nan), deviates)
    seen = SkyCoord(
        ra * u.deg, dec * u.deg, far * u.pc, pm_ra_cosdec=pm_ra * u.mas / u.yr, pm_dec=pm_dec * u.mas / u.yr,
        radial_velocity=v_r * u.km / u.s,
    ).galactic  # fmt: skip
    found = seen.velocity.d_xyz.to_value(u.km / u.s).T + SUN["motion"] + np.array([0.0, SUN["circular"], 0.0])
    place = seen.cartesian.xyz.to_value(u.pc).T - np.array([SUN["radius"], 0.0, 0.0])
    radius = np.hypot(place[:, 0], place[:, 1])
    k = kinematics.ellipsoid_index(component, np.full(n, np.nan))
    wider = np.exp(-0.1e-3 * (radius - SUN["radius"]) * np.array(ELLIPSOIDS["grows"])[k])
    outwards = (found[:, 0] * place[:, 0] + found[:, 1] * place[:, 1]) / radius
    turning = (found[:, 0] * place[:, 1] - found[:, 1] * place[:, 0]) / radius
    assert -outwards == pytest.approx(deviates[0] * wider * np.array(ELLIPSOIDS["towards_centre"])[k], abs=0.01)
    assert found[:, 2] == pytest.approx(deviates[2] * wider * np.array(ELLIPSOIDS["towards_pole"])[k], abs=0.01)
    core = np.minimum(radius / np.maximum(np.array(ELLIPSOIDS["turns_from"])[k], 1.0), 1.0)
    mean = (SUN["circular"] - np.array(ELLIPSOIDS["lag"])[k] * wider**2) * core
    assert turning - mean == pytest.approx(deviates[1] * wider * np.array(ELLIPSOIDS["along_rotation"])[k], abs=0.01)


def test_a_star_without_a_distance_has_no_motion():
    place, far = np.array([30.0]), np.array([np.nan])
    found = kinematics.velocities(place, place, far, np.array([0]), np.array([1.0]), np.zeros((3, 1)))
    assert np.isnan(found).all()
