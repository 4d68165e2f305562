"""A sky without structure: its means, which observed means are compared with, have no sample variance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from truesky.catalogue.galaxies import galaxies
from truesky.catalogue.galaxies.galaxies import GalaxyModel
from truesky.catalogue.galaxies.lensing import Shear
from truesky.catalogue.halos import population

# No dust in the Milky Way: map with nside 1.
_CLEAR = np.zeros(12, np.float32)


def without_clustering(universe: GalaxyModel) -> GalaxyModel:
    """Return the universe with halos at their mean density everywhere and without lensing."""
    halos = universe.population.halos
    uniform = replace(halos, amplitude=np.zeros_like(halos.amplitude))
    return replace(universe, population=replace(universe.population, halos=uniform), lens=Shear())


def rows(universe: GalaxyModel, first: int, count: int) -> pa.Table:
    """Draw table `galaxies` in contiguous generation cells.

    Parameters
    ----------
    universe : GalaxyModel
        Universe from `without_clustering`.
    first, count : int
        First cell, and number of cells.

    Returns
    -------
    Table
        Rows of table `galaxies`.
    """
    halo_cells = population.CellCache(universe.population)
    return pa.concat_tables([galaxies.draw(cell, universe, halo_cells, _CLEAR) for cell in range(first, first + count)])
