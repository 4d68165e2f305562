"""Sources to be expected in a direction, from published counts.

Densities  how many sources there are where: of the lake's catalogues, or of the mission's count models
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import layout
from lake_schema.store.read import Version
from truesky.request.schema import Universe

# ------------------------------------------------------------------------------------------------ sources


class Densities:
    """Sources a square degree at a place.

    catalogues : published galaxies and stars, both or none
    Error: without them a limit in another band than I_E is taken for one in I_E
    """

    def __init__(self, mission: MissionConfiguration, universe: Universe, catalogues: Sequence[Version] = ()) -> None:
        self.published = [_catalogue_density(version) for version in catalogues]
        counts = np.array(mission.numbers("survey.galaxy_counts"))
        self.galaxies = float(np.exp(np.interp(universe.galaxy_limit, counts[:, 0], np.log(counts[:, 1]))))
        stars = np.array(mission.numbers("survey.star_counts"))
        # Columns: l, b, then counts to H = 8, 10, .., 26.
        limits = 8.0 + 2.0 * np.arange(stars.shape[1] - 2)
        at_limit = [np.interp(universe.star_limit, limits, np.log(row)) for row in stars[:, 2:]]
        self.lon, self.lat = np.unique(stars[:, 0]), np.unique(stars[:, 1])
        self.stars = np.reshape(at_limit, (self.lon.size, self.lat.size))

    def at(self, ra: Float, dec: Float) -> Float:
        """[2, n] deg-2, galaxies and stars; of the published catalogues where they reach, else of the count models."""
        model = self._model(ra, dec)
        if not self.published:
            return model
        cells = [int(cell) for cell in sky.cell_at(ra, dec, GENERATION_ORDER)]
        published = np.array([[table.get(cell, np.nan) for cell in cells] for table in self.published])
        return np.where(np.isfinite(published).all(axis=0), published, model)

    def _model(self, ra: Float, dec: Float) -> Float:
        lon, lat = sky.galactic(ra, dec)
        wrapped_lon = (lon + 180.0) % 360.0 - 180.0
        i = np.clip(np.searchsorted(self.lon, wrapped_lon, "right") - 1, 0, self.lon.size - 2)
        j = np.clip(np.searchsorted(self.lat, lat, "right") - 1, 0, self.lat.size - 2)
        s = (wrapped_lon - self.lon[i]) / (self.lon[i + 1] - self.lon[i])
        t = (lat - self.lat[j]) / (self.lat[j + 1] - self.lat[j])
        low = (1 - s) * self.stars[i, j] + s * self.stars[i + 1, j]
        high = (1 - s) * self.stars[i, j + 1] + s * self.stars[i + 1, j + 1]
        return np.stack([np.full(lon.shape, self.galaxies), np.exp((1 - t) * low + t * high)])


def _catalogue_density(version: Version) -> dict[int, float]:
    """Density of each generation cell that a catalogue covers: that of its file."""
    density: dict[int, float] = {}
    for part in version.manifest["parts"]:
        cells = part["facts"]["generation_cells"]
        order, file = layout.cell_of_file(part["name"])
        if any(cell >> 2 * (GENERATION_ORDER - order) != file for cell in cells):
            raise BadInput(f"table {version.table}: part {part['name']} names cells of another file")
        mean = version.partition_rows(part["name"]) / (len(cells) * sky.cell_area(GENERATION_ORDER))
        density.update(dict.fromkeys(cells, mean))
    return density
