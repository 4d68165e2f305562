"""Draw the velocities of the Milky Way's stars from the velocity ellipsoid of each population and age.

A star moves with the mean rotation of its population around the Galactic centre. A random velocity along each axis of
the ellipsoid is added, and the motion of the Sun is subtracted. One axis of the ellipsoid points to the Galactic
centre. For discs, both the velocity dispersions and the lag of the rotation behind the circular velocity increase
towards the centre. The parameters and their sources are in kinematics.toml.

References
----------
Robin et al. 2003, Section 2.2.5
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
# One AU per year in km/s, the velocity of 1 mas/yr at 1 kpc (IAU 2012 astronomical unit, Julian year).
_KM_S = 4.740470463533349
_THIN = 0


def velocities(
    ra: Float, dec: Float, distance: Float, component: Int, age: Float, deviates: Float
) -> tuple[Float, Float, Float]:
    """Return the proper motions and radial velocities of stars.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        ICRS position, deg.
    distance : float array, shape (n,)
        Distance from the Sun, pc, above 0 or NaN.
    component : int array, shape (n,)
        Code of the population (such as the thin disc) in column `component` of table `stars`.
    age : float array, shape (n,)
        Age, Gyr, NaN if unknown; used only for the thin disc.
    deviates : float array, shape (3, n)
        Standard normal deviates of the velocity towards the centre, along the rotation and towards the pole.

    Returns
    -------
    pm_ra, pm_dec : float array, shape (n,)
        mu_ra cos(dec) and mu_dec, mas/yr; NaN if the distance is NaN.
    radial_velocity : float array, shape (n,)
        Radial velocity, km/s; NaN if the distance is NaN.
    """
    table, motion, _, gradient = _numbers()
    out = np.empty((3, ra.size))
    _velocities(
        ra, dec, distance, ellipsoid_index(component, age), np.ascontiguousarray(deviates), table, motion,
        sky.TO_GALACTIC, gradient, out,
    )  # fmt: skip
    return out[0], out[1], out[2]


def ellipsoid_index(component: Int, age: Float) -> Int:
    """Return the number of the velocity ellipsoid of each star, which is a column of the table in kinematics.toml.

    The first columns are the age bins of the thin disc, for its stars of known age (Gyr). Then follows one column
    per component, in the order of the codes in `component`. These columns are used for stars of the other components,
    and for thin-disc stars of unknown age (NaN).
    """
    edges = _numbers()[2]
    with np.errstate(invalid="ignore"):
        by_age = np.clip(np.searchsorted(edges, age, side="right") - 1, 0, edges.size - 2)
    return np.where((component == _THIN) & ~np.isnan(age), by_age, edges.size - 1 + component)


def sun_motion() -> Float:
    """Return the Sun's peculiar velocity (km/s): towards the Galactic centre, along the rotation, towards the pole."""
    return _numbers()[1][:3]


@lru_cache(maxsize=1)
def _numbers() -> tuple[Float, Float, Float, float]:
    """Return the parameters of kinematics.toml as arrays.

    These are: the velocity ellipsoids, shape (6, ellipsoids): three dispersions and lag (km/s), flag of the radial
    gradient, and radius of solid-body rotation (pc); the Sun's velocity (3 values, km/s), its distance from the centre
    (pc) and the circular velocity (km/s); the edges of the age bins (Gyr); and the gradient (pc^-1), with which squared
    dispersions and lag decrease outwards as exp(-gradient R).
    """
    law, sun = parameters.section(_FILE, "ellipsoids"), parameters.section(_FILE, "sun")
    names = ("towards_centre", "along_rotation", "towards_pole", "lag", "grows", "turns_from")
    motion = np.array([*sun["motion"], sun["radius"], sun["circular"]], float)
    return np.array([law[name] for name in names], float), motion, np.array(law["age"]), law["gradient"] / 1e3


@exact_jit
def _velocities(
    ra: Float, dec: Float, distance: Float, ellipsoids: Int, deviates: Float, table: Float, motion: Float, turn: Float,
    gradient: float, out: Float,
) -> None:  # fmt: skip
    """Fill `out`, shape (3, n), with proper motions in ra (times cos(dec)) and dec (mas/yr) and radial velocity (km/s).

    `deviates`, shape (3, n), are normal deviates of the velocity. `table` has the parameters of the velocity ellipsoids
    in its columns, and `ellipsoids` the column of each star. `motion` is the Sun's velocity (3 values, km/s), distance
    from the centre (pc) and circular velocity (km/s). `turn` is the rotation matrix from equatorial to Galactic axes.
    If the flag of an ellipsoid is set, its squared dispersions and its lag decrease outwards as exp(-gradient R), with
    `gradient` in pc^-1.
    """
    axis = np.empty((3, 3))
    for i in range(ra.size):
        a, d, distance_pc = math.radians(ra[i]), math.radians(dec[i]), distance[i]
        sin_a, cos_a, sin_d, cos_d = math.sin(a), math.cos(a), math.sin(d), math.cos(d)
        # Rows of `axis`: unit vectors to the east, to the north and to the star. Their components are along the axes at
        # the Sun: to the Galactic centre, along the rotation and to the pole.
        for k in range(3):
            axis[0, k] = -turn[k, 0] * sin_a + turn[k, 1] * cos_a
            axis[1, k] = (-turn[k, 0] * cos_a - turn[k, 1] * sin_a) * sin_d + turn[k, 2] * cos_d
            axis[2, k] = (turn[k, 0] * cos_a + turn[k, 1] * sin_a) * cos_d + turn[k, 2] * sin_d
        # Position of the star relative to the Galactic centre along the axes at the Sun; it gives the axes at the star.
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
