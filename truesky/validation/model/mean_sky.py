"""The sky without structure: what every observed mean is compared with, free of the chance of one field.

flat    a universe whose halos are everywhere as many as on average
rows    its galaxies in contiguous cells
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from truesky.catalogue.galaxies import galaxies
from truesky.catalogue.galaxies.galaxies import GalaxyModel
from truesky.catalogue.galaxies.lensing import Shear
from truesky.catalogue.halos import population

# Without dust of the Milky Way: nside 1.
_CLEAR = np.zeros(12, np.float32)


def without_clustering(universe: GalaxyModel) -> GalaxyModel:
    """The universe with its halos where the mean says, unlensed."""
    halos = universe.population.halos
    uniform = replace(halos, amplitude=np.zeros_like(halos.amplitude))
    return replace(universe, population=replace(universe.population, halos=uniform), lens=Shear())


def rows(universe: GalaxyModel, first: int, count: int) -> pa.Table:
    """Table `galaxies` of generation cells [first, first + count) of a universe of `flat`."""
    halo_cells = population.CellCache(universe.population)
    return pa.concat_tables([galaxies.draw(cell, universe, halo_cells, _CLEAR) for cell in range(first, first + count)])
