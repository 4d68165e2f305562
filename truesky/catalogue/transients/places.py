"""Draw the places of supernovae in their hosts: they follow the light of the bulge and of the disc."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Bool, Float
from truesky.catalogue import parameters
from truesky.catalogue.transients.rates import FILE
from truesky.randomness.per_source import AnyGenerator

# Columns of the table `galaxies` with the profile of a galaxy, and its lensing.
COLUMNS = (
    "bulge_fraction", "bulge_half_light_radius", "bulge_sersic_index", "bulge_axis_ratio", "disk_half_light_radius",
    "disk_axis_ratio", "position_angle", "kappa", "gamma1", "gamma2",
)  # fmt: skip
# Half-light radius of an exponential disc in units of its scale length.
_DISC_RADIUS = 1.6783469900166605


def draw_offsets(hosts: pa.Table, in_disc: Bool, rng: AnyGenerator) -> tuple[Float, Float]:
    """Draw the observed places of supernovae relative to the middle of their hosts.

    Parameters
    ----------
    hosts : Table
        Host of each supernova: n rows of table `galaxies` with the columns COLUMNS.
    in_disc : bool array, shape (n,)
        True for supernovae of young stars, which are in the disc if the host has one.
    rng : Generator or PerSourceGenerator
        Random numbers.

    Returns
    -------
    east, north : float array, shape (n,)
        Offsets, arcsec, with lensing.
    """
    columns = {name: np.asarray(hosts[name].to_numpy(), float) for name in COLUMNS}
    n, share = len(in_disc), np.where(in_disc, 0.0, columns["bulge_fraction"])
    share = np.where(columns["bulge_fraction"] >= 1.0, 1.0, share)
    in_bulge = rng.random(n) < share
    radius = _draw_radii(in_bulge, columns, rng)
    angle = 2.0 * np.pi * rng.random(n)
    ratio = np.where(in_bulge, columns["bulge_axis_ratio"], columns["disk_axis_ratio"])
    along, across = radius * np.cos(angle), radius * ratio * np.sin(angle)
    turn = np.radians(columns["position_angle"])
    east = along * np.sin(turn) + across * np.cos(turn)
    north = along * np.cos(turn) - across * np.sin(turn)
    kappa, gamma1, gamma2 = columns["kappa"], columns["gamma1"], columns["gamma2"]
    determinant = (1.0 - kappa) ** 2 - gamma1**2 - gamma2**2
    return (
        ((1.0 - kappa + gamma1) * east + gamma2 * north) / determinant,
        (gamma2 * east + (1.0 - kappa - gamma1) * north) / determinant,
    )


def _draw_radii(in_bulge: Bool, columns: dict[str, Float], rng: AnyGenerator) -> Float:
    """Draw distances along the major axis, arcsec, that enclose a uniform fraction of the light of the component.

    The light of a Sersic profile of index n inside r is the distribution function of x = b (r / r_half)^(1 / n), which
    has a gamma distribution with the shape parameter 2 n. The disc has n = 1.
    """
    index = np.where(in_bulge, columns["bulge_sersic_index"], 1.0)
    half = np.where(in_bulge, columns["bulge_half_light_radius"], columns["disk_half_light_radius"])
    light = rng.standard_gamma(2.0 * index, len(index))
    farthest = float(parameters.section(FILE, "places")["farthest"])
    return np.asarray(half * np.minimum((light / _b(index)) ** index, farthest))


def _b(index: Float) -> Float:
    """Return the constant b of Sersic profiles, with an error below 1 % above n = 0.3: Ciotti & Bertin 1999, eq. 18."""
    series = 2.0 * index - 1.0 / 3.0 + 4.0 / (405.0 * index) + 46.0 / (25515.0 * index**2)
    return np.where(index == 1.0, _DISC_RADIUS, series)
