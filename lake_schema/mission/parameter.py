"""Parameters of the mission database (numbers with unit, status and source), and the reader of its CSV files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import TYPE_CHECKING, Protocol, TypeVar

from lake_schema.errors import BadInput
from lake_schema.tables import mission as table

if TYPE_CHECKING:
    import astropy.units as u

# Allowed statuses of a record: REQ (required), DES (designed), BLT (built), CBE (current best estimate) and SIM
# (simulated) (Serrano et al. 2024, the Mission Database).
STATUSES = tuple(code for code, _ in table.STATUSES)
# Allowed confidences of a record: "published" (read in its source), "quoted" (the source was not at hand), "derived"
# (computed from published values) and "assumed" (chosen for truesky).
CONFIDENCES = tuple(code for code, _ in table.CONFIDENCES)
# Names of the ground cameras in the database. A user can describe another camera in a folder of files.
CAMERAS = ("decam", "lsstcam", "megacam", "jpcam", "gpc1", "hsc")
# Names of Euclid's cameras; all other cameras are on the ground.
SPACE_CAMERAS = ("vis", "nisp")
SECTIONS = ("environment", "spacecraft", "vis", "nisp", *(f"ext_{camera}" for camera in CAMERAS), "survey")
_COLUMNS = ("key", "status", "value", "unit", "version", "valid_from", "confidence", "source")

# Largest number of characters of an entry in a CSV file of the database.
_MAX_LENGTH = 1000

# Units of the parameters in the package. Their texts are not parsed again, because importing astropy.units takes half a
# second.
_SHIPPED_UNITS = frozenset((
    "", "1 / (cm2 s)", "1 / (deg s)", "1 / electron", "1 / mm2", "1 / mm4", "1 / mm6", "1 / pix", "1 / s",
    "1 / yr", "K",
    "adu", "arcmin", "arcsec", "arcsec / h", "arcsec / mm", "arcsec / pix", "arcsec / um", "cm2", "d", "deg",
    "deg / s", "deg-2", "deg2", "dex", "dex / mag", "eV", "electron", "electron / (s pix)", "electron / adu",
    "electron / um", "erg / (s cm2)", "h", "km", "m", "m2", "mag", "mag / arcsec2", "mas", "mm", "mm / pix", "ms",
    "nm", "pix", "pix / electron", "s", "um", "um / pix", "yr",
))  # fmt: skip
# Factors of frequent conversions, as astropy computes them.
_FACTORS = {
    ("1 / (cm2 s)", "cm-2 s-1"): 1.0,
    ("arcmin", "deg"): 0.016666666666666666,
    ("cm2", "m2"): 0.0001,
    ("mm", "um"): 1000.0000000000001,
    ("ms", "s"): 0.001,
    ("um", "nm"): 999.9999999999999,
    ("um / pix", "mm / pix"): 0.001,
}

Identity = tuple[str, str, int, float]
Record = TypeVar("Record")


class MissionRecord(Protocol):
    """Attributes that both types of records in the mission database have: Parameter (a number) and Model (a file)."""

    @property
    def key(self) -> str: ...
    @property
    def status(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def valid_from(self) -> float | None: ...
    @property
    def confidence(self) -> str: ...
    @property
    def source(self) -> str: ...


@dataclass(frozen=True, slots=True)
class Parameter:
    """A record of the mission database for one value of a quantity, such as the gain of a camera.

    A quantity can have several records with different statuses, versions and dates. BadInput is raised if an attribute
    has a value that is not allowed.

    Attributes
    ----------
    key : str
        Name of the quantity, such as vis.gain.
    status : str
        REQ (required), DES (designed), BLT (built), CBE (current best estimate) or SIM (simulated).
    value : float
        Finite value in the unit `unit`.
    unit : str
        astropy unit string, "" for a pure number.
    version : int
        Version number of the record. If several records have the same status and date, the highest version is chosen.
    valid_from : float or None
        Date (MJD) from which the record is valid, None for always.
    confidence : str
        How far the value can be trusted: published, quoted, derived or assumed.
    source : str
        Reference for the value, not empty.
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
        check_record(self, where)
        if not math.isfinite(self.value):
            raise BadInput(f"{where}: value = {self.value} must be finite")
        _check_unit(self.unit, where)

    @property
    def identity(self) -> Identity:
        """Name, status, version and date of the record; no two records may have the same four values."""
        return record_identity(self)


def check_record(record: MissionRecord, where: str) -> None:
    """Raise BadInput if a record has an unknown status or confidence, a date that is not finite, or no source.

    `where` is the name of the record, with which the message begins.
    """
    if record.status not in STATUSES:
        raise BadInput(f"{where}: status is not one of {', '.join(STATUSES)}")
    if record.confidence not in CONFIDENCES:
        raise BadInput(f"{where}: confidence {record.confidence!r} is not one of {', '.join(CONFIDENCES)}")
    if record.valid_from is not None and not math.isfinite(record.valid_from):
        raise BadInput(f"{where}: valid_from = {record.valid_from} must be finite")
    if not record.source:
        raise BadInput(f"{where}: has no source")


def record_identity(record: MissionRecord) -> Identity:
    """Return name, status, version and date (MJD) of a record; the date is -inf if the record is always valid."""
    return record.key, record.status, record.version, -math.inf if record.valid_from is None else record.valid_from


@cache
def parse_unit(text: str, where: str = "mission", allowed: str = "") -> u.UnitBase:
    """Return the astropy unit for a unit string.

    Parameters
    ----------
    text : str
        The unit string.
    where : str, optional
        Name of the quantity, with which the error message begins.
    allowed : str, optional
        Words about the units that are allowed, for the error message.

    Returns
    -------
    Unit
        The unit.

    Raises
    ------
    BadInput
        If the string is not a unit, or is a logarithmic unit such as mag(um).
    """
    import astropy.units as u

    try:
        unit = u.Unit(text)
    except (ValueError, TypeError, ArithmeticError):
        raise BadInput(f"{where}: {text!r} is not a unit{f': the unit must be {allowed}' if allowed else ''}") from None
    if not isinstance(unit, u.UnitBase):
        # Refuse logarithmic units: astropy would convert a value in mag(um) to um without computing the power of ten.
        raise BadInput(f"{where}: {text!r} is a logarithmic or structured unit: use a linear unit, or mag")
    return unit


def _check_unit(text: str, where: str, allowed: str = "") -> None:
    """Raise BadInput, with the arguments of `parse_unit`, if a text is not a unit that it accepts."""
    if text not in _SHIPPED_UNITS:
        parse_unit(text, where, allowed)


@cache
def _conversion_factor(unit: str, to: str) -> float | None:
    """Return the factor that converts a value from `unit` to the unit `to`, or None if they cannot be converted."""
    if unit == to:
        return 1.0
    if (unit, to) in _FACTORS:
        return _FACTORS[unit, to]
    import astropy.units as u

    try:
        factor = float(parse_unit(unit).to(parse_unit(to)))
    except (u.UnitsError, ArithmeticError):
        # The factor of units such as km^999 exceeds the range of numbers.
        return None
    return factor if math.isfinite(factor) else None


def convert(value: float, unit: str, to: str, where: str) -> float:
    """Convert a value from one unit to another.

    Parameters
    ----------
    value : float
        The value.
    unit : str
        astropy unit string of `value`, "" for a pure number.
    to : str
        astropy unit string of the result.
    where : str
        Name of the quantity, with which the error message begins.

    Returns
    -------
    float
        The value in unit `to`.

    Raises
    ------
    BadInput
        If a unit is unknown or the units are not convertible.
    """
    allowed = f"{to} or a unit that converts to it" if to else "empty, for a number without a unit"
    if (unit, to) not in _FACTORS:
        _check_unit(unit, where, allowed)
        _check_unit(to, where)
    factor = _conversion_factor(unit, to)
    if factor is None:
        raise BadInput(f"{where}: the unit must be {allowed}, got {unit or 'no unit'}")
    return value * factor


def read(file: Traversable) -> tuple[Parameter, ...]:
    """Read the parameters in a CSV file of the mission database.

    Its columns must be key, status, value, unit, version, valid_from, confidence and source, in this order. BadInput is
    raised for other columns or a wrong line.
    """

    def make_parameter(row: Mapping[str, str], version: int, valid_from: float | None) -> Parameter:
        value = float(row["value"])
        return Parameter(
            row["key"], row["status"], value, row["unit"], version, valid_from, row["confidence"], row["source"] or ""
        )

    return tuple(read_records(file, _COLUMNS, make_parameter))


def read_records(
    file: Traversable,
    columns: Sequence[str],
    make_record: Callable[[Mapping[str, str], int, float | None], Record],
) -> Iterator[Record]:
    """Yield the records of a CSV file of the mission database, which must have exactly the given columns.

    Parameters
    ----------
    file : Traversable
        The file.
    columns : sequence of str
        Names of the columns in their order. They must include version and valid_from.
    make_record : callable
        Function of (row, version, valid_from) that returns a record. `row` maps column names to texts; the other two
        arguments are the values of these columns as int, and as float or None.

    Yields
    ------
    Parameter or Model
        Result of `make_record` for each line.

    Raises
    ------
    BadInput
        If the columns differ, or a line is wrong. The message names the file and the line, or the record if
        `make_record` raises the error.
    """
    try:
        lines = csv.DictReader(io.StringIO(file.read_text(encoding="utf-8"), newline=""))
        if tuple(lines.fieldnames or ()) != tuple(columns):
            raise BadInput(f"{file.name}: columns are not {', '.join(columns)}")
        for row in lines:
            if not all(_is_short_line(value) for value in row.values()):
                raise BadInput(f"{file.name} line {lines.line_num}: a text is too long or spans several lines")
            valid_from = float(row["valid_from"]) if row["valid_from"] else None
            yield make_record(row, int(row["version"]), valid_from)
    except UnicodeDecodeError as error:
        raise BadInput(f"{file.name}: {error}") from None
    except (ValueError, TypeError, csv.Error) as error:
        raise BadInput(f"{file.name} line {lines.line_num}: {error}") from None


def _is_short_line(value: object) -> bool:
    return value is None or (isinstance(value, str) and value.isprintable() and len(value) <= _MAX_LENGTH)


@cache
def read_all_parameters() -> tuple[Parameter, ...]:
    """Return the records of all parameters in the mission database of the package, with every status and date."""
    folder = files("lake_schema.mission")
    return tuple(record for section in SECTIONS for record in read(folder / f"{section}.csv"))
