"""Proper motions of the Milky Way's stars, drawn from the velocity ellipsoid of each population.

proper_motions   of stars at their places and distances, mas/yr

Every star moves with its population's mean rotation about the Galactic centre, plus a normal deviate along each axis of
the ellipsoid, as seen from the moving Sun. The ellipsoids point to the centre and do not change with radius.
Ref: Robin et al. 2003, Section 2.2.5; the numbers and their sources are in kinematics.toml.
"""

from __future__ import annotations

import numpy as np

from jobs.catalogue import parameters
from lake_schema import sky
from lake_schema.arrays import Float, Int

_FILE = "kinematics.toml"
# One AU a year, km/s: what 1 mas/yr is at 1 kpc (IAU 2012 astronomical unit, Julian year).
_KM_S = 4.740470463533349
# The Galactic pole, ICRS, deg: ESA 1997, The Hipparcos Catalogue, Vol. 1, Section 1.5.3.
_POLE_RA, _POLE_DEC = 192.85948, 27.12825


def proper_motions(ra: Float, dec: Float, distance: Float, component: Int, deviates: Float) -> tuple[Float, Float]:
    """(mu_ra cos(dec), mu_dec), float64[n] mas/yr each; NaN where the distance is.

    ra, dec   : float64[n] deg, ICRS
    distance  : float64[n] pc, > 0
    component : int[n] population, as in table `stars`
    deviates  : float64[3, n] standard normal
    """
    lon, lat = (np.radians(angle) for angle in sky.galactic(ra, dec))
    east, north = _seen(lon, lat, _velocity(lon, lat, distance, component, deviates))
    scale = 1.0 / (_KM_S * 1e-3 * distance)
    return _equatorial(np.radians(ra), np.radians(dec), east * scale, north * scale)


def _velocity(lon: Float, lat: Float, distance: Float, component: Int, deviates: Float) -> Float:
    """Velocity[3, n] relative to the Sun: along the Sun's axes to the centre, the rotation, the pole; km/s."""
    law, sun = parameters.section(_FILE, "ellipsoids"), parameters.section(_FILE, "sun")
    axes = (law["towards_centre"], law["along_rotation"], law["towards_pole"])
    inwards, forwards, up = (np.array(axis)[component] * own for axis, own in zip(axes, deviates, strict=True))
    forwards = forwards + sun["circular"] - np.array(law["lag"])[component]
    # From the centre to the star; what turns the axes at the Sun into those at the star.
    x = distance * np.cos(lat) * np.cos(lon) - sun["radius"]
    y = distance * np.cos(lat) * np.sin(lon)
    radius = np.maximum(np.hypot(x, y), 1.0)
    outwards = np.stack([x, y]) / radius
    moving = np.stack(
        [-inwards * outwards[0] + forwards * outwards[1], -inwards * outwards[1] - forwards * outwards[0]]
    )
    ours = np.array(sun["motion"]) + np.array([0.0, sun["circular"], 0.0])
    return np.asarray(np.stack([moving[0], moving[1], up]) - ours[:, None])


def _seen(lon: Float, lat: Float, velocity: Float) -> tuple[Float, Float]:
    """Velocity along Galactic longitude and latitude."""
    x, y, z = velocity
    outwards = x * np.cos(lon) + y * np.sin(lon)
    return y * np.cos(lon) - x * np.sin(lon), z * np.cos(lat) - outwards * np.sin(lat)


def _equatorial(ra: Float, dec: Float, east: Float, north: Float) -> tuple[Float, Float]:
    """What goes along Galactic longitude and latitude, along right ascension and declination.

    ra, dec : rad;  Ref: Poleski 2013, arXiv:1306.2945
    """
    pole_ra, pole_dec = np.radians(_POLE_RA), np.radians(_POLE_DEC)
    cos = np.sin(pole_dec) * np.cos(dec) - np.cos(pole_dec) * np.sin(dec) * np.cos(ra - pole_ra)
    sin = np.cos(pole_dec) * np.sin(ra - pole_ra)
    turn = np.arctan2(sin, cos)
    return east * np.cos(turn) - north * np.sin(turn), east * np.sin(turn) + north * np.cos(turn)
