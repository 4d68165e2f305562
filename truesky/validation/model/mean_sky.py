"""Simulate galaxies of a sky without clustering and lensing, whose mean densities have no cosmic variance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from truesky.catalogue.galaxies import galaxies
from truesky.catalogue.galaxies.galaxies import GalaxyModel
from truesky.catalogue.galaxies.lensing import Shear
from truesky.catalogue.halos import population

# Map (nside 1) of A(V) = 0: no dust in the Milky Way.
_CLEAR = np.zeros(12, np.float32)


def without_clustering(universe: GalaxyModel) -> GalaxyModel:
    """Return a copy of a model of galaxies in which halos have their mean density everywhere, without lensing."""
    halos = universe.population.halos
    uniform = replace(halos, amplitude=np.zeros_like(halos.amplitude), fine=None)
    return replace(universe, population=replace(universe.population, halos=uniform), lens=Shear())


def rows(universe: GalaxyModel, first: int, count: int) -> pa.Table:
    """Simulate the table `galaxies` in consecutive generation cells (nested HEALPix cells of order 8).

    Parameters
    ----------
    universe : GalaxyModel
        Model of the galaxies, usually from `without_clustering`.
    first, count : int
        Number of the first cell, and number of cells, at least 1.

    Returns
    -------
    Table
        Rows of the table `galaxies`, without extinction by the Milky Way.
    """
    halo_cells = population.CellCache(universe.population)
    return pa.concat_tables([galaxies.draw(cell, universe, halo_cells, _CLEAR) for cell in range(first, first + count)])
