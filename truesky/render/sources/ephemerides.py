"""Moving bodies from a user's table, which replace the embedded population.

A table is a Parquet, CSV or FITS file with the columns of KEYS and one row per body and day:

- mjd: date (UTC).
- lon, lat: ecliptic longitude and latitude at this date (deg, mean equinox J2000).
- east, north: motion in these directions (arcsec / h).
- mag: I_E (AB).

An exposure uses the rows of the day on which it begins. If there is a column `name` (texts or integers), each row must
have a name, and no name may occur twice on a day. From an hourly ephemeris, select one row per day. Other columns are
ignored.
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
from lake_schema.ids import GENERATION_ORDER, source_id
from lake_schema.sky.ecliptic import equatorial
from truesky.render.sources.solar_system import KIND, Population

# Smallest and largest value of each column. A day must fit into an identifier.
KEYS = {
    "mjd": (0.0, 2.0**18 - 1.0),
    "lon": (-360.0, 720.0),
    "lat": (-90.0, 90.0),
    "east": (-1e5, 1e5),
    "north": (-1e5, 1e5),
    "mag": (-30.0, 60.0),
}
_NAME = "name"
# Every worker stores the table within the memory of its task (2 GB): 0.2 kB per row, 0.3 kB while reading.
_MOST_ROWS = 1 << 21


@dataclass(frozen=True, slots=True)
class Bodies:
    """Moving bodies by day.

    Attributes
    ----------
    day : int array, shape (n,)
        MJD of each row.
    rows : Population
        Rows of the table.
    """

    day: Int
    rows: Population

    def on_day(self, day: int) -> Population:
        """Bodies of one day (MJD)."""
        return self.rows.take(self.day == day)


@lru_cache(maxsize=2)
def read(file: Path, sha256: str) -> Bodies:
    """Read and check a table of bodies; `sha256` is the checksum of the file.

    `external_rows` raises BadInput with the file, column and row of a wrong value.
    """
    values, names = _table(file)
    for key, bounds in KEYS.items():
        external_rows.check_bounds(file, key, values[key], bounds)
    day = np.floor(values["mjd"]).astype(np.int64)
    if names is not None:
        _refuse_duplicates(file, names, day)
    hour = 24.0 * (values["mjd"] - day - 0.5)
    cell = sky.cell_at(*equatorial(values["lon"], values["lat"]), GENERATION_ORDER)
    ids = source_id(KIND, cell, np.arange(len(day)), day)
    lon, lat, east, north, mag = (values[key] for key in ("lon", "lat", "east", "north", "mag"))
    return Bodies(day, Population(ids, lon, lat, east, north, mag, hour))


def check(bodies: Bodies, file: Path, mjd: Iterable[float]) -> None:
    """Refuse a table without bodies on the day of any exposure.

    Parameters
    ----------
    bodies : Bodies
        The bodies.
    file : Path
        Their file, for the message.
    mjd : iterable of float
        Starts of the exposures.

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
    """Columns of KEYS, and names if the table has a column for them."""
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
    """Raise BadInput if a name is missing, or occurs twice on a day."""
    if (absent := pc.index(names, "").as_py()) >= 0:
        raise BadInput(f"{file}: {_NAME} of row {absent + 1} is missing")
    body = names.combine_chunks().dictionary_encode().indices.to_numpy()
    order = np.lexsort((body, day))
    same = np.flatnonzero((np.diff(body[order]) == 0) & (np.diff(day[order]) == 0))
    if len(same):
        # Sorting is stable, so the second of two equal rows is reported.
        row = int(order[same + 1].min())
        problem = f"{_NAME} of row {row + 1} is {names[row].as_py()[:40]!r}, which already has a row for MJD {day[row]}"
        raise BadInput(f"{file}: {problem} ({len(same)} of {len(day)} rows like it)")
