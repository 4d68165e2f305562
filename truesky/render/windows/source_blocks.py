"""Read the sources around windows from a catalogue in blocks of sky, which are kept for the windows that follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.store import read
from truesky.render.sources import catalogue_rows
from truesky.render.sources.catalogue_rows import BrightQuery

# Order of the HEALPix cells (0.9 arcmin) in which the rows around a window are selected.
READ_ORDER = 12
# Order of the HEALPix cells (3.4 arcmin) that are read together and kept, and the number of cells that are kept. A cell
# has about 1 MB at 27 mag.
_BLOCK_ORDER, _BLOCKS = 10, 128
# Order of the HEALPix cells (14 arcmin) whose windows share the bright sources around them, and the number of cells for
# which bright sources are kept.
_FAR_ORDER, _FAR_BLOCKS = 8, 8
Pair = tuple[pa.Table, pa.Table]


class SourceBlocks:
    """Sources of one catalogue with their fluxes, near given places.

    Parameters
    ----------
    catalogue, fluxes : Version
        Stored versions of a table of sources and of its table of fluxes.
    columns : sequence of str
        Columns of the catalogue that are read.
    """

    def __init__(self, catalogue: read.Version, fluxes: read.Version, columns: Sequence[str]) -> None:
        self._catalogue, self._fluxes, self._columns = catalogue, fluxes, tuple(columns)
        self._deflection = catalogue_rows.max_deflection(catalogue)
        self._block = lru_cache(maxsize=_BLOCKS)(self._read_block)
        self._far = lru_cache(maxsize=_FAR_BLOCKS)(self._read_far)

    def read(self, task: Mapping[str, Any], band: str, rings: Sequence[tuple[float, float]]) -> Pair:
        """Read at least all sources in a circle, and brighter sources around it, with their fluxes.

        Parameters
        ----------
        task : mapping
            `ra`, `dec` and `radius` (deg) of the circle.
        band : str
            Name of the band of the fluxes.
        rings : sequence of (float, float)
            Distance beyond the circle in arcsec, and the smallest flux in microjansky of the sources up to this
            distance; the flux is infinite to read none.

        Returns
        -------
        (pyarrow.Table, pyarrow.Table)
            Rows of the catalogue and of the fluxes, in the same order. Sources farther away than requested are
            included, because whole cells are read.
        """
        cells = sky.cells_in_cone(task["ra"], task["dec"], task["radius"] + self._deflection, READ_ORDER)
        blocks = np.unique(sky.parent(cells, READ_ORDER, _BLOCK_ORDER)).tolist()
        parts = []
        for block in blocks:
            rows, light, cell_of_row = self._block(band, block)
            inside = pa.array(np.isin(cell_of_row, cells))
            parts.append((rows.filter(inside), light.filter(inside)))
        rows, light = (pa.concat_tables(tables) for tables in zip(*parts, strict=True))
        (cell,) = sky.cell_at([task["ra"]], [task["dec"]], _FAR_ORDER).tolist()
        for bright_rows, bright_light in self._far(band, cell, task["radius"], tuple(rings)):
            new = pc.invert(pc.is_in(bright_rows["id"], rows["id"]))
            new_light = pc.invert(pc.is_in(bright_light["id"], light["id"]))
            rows = pa.concat_tables([rows, bright_rows.filter(new)])
            light = pa.concat_tables([light, bright_light.filter(new_light)])
        return rows, light

    def _read_block(self, band: str, block: int) -> tuple[pa.Table, pa.Table, Any]:
        """Return the rows of a cell of _BLOCK_ORDER, their fluxes, and their cells of READ_ORDER."""
        rows = self._catalogue.rows_in_cells([block], _BLOCK_ORDER, [*self._columns, "_healpix_29"])
        light = self._fluxes.rows_in_cells([block], _BLOCK_ORDER, ["id", f"f_nu_{band}"])
        if not rows["id"].equals(light["id"]):
            raise BadInput(
                f"tables {self._catalogue.table} and {self._fluxes.table}: the rows differ, compute the fluxes"
            )
        cell = sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, READ_ORDER)
        return rows.select(self._columns), light, cell

    def _read_far(self, band: str, cell: int, radius: float, rings: tuple[tuple[float, float], ...]) -> list[Pair]:
        """Return the bright sources around all windows in a cell of _FAR_ORDER, for each ring that has a limit."""
        ra, dec = sky.cell_centre(_FAR_ORDER, cell)
        task = {"ra": ra, "dec": dec, "radius": radius + sky.cell_radius(_FAR_ORDER)}
        queries = [BrightQuery(task, self._columns, band, limit, reach) for reach, limit in rings if np.isfinite(limit)]
        return catalogue_rows.read_bright(self._catalogue, self._fluxes, queries)
