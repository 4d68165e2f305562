"""Intrinsic alignments: which way galaxies point before anything lenses them.

model            the numbers, and the tide of the box
mean             the mean ellipticity that the places of galaxies ask for
position_angles  drawn about it: axis ratios stay as they are

Ellipticities are complex, e_1 + i e_2 = |e| exp(2 i phi), (a - b) / (a + b) in size, phi from east to north.
Error: linear alignment with the tide of matter on the box's cells; satellites point to their central without scatter of
       the mean
Ref: Hirata & Seljak 2004, PhRvD 70, 063526
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

# Steps that solve y + a sin 2y = x to the last bits for a < 1/2.
_STEPS = 12


@dataclass(frozen=True, slots=True)
class Constants:
    """How strongly galaxies are aligned (alignments.toml)."""

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
    """times : what every mean ellipticity is multiplied by;  tides : float32[n^3] each, as of density_box.tides."""

    numbers: Constants
    strength: float
    box: Box
    replicas: Replicas
    tides: tuple[Float32, ...]


def model(box: Box, replicas: Replicas, strength: float) -> Alignments | None:
    """The alignments of the embedded universe; None where they are multiplied by 0.

    box : of matter;  turned : how each replica of it is turned;  times : of the request
    """
    if not strength:
        return None
    numbers = Constants(**parameters.section("alignments.toml", "alignments"))
    return Alignments(numbers, strength, box, replicas, density_box.tides(box))


def tide(alignments: Alignments, ra: Float, dec: Float, chi: Float) -> Complex:
    """T_11 - T_22 + 2 i T_12 of the linear density today, complex[n], axis 1 east and 2 north.

    ra, dec : float[n] deg, true;  chi : float[n] Mpc/h
    own     : box and its tides
    """
    lon, lat = np.radians(ra), np.radians(dec)
    zeros = np.zeros_like(lon)
    direction = sky.unit_vectors(ra, dec)
    east = np.stack([-np.sin(lon), np.cos(lon), zeros], 1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], 1)
    cell, _ = lightcone.box_cells(alignments.box, alignments.replicas, direction, chi)
    # In front of a replica, what is seen of it is the axes alone.
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
    """Mean ellipticity[n] that the tide gives; in linear theory it does not change with time.

    ra, dec : float[n] deg, true;  chi : float[n] Mpc/h;  m_r : float[n] mag;  red : bool[n]
    own     : numbers and tides
    """
    numbers = alignments.numbers
    amplitude = numbers.amplitude * 10.0 ** (-0.4 * numbers.slope * (m_r - numbers.magnitude))
    amplitude = alignments.strength * amplitude * np.where(red, 1.0, numbers.blue)
    return np.asarray(-amplitude * numbers.c1_rho_crit * cosmology.OMEGA_M * tide(alignments, ra, dec, chi))


def satellite_ellipticity(alignments: Alignments, direction: Float, distance: Float, red: Bool) -> Complex:
    """Mean ellipticity[n] along the line to the central.

    towards  : float[n] rad, direction of the central from east to north;  red : bool[n]
    distance : float[n] from it in projection, in units of R_200m
    own      : numbers
    """
    numbers = alignments.numbers
    size = np.maximum(numbers.inner - numbers.outer * distance, 0.0)
    size = alignments.strength * size * np.where(red, numbers.satellite, numbers.satellite_blue)
    return np.asarray(size * np.exp(2j * direction))


def position_angles(alignments: Alignments | None, uniform: Float, mean: Complex, red: Bool) -> Float:
    """Position angle[n] of the major axis, north through east, deg in [0, 180).

    p(phi) ~ 1 + 2 a cos 2(phi - phi_0), by inversion, with a = |mean| over the mean ellipticity of galaxies.
    own     : numbers; None = all directions alike
    uniform : float[n] in (0, 1);  mean : complex[n];  red : bool[n]
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
    # From north, through east; whoever is not aligned is as without alignments.
    return np.where(a > 0.0, np.mod(90.0 - np.degrees(phi), 180.0), 180.0 * uniform)


def direction_to_cells(ra: Float, dec: Float, target: Int) -> tuple[Float, Float]:
    """(direction[n] from east to north, separation[n]) rad, of places of order-29 cells as seen from others.

    ra, dec : float[n] deg;  to : int[n]
    """
    lon, lat = (np.radians(angle) for angle in sky.positions_of_indices(target))
    origin_lon, origin_lat = np.radians(ra), np.radians(dec)
    x = np.cos(lat) * np.sin(lon - origin_lon)
    y = np.sin(lat - origin_lat) + 2.0 * np.cos(lat) * np.sin(origin_lat) * np.sin(0.5 * (lon - origin_lon)) ** 2
    return np.arctan2(y, x), np.hypot(x, y)
