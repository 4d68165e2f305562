"""Convert a user's table of sources, which are added to images, to catalogue rows with fluxes.

The columns belong to the section `sources` of a request (module `given_sources`). `mag` is the AB magnitude in the
band of the image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import ids, sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from truesky.catalogue import given_sources, injected_rows
from truesky.catalogue.stars import stars as star_rows
from truesky.cosmology import Cosmology
from truesky.fluxes import integration, passbands, sources
from truesky.fluxes.libraries import templates
from truesky.fluxes.passbands import Passband
from truesky.request.files import UserSources

# Identifiers of added sources are in a cell that does not exist on the sky, so that no source of a lake has them.
_CELL = 12 * 4**GENERATION_ORDER
_Rows = tuple[pa.Table, pa.Table]


def rows(
    table: Any, band: str, flux_bands: Sequence[str], cosmology: Cosmology, first_number: int = 0
) -> tuple[_Rows, _Rows]:
    """Return the catalogue rows of added sources.

    Parameters
    ----------
    table : table, str, Path or mapping
        Sources with the columns of the section `sources` of a request, as in `injected_rows.read_rows`.
    band : str
        Passband of the magnitudes.
    flux_bands : sequence of str
        Passbands of the fluxes in the result.
    cosmology : Cosmology
        Parameters of the universe to which the sources are added.
    first_number : int
        Number of the first source in the identifiers.

    Returns
    -------
    (galaxies, galaxy_fluxes) : (pyarrow.Table, pyarrow.Table)
        Rows of the table `galaxies`, and their fluxes f_nu in microjansky in the bands.
    (stars, star_fluxes) : (pyarrow.Table, pyarrow.Table)
        The same for stars.

    Raises
    ------
    BadInput
        If a column is unknown or missing, or a value is out of range.
    """
    columns = given_sources.from_arrays(injected_rows.read_columns(table, "extra"), cosmology)
    user_sources = UserSources(None, None, band, 0.0)
    bands = [passbands.load(name) for name in flux_bands]
    return _galaxies(user_sources, columns, bands, cosmology, first_number), _stars(columns, band, bands, first_number)


def is_added(numbers: Int) -> Bool:
    """Return the mask of the identifiers [n] that `rows` gives to sources."""
    return np.asarray((numbers >> ids.BLOCK_BITS) & ((1 << 20) - 1) == _CELL)


def _galaxies(
    user_sources: UserSources,
    columns: given_sources.SourceColumns,
    bands: Sequence[Passband],
    cosmology: Cosmology,
    first: int,
) -> _Rows:
    model = given_sources.model(0, user_sources, columns, cosmology, None, 0.0)
    drawn = [GALAXIES.empty(), *(given_sources.galaxies(cell, columns, model) for cell in _cells(columns.galaxies))]
    drawn_rows = pa.concat_tables([each.select(drawn[0].column_names) for each in drawn])
    order = np.argsort(columns.galaxies["origin_id"], kind="stable")
    library = templates.galaxy_library()
    light = integration.galaxy_fluxes(sources.galaxies_from_table(drawn_rows, library), bands, library)
    return _give_identifiers(drawn_rows, light, bands, 0, order, first)


def _stars(columns: given_sources.SourceColumns, band: str, bands: Sequence[Passband], first: int) -> _Rows:
    model = star_rows.model(math.inf, math.inf, brown_dwarf_boost=0.0, catalogue=given_sources.stars(columns, band))
    dust = np.zeros(12, np.float32)
    drawn = [STARS.empty(), *(star_rows.draw(cell, 0, model, dust) for cell in _cells(columns.stars))]
    drawn_rows = pa.concat_tables([each.select(drawn[0].column_names) for each in drawn])
    order = np.argsort(columns.stars["origin_id"], kind="stable")
    library = templates.stellar_library()
    light = integration.star_fluxes(sources.stars_from_table(drawn_rows, library), bands, library)
    return _give_identifiers(drawn_rows, light, bands, 5, order, first)


def _cells(columns: Mapping[str, Any]) -> list[int]:
    positions = np.asarray(columns["index"], np.int64)
    return [int(cell) for cell in np.unique(sky.parent(positions, sky.MAX_ORDER, GENERATION_ORDER))]


def _give_identifiers(
    drawn_rows: pa.Table, light: Float, bands: Sequence[Passband], kind: int, order: Int, first: int
) -> _Rows:
    """Give sources, which are sorted by position, identifiers that count the rows of the user's table."""
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    numbers = pa.array((kind << 60) | (_CELL << ids.BLOCK_BITS) | (first + rank), pa.int64())
    drawn_rows = drawn_rows.set_column(drawn_rows.schema.get_field_index("id"), "id", numbers)
    fluxes = {f"f_nu_{band.name}": pa.array(light[:, k], pa.float32()) for k, band in enumerate(bands)}
    return drawn_rows, pa.table({"id": numbers, **fluxes})
