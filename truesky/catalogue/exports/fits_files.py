"""Write a table of sources as FITS files, one for each of its partitions, with units (TUNIT) and UCDs (TUCD)."""

from __future__ import annotations

from pathlib import Path

from lake_schema import tables
from lake_schema.columns import Table
from lake_schema.fits.tables import table_to_fits
from lake_schema.store import layout, read


def write(lake: Path, declared: Table, folder: Path, request: str | None = None) -> list[Path]:
    """Write all columns of a catalogue to FITS files; existing files are replaced atomically.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    declared : Table
        Declaration of a catalogue, of which each partition is a HEALPix cell, such as that of `galaxies`.
    folder : Path
        Folder to write to; it is created if it does not exist.
    request : str, optional
        Name of the request to export; None if the lake contains only one.

    Returns
    -------
    list of Path
        Files written.
    """
    version = read.version(lake, declared.name, request=request)
    # The table of the lake may have optional columns: the light curves of variable stars.
    declared = tables.find_table(declared.name, version.schema.names) or declared
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for partition in version.partitions:
        path = folder / f"{file_stem(declared.name, partition)}.fits"
        table_to_fits(path, version.rows(partitions=[partition]), declared)
        written.append(path)
    return written


def file_stem(name: str, partition: str) -> str:
    """Return the name, without its ending, of a file with the rows of a partition, such as "stars_nside8_nest_12"."""
    order, cell = layout.cell_of_file(partition)
    return f"{name}_nside{1 << order}_nest_{cell}"
