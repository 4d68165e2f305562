"""A table with its units as a FITS binary table.

table_to_fits   an Arrow table -> a binary table, units and UCDs from the table's declaration
fits_unit       a unit as FITS spells it
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pyarrow as pa
from astropy import units
from astropy.io import fits

from lake_schema.arrays import Array
from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput
from lake_schema.fits import write

# What fits into the card of a column's name.
_LONGEST_NAME = 68
_TABLE_FORMATS = {
    "int64": "K",
    "int32": "J",
    "int16": "I",
    "int8": "I",
    "float64": "D",
    "float32": "E",
    "bool": "L",
}


def table_to_fits(path: Path, table: pa.Table, declared: Table) -> None:
    """Export rows of a declared table as a binary table extension; lists become arrays of variable length.

    table  : Arrow table with (some of) the declared columns; null becomes NaN, TNULL for integers, the byte 0 for
             booleans, "" for texts, an empty array for lists
    Errors : BadInput names a column whose name FITS cannot hold; ValueError or TypeError for such values
    """
    columns = [declared.column(name) for name in table.column_names]
    for column in columns:
        if not (column.name.isascii() and column.name.isprintable() and 0 < len(column.name) <= _LONGEST_NAME):
            raise BadInput(f"{path}: column {column.name!r} has a name that FITS cannot hold; give it another with AS")
    unit = fits.BinTableHDU.from_columns(
        [_fits_column(c, table.column(c.name)) for c in columns], name=declared.name.upper()
    )
    stored = unit.data.view(np.ndarray)
    for column in columns:
        if column.type == "bool":
            stored[column.name][table.column(column.name).is_null().to_numpy()] = 0
    for number, column in enumerate(columns, start=1):
        if column.ucd:
            unit.header[f"TUCD{number}"] = (column.ucd, "IVOA UCD")
    unit.header["TABLEVER"] = (declared.version, "version of the table's declaration")
    write.write_staged(path, fits.HDUList([fits.PrimaryHDU(), unit]))


def _fits_column(column: Column, values: pa.ChunkedArray) -> fits.Column:
    unit = {"unit": fits_unit(column.unit)} if column.unit else {}
    if column.type.startswith("list"):
        return _fits_lists(column, values, unit)
    if column.type == "string":
        texts = [value or "" for value in values.to_pylist()]
        width = max([1, *(len(text.encode()) for text in texts)])
        return fits.Column(column.name, f"{width}A", array=np.array(texts, dtype=f"U{width}"), **unit)
    code = _TABLE_FORMATS[column.type]
    if values.null_count == 0 or code in "DEL":
        filled = values.fill_null(False if code == "L" else float("nan")) if values.null_count else values
        return fits.Column(column.name, code, array=filled.to_numpy(), **unit)
    # FITS has no signed bytes: they are written as 16 bits.
    wide = values.cast(pa.int16()) if column.type == "int8" else values
    missing = _unused(wide.drop_null().to_numpy())
    return fits.Column(column.name, code, array=wide.fill_null(missing).to_numpy(), null=missing, **unit)


def _unused(values: Array) -> int:
    """The lowest number of an integer type that does not occur."""
    limits, seen = np.iinfo(values.dtype), np.unique(values)
    taken = np.flatnonzero(seen != limits.min + np.arange(seen.size))
    lowest = int(limits.min) + int(taken[0] if taken.size else seen.size)
    if lowest > limits.max:
        raise ValueError(f"every number of {values.dtype} occurs: none is left for what is missing")
    return lowest


def _fits_lists(column: Column, values: pa.ChunkedArray, unit: dict[str, str]) -> fits.Column:
    code = _TABLE_FORMATS[column.type.removeprefix("list<").removesuffix(">")]
    arrays = np.empty(len(values), object)
    for i, value in enumerate(values.to_pylist()):
        arrays[i] = np.array(value or [], fits.column.FITS2NUMPY[code])
    return fits.Column(column.name, f"P{code}()", array=arrays, **unit)


def fits_unit(text: str) -> str:
    """A unit as FITS spells it; one that it does not know, such as the electron, as it is."""
    try:
        units.Unit(text, format="fits")
    except ValueError:
        with contextlib.suppress(ValueError):
            return str(units.Unit(text).to_string("fits"))
    return text
