"""Draw in which halos quasars are, and how luminous they are.

Each halo has a quasar with a probability that depends on its mass and distance: the number density of quasars divided
by that of halos, which have weights by mass. One random number of each halo decides
whether it has a quasar and how luminous it is: a smaller number is a more luminous quasar. The quasars therefore follow
the halos and the luminosity function, and a deeper request contains the quasars of a shallower one. Halos do not depend
on the depth of the request.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue import parameters
from truesky.catalogue.halos import halos
from truesky.catalogue.halos.halos import HaloModel, Halos
from truesky.randomness.per_source import PerSourceGenerator


@dataclass(frozen=True, slots=True, eq=False)
class QuasarHosts:
    """Tables from which quasars are drawn in halos, by step in distance (s) and mass bin.

    Attributes
    ----------
    halos : HaloModel
        Model of the halos.
    weight : float array, shape (bins,)
        Relative probability of a quasar by mass of the halo.
    min_log_mass : float array, shape (s,)
        log10 of the smallest mass (Msun/h) of a host; infinite for steps without quasars.
    m : float array, shape (c + 1,)
        Absolute AB magnitudes at 1450 A, ascending.
    expected : float array, shape (s, c + 1)
        Expected number of quasars brighter than `m` in a halo with weight 1.
    """

    halos: HaloModel
    weight: Float
    min_log_mass: Float
    m: Float
    expected: Float


@dataclass(frozen=True, slots=True, eq=False)
class Quasars:
    """Quasars in halos.

    Attributes
    ----------
    halos : Halos
        The halo of each quasar, shape (n,).
    m_1450 : float array, shape (n,)
        Absolute AB magnitude at 1450 A.
    """

    halos: Halos
    m_1450: Float


def faintest() -> float:
    """Return the absolute AB magnitude at 1450 A of the faintest quasars below z = 6."""
    return float(parameters.section("active_nuclei.toml", "quasar_hosts")["faintest"])


def model(halo_model: HaloModel, m: Float, density: Float, boost: float, max_distance: float) -> QuasarHosts:
    """Return the tables from which quasars are drawn in halos.

    Parameters
    ----------
    halo_model : HaloModel
        Model of the halos.
    m : float array, shape (c + 1,)
        Edges of the cells of absolute AB magnitude at 1450 A, ascending, mag.
    density : float array, shape (s, c)
        Number of quasars in each cell, comoving (Mpc/h)^-3, at the middle of each step in distance; 0 for none.
    boost : float
        Ratio of the drawn to the natural number density.
    max_distance : float
        Comoving distance beyond which there are no quasars, Mpc/h.

    Returns
    -------
    QuasarHosts
        The tables.

    Raises
    ------
    BadInput
        If a halo would have more than one quasar because of the boost.
    """
    numbers = parameters.section("active_nuclei.toml", "quasar_hosts")
    middle = 0.5 * (halo_model.log_mass[1:] + halo_model.log_mass[:-1])
    deviation = (middle - numbers["log_mass"]) / numbers["scatter"]
    weight = np.where(np.abs(deviation) <= numbers["cut"], np.exp(-0.5 * deviation**2), 0.0)
    # Halos that span larger angles are drawn in larger cells. They are heavier or nearer than hosts of quasars.
    is_drawn = halo_model.level == GENERATION_ORDER
    weighted = np.sum(halo_model.number * weight * is_drawn, axis=1)
    expected = np.pad(np.cumsum(density, axis=1), ((0, 0), (1, 0)))
    included = (expected[:, -1] > 0.0) & (halo_model.steps.edge[:-1] < max_distance)
    expected = np.where(included[:, None], expected / np.where(included, weighted, 1.0)[:, None], 0.0)
    largest = float(expected.max(initial=0.0) * weight.max())
    if boost * largest > 1.0:
        limit = np.floor(100.0 / largest) / 100.0
        raise BadInput(
            f"universe.quasar_boost = {boost:g} must be at most {limit:g} with universe.variables, so that no halo has "
            "two quasars"
        )
    lightest = halo_model.log_mass[:-1][weight > 0.0].min()
    return QuasarHosts(halo_model, weight, np.where(included, lightest, np.inf), m, boost * expected)


def draw(hosts: QuasarHosts, seed: int, cell: int) -> Quasars:
    """Draw the quasars whose true positions are in a HEALPix cell of order 8.

    Parameters
    ----------
    hosts : QuasarHosts
        Tables from `model`.
    seed : int
        Seed of the request.
    cell : int
        Nested index of the cell.

    Returns
    -------
    Quasars
        The quasars with their halos, sorted by position.
    """
    drawn = halos.draw(hosts.halos, seed, GENERATION_ORDER, cell, hosts.min_log_mass)
    number = PerSourceGenerator(drawn.id, seed, "quasars.host").random()
    step = np.searchsorted(hosts.halos.steps.edge, drawn.chi, side="right") - 1
    width = hosts.halos.log_mass[1] - hosts.halos.log_mass[0]
    column = ((drawn.log_mass - hosts.halos.log_mass[0]) / width).astype(np.int64)
    weight = hosts.weight[np.clip(column, 0, hosts.weight.size - 1)]
    selected = np.flatnonzero(number < weight * hosts.expected[step, -1])
    x = number[selected] / weight[selected]
    pairs = zip(x.tolist(), step[selected].tolist(), strict=True)
    m_1450 = np.array([np.interp(value, hosts.expected[row], hosts.m) for value, row in pairs], float)
    return Quasars(drawn.select(selected), m_1450)
