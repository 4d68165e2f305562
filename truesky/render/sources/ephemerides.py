"""Read Solar System bodies from a user's table, which replace the random population of truesky.

The table is a Parquet, CSV or FITS file with the columns of KEYS and one row per body and day:

- mjd: date (MJD, UTC).
- lon, lat: ecliptic longitude and latitude at this date (deg, mean equinox J2000).
- east, north: motion along longitude (times the cosine of the latitude) and latitude (arcsec / h).
- mag: AB magnitude in the Euclid band I_E.

An exposure uses the rows of the UTC day on which it begins. If there is a column `name` (texts or integers), each row
must have a name, and no name may occur twice on a day. From an hourly ephemeris, select one row per day. Other columns
are ignored.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.external import rows as external_rows
from lake_schema.external.mistakes import find_out_of_bounds
from lake_schema.ids import GENERATION_ORDER, source_id
from lake_schema.sky.ecliptic import equatorial
from truesky.render.sources.solar_system import KIND, Population

# Smallest and largest allowed value of each column in a user's table of bodies. The largest MJD has 18 bits, as many as
# source identifiers have for the day.
KEYS = {
    "mjd": (0.0, 2.0**18 - 1.0),
    "lon": (-360.0, 720.0),
    "lat": (-90.0, 90.0),
    "east": (-1e5, 1e5),
    "north": (-1e5, 1e5),
    "mag": (-30.0, 60.0),
}
# Optional column of a user's table with the name of each Solar System body.
_NAME = "name"
# Largest number of rows in a user's table of bodies. Every worker keeps the table in its memory (2 GB), with 0.2 kB per
# row, and 0.3 kB while the table is read.
_MOST_ROWS = 1 << 21


@dataclass(frozen=True, slots=True)
class Bodies:
    """Solar System bodies of a user's table.

    Attributes
    ----------
    day : int array, shape (n,)
        UTC day of each row, as whole MJD.
    rows : Population
        Bodies in the order of the table; a body has one row per day.
    """

    day: Int
    rows: Population

    def on_day(self, day: int) -> Population:
        """Return the bodies that the table has for a day (whole MJD); there may be none."""
        return self.rows.take(self.day == day)


@lru_cache(maxsize=2)
def read(file: Path, sha256: str) -> Bodies:
    """Read and check a user's table of Solar System bodies.

    `sha256` is the checksum of the file, which selects the cached result; it is not checked. BadInput is raised if a
    column is missing, a value is out of bounds, there are more than 2^21 rows, or a name is missing or occurs twice on
    a day. It has one message for each column and kind of mistake, with the file, the column and the first row.
    """
    values, names = _table(file)
    mistakes = find_out_of_bounds(file, values, KEYS)
    day = np.floor(np.nan_to_num(values["mjd"])).astype(np.int64)
    if names is not None:
        try:
            _refuse_duplicates(file, names, day)
        except BadInput as error:
            mistakes.add(error)
    mistakes.refuse()
    hour = 24.0 * (values["mjd"] - day - 0.5)
    cell = sky.cell_at(*equatorial(values["lon"], values["lat"]), GENERATION_ORDER)
    ids = source_id(KIND, cell, np.arange(len(day)), day)
    lon, lat, east, north, mag = (values[key] for key in ("lon", "lat", "east", "north", "mag"))
    return Bodies(day, Population(ids, lon, lat, east, north, mag, hour))


def check(bodies: Bodies, file: Path, mjd: Iterable[float]) -> None:
    """Check that a table has bodies on at least one day on which an exposure begins.

    Parameters
    ----------
    bodies : Bodies
        The bodies of the table.
    file : Path
        File of the table, quoted in the error message.
    mjd : iterable of float
        Starts of the exposures (MJD); without exposures nothing is checked.

    Raises
    ------
    BadInput
        If no exposure begins on a day of the table.
    """
    days = sorted({int(np.floor(start)) for start in mjd})
    if days and not np.isin(days, bodies.day).any():
        has = f"MJD {bodies.day.min()} to {bodies.day.max()}" if len(bodies.day) else "no day"
        raise BadInput(f"{file}: has bodies of {has}, but the exposures begin on {days[0]} to {days[-1]}")


def _table(file: Path) -> tuple[dict[str, Float], pa.ChunkedArray | None]:
    """Read the columns `KEYS` of a table of bodies by name, and its column of names (None if it has none).

    Raises BadInput if the table has too many rows.
    """
    parts: dict[str, list[Float]] = {key: [np.zeros(0)] for key in KEYS}
    names, rows = [], 0
    for piece in external_rows.read_batches(file, list(KEYS), text_columns=[_NAME], kind="table of bodies"):
        rows += len(piece.columns["mjd"])
        if rows > _MOST_ROWS:
            raise BadInput(f"{file}: has more than {_MOST_ROWS} rows")
        for key, column in parts.items():
            column.append(np.asarray(piece.columns[key], float))
        if _NAME in piece.columns:
            names.append(pa.array(piece.columns[_NAME], pa.string()))
    return {key: np.concatenate(column) for key, column in parts.items()}, pa.chunked_array(names) if names else None


def _refuse_duplicates(file: Path, names: pa.ChunkedArray, day: Int) -> None:
    """Raise BadInput if a body in the table has no name, or if a name occurs twice on a day (whole MJD)."""
    if (absent := pc.index(names, "").as_py()) >= 0:
        raise BadInput(f"{file}: {_NAME} of row {absent + 1} is missing")
    body = names.combine_chunks().dictionary_encode().indices.to_numpy()
    order = np.lexsort((body, day))
    same = np.flatnonzero((np.diff(body[order]) == 0) & (np.diff(day[order]) == 0))
    if len(same):
        # Report the later of two rows with the same name and day; the sort is stable and keeps their order.
        row = int(order[same + 1].min())
        problem = f"{_NAME} of row {row + 1} is {names[row].as_py()[:40]!r}, which already has a row for MJD {day[row]}"
        raise BadInput(f"{file}: {problem} ({len(same)} of {len(day)} rows like it)")
