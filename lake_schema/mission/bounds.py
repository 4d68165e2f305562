"""Allowed ranges of the parameters of the mission database (bounds.csv), and which are whole numbers (counts.csv)."""

from __future__ import annotations

import csv
import math
from fnmatch import fnmatchcase
from functools import cache
from importlib.resources import files

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.parameter import Parameter, convert

_WILDCARDS = frozenset("*?[")


@cache
def read_bounds() -> tuple[tuple[str, float, float, str], ...]:
    """Return the rows of bounds.csv: pattern of the names of parameters, lowest and highest value, and unit."""
    with (files("lake_schema.mission") / "bounds.csv").open(encoding="utf-8") as stream:
        return tuple((r["pattern"], float(r["lo"]), float(r["hi"]), r["unit"]) for r in csv.DictReader(stream))


@cache
def _read_counts() -> tuple[str, ...]:
    with (files("lake_schema.mission") / "counts.csv").open(encoding="utf-8") as stream:
        return tuple(row["pattern"] for row in csv.DictReader(stream))


def matches(key: str, pattern: str) -> bool:
    """Return True if the name of a parameter matches a pattern with *, ? or [...], as in fnmatch.

    Most patterns are a name, or end in a name after one *. They are compared directly, because compiling a regular
    expression for each pattern takes a tenth of a second.
    """
    if not _WILDCARDS.intersection(pattern):
        return key == pattern
    if pattern.startswith("*") and not _WILDCARDS.intersection(pattern[1:]):
        return key.endswith(pattern[1:])
    return fnmatchcase(key, pattern)


@cache
def bounds_of_parameter(key: str) -> tuple[tuple[float, float, str], ...]:
    """Return all allowed ranges of a parameter as tuples (lowest, highest, unit); its value must be in every range.

    The result is () if no pattern in bounds.csv matches the name `key`.
    """
    return tuple((lo, hi, unit) for pattern, lo, hi, unit in read_bounds() if matches(key, pattern))


@cache
def is_count(key: str) -> bool:
    """Return True if the parameter with the name `key` counts something, so that it must be a whole number."""
    return any(matches(key, pattern) for pattern in _read_counts())


def check_bounds(parameter: Parameter, key: str) -> None:
    """Raise an error if the value of a parameter is outside its allowed ranges.

    Parameters
    ----------
    parameter : Parameter
        Value and unit of the parameter.
    key : str
        Name of the parameter for which the ranges are declared: without the name of a detector or amplifier that
        `parameter.key` may contain, such as vis.gain for vis.gain@3-4.

    Raises
    ------
    BadInput
        If the value must be a whole number and is not, or the unit cannot be converted to the unit of a range.
    OutOfRange
        If the value is outside a range.
    """
    if is_count(key) and parameter.value % 1.0:
        raise BadInput(f"mission parameter {parameter.key} = {parameter.value:g} is not a whole number")
    for lo, hi, unit in bounds_of_parameter(key):
        value = convert(parameter.value, parameter.unit, unit, f"mission parameter {parameter.key}")
        # The conversion of a value at a limit to the unit of the limit may be rounded.
        tolerance = 0.0 if unit == parameter.unit else 1e-15
        if not (lo <= value <= hi or any(math.isclose(value, limit, rel_tol=tolerance) for limit in (lo, hi))):
            raise OutOfRange(f"mission parameter {parameter.key} [{unit}]", value, lo, hi)
