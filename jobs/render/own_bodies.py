"""Moving bodies of the user's own, in place of the embedded population.

Bodies, read   a table of where they are on which date, how they move, how bright they are
check          that planned exposures are of its days

A table : Parquet, CSV or FITS with the columns of KEYS, one row a body and day: mjd (UTC), ecliptic longitude and
          latitude then (deg, mean equinox J2000), motion to the east and north along them (arcsec / h), I_E (AB).
          An exposure sees the rows of the day that it begins on; other columns are left alone.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from jobs.render.moving import KIND, Population
from lake_schema import fits, sky
from lake_schema.ecliptic import equatorial
from lake_schema.errors import BadInput, Damaged
from lake_schema.ids import GENERATION_ORDER, source_id

Float = npt.NDArray[np.float64]

# Columns, and the smallest and largest value of each. A day has to fit into an identifier.
KEYS = {
    "mjd": (0.0, 2.0**18 - 1.0),
    "lon": (-360.0, 720.0),
    "lat": (-90.0, 90.0),
    "east": (-1e5, 1e5),
    "north": (-1e5, 1e5),
    "mag": (-30.0, 60.0),
}
# Every worker holds the table, within the memory of its task (2 GB): 0.2 kB a row, 0.3 kB while it is read.
_MOST_ROWS = 1 << 21


@dataclass(frozen=True, slots=True)
class Bodies:
    """Rows of a table by the day, int64[n], MJD, that they are of."""

    day: npt.NDArray[np.int64]
    rows: Population

    def of_day(self, day: int) -> Population:
        """Those of one day."""
        here = self.day == day
        return Population(*(getattr(self.rows, field.name)[here] for field in fields(Population)))


@lru_cache(maxsize=2)
def read(file: Path, sha256: str) -> Bodies:
    """A table of bodies; BadInput names the file, and the column and row that is wrong.  sha256 : of the file."""
    values = _bounded(file, _table(file))
    day = np.floor(values["mjd"]).astype(np.int64)
    hour = 24.0 * (values["mjd"] - day - 0.5)
    cell = sky.cell_of(*equatorial(values["lon"], values["lat"]), GENERATION_ORDER)
    ids = source_id(KIND, cell, np.arange(len(day)), day)
    lon, lat, east, north, mag = (values[key] for key in ("lon", "lat", "east", "north", "mag"))
    return Bodies(day, Population(ids, lon, lat, east, north, mag, hour))


def check(bodies: Bodies, file: Path, mjd: Iterable[float]) -> None:
    """Refuse a table that has nothing of any exposure's day; mjd : of their starts."""
    days = sorted({int(np.floor(start)) for start in mjd})
    if days and not np.isin(days, bodies.day).any():
        has = f"MJD {bodies.day.min()} to {bodies.day.max()}" if len(bodies.day) else "no day"
        raise BadInput(f"{file}: has bodies of {has}, the exposures begin on {days[0]} to {days[-1]}")


def _table(file: Path) -> dict[str, Float]:
    if not file.is_file():
        raise BadInput(f"{file}: no such file")
    try:
        start = _start(file)
        if start.startswith(b"SIMPLE"):
            found = fits.read_numbers(file)
            _complete(file, list(found))
            return {key: np.asarray(found[key], float) for key in KEYS}
        parquet = start.startswith(b"PAR1")
        _complete(file, pq.read_schema(file).names if parquet else _titles(file))
        table = _parquet(file) if parquet else _csv(file)
    except Damaged as error:
        raise BadInput(str(error)) from None
    except UnicodeDecodeError:
        raise BadInput(f"{file}: is neither Parquet nor FITS, nor CSV in UTF-8") from None
    except (pa.ArrowException, OSError, EOFError, zlib.error) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())}") from None
    return {key: _numbers(file, key, table[key]) for key in KEYS}


def _start(file: Path) -> bytes:
    """The first bytes, which tell the format; of a packed file those inside."""
    with file.open("rb") as stream:
        start = stream.read(6)
    if not start.startswith(b"\x1f\x8b"):
        return start
    with gzip.open(file) as stream:
        return stream.read(6)


def _titles(file: Path) -> list[str]:
    with pyarrow.csv.open_csv(file) as reader:
        return list(reader.schema.names)


def _parquet(file: Path) -> pa.Table:
    _few_enough(file, pq.read_metadata(file).num_rows)
    return pq.read_table(file, columns=list(KEYS))


def _csv(file: Path) -> pa.Table:
    """Block by block: what is too long is not read to its end."""
    wanted = pyarrow.csv.ConvertOptions(include_columns=list(KEYS), column_types=dict.fromkeys(KEYS, pa.float64()))
    blocks, rows = [], 0
    with pyarrow.csv.open_csv(file, convert_options=wanted) as reader:
        for block in reader:
            rows += len(block)
            _few_enough(file, rows)
            blocks.append(block)
        return pa.Table.from_batches(blocks, reader.schema)


def _few_enough(file: Path, rows: int) -> None:
    if rows > _MOST_ROWS:
        raise BadInput(f"{file}: has more than {_MOST_ROWS} rows")


def _complete(file: Path, titles: list[str]) -> None:
    """Refuse columns that are not there, or there twice."""
    if absent := [key for key in KEYS if key not in titles]:
        raise BadInput(f"{file}: has no column {', '.join(absent)}; it has {', '.join(titles)}")
    if twice := [key for key in KEYS if titles.count(key) > 1]:
        raise BadInput(f"{file}: has column {', '.join(twice)} more than once")


def _numbers(file: Path, key: str, column: pa.ChunkedArray) -> Float:
    if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
        raise BadInput(f"{file}: column {key} is of {column.type}, not of numbers")
    # A missing value is no number, which the bounds refuse.
    return np.asarray(column.cast(pa.float64()).to_numpy(), float)


def _bounded(file: Path, values: dict[str, Float]) -> dict[str, Float]:
    _few_enough(file, len(values["mjd"]))
    for key, (low, high) in KEYS.items():
        bad = ~((values[key] >= low) & (values[key] <= high))
        if bad.any():
            row = int(bad.argmax())
            rest = f" ({bad.sum()} of {len(bad)} rows like it)"
            raise BadInput(f"{file}: {key} of row {row + 1} is {values[key][row]:g}, not in [{low:g}, {high:g}]{rest}")
    return values
