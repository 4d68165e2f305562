"""Draw the quasars behind strong lenses, and their images.

Lenses are drawn as in `galaxies.strong_lenses`: a quasar is as likely within an Einstein radius of a lens as in any
other area of the same size. The images appear in addition to the quasar itself, which stays at its own place. Quasars
with a single image are left out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from lake_schema import ids
from lake_schema.arrays import Array
from lake_schema.tables.variability.lensed_images import LENSED_IMAGES
from truesky.catalogue.galaxies import strong_lenses
from truesky.catalogue.galaxies.strong_lenses import STRONG_LENS
from truesky.cosmology import Cosmology
from truesky.variability import lensed_rows
from truesky.variability.lensed_rows import PointSources

COLUMNS = (*strong_lenses.COLUMNS, "density_boost")
_QUASAR = 2
# Smallest Einstein radius, arcsec: images that are closer than twice this radius are one source for all cameras
# (assumed). The limit of `strong_lenses` is larger, because arcs must be resolved.
_LEAST_RADIUS = 0.1


def draw(cell: int, galaxies: pa.Table, seed: int, boost: float, cosmology: Cosmology) -> pa.Table:
    """Draw the images of lensed quasars in one order-8 cell.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    galaxies : Table
        Rows of table `galaxies` in the cell, with the columns COLUMNS.
    seed : int
        Seed of the request.
    boost : float
        Ratio of the drawn to the natural number density of strong lenses.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Table
        Rows of table `lensed_images`, sorted by position. Their lenses are in the cell, but images near its edge may
        be in the next cell.
    """
    columns = {name: galaxies[name].to_numpy() for name in COLUMNS}
    if not (columns["kind"] == _QUASAR).any():
        return LENSED_IMAGES.empty()
    law = replace(strong_lenses.laws(), least_radius=_LEAST_RADIUS)
    pairs = strong_lenses.draw_pairs(law, cosmology, columns, columns["kind"] == _QUASAR, boost, seed)
    systems = [strong_lenses.system_of_pair(law, columns, pair) for pair in pairs]
    lens, source = (np.array([getattr(pair, name) for pair in pairs], np.int64) for name in ("lens", "source"))
    lenses: dict[str, Array] = {
        "id": ids.hashed_id(STRONG_LENS, cell, np.array([pair.key for pair in pairs], np.uint64)),
        "lens_id": columns["id"][lens],
        "source_id": columns["id"][source],
        "density_boost": np.full(len(pairs), boost),
        "ra": columns["ra"][lens],
        "dec": columns["dec"][lens],
        "z_lens": columns["z_true"][lens],
        "z_source": columns["z_true"][source],
        "einstein_radius": np.array([ellipsoid.radius for ellipsoid, _ in systems], float),
        "axis_ratio": np.array([ellipsoid.axis_ratio for ellipsoid, _ in systems], float),
        "position_angle": np.array([ellipsoid.angle for ellipsoid, _ in systems], float),
        "source_east": np.array([disc.east for _, disc in systems], float),
        "source_north": np.array([disc.north for _, disc in systems], float),
    }
    # A quasar behind several lenses is one source.
    quasar = np.unique(source)
    centre = np.zeros(len(quasar))
    quasar_ids = columns["id"][quasar]
    quasars = PointSources(quasar_ids, quasar_ids, centre, centre, columns["density_boost"][quasar], {})
    rows = lensed_rows.image_rows(lenses, quasars, cosmology)
    return rows.filter(pa.array(rows["images"].to_numpy() > 1))
