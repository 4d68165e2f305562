"""Write galaxies and stars in the format of Euclid's True Universe (lake_schema.external.euclid_catalogues).

Columns of galaxies are computed with the mapping `euclid` of ingest_formats.toml, applied backwards. truesky therefore
reads its own files without change. A column that the lake has no values for is NaN, the null value of FITS.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import __version__, user_files
from lake_schema.arrays import Array, Float
from lake_schema.columns import Table
from lake_schema.errors import BadInput
from lake_schema.external import euclid_catalogues
from lake_schema.fits import row_files
from lake_schema.fits.images import Card
from truesky.catalogue.exports import catalogues, fits_files
from truesky.catalogue.external import mapping
from truesky.catalogue.galaxies import lensing
from truesky.cosmology import FIDUCIAL
from truesky.fluxes.sources import column, determinant

FORMAT = "euclid"
# Properties of the mapping whose values are in other columns of table `galaxies`: `ra` and `dec` are true positions.
_COLUMNS = {
    "origin_id": "id", "halo": "halo_id", "ra": "ra_true", "dec": "dec_true", "ra_lensed": "ra", "dec_lensed": "dec",
}  # fmt: skip
# Kinds of galaxies in halos: central and satellite.
_KINDS = (0, 1)
# Number of rows that are converted at a time, which need 60 MB.
_BATCH = 1 << 16
_JY_PER_UJY = 1e-6
_Columns = dict[str, Array]


@dataclass(frozen=True, slots=True)
class Written:
    """Files of an exported catalogue.

    Attributes
    ----------
    files : list of Path
        Files in the order of the partitions.
    rows : int
        Number of rows in the files.
    left_out : int
        Number of rows of the lake that are not in the files, because the format has no place for sources of their kind.
    """

    files: list[Path]
    rows: int
    left_out: int


def write_galaxies(lake: Path, folder: Path, request: str | None = None) -> Written:
    """Write the galaxies in halos of a lake to a new folder, one file per partition.

    Quasars and galaxies beyond z = 6 are left out, because their magnitudes and templates have another meaning than the
    columns of the format, and so are strongly lensed galaxies, which need the table `strong_lenses`.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    folder : Path
        New folder, which appears when all files are complete.
    request : str, optional
        Name of the request to export; None if the lake contains only one.

    Returns
    -------
    Written
        Files and numbers of rows.

    Raises
    ------
    BadInput
        If a table is missing, fluxes belong to other rows, no galaxy is in a halo, or the folder exists.
    """
    return _write(lake, "galaxies", folder, request)


def write_stars(lake: Path, folder: Path, request: str | None = None) -> Written:
    """Write the stars of a lake to a new folder, one file per partition.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    folder : Path
        New folder, which appears when all files are complete.
    request : str, optional
        Name of the request to export; None if the lake contains only one.

    Returns
    -------
    Written
        Files and numbers of rows.

    Raises
    ------
    BadInput
        If a table is missing, fluxes belong to other rows, there are no stars, or the folder exists.
    """
    return _write(lake, "stars", folder, request)


def _write(lake: Path, table: str, folder: Path, request: str | None) -> Written:
    if folder.exists():
        raise BadInput(f"{user_files.format_path(folder)}: exists already; give the name of a new folder")
    catalogue = catalogues.open_catalogue(lake, table, request)
    is_galaxies = table == "galaxies"
    declared = euclid_catalogues.GALAXIES if is_galaxies else euclid_catalogues.STARS
    convert = galaxy_columns if is_galaxies else star_columns
    names, total = [], 0
    with user_files.create_folder(folder) as staged:
        for partition in catalogue.rows.partitions:
            rows = catalogue.read_partition(partition)
            if is_galaxies:
                rows = rows.filter(pc.is_in(rows["kind"], pa.array(_KINDS, rows["kind"].type)))
            if rows.num_rows:
                names.append(f"{fits_files.file_stem(f'euclid_{table}', partition)}.fits")
                total += row_files.write(staged / names[-1], declared, _batches(rows, convert), _cards(declared))
        if not total:
            what = "galaxies in halos (kinds 0 and 1)" if is_galaxies else "stars"
            raise BadInput(f"table {table} has no {what}")
    return Written([folder / name for name in names], total, catalogue.rows.num_rows - total)


def _batches(rows: pa.Table, convert: Callable[[pa.Table], _Columns]) -> Iterator[_Columns]:
    return (convert(rows.slice(start, _BATCH)) for start in range(0, rows.num_rows, _BATCH))


def _cards(declared: Table) -> tuple[Card, ...]:
    version = (("FITS_VER", "0.1", "version of the format"),) if declared is euclid_catalogues.GALAXIES else ()
    return (
        ("FITS_DEF", f"sim.{declared.name}", "format of Euclid's data model"),
        *version,
        ("CREATOR", f"truesky {__version__}", "program that wrote this file"),
    )


def galaxy_columns(rows: pa.Table) -> _Columns:
    """Return the values of Euclid's columns for galaxies in halos.

    Parameters
    ----------
    rows : Table
        Rows of table `galaxies` with kinds 0 and 1, with fluxes f_nu_<band> (microjansky) appended.

    Returns
    -------
    dict of str to array, shape (n,)
        Values by name of the column. Columns without values in truesky are missing.
    """
    lens = (column(rows, name) for name in ("kappa", "gamma1", "gamma2"))
    # The same limit as in the ingest, which divides by the magnification.
    magnification = 1.0 / np.maximum(np.abs(determinant(*lens)), lensing.settings().caustic)
    out: _Columns = {}
    for key, field in _fields().items():
        # SED_FRACTION_1 gives two properties, of which the first is its own value.
        if field.column not in out:
            values = _values(rows, _COLUMNS.get(key, key))
            out[field.column] = _invert(field, values * magnification if key.startswith("flux_") else values)
    return out | _fluxes(rows, "galaxy")


def star_columns(rows: pa.Table) -> _Columns:
    """Return the values of Euclid's columns for stars.

    Parameters
    ----------
    rows : Table
        Rows of table `stars`, with fluxes f_nu_<band> (microjansky) appended.

    Returns
    -------
    dict of str to array, shape (n,)
        Values by name of the column. Columns without values in truesky are missing.
    """
    names = {
        "SOURCE_ID": "id", "RA": "ra", "DEC": "dec", "DIST": "distance", "TU_MAG_H_2MASS": "mag_h",
        "SED_TEMPLATE": "sed", "AV": "a_v",
    }  # fmt: skip
    return {name: _values(rows, source) for name, source in names.items()} | _fluxes(rows, "star")


@lru_cache(maxsize=1)
def _fields() -> dict[str, mapping.Field]:
    """Return the entries of the mapping of the format, which do not depend on the cosmology."""
    return dict(mapping.galaxy_columns(FORMAT, {}, FIDUCIAL).fields)


def _values(rows: pa.Table, name: str) -> Array:
    """Return a column; floating-point numbers as float64 with NaN in place of null."""
    values = rows[name]
    return np.asarray((pc.cast(values, pa.float64()) if pa.types.is_floating(values.type) else values).to_numpy())


def _invert(field: mapping.Field, values: Array) -> Array:
    """Return the column of a file from which an entry of a mapping computes `values`.

    The entry must have one column, an optional scale and offset, and at most one function, 10^x or log10.
    """
    if field.scale == 1.0 and field.offset == 0.0 and not (field.power10 or field.log10):
        return values
    argument: Float = (values - field.offset) / field.scale
    with np.errstate(divide="ignore"):
        # A line without light has the logarithm -inf, of which 10^x is 0.
        argument = np.log10(argument) if field.power10 else argument
    return np.asarray(10.0**argument if field.log10 else argument)


def _fluxes(rows: pa.Table, kind: str) -> _Columns:
    """Return flux densities in jansky of the bands that the rows have; `kind` is "galaxy" or "star"."""
    return {
        euclid_catalogues.flux_column(band, kind): _JY_PER_UJY * column(rows, f"f_nu_{passband}")
        for band, passband in euclid_catalogues.BANDS.items()
        if f"f_nu_{passband}" in rows.column_names
    }
