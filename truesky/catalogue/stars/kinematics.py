"""Velocities of the Milky Way's stars, drawn from the ellipsoid of each population and age.

velocities   proper motions, mas/yr, and radial velocities, km/s, of stars at their places and distances
ellipsoid    which of the ellipsoids is a star's

Every star moves with its population's mean rotation about the Galactic centre, plus a normal deviate along each axis of
the ellipsoid, as seen from the moving Sun. The ellipsoids point to the centre; those of discs are larger nearer to it,
and lag behind the more.
Ref: Robin et al. 2003, Section 2.2.5; the numbers and their sources are in kinematics.toml.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float, Int
from truesky.catalogue import parameters
from truesky.numerics.compiling import exact_jit

_FILE = "kinematics.toml"
# One AU a year, km/s: what 1 mas/yr is at 1 kpc (IAU 2012 astronomical unit, Julian year).
_KM_S = 4.740470463533349
_THIN = 0


def velocities(
    ra: Float, dec: Float, distance: Float, component: Int, age: Float, deviates: Float
) -> tuple[Float, Float, Float]:
    """(mu_ra cos(dec), mu_dec, v_r), float64[n] mas/yr, mas/yr, km/s; NaN where the distance is.

    ra, dec   : float64[n] deg, ICRS
    distance  : float64[n] pc, > 0
    component : int[n] population, as in table `stars`;  age : float64[n] Gyr, NaN = unknown
    deviates  : float64[3, n] standard normal
    """
    table, motion, _, gradient = _numbers()
    out = np.empty((3, ra.size))
    _velocities(
        ra, dec, distance, ellipsoid_index(component, age), np.ascontiguousarray(deviates), table, motion,
        sky.TO_GALACTIC, gradient, out,
    )  # fmt: skip
    return out[0], out[1], out[2]


def ellipsoid_index(component: Int, age: Float) -> Int:
    """Column[n] of the table: of the thin disc by age, the others behind, in the order of their codes."""
    edges = _numbers()[2]
    with np.errstate(invalid="ignore"):
        by_age = np.clip(np.searchsorted(edges, age, side="right") - 1, 0, edges.size - 2)
    return np.where((component == _THIN) & ~np.isnan(age), by_age, edges.size - 1 + component)


def sun_motion() -> Float:
    """[3] km/s beside the circular velocity: towards the centre, along the rotation, towards the pole."""
    return _numbers()[1][:3]


@lru_cache(maxsize=1)
def _numbers() -> tuple[Float, Float, Float, float]:
    """Table [6, ellipsoid]; the Sun's motion, radius and circular velocity; edges of ages; gradient, pc^-1."""
    law, sun = parameters.section(_FILE, "ellipsoids"), parameters.section(_FILE, "sun")
    names = ("towards_centre", "along_rotation", "towards_pole", "lag", "grows", "turns_from")
    motion = np.array([*sun["motion"], sun["radius"], sun["circular"]], float)
    return np.array([law[name] for name in names], float), motion, np.array(law["age"]), law["gradient"] / 1e3


@exact_jit
def _velocities(
    ra: Float, dec: Float, distance: Float, ellipsoids: Int, deviates: Float, table: Float, motion: Float, turn: Float,
    gradient: float, out: Float,
) -> None:  # fmt: skip
    """Fills out[3, n]; table [6, ellipsoid], motion (U, V, W, R, V_c), turn [3, 3] equatorial to Galactic."""
    axis = np.empty((3, 3))
    for i in range(ra.size):
        a, d, distance_pc = math.radians(ra[i]), math.radians(dec[i]), distance[i]
        sin_a, cos_a, sin_d, cos_d = math.sin(a), math.cos(a), math.sin(d), math.cos(d)
        # East, north, outwards; along the Sun's axes to the centre, the rotation, the pole.
        for k in range(3):
            axis[0, k] = -turn[k, 0] * sin_a + turn[k, 1] * cos_a
            axis[1, k] = (-turn[k, 0] * cos_a - turn[k, 1] * sin_a) * sin_d + turn[k, 2] * cos_d
            axis[2, k] = (turn[k, 0] * cos_a + turn[k, 1] * sin_a) * cos_d + turn[k, 2] * sin_d
        # From the centre to the star: what turns the axes at the Sun into those at the star.
        x, y = distance_pc * axis[2, 0] - motion[3], distance_pc * axis[2, 1]
        radius = max(math.sqrt(x * x + y * y), 1.0)
        w = ellipsoids[i]
        dispersion_factor = math.exp(-0.5 * gradient * (radius - motion[3])) if table[4, w] > 0.0 else 1.0
        inwards = table[0, w] * dispersion_factor * deviates[0, i]
        forwards = table[1, w] * dispersion_factor * deviates[1, i]
        forwards += (motion[4] - table[3, w] * dispersion_factor * dispersion_factor) * min(
            radius / max(table[5, w], 1.0), 1.0
        )
        u = (-inwards * x + forwards * y) / radius - motion[0]
        v = (-inwards * y - forwards * x) / radius - motion[1] - motion[4]
        z = table[2, w] * dispersion_factor * deviates[2, i] - motion[2]
        scale = 1.0 / (_KM_S * 1e-3 * distance_pc)
        out[0, i] = (u * axis[0, 0] + v * axis[0, 1] + z * axis[0, 2]) * scale
        out[1, i] = (u * axis[1, 0] + v * axis[1, 1] + z * axis[1, 2]) * scale
        out[2, i] = u * axis[2, 0] + v * axis[2, 1] + z * axis[2, 2] if distance_pc == distance_pc else math.nan
