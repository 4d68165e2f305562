"""Read the sources of a lake together with their fluxes, a partition at a time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from lake_schema.errors import BadInput
from lake_schema.store import layout, read, request_links

# Table of the fluxes of each table of sources.
FLUXES = {"galaxies": "galaxy_fluxes", "stars": "star_fluxes"}


@dataclass(frozen=True, slots=True)
class Catalogue:
    """A table of sources in the lake, and the table of their fluxes, which has the same rows in the same order.

    Attributes
    ----------
    rows : read.Version
        Table `galaxies` or `stars`.
    fluxes : read.Version
        Table `galaxy_fluxes` or `star_fluxes`.
    bands : list of str
        Passbands of the fluxes that are read, such as "lsst_r".
    """

    rows: read.Version
    fluxes: read.Version
    bands: list[str]

    def read_partition(self, name: str) -> pa.Table:
        """Return the rows of a partition (file) of the sources, with the columns f_nu_<band> of all bands appended.

        Raises BadInput if the table of fluxes has other rows.
        """
        rows = self.rows.rows(partitions=[name])
        flux_rows = self.fluxes.rows(["id", *(f"f_nu_{band}" for band in self.bands)], [name])
        if not flux_rows["id"].equals(rows["id"]):
            raise BadInput(f"table {self.fluxes.table}: {name} must have the same rows as table {self.rows.table}")
        for band in self.bands:
            rows = rows.append_column(f"f_nu_{band}", flux_rows[f"f_nu_{band}"])
        return rows


def has_table(lake: Path, table: str, request: str | None) -> bool:
    """Return True if a lake has a table.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    table : str
        Name of the table.
    request : str or None
        Name of the request; None for the version that was published last.

    Returns
    -------
    bool
        True if the lake has the table, for the request if one is given.
    """
    key = (
        layout.current_key(lake, table)
        if request is None
        else request_links.linked_key(lake, request_links.check_request(lake, request), table)
    )
    return key is not None


def open_catalogue(lake: Path, table: str, request: str | None = None, beginning: str = "") -> Catalogue:
    """Open a table of sources and the table of their fluxes.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    table : str
        "galaxies" or "stars".
    request : str, optional
        Name of the request; None if the lake contains only one.
    beginning : str, optional
        Beginning of the names of the passbands that are read, such as "lsst_"; by default all are read.

    Returns
    -------
    Catalogue
        The opened tables.

    Raises
    ------
    BadInput
        If a table is missing, or the fluxes were computed from other sources.
    """
    rows = read.version(lake, table, request=request)
    fluxes = read.version(lake, FLUXES[table], request=request)
    if fluxes.manifest["facts"].get("input") != rows.key:
        raise BadInput(
            f"table {fluxes.table} was computed from another version of {rows.table}: run truesky fluxes first"
        )
    start = f"f_nu_{beginning}"
    bands = [name.removeprefix("f_nu_") for name in fluxes.schema.names if name.startswith(start)]
    return Catalogue(rows, fluxes, bands)
