"""Write the table `gaia` to a file with the column names of Gaia's archive, or of a reference catalogue for SCAMP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from lake_schema import sky, user_files
from lake_schema.columns import Table
from lake_schema.errors import BadInput
from lake_schema.fits.tables import table_to_fits
from lake_schema.store import read
from lake_schema.tables.gaia import EXPORT, EXPORT_DR3, PARAMETERS, VARIABLE_FLAG, with_variable_flag
from truesky.catalogue import parameters
from truesky.catalogue.exports import ldac
from truesky.catalogue.stars import gaia

RELEASES = {"dr2": EXPORT, "dr3": EXPORT_DR3}
FORMS = {"table": (".csv", ".fits"), "ldac": (".fits", ".cat", ".ldac")}
_MAS = np.pi / 180.0 / 3.6e6


def write(
    lake: Path, path: Path, declared: Table = EXPORT, form: str = "table", epoch: float | None = None,
    request: str | None = None,
) -> int:  # fmt: skip
    """Write the table `gaia` of a lake to a file; an existing file is replaced atomically.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    path : Path
        File to write. It must end in .csv or .fits for the form "table", and in .fits, .cat or .ldac for "ldac".
    declared : Table
        Columns to write with the form "table"; phot_variable_flag is added if the lake has variable stars.
    form : str
        "table" or "ldac" (FITS_LDAC for SCAMP).
    epoch : float, optional
        Year from 1900 to 2100 to which positions are moved with the measured proper motions; None for the epoch of the
        catalogue.
    request : str, optional
        Name of the request to export; None if the lake contains only one.

    Returns
    -------
    int
        Number of rows written.

    Raises
    ------
    BadInput
        If the ending of the file does not fit the form, the epoch is outside its range, or the table has no proper
        motions.
    """
    user_files.check_target(path, FORMS[form])
    if epoch is not None and not 1900.0 <= epoch <= 2100.0:
        raise BadInput(f"--epoch {epoch:g}: give a year from 1900 to 2100")
    version = read.version(lake, "gaia", request=request)
    if VARIABLE_FLAG.name in version.schema.names:
        declared = with_variable_flag(declared)
    tables = (_release_columns(version, partition, epoch) for partition in version.partitions)
    if form == "ldac":
        ldac.write(path, pa.concat_tables(list(tables)))
    elif path.suffix.lower() == ".fits":
        table_to_fits(path, pa.concat_tables([table.select(declared.names) for table in tables]), declared)
    else:
        with (
            user_files.replace_atomically(path) as temporary,
            csv.CSVWriter(temporary, declared.arrow_schema()) as writer,
        ):
            for table in tables:
                writer.write_table(_select_columns(table, declared))
    return version.num_rows


def _select_columns(rows: pa.Table, declared: Table) -> pa.Table:
    return declared.build({name: rows[name] for name in declared.names})


def _release_columns(version: read.Version, partition: str, epoch: float | None) -> pa.Table:
    """Return the rows of a partition with the columns of all Gaia releases that can be exported.

    Raises BadInput if the table has no proper motions.
    """
    rows = version.rows(partitions=[partition])
    if rows.num_rows and rows["ruwe"].null_count:
        raise BadInput("table gaia has no proper motions: it was built by an older version; run truesky gaia again")
    columns: dict[str, Any] = {name: rows[name] for name in rows.column_names}
    columns |= {"source_id": rows["id"], "bp_rp": pc.subtract(rows["phot_bp_mean_mag"], rows["phot_rp_mean_mag"])}
    catalogue_epoch = parameters.section("gaia.toml", "astrometry")["epoch"]
    columns["ref_epoch"] = pa.array(np.full(rows.num_rows, catalogue_epoch if epoch is None else epoch))
    if epoch is not None:
        columns["ra"], columns["dec"] = map(pa.array, _advance_positions(rows, epoch - catalogue_epoch))
    has_motion = pc.is_valid(rows["pmra"])
    columns |= _correlations(has_motion)
    for band, short in enumerate(("g", "bp", "rp")):
        name = f"phot_{short}_mean"
        flux = gaia.mean_flux(pc.fill_null(rows[f"{name}_mag"], np.nan).to_numpy(), band)
        error = flux / pc.fill_null(rows[f"{name}_flux_over_error"], np.nan).to_numpy()
        columns |= {
            f"{name}_flux": pa.array(flux, mask=np.isnan(flux)),
            f"{name}_flux_error": pa.array(error, mask=np.isnan(flux)),
        }
    columns["parallax_over_error"] = pc.divide(rows["parallax"], rows["parallax_error"]).cast(pa.float32())
    columns["pm"] = pc.sqrt(pc.add(pc.power(rows["pmra"], 2), pc.power(rows["pmdec"], 2))).cast(pa.float32())
    columns["astrometric_params_solved"] = pc.if_else(has_motion, 31, 3).cast(pa.int16())
    return pa.table(columns)


def _correlations(has_motion: pa.ChunkedArray) -> dict[str, Any]:
    """Return the columns with the correlations of the astrometric parameters.

    They are 0, because the errors are drawn independently. For stars without proper motions they are null, except for
    the correlation of ra and dec.
    """
    zero = pc.if_else(has_motion, pa.scalar(0.0, pa.float32()), pa.scalar(None, pa.float32()))
    pairs = [(first, second) for i, first in enumerate(PARAMETERS) for second in PARAMETERS[i + 1 :]]
    position = pa.array(np.zeros(len(has_motion), np.float32))
    return {f"{first}_{second}_corr": position if (first, second) == ("ra", "dec") else zero for first, second in pairs}


def _advance_positions(rows: pa.Table, years: float) -> tuple[Any, Any]:
    """Return ra and dec (deg) after `years` of the measured proper motion; unknown proper motions count as 0."""
    east, north = (_MAS * years * pc.fill_null(rows[name], 0.0).to_numpy() for name in ("pmra", "pmdec"))
    return sky.offset_positions(rows["ra"].to_numpy(), rows["dec"].to_numpy(), east, north)
