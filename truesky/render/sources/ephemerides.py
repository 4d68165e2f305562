"""Moving bodies of the user's own, in place of the embedded population.

Bodies, read   a table of where they are on which date, how they move, how bright they are
check          that planned exposures are of its days

A table : Parquet, CSV or FITS with the columns of KEYS, one row a body and day: mjd (UTC), ecliptic longitude and
          latitude then (deg, mean equinox J2000), motion to the east and north along them (arcsec / h), I_E (AB).
          An exposure sees the rows of the day that it begins on. Where there is a column `name` (texts or whole
          numbers), each row has one, and none stands twice on a day: whoever has an ephemeris by the hour wants one
          row of each day. Other columns are left alone.
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

# Columns, and the smallest and largest value of each. A day has to fit into an identifier.
KEYS = {
    "mjd": (0.0, 2.0**18 - 1.0),
    "lon": (-360.0, 720.0),
    "lat": (-90.0, 90.0),
    "east": (-1e5, 1e5),
    "north": (-1e5, 1e5),
    "mag": (-30.0, 60.0),
}
_NAME = "name"
# Every worker holds the table, within the memory of its task (2 GB): 0.2 kB a row, 0.3 kB while it is read.
_MOST_ROWS = 1 << 21


@dataclass(frozen=True, slots=True)
class Bodies:
    """Rows of a table by the day, int64[n], MJD, that they are of."""

    day: Int
    rows: Population

    def on_day(self, day: int) -> Population:
        """Those of one day."""
        return self.rows.take(self.day == day)


@lru_cache(maxsize=2)
def read(file: Path, sha256: str) -> Bodies:
    """A table of bodies; BadInput names the file, and the column and row that is wrong.  sha256 : of the file."""
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
    """Refuse a table that has nothing of any exposure's day; mjd : of their starts."""
    days = sorted({int(np.floor(start)) for start in mjd})
    if days and not np.isin(days, bodies.day).any():
        has = f"MJD {bodies.day.min()} to {bodies.day.max()}" if len(bodies.day) else "no day"
        raise BadInput(f"{file}: has bodies of {has}, the exposures begin on {days[0]} to {days[-1]}")


def _table(file: Path) -> tuple[dict[str, Float], pa.ChunkedArray | None]:
    """Columns of KEYS, and names where it has some."""
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
    """One row a name and day."""
    if (absent := pc.index(names, "").as_py()) >= 0:
        raise BadInput(f"{file}: {_NAME} of row {absent + 1} is missing")
    body = names.combine_chunks().dictionary_encode().indices.to_numpy()
    order = np.lexsort((body, day))
    same = np.flatnonzero((np.diff(body[order]) == 0) & (np.diff(day[order]) == 0))
    if len(same):
        # Sorting keeps the order of equals.
        row = int(order[same + 1].min())
        problem = (
            f"{_NAME} of row {row + 1} is {names[row].as_py()[:40]!r}, which has a row of MJD {day[row]} before it"
        )
        raise BadInput(f"{file}: {problem} ({len(same)} of {len(day)} rows like it)")
