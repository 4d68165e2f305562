"""Intrinsic alignments: orientations of galaxies before lensing.

Position angles are drawn around a mean ellipticity that depends on the place of a galaxy; axis ratios do not change.
Ellipticities are complex, e_1 + i e_2 = |e| exp(2 i phi), where |e| = (a - b) / (a + b) and phi is measured from east
to north.

Notes
-----
Central galaxies follow the linear alignment model with the tide of the matter in the cells of the box. Satellites point
to their central galaxy, with a mean ellipticity without scatter.

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
from truesky.fluxes import cosmology

# Newton steps that solve y + a sin 2y = x to floating-point precision for a < 1/2.
_STEPS = 12


@dataclass(frozen=True, slots=True)
class Constants:
    """Parameters of the alignments (alignments.toml)."""

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
        Parameters of the file.
    strength : float
        Factor by which each mean ellipticity is multiplied.
    box : Box
        Matter in a box.
    replicas : Replicas
        Rotation of each replica of the box.
    tides : tuple of float32 array
        Tidal field, same as `density_box.tides`.
    """

    numbers: Constants
    strength: float
    box: Box
    replicas: Replicas
    tides: tuple[Float32, ...]


def model(box: Box, replicas: Replicas, strength: float) -> Alignments | None:
    """Return the alignments of the embedded universe.

    Parameters
    ----------
    box : Box
        Matter in a box.
    replicas : Replicas
        Rotation of each replica of the box.
    strength : float
        Factor of the request by which each mean ellipticity is multiplied.

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
    """Return the tidal field of the linear density today at positions in the light-cone.

    Parameters
    ----------
    alignments : Alignments
        The model.
    ra, dec : float array, shape (n,)
        True positions, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.

    Returns
    -------
    complex array, shape (n,)
        T_11 - T_22 + 2 i T_12; axis 1 points east, axis 2 north.
    """
    lon, lat = np.radians(ra), np.radians(dec)
    zeros = np.zeros_like(lon)
    direction = sky.unit_vectors(ra, dec)
    east = np.stack([-np.sin(lon), np.cos(lon), zeros], 1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], 1)
    cell, _ = lightcone.box_cells(alignments.box, alignments.replicas, direction, chi)
    # Rotate the axes of each position into the frame of its replica.
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
        The model.
    ra, dec : float array, shape (n,)
        True positions, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    m_r : float array, shape (n,)
        M_r, mag.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.

    Returns
    -------
    complex array, shape (n,)
        Mean ellipticity. It does not change with time in linear theory.
    """
    numbers = alignments.numbers
    amplitude = numbers.amplitude * 10.0 ** (-0.4 * numbers.slope * (m_r - numbers.magnitude))
    amplitude = alignments.strength * amplitude * np.where(red, 1.0, numbers.blue)
    return np.asarray(-amplitude * numbers.c1_rho_crit * cosmology.OMEGA_M * tide(alignments, ra, dec, chi))


def satellite_ellipticity(alignments: Alignments, direction: Float, distance: Float, red: Bool) -> Complex:
    """Return the mean ellipticity of satellites, along the line to their central galaxy.

    Parameters
    ----------
    alignments : Alignments
        The model.
    direction : float array, shape (n,)
        Direction of the central galaxy, rad, from east to north.
    distance : float array, shape (n,)
        Projected distance from the central galaxy in units of R_200m.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.

    Returns
    -------
    complex array, shape (n,)
        Mean ellipticity.
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
        The model; None for isotropic directions.
    uniform : float array, shape (n,)
        Uniform random numbers in (0, 1).
    mean : complex array, shape (n,)
        Mean ellipticities.
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

    with a = |mean| / (mean ellipticity of galaxies, red or blue), limited to `max_modulation`. It is sampled by
    inversion.
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
    # Convert to an angle from north through east. Galaxies without alignment get the same angle as without a model.
    return np.where(a > 0.0, np.mod(90.0 - np.degrees(phi), 180.0), 180.0 * uniform)


def direction_to_cells(ra: Float, dec: Float, target: Int) -> tuple[Float, Float]:
    """Return direction and separation of order-29 cells as seen from positions.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions, deg.
    target : int array, shape (n,)
        Nested indices of order-29 cells.

    Returns
    -------
    direction : float array, shape (n,)
        Direction from east to north, rad.
    separation : float array, shape (n,)
        Separation, rad.
    """
    lon, lat = (np.radians(angle) for angle in sky.positions_of_indices(target))
    origin_lon, origin_lat = np.radians(ra), np.radians(dec)
    x = np.cos(lat) * np.sin(lon - origin_lon)
    y = np.sin(lat - origin_lat) + 2.0 * np.cos(lat) * np.sin(origin_lat) * np.sin(0.5 * (lon - origin_lon)) ** 2
    return np.arctan2(y, x), np.hypot(x, y)
