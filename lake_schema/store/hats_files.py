"""Write the files that turn a folder of cells into a HATS collection: metadata, margin and properties.

The files of a version are::

    <version>/collection.properties
    <version>/<table>/          hats.properties properties partition_info.csv skymap.fits dataset/{_metadata,...}
    <version>/<table>_margin/   the same for the rows within 10 arcsec outside each cell

With the margin, a cross-match loses no pairs at the edges of cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.arrays import Int
from lake_schema.columns import Table
from lake_schema.store import layout, parquet
from lake_schema.store.plan import Json

MARGIN_ARCSEC = 10.0
# Cells of order 13 are 26" wide, so a ring of them around a cell contains all positions within 10" of the cell.
_MARGIN_ORDER = 13
_SKYMAP_ORDER = 8
# With more files, the merged footers in `_metadata` would be too large to be useful.
_MAX_FILES_IN_METADATA = 1000
# The properties require a date; the current date would make equal lakes differ.
_DATE = "2000-01-01T00:00UTC"

Cell = tuple[int, int]  # order, nested cell


def border_rows(rows: pa.Table, partition: str) -> pa.Table:
    """Return the rows of a cell that the margins of other cells may need.

    They are stored with the receipts of the tasks until the margins are written.
    """
    order, cell = layout.cell_of_file(partition)
    fine = sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, _MARGIN_ORDER)
    return rows.filter(pa.array(np.isin(fine, sky.border_cells(order, cell, _MARGIN_ORDER))))


def write_metadata(version: Path, table: Table, receipts: Sequence[Json], borders: Path) -> None:
    """Write the metadata of a catalogue whose cells are in `version`/<table>/dataset.

    Parameters
    ----------
    version : Path
        Folder of the version, or of its stage.
    table : Table
        Declaration of the table.
    receipts : sequence of mapping
        Receipts of the cells.
    borders : Path
        Folder with the border rows of the cells.
    """
    cells = [layout.cell_of_file(receipt["part"]) for receipt in receipts]
    root, margin = version / table.name, version / f"{table.name}_margin"
    borders_by_cell = {cell: receipt["border"] for cell, receipt in zip(cells, receipts, strict=True)}
    margin_rows = _write_margin(margin, table, borders, borders_by_cell)
    counts = _count_rows_per_cell(version, [receipt["files"][0] for receipt in receipts])
    _write_catalogue(root, table, cells, sum(receipt["rows"] for receipt in receipts), counts)
    _write_catalogue(margin, table, cells, margin_rows, None)
    _write_collection(version, table)


def _write_margin(folder: Path, table: Table, borders: Path, borders_by_cell: Mapping[Cell, Json]) -> int:
    orders = sorted({order for order, _ in borders_by_cell})
    total = 0
    for order, cell in borders_by_cell:
        rim = sky.margin_cells(order, cell, _MARGIN_ORDER)
        neighbours = [(o, int(c)) for o in orders for c in np.unique(sky.parent(rim, _MARGIN_ORDER, o))]
        pieces = [
            _rows_in_cells(borders, borders_by_cell[other], rim) for other in neighbours if other in borders_by_cell
        ]
        rows = pa.concat_tables([table.empty(), *pieces]).sort_by([("_healpix_29", "ascending"), ("id", "ascending")])
        target = folder / "dataset" / layout.cell_file(order, cell)
        target.parent.mkdir(parents=True, exist_ok=True)
        parquet.write(target, rows, table)
        total += rows.num_rows
    return total


def _rows_in_cells(folder: Path, entry: Json, cells: Int) -> pa.Table:
    rows = parquet.read(folder, entry)
    fine = sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, _MARGIN_ORDER)
    return rows.filter(pa.array(np.isin(fine, cells)))


def _write_catalogue(root: Path, table: Table, cells: list[Cell], rows: int, counts: Int | None) -> None:
    from hats.catalog.dataset.table_properties import TableProperties
    from hats.catalog.partition_info import PartitionInfo
    from hats.io.file_io.file_io import write_fits_image
    from hats.io.parquet_metadata import write_parquet_metadata
    from hats.io.paths import get_skymap_file_pointer
    from hats.pixel_math.healpix_pixel import HealpixPixel

    write_parquet_metadata(root, create_metadata=len(cells) <= _MAX_FILES_IN_METADATA)
    PartitionInfo([HealpixPixel(order, cell) for order, cell in cells]).write_to_file(catalog_path=root)
    facts: dict[str, Any] = {
        "total_rows": rows,
        "ra_column": "ra",
        "dec_column": "dec",
        "healpix_column": "_healpix_29",
        "healpix_order": sky.MAX_ORDER,
        "npix_suffix": ".parquet",
    }
    if counts is None:
        facts |= {"catalog_name": f"{table.name}_margin", "catalog_type": "margin"}
        facts |= {"primary_catalog": f"../{table.name}", "margin_threshold": MARGIN_ARCSEC}
    else:
        write_fits_image(counts, get_skymap_file_pointer(root))
        facts |= {"catalog_name": table.name, "catalog_type": "object", "skymap_order": _SKYMAP_ORDER}
    provenance = TableProperties.new_provenance_dict(root, builder="truesky")
    provenance["hats_creation_date"] = _DATE
    # The estimated size depends on the length of the path, so equal lakes would differ.
    provenance.pop("hats_estsize", None)
    TableProperties(**facts, **provenance).to_properties_file(root)


def _count_rows_per_cell(folder: Path, entries: Sequence[Json]) -> Int:
    counts = np.zeros(12 << (2 * _SKYMAP_ORDER), np.int64)
    for entry in entries:
        index = parquet.read(folder, entry, ["_healpix_29"])["_healpix_29"].to_numpy()
        counts += np.bincount(sky.parent(index, sky.MAX_ORDER, _SKYMAP_ORDER), minlength=counts.size)
    return counts


def _write_collection(version: Path, table: Table) -> None:
    from hats.catalog.dataset.collection_properties import CollectionProperties

    margin = f"{table.name}_margin"
    provenance: dict[str, Any] = {"hats_builder": "truesky", "hats_creation_date": _DATE}
    CollectionProperties(
        obs_collection=table.name,
        hats_primary_table_url=table.name,
        all_margins=[margin],
        default_margin=margin,
        **provenance,
    ).to_properties_file(version)
