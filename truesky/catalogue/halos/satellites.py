"""Satellite galaxies of halos: number, sub-mass, position and velocity.

Satellites are a Poisson sample with an NFW profile. Halos are isotropic, spherical and end at R_200m. The parameters
are in halos.toml.

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

# Nodes of the inverse NFW mass profile in concentration and enclosed mass; the error of a radius is 1e-3.
_C_NODES, _U_NODES = np.geomspace(1.0, 60.0, 40), np.linspace(0.0, 1.0, 256)
_X_NODES = np.linspace(0.0, 1.0, 2001) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class Satellites:
    """Satellites sorted by host.

    Attributes
    ----------
    host : int array, shape (n,)
        Row of the host.
    member : int array, shape (n,)
        Number from 1, in the order of decreasing sub-mass.
    proxy : float array, shape (n,)
        log10 of the scattered sub-mass, Msun/h.
    ra, dec : float array, shape (n,)
        Position, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    velocity : float array, shape (n,)
        Line-of-sight velocity including that of the host, km/s, positive if receding.
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
        """Return the satellites of a bool mask or of row numbers."""
        return Satellites(*(getattr(self, name)[keep] for name in self.__slots__))


def draw(halos: HaloModel, masses: Masses, hosts: Halos, seed: int) -> Satellites:
    """Draw the satellites of hosts that reach the mass limit at their distance.

    Parameters
    ----------
    halos : HaloModel
        Tables of halos.
    masses : Masses
        Tables of halos by mass.
    hosts : Halos
        The hosts.
    seed : int
        Seed of the request.

    Returns
    -------
    Satellites
        The satellites.

    Notes
    -----
    The satellites of a host are drawn in the order of decreasing sub-mass, each with separate random numbers, so that a
    deeper request only appends satellites.
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
    """Return the radius in units of R_200m that encloses a fraction (0 to 1) of the mass inside R_200m (error 1e-3)."""
    row, part = bracket(np.log(_C_NODES), np.log(concentration), extrapolated=True)
    step = np.asarray(enclosed) * (_U_NODES.size - 1)
    column = np.clip(step.astype(np.int64), 0, _U_NODES.size - 2)
    share = step - column
    # Interpolate the square of the radius, which is almost linear in the enclosed mass at the centre.
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
    """Offsets from the centres of the hosts, shape (n, 3), comoving Mpc/h."""
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
