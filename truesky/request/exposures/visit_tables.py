"""Read a table of visits of the Rubin Observatory's scheduler (OpSim, rubin_scheduler): CSV, Parquet or SQLite.

A visit has one or more exposures (snaps) of the same field. `COLUMNS` lists the columns that are read; a table has many
others. The file is a table of visits if it is SQLite or Parquet, or if a CSV file has a column of `_KEY_COLUMNS`.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import user_files
from lake_schema.errors import BadInput, Mistakes
from lake_schema.external import rows as external_rows
from lake_schema.external.mistakes import find_out_of_bounds
from lake_schema.texts import spelling
from truesky.request import sky_notation
from truesky.request.exposures.pointing_tables import Row, Visit

# Columns of numbers that every table must have, with the smallest and largest allowed number.
BOUNDS: Mapping[str, tuple[float, float]] = {
    "observationStartMJD": sky_notation.MJD_LIMITS,
    "fieldRA": (0.0, 360.0),
    "fieldDec": sky_notation.DEC_LIMITS,
    "seeingFwhmEff": (0.1, 10.0),
    "airmass": (1.0, 3.0),
    "skyBrightness": (5.0, 35.0),
    "visitExposureTime": (0.1, 1e4),
    "numExposures": (1.0, 100.0),
}
# Columns of angles in degrees, of which a table must have the first or the second, with their limits.
ANGLES: Mapping[str, tuple[float, float]] = {
    "rotSkyPos": (-360.0, 360.0),
    "rotTelPos": (-360.0, 360.0),
    "paraAngle": (-360.0, 360.0),
}
# Further columns of numbers that are read if they exist, with their limits.
OPTIONAL: Mapping[str, tuple[float, float]] = {"visitTime": (0.1, 1e5)}
# Columns of texts that name the filter; a table must have one of them. Newer tables have the name of the physical
# filter, such as r_57, in `filter`, and its letter in `band`.
_FILTERS = ("band", "filter")
# Columns by which a CSV file is recognised as a table of visits.
_KEY_COLUMNS = frozenset({"observationStartMJD", "fieldRA", "fieldDec"})
_SQLITE, _PARQUET = (".db", ".sqlite", ".sqlite3"), (".parquet", ".parq")
_SQLITE_MAGIC, _HEADER_BYTES = b"SQLite format 3\0", 100
# Names of the table of visits in a SQLite file, now and in versions before 2020.
_TABLE_NAMES = ("observations", "SummaryAllProps")
_KIND = "table of visits"
_MAX_ROWS, _MAX_MISTAKES = 1_000_000, 20
# Seconds between the exposures of a visit if the table has no `visitTime`: time to read and to open the shutter.
_OVERHEAD_S = 2.0


def is_table_of_visits(path: Path) -> bool:
    """Return True if a file is a table of visits, from its ending or from the names of its columns (CSV).

    Raise BadInput if the file cannot be read.
    """
    if path.suffix.lower() in (*_SQLITE, *_PARQUET):
        return True
    with user_files.open_file(path, "catalogue") as stream:
        start = stream.read(1 << 16)
    lines = (line for line in start.decode("utf-8-sig", errors="replace").splitlines() if not line.startswith("#"))
    return bool(_KEY_COLUMNS & {name.strip().strip('"') for name in next(lines, "").split(",")})


def read(path: Path, bands: Sequence[str], image_type: str) -> list[Row]:
    """Read and check a table of visits.

    Parameters
    ----------
    path : Path
        The file.
    bands : sequence of str
        Passbands of the camera. A visit has the one that ends with "_" and the letter of its filter.
    image_type : str
        Image type of the exposures.

    Returns
    -------
    list of Row
        One row per visit, in the order of the file.

    Raises
    ------
    BadInput
        If the file is damaged, a column is missing, or a value is missing, wrong or out of range. There is one message
        for each column and kind of mistake.
    """
    columns, filters = _read_columns(path)
    names = _band_names(bands)
    count = len(filters)
    rows: list[Row] = []
    with Mistakes() as mistakes:
        for i in range(count):
            location = f"{user_files.format_path(path)} row {i + 1}"
            values = {name: float(numbers[i]) for name, numbers in columns.items() if not np.isnan(numbers[i])}
            rows.append(mistakes.read(_row, values, filters[i], names, location, image_type))
            if len(mistakes) >= _MAX_MISTAKES:
                break
    return rows


def _row(values: Mapping[str, float], filter_name: str, names: Mapping[str, str], location: str, kind: str) -> Row:
    band = names.get(filter_name) or names.get(filter_name.partition("_")[0])
    if band is None:
        allowed = spelling.choices(filter_name, sorted(name for name in names if len(name) == 1))
        raise BadInput(f"{location}: filter {filter_name!r} is unknown: {allowed}")
    if "rotSkyPos" not in values and "rotTelPos" not in values:
        raise BadInput(f"{location}: rotSkyPos and rotTelPos are empty: one of them must have a number")
    exposures, seconds = values["numExposures"], values["visitExposureTime"]
    if exposures != round(exposures):
        raise BadInput(f"{location}: numExposures = {exposures:g} is not a whole number")
    overhead = (values["visitTime"] - seconds) / exposures if "visitTime" in values else _OVERHEAD_S
    return Row(
        location=location,
        channel="EXT",
        camera="",
        band=band,
        image_type=kind,
        ra=values["fieldRA"] % 360.0,
        dec=values["fieldDec"],
        position_angle=None,
        mjd=values["observationStartMJD"],
        exposure_time_s=seconds / exposures,
        sky=None,
        seeing=None,
        zero_point=None,
        clouds=None,
        psf=None,
        grism_angle=None,
        detectors=(),
        visit=Visit(
            exposures=int(exposures),
            overhead_s=max(overhead, 0.0),
            seeing_eff=values["seeingFwhmEff"],
            airmass=values["airmass"],
            sky_brightness=values["skyBrightness"],
            rot_sky=values.get("rotSkyPos"),
            rot_tel=values.get("rotTelPos"),
            parallactic=values.get("paraAngle"),
        ),
    )


def _band_names(bands: Sequence[str]) -> dict[str, str]:
    """Return the passbands of a camera by letter ("r") and by name ("lsst_r")."""
    return {**{band.rpartition("_")[2]: band for band in bands}, **{band: band for band in bands}}


def _read_columns(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Read the columns of numbers, and the names of the filters, of a table of visits.

    Missing numbers are NaN in columns of angles, and refused in others.
    """
    table, names = _sqlite_columns(path) if path.suffix.lower() in _SQLITE else ("", _column_names(path))
    _refuse_missing(path, names)
    filter_column = next(name for name in _FILTERS if name in names)
    numbers = [*BOUNDS, *(name for name in (*ANGLES, *OPTIONAL) if name in names)]
    columns: dict[str, Any] = {name: [] for name in numbers}
    filters: list[str] = []
    batches = (
        _sqlite_batches(path, table, numbers, filter_column)
        if table
        else (batch.columns for batch in external_rows.read_batches(path, numbers, (), (filter_column,)))
    )
    for batch in batches:
        for name in numbers:
            columns[name].append(np.asarray(batch[name], float))
        filters += [str(text).strip() for text in batch[filter_column]]
        if len(filters) > _MAX_ROWS:
            raise BadInput(f"{user_files.format_path(path)}: more than {_MAX_ROWS} visits")
    if not filters:
        raise BadInput(f"{user_files.format_path(path)}: contains no visits")
    arrays = {name: np.concatenate(parts) for name, parts in columns.items()}
    find_out_of_bounds(path, {name: arrays[name] for name in BOUNDS}, BOUNDS).refuse()
    limits = {name: bound for name, bound in {**ANGLES, **OPTIONAL}.items() if name in arrays}
    filled = {name: np.where(np.isnan(arrays[name]), limits[name][1], arrays[name]) for name in limits}
    find_out_of_bounds(path, filled, limits).refuse()
    return arrays, filters


def _column_names(path: Path) -> list[str]:
    try:
        return external_rows.column_names(path)
    except BadInput as error:
        raise error.with_prefix(_KIND) from None


def _refuse_missing(path: Path, names: Sequence[str]) -> None:
    missing = [name for name in BOUNDS if name not in names]
    if not {"rotSkyPos", "rotTelPos"} & {*names}:
        missing.append("rotSkyPos or rotTelPos")
    if not {*_FILTERS} & {*names}:
        missing.append("filter")
    if missing:
        subject = f"column{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
        place = user_files.format_path(path)
        raise BadInput(f"{place}: {subject} {'are' if len(missing) > 1 else 'is'} missing from the table of visits")


def _connect(path: Path) -> sqlite3.Connection:
    with user_files.open_file(path, "catalogue") as stream:
        start = stream.read(_HEADER_BYTES)
        size = stream.seek(0, os.SEEK_END)
    if not start.startswith(_SQLITE_MAGIC) or len(start) < _HEADER_BYTES:
        raise BadInput(f"{user_files.format_path(path)}: is not a SQLite file")
    # SQLite reads missing pages at the end of a file that is opened as immutable as zeros.
    page = int.from_bytes(start[16:18], "big")
    expected = (65_536 if page == 1 else page) * int.from_bytes(start[28:32], "big")
    if size < expected:
        raise BadInput(f"{user_files.format_path(path)}: is damaged: it has {size} of {expected} bytes")
    connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    connection.execute("PRAGMA trusted_schema = OFF")
    return connection


def _sqlite_columns(path: Path) -> tuple[str, list[str]]:
    """Return the name of the table of visits in a SQLite file, and the names of its columns."""
    try:
        with closing(_connect(path)) as connection:
            tables = [
                str(name) for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            ]
            table = next((name for name in _TABLE_NAMES if name in tables), None)
            if table is None:
                raise BadInput(
                    f"{user_files.format_path(path)}: has no table {' or '.join(_TABLE_NAMES)}: it has "
                    f"{', '.join(tables[:5]) or 'no table'}"
                )
            return table, [str(row[1]) for row in connection.execute(f"PRAGMA table_info({table})")]
    except sqlite3.Error as error:
        raise BadInput(f"{user_files.format_path(path)}: {error}") from None


def _sqlite_batches(path: Path, table: str, numbers: Sequence[str], filter_column: str) -> Iterator[dict[str, Any]]:
    """Yield the columns of batches of rows of a table in a SQLite file, in the order of the file.

    Parameters
    ----------
    path : Path
        The file.
    table : str
        Name of the table.
    numbers : sequence of str
        Columns of numbers.
    filter_column : str
        Column with the name of the filter.

    Yields
    ------
    dict
        Lists of float by column of numbers, with NaN for missing numbers, and a list of str for the filter.
    """
    selected = ", ".join(f'"{name}"' for name in (*numbers, filter_column))
    try:
        with closing(_connect(path)) as connection:
            # The names are constants of this module, so that the statement cannot contain other text.
            cursor = connection.execute(f"SELECT {selected} FROM {table} ORDER BY rowid LIMIT {_MAX_ROWS + 1}")  # noqa: S608
            first_row = 1
            while batch := cursor.fetchmany(65_536):
                values = list(zip(*batch, strict=True))
                columns = {
                    name: _as_numbers(path, first_row, name, column)
                    for name, column in zip(numbers, values, strict=False)
                }
                yield {**columns, filter_column: ["" if text is None else str(text)[:64] for text in values[-1]]}
                first_row += len(batch)
    except sqlite3.Error as error:
        raise BadInput(f"{user_files.format_path(path)}: {error}") from None


def _as_numbers(path: Path, first_row: int, name: str, values: Sequence[object]) -> list[float]:
    numbers = []
    for row, value in enumerate(values, start=first_row):
        if value is not None and not isinstance(value, int | float):
            raise BadInput(
                f"{user_files.format_path(path)}: column {name} of row {row} is {str(value)[:40]!r}, no number"
            )
        numbers.append(np.nan if value is None else float(value))
    return numbers
