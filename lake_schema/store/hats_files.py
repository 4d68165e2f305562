"""Write the files that turn a folder of Parquet files, one per HEALPix cell, into a HATS collection.

HATS is the format of partitioned catalogues that lsdb reads. The files of a version of a table are::

    <version>/collection.properties
    <version>/<table>/          hats.properties properties partition_info.csv skymap.fits dataset/{_metadata,...}
    <version>/<table>_margin/   the same without skymap.fits, for copies of the rows just outside each cell

The margin contains all rows within 10 arcsec of a cell, so that a cross-match loses no pairs at the edges of cells. A
table whose rows are pixels of the sky is a HATS map. It has no margin, and no collection.properties, because a
collection must not have a map as its primary catalogue.
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
# HEALPix order of the cells that form the margin. They are 26 arcsec wide, so one ring of them around a cell contains
# all positions within 10 arcsec of the cell.
_MARGIN_ORDER = 13
# HEALPix order of the map of source counts in skymap.fits.
_SKYMAP_ORDER = 8
# Largest number of files whose footers are merged into the file `_metadata`; beyond it, the file would be too large.
_MAX_FILES_IN_METADATA = 1000
# Date in the properties files, which must contain one. It is fixed, so that equal tables give equal files.
_DATE = "2000-01-01T00:00UTC"

Cell = tuple[int, int]  # HEALPix order, and number of the nested cell.


def border_rows(rows: pa.Table, partition: str) -> pa.Table:
    """Return the rows of a partition near the edge of its HEALPix cell, which the margins of other cells may contain.

    They lie in the order-13 cells (26 arcsec wide) along the inner edge. `partition` is the path of the file, which
    contains the order and number of the cell.
    """
    order, cell = layout.cell_of_file(partition)
    fine = sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, _MARGIN_ORDER)
    return rows.filter(pa.array(np.isin(fine, sky.border_cells(order, cell, _MARGIN_ORDER))))


def write_metadata(version: Path, table: Table, receipts: Sequence[Json], borders: Path) -> None:
    """Write the margin and the HATS metadata of a catalogue whose Parquet files are in `version`/<table>/dataset.

    Parameters
    ----------
    version : Path
        Folder of the version, which need not be published yet.
    table : Table
        Declaration of the table.
    receipts : sequence of mapping
        Receipts (JSON records of files and rows) of all partitions, one per HEALPix cell.
    borders : Path
        Folder with the files of rows near the edges of the cells, see `border_rows`.
    """
    cells = [layout.cell_of_file(receipt["part"]) for receipt in receipts]
    root, margin = version / table.name, version / f"{table.name}_margin"
    counts = _count_rows_per_cell(version, [receipt["files"][0] for receipt in receipts])
    _write_catalogue(root, table, cells, sum(receipt["rows"] for receipt in receipts), counts)
    if table.pixel_order is not None:
        return
    borders_by_cell = {cell: receipt["border"] for cell, receipt in zip(cells, receipts, strict=True)}
    margin_rows = _write_margin(margin, table, borders, borders_by_cell)
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
        "healpix_column": "_healpix_29",
        "healpix_order": sky.MAX_ORDER,
        "npix_suffix": ".parquet",
    }
    if table.pixel_order is None:
        facts |= {"ra_column": "ra", "dec_column": "dec"}
    if counts is None:
        facts |= {"catalog_name": f"{table.name}_margin", "catalog_type": "margin"}
        facts |= {"primary_catalog": f"../{table.name}", "margin_threshold": MARGIN_ARCSEC}
    else:
        write_fits_image(counts, get_skymap_file_pointer(root))
        kind = "object" if table.pixel_order is None else "map"
        facts |= {"catalog_name": table.name, "catalog_type": kind, "skymap_order": _SKYMAP_ORDER}
    provenance = TableProperties.new_provenance_dict(root, builder="truesky")
    provenance["hats_creation_date"] = _DATE
    # Remove the estimated size of the catalogue, which depends on the length of its path: equal tables must give equal
    # files.
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
