"""Satellite galaxies: how many a halo has, of which sub-mass, where, and how fast.

draw        satellites of halos, a Poisson sample with an NFW profile
nfw_radius  that holds a share of the mass

Error: isotropic, spherical halos that are cut at R_200m
Ref: Navarro, Frenk & White 1997, ApJ 490, 493; Evrard et al. 2008; the numbers are in halos.toml
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

# Nodes of the inverse of the NFW mass profile, in concentration and in enclosed mass: 1e-3 of a radius.
_C_NODES, _U_NODES = np.geomspace(1.0, 60.0, 40), np.linspace(0.0, 1.0, 256)
_X_NODES = np.linspace(0.0, 1.0, 2001) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class Satellites:
    """n satellites, by host.

    host : int[n] row of the host;  member : int[n] from 1, by falling sub-mass
    proxy : log10 of the scattered sub-mass;  ra, dec : deg;  chi : Mpc/h;  velocity : km/s, receding, with the host's
    radius : from the host's centre / R_200m
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
        """The satellites that are kept: keep : bool or int[m] rows."""
        return Satellites(*(getattr(self, name)[keep] for name in self.__slots__))


def draw(halos: HaloModel, masses: Masses, hosts: Halos, seed: int) -> Satellites:
    """The satellites of hosts that reach the limit of their distance.

    A host's satellites are drawn by falling sub-mass, each with numbers of its own: a deeper request goes on with them.
    halos, masses : tables of halos, and by mass;  hosts : n halos;  seed : of the request
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
    """Radius / R_200m[n] that holds a share of the mass inside R_200m.

    concentration : float[n] c_200m;  enclosed : float[n] of the mass, 0 .. 1
    Error: 1e-3
    """
    row, part = bracket(np.log(_C_NODES), np.log(concentration), extrapolated=True)
    step = np.asarray(enclosed) * (_U_NODES.size - 1)
    column = np.clip(step.astype(np.int64), 0, _U_NODES.size - 2)
    share = step - column
    # The square of the radius is nearly linear in the enclosed mass at the centre.
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
    """Offsets from the hosts' centres, [n, 3] comoving Mpc/h."""
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
