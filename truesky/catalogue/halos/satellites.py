"""Draw the satellite galaxies of halos: their number, mass of the sub-halo, position and velocity.

Satellites are a Poisson sample with an NFW profile. Halos are spherical, have isotropic velocities and end at R_200m.
The parameters are in halos.toml.

References
----------
Navarro, Frenk & White 1997, ApJ 490, 493; Evrard et al. 2008
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema import sky
from lake_schema.arrays import Float, Int
from truesky.catalogue.halos import compiled_halos
from truesky.catalogue.halos.halos import HaloModel, Halos
from truesky.catalogue.halos.matching import Masses
from truesky.catalogue.interpolation import bracket
from truesky.randomness import per_source

# Concentrations and fractions of the enclosed mass at which the radius of an NFW profile is tabulated; the error of a
# radius is 1e-3.
_C_NODES, _U_NODES = np.geomspace(1.0, 60.0, 40), np.linspace(0.0, 1.0, 256)
# Radii (R_200m) at which the enclosed mass of an NFW profile is computed; the inverse is interpolated from it.
_X_NODES = np.linspace(0.0, 1.0, 2001) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class Satellites:
    """Satellite galaxies, sorted by host halo.

    Attributes
    ----------
    host : int array, shape (n,)
        Row of the host in the table of halos.
    member : int array, shape (n,)
        Number of the satellite in its host, from 1, in the order of decreasing mass of the sub-halo.
    proxy : float array, shape (n,)
        log10 of the proxy mass (Msun/h), which determines the luminosity: mass of the sub-halo with a scatter.
    ra, dec : float array, shape (n,)
        Position, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    velocity : float array, shape (n,)
        Line-of-sight peculiar velocity including the velocity of the host, km/s, positive if receding.
    radius : float array, shape (n,)
        Distance from the centre of the host in units of R_200m.
    """

    host: Int
    member: Int
    proxy: Float
    ra: Float
    dec: Float
    chi: Float
    velocity: Float
    radius: Float

    def select(self, keep: npt.NDArray[np.generic]) -> Satellites:
        """Return some of the satellites, given as a bool mask of shape (n,) or as row numbers."""
        return Satellites(*(getattr(self, name)[keep] for name in self.__slots__))


def draw(halos: HaloModel, masses: Masses, hosts: Halos, seed: int) -> Satellites:
    """Draw the satellites of host halos that may be bright enough for the catalogue.

    Parameters
    ----------
    halos : HaloModel
        Model with the smallest proxy mass (mass of the sub-halo with a scatter) by distance.
    masses : Masses
        Tables of radius, concentration and velocity dispersion of halos.
    hosts : Halos
        The host halos.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    Satellites
        The satellites, sorted by host; positions may be outside the sky cell of the host.

    Notes
    -----
    The satellites of a host are drawn in the order of decreasing sub-halo mass, each with separate random numbers. A
    fainter limit therefore only adds satellites.
    """
    occupation, limit, z = halos.matching.occupation, halos.mass_limit(hosts.chi), halos.distances.redshift(hosts.chi)
    ratio = occupation.ratio_at(z)
    arguments = (
        per_source.keys(hosts.id, seed, "satellites"),
        hosts.log_mass,
        limit,
        occupation.min_mass_ratio,
        ratio,
        occupation.scatter,
        occupation.depth,
    )
    mass_ratio = 10.0 ** np.maximum(hosts.log_mass - limit + occupation.depth, np.log10(occupation.min_mass_ratio))
    out = _allocate(int(np.sum((mass_ratio - occupation.min_mass_ratio) / ratio)))
    count = compiled_halos.fill_satellites(*arguments, out)
    if count > out[0].size:
        out = _allocate(count)
        compiled_halos.fill_satellites(*arguments, out)
    host, member, proxy, numbers = out[0][:count], out[1][:count], out[2][:count], out[3][:count]
    offset = _offsets(masses, occupation.concentration, hosts.log_mass, z, host, numbers)
    kick = masses.dispersion(hosts.log_mass, z)[host] * numbers[:, 3]
    ra, dec, chi = _positions(hosts, host, offset)
    radius = np.sqrt(np.sum(offset**2, 1)) / masses.radius(hosts.log_mass)[host]
    return Satellites(host, member, proxy, ra, dec, chi, hosts.velocity[host] + kick, radius)


def _allocate(count: int) -> tuple[Int, Int, Float, Float]:
    return np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count), np.empty((count, 4))


def nfw_radius(concentration: Float, enclosed: Float) -> Float:
    """Return the radius, in units of R_200m, inside which an NFW halo has a fraction `enclosed` of its mass (0 to 1).

    `concentration` is c_200m. The error is 1e-3.
    """
    row, part = bracket(np.log(_C_NODES), np.log(concentration), extrapolated=True)
    step = np.asarray(enclosed) * (_U_NODES.size - 1)
    column = np.clip(step.astype(np.int64), 0, _U_NODES.size - 2)
    share = step - column
    # Interpolate the square of the radius, because near the centre it is almost linear in the enclosed mass.
    low = _SQUARES[row, column] * (1.0 - share) + _SQUARES[row, column + 1] * share
    high = _SQUARES[row + 1, column] * (1.0 - share) + _SQUARES[row + 1, column + 1] * share
    return np.asarray(np.sqrt(low * (1.0 - part) + high * part))


def _squares() -> Float:
    x = _C_NODES[:, None] * _X_NODES
    inside = np.log1p(x) - x / (1.0 + x)
    return np.array([np.interp(_U_NODES, row / row[-1], _X_NODES**2) for row in inside])


def _offsets(
    masses: Masses, concentration_factor: float, log_mass: Float, z: Float, host: Int, numbers: Float
) -> Float:
    """Return the positions of satellites relative to the centres of their hosts, shape (n, 3), comoving Mpc/h.

    The first three columns of `numbers` are uniform random numbers for enclosed mass, height and azimuth.
    """
    c = concentration_factor * masses.interpolate_pairs(masses.concentration, z, log_mass)
    radius = masses.radius(log_mass)[host] * nfw_radius(np.clip(c, 1.0, 60.0)[host], numbers[:, 0])
    height, azimuth = 2.0 * numbers[:, 1] - 1.0, 2.0 * np.pi * numbers[:, 2]
    flat = np.sqrt((1.0 - height) * (1.0 + height))
    return np.asarray(np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], 1) * radius[:, None])


def _positions(hosts: Halos, host: Int, offset: Float) -> tuple[Float, Float, Float]:
    unit = sky.unit_vectors(*sky.positions_of_indices(hosts.index))
    x, y, z = ((unit * hosts.chi[:, None])[host] + offset).T
    flat = np.hypot(x, y)
    return sky.wrap_angle(np.degrees(np.arctan2(y, x))), np.degrees(np.arctan2(z, flat)), np.hypot(flat, z)


_SQUARES = _squares()
