"""Intrinsic alignments: draw the position angles of galaxies before lensing.

Alignments change only the distribution of position angles, not the axis ratios. Each galaxy has a mean ellipticity,
which depends on its place; larger means give a narrower distribution of position angles. Ellipticities are complex,
e_1 + i e_2 = |e| exp(2 i phi), where |e| = (a - b) / (a + b) and phi is measured from east to north.

Notes
-----
Central galaxies follow the linear alignment model with the tidal field on the grid of simulated matter. Satellites
point to their central galaxy; their mean ellipticity depends on their distance from it, and on whether they are red.

References
----------
Hirata & Seljak 2004, PhRvD 70, 063526
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Bool, Complex, Float, Float32, Int
from truesky.catalogue import parameters
from truesky.catalogue.matter import density_box, lightcone
from truesky.catalogue.matter.density_box import Box
from truesky.catalogue.matter.lightcone import Replicas

# Number of Newton steps that solve y + a sin(2 y) = x to floating-point precision for a < 1/2.
_STEPS = 12


@dataclass(frozen=True, slots=True)
class Constants:
    """Parameters of the alignments of central and satellite galaxies; explained in alignments.toml."""

    amplitude: float
    slope: float
    magnitude: float
    c1_rho_crit: float
    blue: float
    satellite: float
    satellite_blue: float
    inner: float
    outer: float
    ellipticity_red: float
    ellipticity_blue: float
    max_modulation: float


@dataclass(frozen=True, slots=True, eq=False)
class Alignments:
    """Alignment model of a universe.

    Attributes
    ----------
    numbers : Constants
        Parameters from alignments.toml.
    strength : float
        Factor by which each mean ellipticity is multiplied.
    box : Box
        Periodic box of simulated matter.
    replicas : Replicas
        Rotations of the copies of the box that fill space.
    tides : tuple of float32 array
        Components xx, yy, xy, xz and yz of the tidal field on the grid of the box, from `density_box.tides`.
    """

    numbers: Constants
    strength: float
    box: Box
    replicas: Replicas
    tides: tuple[Float32, ...]


def model(box: Box, replicas: Replicas, strength: float) -> Alignments | None:
    """Return the alignment model with the built-in parameters.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    replicas : Replicas
        Rotations of the copies of the box that fill space.
    strength : float
        Factor by which each mean ellipticity is multiplied.

    Returns
    -------
    Alignments or None
        The model; None if `strength` is 0.
    """
    if not strength:
        return None
    numbers = Constants(**parameters.section("alignments.toml", "alignments"))
    return Alignments(numbers, strength, box, replicas, density_box.tides(box))


def tide(alignments: Alignments, ra: Float, dec: Float, chi: Float) -> Complex:
    """Return the projected tidal field of the linear density at z = 0 at positions in the light-cone.

    Parameters
    ----------
    alignments : Alignments
        Alignment model.
    ra, dec : float array, shape (n,)
        True positions, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.

    Returns
    -------
    complex array, shape (n,)
        T_11 - T_22 + 2 i T_12, where T is the tidal tensor in the grid cell that contains the position; axis 1 points
        east, axis 2 north.
    """
    lon, lat = np.radians(ra), np.radians(dec)
    zeros = np.zeros_like(lon)
    direction = sky.unit_vectors(ra, dec)
    east = np.stack([-np.sin(lon), np.cos(lon), zeros], 1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], 1)
    cell, _ = lightcone.box_cells(alignments.box, alignments.replicas, direction, chi)
    # Rotate the east and north axes at each position into the frame of the copy of the box that contains the position.
    (e_x, e_y, e_z), (n_x, n_y, n_z) = (
        lightcone.box_cells(alignments.box, alignments.replicas, axis, chi)[1].T for axis in (east, north)
    )
    xx, yy, xy, xz, yz = (field.ravel()[cell].astype(float) for field in alignments.tides)
    zz = -xx - yy

    def contract(a: tuple[Float, ...], b: tuple[Float, ...]) -> Float:
        same = a[0] * b[0] * xx + a[1] * b[1] * yy + a[2] * b[2] * zz
        mixed = (a[0] * b[1] + a[1] * b[0]) * xy + (a[0] * b[2] + a[2] * b[0]) * xz
        return np.asarray(same + mixed + (a[1] * b[2] + a[2] * b[1]) * yz)

    east_axis, north_axis = (e_x, e_y, e_z), (n_x, n_y, n_z)
    return np.asarray(
        contract(east_axis, east_axis) - contract(north_axis, north_axis) + 2j * contract(east_axis, north_axis)
    )


def central_ellipticity(alignments: Alignments, ra: Float, dec: Float, chi: Float, m_r: Float, red: Bool) -> Complex:
    """Return the mean ellipticity of central galaxies in the tidal field.

    Parameters
    ----------
    alignments : Alignments
        Alignment model.
    ra, dec : float array, shape (n,)
        True positions, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    m_r : float array, shape (n,)
        Absolute magnitude in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1, mag.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.

    Returns
    -------
    complex array, shape (n,)
        Mean ellipticity e_1 + i e_2. It does not depend on the epoch, because the factor 1 / D of the linear alignment
        model cancels the linear growth D of the tidal field.
    """
    numbers = alignments.numbers
    amplitude = numbers.amplitude * 10.0 ** (-0.4 * numbers.slope * (m_r - numbers.magnitude))
    amplitude = alignments.strength * amplitude * np.where(red, 1.0, numbers.blue)
    density = alignments.box.model.cosmology.omega_cold
    return np.asarray(-amplitude * numbers.c1_rho_crit * density * tide(alignments, ra, dec, chi))


def satellite_ellipticity(alignments: Alignments, direction: Float, distance: Float, red: Bool) -> Complex:
    """Return the mean ellipticity of satellites; the major axis points to their central galaxy.

    Parameters
    ----------
    alignments : Alignments
        Alignment model.
    direction : float array, shape (n,)
        Direction of the central galaxy as seen from the satellite, rad from east to north.
    distance : float array, shape (n,)
        Projected distance from the central galaxy in units of the halo radius R_200m.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.

    Returns
    -------
    complex array, shape (n,)
        Mean ellipticity e_1 + i e_2; it decreases with distance, to 0 in the outer parts of the halo.
    """
    numbers = alignments.numbers
    size = np.maximum(numbers.inner - numbers.outer * distance, 0.0)
    size = alignments.strength * size * np.where(red, numbers.satellite, numbers.satellite_blue)
    return np.asarray(size * np.exp(2j * direction))


def position_angles(alignments: Alignments | None, uniform: Float, mean: Complex, red: Bool) -> Float:
    """Draw position angles around the mean ellipticities.

    Parameters
    ----------
    alignments : Alignments or None
        Alignment model; None for isotropic directions.
    uniform : float array, shape (n,)
        Uniform random numbers in (0, 1).
    mean : complex array, shape (n,)
        Mean ellipticities e_1 + i e_2; galaxies with 0 get a uniform position angle.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.

    Returns
    -------
    float array, shape (n,)
        Position angle of the major axis, deg in [0, 180), from north through east.

    Notes
    -----
    The distribution of the direction phi (from east to north) is::

        p(phi) ~ 1 + 2 a cos 2(phi - phi_0)

    where phi_0 is the direction of `mean`. The modulation a is |mean| / m, but at most `max_modulation` of
    alignments.toml; m is the average of |e| over galaxies of the same colour (red or blue). The cumulative distribution
    is inverted to draw phi.
    """
    if alignments is None:
        return 180.0 * uniform
    numbers = alignments.numbers
    typical = np.where(red, numbers.ellipticity_red, numbers.ellipticity_blue)
    a = np.minimum(np.abs(mean) / typical, numbers.max_modulation)
    phase = np.pi * (0.5 - uniform)
    y = phase.copy()
    for _ in range(_STEPS):
        y -= (y + a * np.sin(2.0 * y) - phase) / (1.0 + 2.0 * a * np.cos(2.0 * y))
    phi = 0.5 * np.angle(mean) + y
    # Convert to an angle from north through east. Galaxies with a = 0 get the same angle as without an alignment model.
    return np.where(a > 0.0, np.mod(90.0 - np.degrees(phi), 180.0), 180.0 * uniform)


def direction_to_cells(ra: Float, dec: Float, target: Int) -> tuple[Float, Float]:
    """Return the direction and the separation of target positions, given as HEALPix cells, from other positions.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions from which direction and separation are measured, deg.
    target : int array, shape (n,)
        Nested indices of the order-29 cells that contain the targets.

    Returns
    -------
    direction : float array, shape (n,)
        Direction from the position to the target, rad from east to north.
    separation : float array, shape (n,)
        Separation, rad. It is the length of the projection on the tangent plane, which is correct for small angles.
    """
    lon, lat = (np.radians(angle) for angle in sky.positions_of_indices(target))
    origin_lon, origin_lat = np.radians(ra), np.radians(dec)
    x = np.cos(lat) * np.sin(lon - origin_lon)
    y = np.sin(lat - origin_lat) + 2.0 * np.cos(lat) * np.sin(origin_lat) * np.sin(0.5 * (lon - origin_lon)) ** 2
    return np.arctan2(y, x), np.hypot(x, y)
