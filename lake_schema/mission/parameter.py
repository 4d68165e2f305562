"""One record of the mission database, and the reader of its files.

Parameter     a value with its status, unit, version, validity and source
read          one CSV file -> records
read_all      every section of the package
read_table    a table of numbers that stands beside the records (zodiacal light, wavefront, solar spectrum)
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable

import astropy.units as u

from lake_schema.errors import BadInput

# As required, as designed, as built, current best estimate, as simulated (Serrano et al. 2024, the Mission
# Database).
STATUSES = ("REQ", "DES", "BLT", "CBE", "SIM")
# What a value rests on: read in its source, quoted without the source at hand, computed from published
# values, chosen here.
CONFIDENCES = ("published", "quoted", "derived", "assumed")
SECTIONS = ("environment", "spacecraft", "vis", "ext_lsstcam", "survey")
_COLUMNS = ("key", "status", "value", "unit", "version", "valid_from", "confidence", "source")


@dataclass(frozen=True, slots=True)
class Parameter:
    """One value of one quantity.

    unit       : astropy unit string, "" for a pure number
    valid_from : MJD from which the record holds, None = always
    """

    key: str
    status: str
    value: float
    unit: str
    version: int = 1
    valid_from: float | None = None
    confidence: str = "assumed"
    source: str = "assumed"

    def __post_init__(self) -> None:
        where = f"mission parameter {self.key} ({self.status})"
        if self.status not in STATUSES:
            raise BadInput(f"{where}: status is not one of {', '.join(STATUSES)}")
        if self.confidence not in CONFIDENCES:
            raise BadInput(f"{where}: confidence {self.confidence!r} is not one of {', '.join(CONFIDENCES)}")
        if not math.isfinite(self.value) or (self.valid_from is not None and not math.isfinite(self.valid_from)):
            raise BadInput(f"{where}: value = {self.value}, valid_from = {self.valid_from} must be finite")
        if not self.source:
            raise BadInput(f"{where}: has no source")
        parse_unit(self.unit, where)

    @property
    def identity(self) -> tuple[str, str, int, float]:
        """What no two records may share."""
        return self.key, self.status, self.version, -math.inf if self.valid_from is None else self.valid_from


def parse_unit(text: str, where: str) -> u.UnitBase:
    """A unit string -> astropy unit; BadInput names where it stands."""
    try:
        return u.Unit(text)
    except (ValueError, TypeError):
        raise BadInput(f"{where}: {text!r} is not a unit") from None


def convert(value: float, unit: str, to: str, where: str) -> float:
    """A value in one unit -> in another; BadInput names where they do not fit."""
    try:
        return float(parse_unit(unit, where).to(parse_unit(to, where), value))
    except u.UnitConversionError:
        raise BadInput(f"{where}: {unit or 'a pure number'} does not convert to {to or 'a pure number'}") from None


def read(file: Traversable) -> tuple[Parameter, ...]:
    """The records of a CSV file of exactly the columns _COLUMNS."""
    with file.open(encoding="utf-8") as stream:
        rows = csv.DictReader(stream)
        if tuple(rows.fieldnames or ()) != _COLUMNS:
            raise BadInput(f"{file.name}: columns are not {', '.join(_COLUMNS)}")
        return tuple(_record(row, f"{file.name} line {rows.line_num}") for row in rows)


def _record(row: dict[str, str], where: str) -> Parameter:
    try:
        valid_from = float(row["valid_from"]) if row["valid_from"] else None
        value, version = float(row["value"]), int(row["version"])
    except (ValueError, TypeError) as error:
        raise BadInput(f"{where}: {error}") from None
    return Parameter(
        row["key"],
        row["status"],
        value,
        row["unit"],
        version,
        valid_from,
        row["confidence"],
        row["source"] or "",
    )


@cache
def read_all() -> tuple[Parameter, ...]:
    """Every record of the package."""
    folder = files("lake_schema.mission")
    return tuple(record for section in SECTIONS for record in read(folder / f"{section}.csv"))


@cache
def read_table(name: str) -> tuple[tuple[float, ...], ...]:
    """A table of numbers of the package, header dropped, '#' lines are comments, a blank entry is NaN."""
    text = (files("lake_schema.mission") / f"{name}.csv").read_text(encoding="utf-8")
    rows = list(csv.reader(line for line in text.splitlines() if not line.startswith("#")))
    return tuple(tuple(float(entry) if entry else math.nan for entry in row) for row in rows[1:])
