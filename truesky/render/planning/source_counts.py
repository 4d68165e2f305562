"""Predict the number of galaxies and stars per square degree at a position on the sky.

The numbers come from the simulated catalogues of the lake, if it has them, or from tables of number counts.
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
from truesky.fluxes import passbands
from truesky.request.schema import Universe

# For passbands with these mean wavelengths (Angstrom), magnitude limits at which they have as many galaxies as there
# are with I_E < 22, 24 and 25. They come from a catalogue of 0.47 deg2 to I_E = 26.3 with fluxes in u, g, r, z, y of
# LSST and Y_E, J_E, H_E of Euclid; at the wavelength of I_E they are 22, 24 and 25.
_WAVELENGTHS = (3724.0, 4807.0, 6221.0, 7335.0, 8680.0, 9753.0, 10832.0, 13690.0, 17741.0)
_EQUAL_LIMITS = {
    22.0: (23.68, 23.23, 22.46, 22.0, 21.54, 21.29, 21.10, 20.70, 20.35),
    24.0: (24.95, 24.64, 24.27, 24.0, 23.66, 23.43, 23.24, 22.85, 22.50),
    25.0: (25.79, 25.48, 25.18, 25.0, 24.78, 24.63, 24.49, 24.21, 23.95),
}


class Densities:
    """Number of galaxies and stars per square degree as a function of position on the sky.

    Parameters
    ----------
    mission : MissionConfiguration
        Parameters of the mission, with the tables of number counts `survey.galaxy_counts` and `survey.star_counts`.
    universe : Universe
        Section `universe` of the user's request; only sources brighter than its magnitude limits are counted.
    catalogues : sequence of Version, optional
        Stored versions of the tables `galaxies` and `stars`: both in this order, or none.

    """

    def __init__(self, mission: MissionConfiguration, universe: Universe, catalogues: Sequence[Version] = ()) -> None:
        self.published = [_catalogue_density(version) for version in catalogues]
        counts = np.array(mission.numbers("survey.galaxy_counts"))
        self.galaxies = float(np.exp(np.interp(euclid_limit(universe), counts[:, 0], np.log(counts[:, 1]))))
        stars = np.array(mission.numbers("survey.star_counts"))
        # The table of star counts has the columns Galactic l and b (deg), then stars per deg2 brighter than H = 8, 10,
        # .., 26 mag. The limits below are these magnitudes.
        limits = 8.0 + 2.0 * np.arange(stars.shape[1] - 2)
        at_limit = [np.interp(universe.star_limit, limits, np.log(row)) for row in stars[:, 2:]]
        self.lon, self.lat = np.unique(stars[:, 0]), np.unique(stars[:, 1])
        self.stars = np.reshape(at_limit, (self.lon.size, self.lat.size))

    def at(self, ra: Float, dec: Float) -> Float:
        """Return the numbers of galaxies and stars per square degree, shape (2, n), at n ICRS positions in degrees.

        They come from the catalogues where both cover the position, otherwise from the tables of number counts.
        """
        model = self._model(ra, dec)
        if not self.published:
            return model
        cells = [int(cell) for cell in sky.cell_at(ra, dec, GENERATION_ORDER)]
        published = np.array([[table.get(cell, np.nan) for cell in cells] for table in self.published])
        return np.where(np.isfinite(published).all(axis=0), published, model)

    def _model(self, ra: Float, dec: Float) -> Float:
        """Return the numbers of galaxies and stars per deg2, shape (2, n), from the tables of number counts.

        The density of galaxies is the same everywhere. The logarithm of that of stars is interpolated bilinearly in
        Galactic longitude and latitude.
        """
        lon, lat = sky.galactic(ra, dec)
        wrapped_lon = (lon + 180.0) % 360.0 - 180.0
        i = np.clip(np.searchsorted(self.lon, wrapped_lon, "right") - 1, 0, self.lon.size - 2)
        j = np.clip(np.searchsorted(self.lat, lat, "right") - 1, 0, self.lat.size - 2)
        s = (wrapped_lon - self.lon[i]) / (self.lon[i + 1] - self.lon[i])
        t = (lat - self.lat[j]) / (self.lat[j + 1] - self.lat[j])
        low = (1 - s) * self.stars[i, j] + s * self.stars[i + 1, j]
        high = (1 - s) * self.stars[i, j + 1] + s * self.stars[i + 1, j + 1]
        return np.stack([np.full(lon.shape, self.galaxies), np.exp((1 - t) * low + t * high)])


def euclid_limit(universe: Universe) -> float:
    """Return the limit in I_E above which there are as many galaxies as above the magnitude limit of a request.

    The limit of the request applies to its band `galaxy_band`. Both are AB magnitudes. The error is about 0.1 mag for
    I_E from 22 to 25.
    """
    if universe.galaxy_band not in passbands.names():
        # Catalogues of the user may have any band.
        return universe.galaxy_limit
    band = passbands.load(universe.galaxy_band)
    wavelength = float(np.average(band.wavelength, weights=band.response))
    equal = np.array([np.interp(wavelength, _WAVELENGTHS, limits) for limits in _EQUAL_LIMITS.values()])
    # Interpolate between the two nearest limits, or extrapolate from them.
    i = int(np.clip(np.searchsorted(equal, universe.galaxy_limit) - 1, 0, len(equal) - 2))
    (first, last), (in_first, in_last) = equal[i : i + 2], list(_EQUAL_LIMITS)[i : i + 2]
    return float(in_first + (universe.galaxy_limit - first) * (in_last - in_first) / (last - first))


def _catalogue_density(version: Version) -> dict[int, float]:
    """Return the mean number of sources per deg2 by order-8 HEALPix cell, for the cells that a catalogue covers.

    A file of the catalogue contains one HEALPix cell of order 8 or less; all order-8 cells in it get the mean of the
    file. Raises BadInput if a file lists an order-8 cell that is outside its own cell.
    """
    density: dict[int, float] = {}
    for part in version.manifest["parts"]:
        cells = part["facts"]["generation_cells"]
        order, file = layout.cell_of_file(part["name"])
        if any(cell >> 2 * (GENERATION_ORDER - order) != file for cell in cells):
            raise BadInput(f"table {version.table}: part {part['name']} lists cells that are not in its file")
        mean = version.partition_rows(part["name"]) / (len(cells) * sky.cell_area(GENERATION_ORDER))
        density.update(dict.fromkeys(cells, mean))
    return density
